"""Every key of the configuration tree, flat: its type, unit, range, default and description."""

from __future__ import annotations

import functools
import math
import re
from contextlib import suppress
from dataclasses import dataclass
from numbers import Real

import msgspec
from msgspec import inspect
from msgspec.structs import fields

from scanchain.errors import InputError, shown

Value = bool | int | float | str

_UNITS = {  # by the ending of a name; the first that fits
    "_m_s": "m/s", "_rad_s": "rad/s", "_m": "m", "_s": "s", "_rad": "rad", "_hz": "Hz", "_percent": "%",
    "_voxels": "voxels", "_keyframes": "keyframes",
}  # fmt: skip
_TRUTHS = {"true": True, "yes": True, "on": True, "1": True, "false": False, "no": False, "off": False, "0": False}
_OWN = "MODULE:CLASS"  # a user's own
LARGEST = 1e50  # largest number in settings, points or a graph: products of a few are still finite


@dataclass(frozen=True, slots=True)
class ConfigKey:
    """One leaf of the tree.

    name : with its section, ``matching.max_distance_m``
    kind : type of its values, with their limits
    default : before presets, files and flags
    range : its values as text
    description : what it sets, from the docstring of its section
    """

    name: str
    kind: object
    default: Value
    range: str
    description: str

    @property
    def unit(self) -> str:
        """Unit by the ending of the name, empty for counts, shares and words."""
        return next((unit for ending, unit in _UNITS.items() if self.name.endswith(ending)), "")

    def check(self, value: object, source: str, *, text: str = "") -> Value:
        """The value converted to the type of this key; ``source``, a file or a flag, is named in the error."""
        try:
            given = float(value) if isinstance(value, Real) and not isinstance(value, bool) else value
            converted: Value = msgspec.convert(given, self.kind, strict=not isinstance(given, float))
            return converted
        except (msgspec.ValidationError, OverflowError):  # the latter of an int of hundreds of digits
            subject = f"{source} is" if self.name in source else f"{source}: {self.name} is"
            unit = f", in {self.unit}" if self.unit else ""
            finite = ""
            if isinstance(value, float) and abs(value) > LARGEST:
                finite = " and finite" if math.isinf(value) else f" and at most {LARGEST:g}"
            message = f"{subject} {text or shown(value)}; it must be {self._demand}{finite}{unit}"
        raise InputError(message)

    def parse(self, text: str, source: str) -> Value:
        """The value that a flag's text stands for."""
        value: object = text
        if isinstance(self.default, bool):
            value = _TRUTHS.get(text.lower(), text)
        elif not isinstance(self.default, str):
            with suppress(ValueError):
                value = float(text)
        return self.check(value, source, text=repr(text) if value is text else text)

    @property
    def _demand(self) -> str:
        if isinstance(self.default, bool):
            return "true or false"
        if not isinstance(self.default, str):
            return f"a {self.range}"
        words, own, _ = self.range.partition(f" | {_OWN}")
        yours = f" or a class of yours, {_OWN}" if own else ""
        return words if words == "text" else f"one of {words.replace(' | ', ', ')}{yours}"


@functools.cache
def section_keys(section: type) -> tuple[ConfigKey, ...]:
    """The keys of one section, ``LocalMapConfig`` being that of ``local_map``, in the order of its fields."""
    name = "_".join(re.findall("[A-Z][a-z]*", section.__name__.removesuffix("Config"))).lower()
    lines = re.findall(r"^ *(\w+) : (.*(?:\n {8,}\S.*)*)", section.__doc__ or "", re.MULTILINE)
    descriptions = {leaf: " ".join(text.split()) for leaf, text in lines}
    return tuple(
        ConfigKey(f"{name}.{key.name}", key.type, key.default, _values(key.type), descriptions.get(key.name, ""))
        for key in fields(section)
    )


def _values(kind: object) -> str:
    match inspect.type_info(kind):
        case inspect.BoolType():
            return "true | false"
        case inspect.StrType():
            return "text"
        case inspect.LiteralType() as words:
            return " | ".join(map(str, words.values))
        case inspect.Metadata() as open_choice:
            return " | ".join((*(open_choice.extra or {})["choices"], _OWN))
        case (inspect.IntType() | inspect.FloatType()) as number:
            text = "whole number" if isinstance(number, inspect.IntType) else "number"
            if number.le is not None and number.le < LARGEST:
                return f"{text} from {number.gt or number.ge or 0:g} to {number.le:g}"
            if number.gt is not None:
                return f"{text} > {number.gt:g}"
            return text if number.ge in (None, -LARGEST) else f"{text} >= {number.ge:g}"
        case other:
            raise TypeError(f"configuration keys are bool, int, float, str or a choice, not {other}")
