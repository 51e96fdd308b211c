"""What can be compared: ours, the baselines, and whatever class a user brings; each with its settings."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from pipeline.baselines import BASELINES
from pipeline.errors import InputError
from pipeline.settings import Override, load_settings

OURS = ("plicp", "svd", "plicp+loops", "svd+loops")
_ON_REQUEST = ("svd+loops", "genz-icp-indoor", "genz-icp-kitti")
_BASE = "method"  # the key of a table that says what it is a variant of


class Method(Struct, frozen=True):
    """One row of a comparison.

    Attributes
    ----------
    name : what the tables call it
    base : one of OURS or BASELINES, or MODULE:CLASS with the verb of a Baseline (in 2D of points (N, 2) and poses
        (3, 3)), which is given the settings as keywords
    settings : as TOML holds them; for ours keys of the configuration by section
    """

    name: str
    base: str
    settings: dict[str, Any]

    @property
    def is_ours(self) -> bool:
        """Whether it is this project's."""
        return self.base in OURS


def default_names(dimension: int) -> tuple[str, ...]:
    """All that make sense for a log of this dimension."""
    ours = [name for name in OURS if name not in _ON_REQUEST]
    others = [
        name
        for name, entry in BASELINES.items()
        if name not in _ON_REQUEST and (dimension == 3 or entry.planar is not None)
    ]
    return (*ours, *others)


def resolve(
    names: Sequence[str], dimension: int, *, file: Path | None, overrides: Sequence[Override] = ()
) -> tuple[Method, ...]:
    """The methods of these names, settings checked.

    file : TOML, one table a method; a table of another name is a variant and says of what by ``method``
    overrides : keys of the configuration, for all of ours
    Raises InputError for a name or a key that there is not.
    """
    tables = {} if file is None else _tables(file)
    unused = [name for name in tables if name not in names]
    if unused:
        raise InputError(
            f"{file}: [{unused[0]}] is not among the methods: {', '.join(names)}; add it to --methods"
        )
    if len(set(names)) < len(names):
        raise InputError(f"--methods names one twice: {', '.join(names)}; name a variant in --settings instead")
    return tuple(_method(name, tables.get(name, {}), dimension, file, overrides) for name in names)


def _method(
    name: str, table: Mapping[str, Any], dimension: int, file: Path | None, overrides: Sequence[Override]
) -> Method:
    base, own = table.get(_BASE, name), {key: value for key, value in table.items() if key != _BASE}
    where = f"{file}: [{name}]"
    if base in OURS:
        return Method(name, base, _our_settings(base, own, dimension, where, overrides))
    if base in BASELINES:
        defaults = BASELINES[base].settings if dimension == 3 else BASELINES[base].planar
        if defaults is None:
            raise InputError(f"{name} is made for 3D clouds, the log is 2D; leave it out of --methods")
        try:
            settings = msgspec.convert(msgspec.to_builtins(defaults) | own, type(defaults))
        except msgspec.ValidationError as error:
            raise InputError(
                f"{where}: {error}; its keys are {', '.join(type(defaults).__struct_fields__)}"
            ) from None
        return Method(name, base, msgspec.to_builtins(settings))
    if isinstance(base, str) and base.count(":") == 1:
        return Method(name, base, own)
    known = ", ".join((*OURS, *BASELINES))
    raise InputError(
        f"there is no method {name!r}; choose among {known}, or say in --settings what [{name}] is a variant of"
    )


def _our_settings(
    base: str, own: Mapping[str, Any], dimension: int, where: str, overrides: Sequence[Override]
) -> dict[str, Any]:
    """The whole configuration of one of ours; no wheels unless they are asked for, since nobody else has them."""
    fixed = (
        Override("odometry.prior", "constant-velocity", "scanchain compare"),
        Override("matching.matcher", base.partition("+")[0], "scanchain compare"),
        Override("loops.enabled", str("+" in base).lower(), "scanchain compare"),
    )
    table = [
        Override(f"{section}.{key}", str(value), f"{where} {section}.{key}")
        for section, keys in own.items()
        for key, value in (keys.items() if isinstance(keys, dict) else (("", keys),))
    ]
    settings = load_settings(dimension, overrides=(*fixed, *table, *overrides))
    return msgspec.to_builtins(settings.config)


def _tables(file: Path) -> dict[str, dict[str, Any]]:
    try:
        tree = tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror}); --settings takes a TOML file") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: is not TOML: {' '.join(str(error).split())}") from None
    for name, table in tree.items():
        if not isinstance(table, dict):
            raise InputError(f"{file}: {name} is no table; write [METHOD] above the keys of a method")
    return tree
