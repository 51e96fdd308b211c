"""The effective configuration: defaults, then a preset, then a file, then flags."""

from __future__ import annotations

import difflib
import functools
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import tomli_w
from msgspec.structs import fields

from scanchain.config import Config
from scanchain.config_keys import ConfigKey, Value, section_keys
from scanchain.errors import InputError, one_line, shown

_ORDERED = (
    ("log.start_s", "log.end_s"),
    ("log.min_range_m", "log.max_range_m"),
    ("preprocess.min_range_m", "preprocess.max_range_m"),
    ("loops.min_radius_m", "loops.max_radius_m"),
    ("maps.slice_min_z_m", "maps.slice_max_z_m"),
)
PRESETS = {2: "lidar2d", 3: "lidar3d"}


@dataclass(frozen=True, slots=True)
class Override:
    """A key set on the command line; ``flag`` is how the user wrote it, for errors."""

    key: str
    text: str
    flag: str


def overrides_of(values: Mapping[str, object], section: str = "") -> tuple[Override, ...]:
    """Keyword arguments as overrides, two underscores for the dot: ``loops__drift=0.02``.

    section : that of the keys, if the arguments do not name it
    """
    named = {f"{section}.{name}" if section else name.replace("__", "."): value for name, value in values.items()}
    texts = {key: ",".join(map(str, value)) for key, value in named.items() if isinstance(value, list | tuple)}
    texts |= {key: str(value).lower() for key, value in named.items() if isinstance(value, bool)}
    return tuple(Override(key, texts.get(key, str(value)), f"--{key}") for key, value in named.items())


def named(overrides: Sequence[Override], key: str) -> str:
    """Text that flags set a key to, the last of several; empty where none does."""
    return next((change.text for change in reversed(overrides) if change.key == key), "")


@dataclass(frozen=True, slots=True)
class Settings:
    """A configuration.

    config : the whole tree
    source : where it came from, in words
    """

    config: Config
    source: str


@functools.cache
def config_keys() -> dict[str, ConfigKey]:
    """All keys by name, in the order of the tree."""
    return {key.name: key for field in fields(Config) for key in section_keys(field.type)}


def find_key(name: str, source: str) -> ConfigKey:
    """The key of that name; else the error names the nearest existing one."""
    keys = config_keys()
    if name in keys:
        return keys[name]
    same_leaf = [key for key in keys if key.rpartition(".")[2] == name.rpartition(".")[2]]
    near = difflib.get_close_matches(name, same_leaf or keys, n=1, cutoff=0.0 if same_leaf else 0.75)
    subject, flag = (source, "--") if source == f"--{name}" else (f"{source}: {name}", "")
    nearest = "".join(f"did you mean {flag}{key}? " for key in near)
    raise InputError(f"{subject} is not a configuration key; {nearest}all keys: scanchain config show")


def load_settings(
    dimension: int | None = None, *, file: Path | str | None = None, overrides: Sequence[Override] = ()
) -> Settings:
    """Defaults < the preset for logs of this dimension, if it is known < ``file`` < ``overrides``.

    Raises InputError naming the file or the flag, the key and its limits, or the nearest existing key.
    """
    if dimension is not None and not (isinstance(dimension, int) and dimension in PRESETS):
        raise InputError(f"dimension is {shown(dimension)}; it must be 2 (laser scans) or 3 (clouds)")
    source = "defaults" if dimension is None else f"preset {PRESETS[dimension]} of {dimension}D logs"
    values = dict(_preset_values(dimension))
    if file is not None:
        source += f", {file}"
        values |= read_layer(Path(file))
        if dimension is not None:
            remedy = f"scanchain config dump --lidar {dimension}d prints what they take"
            _check_dimension(values, dimension, str(file), remedy)
    for override in overrides:
        values[override.key] = find_key(override.key, override.flag).parse(override.text, override.flag)
    for key in dict.fromkeys(override.key for override in overrides):
        text = str(values[key])
        source += f", {key} {text.lower() if isinstance(values[key], bool) else text}"
    is_final = dimension is not None  # else a preset may still change all but log.*
    _check_order(values, source, [pair for pair in _ORDERED if is_final or pair[0].startswith("log.")])
    tree: dict[str, dict[str, Value]] = {field.name: {} for field in fields(Config)}
    for key, value in values.items():
        section, _, leaf = key.partition(".")
        tree[section][leaf] = value
    return Settings(msgspec.convert(tree, Config), source)


def read_toml(file: Path) -> dict[str, Any]:
    """The tree of a TOML file that a user named."""
    try:
        return tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror}); --config takes a TOML file") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        reason = one_line(error)
        raise InputError(f"{file}: is not TOML: {reason}; scanchain config dump prints one that is") from None


def read_layer(file: Path) -> dict[str, Value]:
    """The keys that a TOML file sets, checked one by one."""
    layer: dict[str, Value] = {}
    for name, value in leaves(read_toml(file)):
        key = find_key(name, str(file))
        layer[key.name] = key.check(value, str(file))
    return layer


def shipped(folder: str) -> Path:
    """A folder of files that come with the package: in it, or at the root of a checkout."""
    package = Path(__file__).resolve().parent
    for path in (package / folder, package.parents[1] / folder):
        if path.is_dir():
            return path
    raise InputError(f"{package / folder}: absent; install scanchain again")


def dump(config: Config) -> str:
    """The whole configuration as TOML; reading it back gives the same one."""
    return tomli_w.dumps(msgspec.to_builtins(config))


def flatten(config: Config) -> dict[str, Value]:
    """Every key with its value, in the order of the tree."""
    tree: dict[str, dict[str, Value]] = msgspec.to_builtins(config)
    return {f"{section}.{leaf}": value for section, branch in tree.items() for leaf, value in branch.items()}


def check_order(config: Config) -> None:
    """Refuse a configuration whose lower limits are not below the upper ones."""
    _check_order(flatten(config), "config", _ORDERED)


def check_dimension(config: Config, dimension: int) -> None:
    """Refuse a configuration made for logs of the other dimension."""
    _check_dimension(flatten(config), dimension, "config", f"start from load_settings({dimension}).config")


def _check_dimension(values: Mapping[str, Value], dimension: int, source: str, remedy: str) -> None:
    """Refuse values of which most are those of the other preset, where the presets differ."""
    other = 5 - dimension
    mine, others = _preset_values(dimension), _preset_values(other)
    differing = [key for key in mine if mine[key] != others[key]]
    foreign = sum(values[key] == others[key] for key in differing)
    if 2 * foreign > len(differing):
        raise InputError(
            f"{source} is made for {other}D scans: of the {len(differing)} settings in which the presets of "
            f"2D and 3D differ it has {foreign} as in {other}D; these scans are {dimension}D: {remedy}"
        )


@functools.cache
def _preset_values(dimension: int | None) -> Mapping[str, Value]:
    """Value of every key by the preset for logs of this dimension; for None the defaults."""
    layer = {} if dimension is None else read_layer(shipped("configs") / f"{PRESETS[dimension]}.toml")
    return {key: spec.default for key, spec in config_keys().items()} | layer


def leaves(tree: Mapping[str, object]) -> Iterator[tuple[str, object]]:
    """Dotted names and values; entries outside sections, misspelled or empty ones too, as they are."""
    sections = {key.partition(".")[0] for key in config_keys()}
    for section, branch in tree.items():
        if isinstance(branch, Mapping) and (branch or section in sections):
            yield from ((f"{section}.{leaf}", value) for leaf, value in branch.items())
        else:
            yield section, branch


def _check_order(values: Mapping[str, Value], source: str, ordered: Sequence[tuple[str, str]]) -> None:
    for lower, upper in ordered:
        if float(values[lower]) >= float(values[upper]):
            raise InputError(f"{source}: {lower} is {values[lower]}; it must be below {upper} ({values[upper]})")
