"""Which logs: paths, patterns, and files that list them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from glob import glob
from pathlib import Path

from pipeline.errors import InputError

_WILD = frozenset("*?[")


def collect(named: Sequence[Path], manifests: Sequence[Path]) -> tuple[Path, ...]:
    """Every log once, in the order named; patterns stand for what they match, by name.

    manifests : text files with a path or a pattern a line, relative to the file; # begins a comment
    Raises InputError for a pattern that matches nothing and a manifest that cannot be read.
    """
    paths = list(_matched(named, "the command line"))
    for manifest in manifests:
        paths += _matched(_listed(manifest), str(manifest))
    if not paths:
        raise InputError("no log is named; name some, or a --manifest that does")
    first: dict[Path, Path] = {}
    for path in paths:
        first.setdefault(path.resolve(), path)
    return tuple(first.values())


def _listed(manifest: Path) -> list[Path]:
    try:
        lines = manifest.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not UTF-8 text"
        raise InputError(f"{manifest}: cannot be read ({reason}); --manifest takes a list of paths") from None
    words = [line.partition("#")[0].strip() for line in lines]
    return [manifest.parent / word for word in words if word]


def _matched(named: Iterable[Path], where: str) -> Iterable[Path]:
    """Paths with patterns replaced; a path that exists is taken as it is, whatever its letters."""
    for path in named:
        if path.exists() or not _WILD & set(str(path)):
            yield path
            continue
        found = sorted(glob(str(path), recursive=True))
        if not found:
            raise InputError(f"{path}: matches nothing; correct the pattern in {where}")
        yield from map(Path, found)
