"""Every key of the configuration tree, flat: its type, unit, range, default and description."""

from __future__ import annotations

import functools
import math
import re
from dataclasses import dataclass
from numbers import Real
from typing import Literal

from msgspec import inspect

from scanchain.errors import InputError, shown
from scanchain.plugins import is_class_name

Value = bool | int | float | str
Kind = Literal["bool", "int", "float", "choice", "str"]

_UNITS = {  # by the ending of a name; the first that fits
    "_m_s": "m/s", "_rad_s": "rad/s", "_m": "m", "_s": "s", "_rad": "rad", "_hz": "Hz", "_percent": "%",
    "_voxels": "voxels", "_keyframes": "keyframes",
}  # fmt: skip
_YES, _NO = ("true", "yes", "on", "1"), ("false", "no", "off", "0")
_LARGEST = 1e50  # beyond which products of a few numbers are infinite
_UNLIMITED = ("log.end_s", "log.max_range_m", "preprocess.max_range_m", "local_map.max_distance_m")  # take inf


@dataclass(frozen=True, slots=True)
class ConfigKey:
    """One leaf of the tree.

    Attributes
    ----------
    name : with its section, ``matching.max_distance_m``
    kind : what it holds
    default : before presets, files and flags
    low, high : limits of a number; ``low_is_allowed`` is False where it must be exceeded
    choices : what a choice offers; ``is_open`` where a user's class, MODULE:CLASS, may stand instead
    description : what it sets, from the docstring of its section
    """

    name: str
    kind: Kind
    default: Value
    low: float
    high: float
    low_is_allowed: bool
    choices: tuple[str, ...]
    is_open: bool
    description: str

    @property
    def unit(self) -> str:
        """Unit by the ending of the name, empty for counts, shares and words."""
        return next((unit for ending, unit in _UNITS.items() if self.name.endswith(ending)), "")

    @property
    def range(self) -> str:
        """Range of its values as text."""
        if self.kind == "choice":
            return " | ".join((*self.choices, "MODULE:CLASS") if self.is_open else self.choices)
        if self.kind in ("bool", "str"):
            return "true | false" if self.kind == "bool" else "text"
        whole = "whole number" if self.kind == "int" else "number"
        if math.isfinite(self.low) and math.isfinite(self.high):
            return f"{whole} from {self.low:g} to {self.high:g}"
        if math.isfinite(self.low):
            return f"{whole} {'>=' if self.low_is_allowed else '>'} {self.low:g}"
        return whole

    def check(self, value: object, source: str, *, text: str = "") -> Value:
        """The value as this key holds it; ``source``, a file or a flag, is named in the error."""
        parsed = self._word(value) if self.kind in ("bool", "choice", "str") else self._number(value)
        if parsed is None:
            subject = f"{source} is" if self.name in source else f"{source}: {self.name} is"
            unit = f", in {self.unit}" if self.unit else ""
            finite = ""
            if isinstance(value, float) and abs(value) > _LARGEST:
                finite = " and finite" if math.isinf(value) else f" and at most {_LARGEST:g}"
            raise InputError(f"{subject} {text or shown(value)}; it must be {self._demand}{finite}{unit}")
        return parsed

    def parse(self, text: str, source: str) -> Value:
        """The value that a flag's text stands for."""
        value: object = text
        if self.kind == "bool":
            value = True if text.lower() in _YES else False if text.lower() in _NO else text
        elif self.kind in ("int", "float"):
            try:
                value = float(text)
            except ValueError:
                value = text
        return self.check(value, source, text=repr(text) if value is text else text)

    @property
    def _demand(self) -> str:
        match self.kind:
            case "choice":
                own = " or a class of yours, MODULE:CLASS" if self.is_open else ""
                return f"one of {', '.join(self.choices)}{own}"
            case "bool":
                return "true or false"
            case "str":
                return "text"
            case _:
                return f"a {self.range}"

    def _word(self, value: object) -> Value | None:
        if self.kind == "bool":
            return value if isinstance(value, bool) else None
        if not isinstance(value, str):
            return None
        is_known = self.kind == "str" or value in self.choices or (self.is_open and is_class_name(value))
        return value if is_known else None

    def _number(self, value: object) -> Value | None:
        """The number if it is one and lies within the limits; −∞ and NaN never do, +∞ where it means no limit."""
        if isinstance(value, bool) or not isinstance(value, Real):
            return None
        try:
            number = float(value)
        except OverflowError:  # an int of hundreds of digits
            return None
        above = number >= self.low if self.low_is_allowed else number > self.low
        is_limited = math.isfinite(number) or self.name not in _UNLIMITED
        if not above or number > self.high or (abs(number) > _LARGEST and is_limited):
            return None
        return number if self.kind == "float" else int(number) if number.is_integer() else None


@functools.cache
def section_keys(section: type) -> tuple[ConfigKey, ...]:
    """The keys of one section, ``LocalMapConfig`` being that of ``local_map``, in the order of its fields."""
    tree = inspect.type_info(section)
    assert isinstance(tree, inspect.StructType)
    words = re.findall("[A-Z][a-z]*", section.__name__.removesuffix("Config"))
    descriptions = _descriptions(section.__doc__ or "")
    return tuple(
        _leaf(
            f"{'_'.join(words).lower()}.{field.name}", field.type, field.default, descriptions.get(field.name, "")
        )
        for field in tree.fields
    )


def _descriptions(docstring: str) -> dict[str, str]:
    """Descriptions by name, from the lines ``name : description`` of a docstring and those that continue them."""
    entries = re.findall(r"^ *(\w+) : (.*(?:\n {8,}\S.*)*)", docstring, re.MULTILINE)
    return {name: " ".join(text.split()) for name, text in entries}


def _leaf(name: str, kind: inspect.Type, default: Value, description: str) -> ConfigKey:
    low, high, low_is_allowed = -math.inf, math.inf, True
    choices: tuple[str, ...] = ()
    is_open = isinstance(kind, inspect.Metadata)
    match kind:
        case inspect.BoolType():
            word: Kind = "bool"
        case inspect.StrType():
            word = "str"
        case inspect.LiteralType():
            word, choices = "choice", tuple(str(value) for value in kind.values)
        case inspect.Metadata():
            word, choices = "choice", (kind.extra or {})["choices"]
        case inspect.IntType() | inspect.FloatType():
            word = "int" if isinstance(kind, inspect.IntType) else "float"
            low_is_allowed = kind.gt is None
            low = next((float(limit) for limit in (kind.gt, kind.ge) if limit is not None), low)
            high = float(kind.le) if kind.le is not None else high
        case _:
            raise TypeError(f"{name}: configuration keys are bool, int, float, str or a choice, not {kind}")
    return ConfigKey(name, word, default, low, high, low_is_allowed, choices, is_open, description)
