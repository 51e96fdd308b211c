"""Errors that a user can cause or meet, and the formatting of their messages: values, numbers, remedies."""

from __future__ import annotations

import errno
import math
import os
import re
import shutil
import textwrap
from collections.abc import Iterable

_OPTION = re.compile(r"scanchain [^;,()]*|--([a-z][\w.-]*\w)")  # commands stay, options become Python arguments
_KEYWORDS = {name: name for name in ("out", "config", "methods", "rpe")} | {
    "force": "force=True", "gt": "ground_truth", "max-gap": "max_gap_s", "start": "log__start_s",
    "end": "log__end_s", "every": "log__every", "topic": "log__topic",
}  # fmt: skip


class ScanchainError(Exception):
    """A run failed for a reason its message names: what, where, what to do. Exit code 1."""

    @property
    def text(self) -> str:
        """The message as the command line prints it."""
        return super().__str__()

    def __str__(self) -> str:
        """The message, options of the command line as arguments of Python."""
        return _OPTION.sub(_keyword, self.text)


class InputError(ScanchainError):
    """Bad input or arguments: the thing, its value, the limit, the remedy, on one line. Exit code 2."""


class OwnCodeError(InputError):
    """User-defined code raised an error, which is the cause, or returned something unexpected."""


class MissingExtraError(InputError):
    """A package of an optional extra is not installed."""

    def __init__(self, package: str, extra: str) -> None:
        super().__init__(f"{package} is not installed; install it with: pip install 'scanchain[{extra}]'")


class NotApplicableError(InputError):
    """A method needs what a log does not have."""


def _keyword(found: re.Match[str]) -> str:
    option: str = found[1] or ""
    return _KEYWORDS.get(option, option.replace(".", "__") if "." in option else found[0])


def shown(value: object) -> str:
    """A value as an error shows it: short ones as written, arrays and long ones by their kind."""
    shape = getattr(value, "shape", None)
    if isinstance(shape, tuple) and shape:
        return f"an array of the shape {shape}"
    text = repr(value)
    return text if len(text) <= 40 and text.isprintable() else f"a {type(value).__name__}"


def printable(text: str) -> str:
    """The text on one line; line breaks, terminal escapes and bidirectional marks are escaped as in Python."""
    return text if text.isprintable() else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def spelled(name: str) -> str:
    """A name as text; bytes in it that are not UTF-8 are written as numbers (x and two digits)."""
    return os.fsencode(name).decode("utf-8", "backslashreplace")


def one_line(error: BaseException) -> str:
    """Message of an error without line breaks; its type where it has none."""
    return " ".join(str(error).split()) or type(error).__name__


_REMEDIES = {
    errno.ENOSPC: "the disk is full; free some space on it, or write to another one",
    errno.EDQUOT: "the quota of the disk is used up; free some space on it, or write to another one",
    errno.EFBIG: "File too large: raise the limit of file sizes (ulimit -f), or write to another disk",
    errno.ENAMETOOLONG: "the name is longer than the file system takes (255 bytes per part); shorten it",
    errno.EROFS: "the file system is read-only; write to another one",
    errno.EACCES: "access is denied; check the permissions",
}


def remedy_of(error: OSError) -> str:
    """Remedy of a system error on one line; empty if none is known."""
    remedy = _REMEDIES.get(error.errno or 0, "")
    return f"{error.filename}: {remedy}" if error.filename and remedy else remedy


FIRST = 3  # number of lines shown of several of a kind
_LABEL = re.compile(r" *(\S+( \S+)* {2,}){1,2}| +")  # names before the text of a line
FREEDOM = ("degree of freedom", "degrees of freedom")


def counted(number: int, noun: str, plural: str = "") -> str:
    """A number and what it counts: "1 scan", "2,000 scans"; ``plural`` where that is not the noun and s."""
    return f"{number:,} {noun if number == 1 else plural or noun + 's'}"


def below(value: float) -> str:
    """A value that is below a limit, two digits rounded down, so that it never reads like the limit."""
    return f"{math.floor(100.0 * value) / 100.0:.2f}"


def at_most(value: float) -> str:
    """An upper bound, two significant digits, rounded up."""
    digits = 1 - math.floor(math.log10(value)) if value > 0.0 else 0
    return f"{math.ceil(value * 10.0**digits) / 10.0**digits:.{max(digits, 0)}f}"


def duration(time_s: float) -> str:
    """A time in the largest unit of which it is more than one."""
    for unit, seconds in (("years", 31_557_600.0), ("days", 86_400.0), ("h", 3600.0), ("min", 60.0)):
        if time_s > seconds:
            return f"{time_s / seconds:.1f} {unit}"
    return f"{time_s:.1f} s"


def folded(text: str) -> str:
    """Text wrapped to the width of the terminal, else 100; continuation lines are indented past the label."""
    wrapper = textwrap.TextWrapper(shutil.get_terminal_size((100, 25)).columns, break_long_words=False)
    wrapper.break_on_hyphens, folds = False, list[str]()
    for line in text.split("\n"):
        label = _LABEL.match(line)
        wrapper.subsequent_indent = " " * (label.end() + 2 * label[0].isspace() if label else 2)
        folds += wrapper.wrap(line) or [line]
    return "\n".join(folds)


def grouped(lines: Iterable[str]) -> list[str]:
    """The lines by order of their first; of those that differ only in numbers three, and the number of others."""
    kinds: dict[str, list[str]] = {}
    for line in lines:
        kinds.setdefault(re.sub(r"\d+", "#", line), []).append(line)
    result: list[str] = []
    for alike in kinds.values():
        result += alike[:FIRST]
        if len(alike) > FIRST:
            result[-1] += f" (and {len(alike) - FIRST:,} more like this)"
    return result
