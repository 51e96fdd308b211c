"""Methods that can be compared: ours, the baselines, and classes of the user; each with its settings."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from msgspec import Struct

from scanchain.baselines import BASELINES, Entry
from scanchain.comparison.evalio_pipelines import PIPELINES, entry_of
from scanchain.config import MATCHERS, Config
from scanchain.errors import InputError
from scanchain.plugins import is_class_name
from scanchain.registration import create_matcher
from scanchain.settings import Override, config_keys, leaves, load_settings, read_toml

_ANY = "matcher"  # ours with the matcher that the settings name
_VARIANTS = ("", "+loops", "+imu")  # of ours
OURS = tuple(f"{name}{variant}" for name in (*MATCHERS, _ANY) for variant in _VARIANTS)
_ON_REQUEST = ("kiss-slam", "genz-icp-indoor", "genz-icp-kitti", "open3d-multiscale")
COMMAND = "command"  # base of a method that is a command, and the key of its table
SCANS, POSES = "{scans}", "{poses}"  # in a command: the folder of PLY files, and the TUM file that it writes
_BASE = "method"  # the key of a table that names the method it is a variant of
_KINDS = ("matching.matcher", "loops.enabled", "odometry.imu")  # keys that distinguish our methods
_SECTIONS = Config.__struct_fields__
_SHARED = ("log", "maps", "recording", "outputs")  # sections of the configuration that no single method has


class Method(Struct, frozen=True):
    """One row of a comparison.

    base : one of OURS or BASELINES, ``evalio:NAME``, MODULE:CLASS with a method ``register(points, stamp_s,
        times_s)`` that returns the pose (in 2D of points (N, 2) and poses (3, 3)), which is given the settings as
        keywords, or COMMAND
    settings : as TOML holds them; for ours the configuration by section, except those that all methods share
    """

    name: str
    base: str
    settings: dict[str, Any]

    @property
    def is_ours(self) -> bool:
        """True for a method of this project."""
        return self.base in OURS


class Variation(NamedTuple):
    """A setting with another value, for all methods that have it; those without it are left out.

    key : of the configuration, or the last part of one, which is that of a method or of the log
    """

    key: str
    value: str

    @property
    def _keys(self) -> list[str]:
        """Keys of the configuration of that name: those of methods, or else of the log and the rest."""
        found = [key for key in config_keys() if self.key in (key, key.rpartition(".")[2])]
        return [key for key in found if key.partition(".")[0] not in _SHARED] or found

    @property
    def overrides(self) -> tuple[Override, ...]:
        """Keys and values for ours; none where only other methods have the key."""
        if len(self._keys) > 1:
            raise InputError(f"--vary {self.key}: there are several, {' and '.join(self._keys)}; give one of them")
        return tuple(Override(key, self.value, f"--vary {self.key}") for key in self._keys)

    @property
    def of_log(self) -> tuple[Override, ...]:
        """Keys and values for the log, and so for all methods."""
        return self.overrides if [key for key in self._keys if key.startswith("log.")] else ()

    def of(self, method: Method, dimension: int) -> Method | None:
        """The method with this setting, None for one that has no such key."""
        if method.is_ours or self.of_log:
            return method if self.overrides else None
        if self.key not in method.settings:
            return None
        try:
            value = tomllib.loads(f"value = {self.value}")["value"]
        except tomllib.TOMLDecodeError:
            value = self.value
        own = method.settings | {self.key: value}
        if (entry := entry_of(method.base)) is not None:
            own = _their_settings(entry, own, dimension, f"--vary {self.key}")
        return msgspec.structs.replace(method, settings=own)


def default_names(dimension: int, *, has_imu: bool = False) -> tuple[str, ...]:
    """Methods that apply to logs of this dimension, with or without an IMU."""
    others = [name for name, entry in BASELINES.items() if name not in _ON_REQUEST and has_imu >= entry.wants_imu]
    planar = [name for name in others if BASELINES[name].planar is not None]
    with_imu = ("plicp+imu",) if has_imu else ()
    return (*MATCHERS, "plicp+loops", *with_imu, *(others if dimension == 3 else planar))


def resolve(
    names: Sequence[str],
    dimension: int,
    *,
    file: Path | None,
    overrides: Sequence[Override] = (),
    matcher: str = "",
    variation: Variation | None = None,
) -> tuple[Method, ...]:
    """The methods of these names, settings checked.

    file : TOML, one table a method; a table of another name is a variant of the one that its key ``method`` names
    overrides : keys of the configuration, for all of ours; sections of it in ``file`` are ``shared_settings``
    matcher : one that is compared as well; ours with MODULE:CLASS are called CLASS, CLASS+loops and CLASS+imu
    variation : of those that have the setting, the others are left out
    Raises InputError for an unknown name or key.
    """
    tables = {name: table for name, table in _tables(file).items() if name not in _SECTIONS}
    names = [each for name in names for each in ([name] if name in tables else _spelled_out(name, dimension))]
    if matcher:
        is_class = is_class_name(matcher)
        own = matcher.rpartition(":")[2] if is_class else matcher
        if not {own + variant for variant in _VARIANTS} & set(names):
            names = [*names, own]
        for base in [_ANY + variant for variant in _VARIANTS] if is_class else []:
            name = base.replace(_ANY, own)
            if name in names:
                tables[name] = {_BASE: base, "matching": {"matcher": matcher}} | tables.get(name, {})
    unused = [name for name in tables if name not in names]
    if unused:
        raise InputError(
            f"{file}: [{unused[0]}] is not among the methods: {', '.join(names)}; add it to --methods"
        )
    if len(set(names)) < len(names):
        raise InputError(f"--methods names one twice: {', '.join(names)}; name a variant in --config instead")
    has_ours = any(str(tables.get(name, {}).get(_BASE, name)) in OURS for name in names)
    overrides = (*overrides, *(variation.overrides if variation and has_ours else ()))
    for override in overrides:
        if override.key in _KINDS:
            raise InputError(
                f"{override.flag} distinguishes plicp, svd, +loops and +imu; choose by --methods or --matcher"
            )
    ours = (shared_settings(file), overrides)
    methods = [_method(name, tables.get(name, {}), dimension, f"{file}: [{name}]", *ours) for name in names]
    varied = methods if variation is None else [variation.of(method, dimension) for method in methods]
    if variation is not None and not any(varied):
        raise InputError(f"--vary {variation.key}: none of {', '.join(names)} has such a setting")
    return tuple(filter(None, varied))


def shared_settings(file: Path | None) -> tuple[Override, ...]:
    """The keys that the sections of a file set for the log and all of ours, except those in _KINDS."""
    sections = {name: table for name, table in _tables(file).items() if name in _SECTIONS}
    return tuple(each for each in _overrides(sections, f"{file}:") if each.key not in _KINDS)


def _method(
    name: str,
    table: Mapping[str, Any],
    dimension: int,
    where: str,
    shared: Sequence[Override],
    overrides: Sequence[Override],
) -> Method:
    """The method of a name with its table, which ``where`` names in errors."""
    base, own = str(table.get(_BASE, name)), {key: value for key, value in table.items() if key != _BASE}
    if name.startswith("."):
        raise InputError(f"{name!r} cannot be a folder's name; let the method's begin with a letter")
    if COMMAND in own and _BASE not in table:
        if not (isinstance(own[COMMAND], str) and SCANS in own[COMMAND] and POSES in own[COMMAND]):
            raise InputError(
                f"{where} {COMMAND} is {own[COMMAND]!r}; wanted one in which {SCANS} stands for a folder of PLY "
                f"files, and {POSES} for the TUM file that it writes"
            )
        return Method(name, COMMAND, own)
    if base in OURS:
        own = _our_settings(base, _overrides(own, where), dimension, shared, overrides)
    elif (entry := entry_of(base)) is not None:
        own = _their_settings(entry, own, dimension, where)
    elif not is_class_name(base):
        known, word = (*OURS, *BASELINES, *PIPELINES), base.lower()
        near = [each for each in known if word in each] or difflib.get_close_matches(word, known) or known
        raise InputError(
            f"there is no method {base!r}; choose among {', '.join(near)}, or say in --config what [{name}] is a "
            "variant of"
        )
    return Method(name, base, own)


def _spelled_out(name: str, dimension: int) -> Sequence[str]:
    """The methods that a word stands for: kiss_icp for kiss-icp, open3d for all of Open3D's that apply."""
    word = name.lower().replace("_", "-")
    if is_class_name(name) or name in OURS:
        return [name]
    if word == "evalio":
        return PIPELINES
    return [
        each for each in default_names(dimension, has_imu=True) if word != each and each.startswith(f"{word}-")
    ] or [word if word in BASELINES else name]


def _their_settings(entry: Entry, own: Mapping[str, Any], dimension: int, where: str) -> dict[str, Any]:
    defaults = entry.planar if dimension == 2 and entry.planar is not None else entry.settings
    try:
        return msgspec.to_builtins(msgspec.convert(msgspec.to_builtins(defaults) | own, type(defaults)))
    except msgspec.ValidationError as error:
        keys = ", ".join(type(defaults).__struct_fields__)
        raise InputError(f"{where}: {error}; its keys are {keys}") from None


def _our_settings(
    base: str, own: Sequence[Override], dimension: int, shared: Sequence[Override], overrides: Sequence[Override]
) -> dict[str, Any]:
    """The configuration of one of ours; no wheels and IMU unless requested, since nobody else has them."""
    wheels = Override("odometry.prior", "constant-velocity", "scanchain compare")
    kind = {"loops.enabled": str("+loops" in base).lower(), "odometry.imu": str("+imu" in base).lower()}
    if base.partition("+")[0] != _ANY:
        kind["matching.matcher"] = base.partition("+")[0]
    for each in own:
        if each.key.partition(".")[0] in _SHARED:
            raise InputError(f"{each.flag} holds for all methods; give it as --{each.key}")
        if each.text.lower() != kind.get(each.key, each.text.lower()):
            raise InputError(f"{each.flag} is {each.text}, but {base} has {kind[each.key]}; choose another method")
    fixed = [Override(key, text, "scanchain compare") for key, text in kind.items()]
    config = load_settings(dimension, overrides=(wheels, *shared, *own, *overrides, *fixed)).config
    create_matcher(config.matching)  # raises InputError where a user's class cannot be loaded
    return {name: keys for name, keys in msgspec.to_builtins(config).items() if name not in _SHARED}


def _overrides(sections: Mapping[str, Any], where: str) -> list[Override]:
    """The keys of sections, or of what should have been some, as if set on the command line."""
    return [Override(key, str(value), f"{where} {key}") for key, value in leaves(sections)]


def _tables(file: Path | None) -> dict[str, dict[str, Any]]:
    tree = {} if file is None else read_toml(file)
    for name, table in tree.items():
        if not isinstance(table, dict):
            raise InputError(f"{file}: {name} is no table; write [METHOD] above the keys of a method")
    return tree
