"""The effective configuration: what wins over what, and what a wrong key or value is told."""

import re

import numpy as np
import pytest
from msgspec.structs import fields

from scanchain.config import Config, LoopsConfig
from scanchain.errors import InputError
from scanchain.odometry import Odometry
from scanchain.settings import Override, config_keys, dump, flatten, load_settings, read_layer, shipped
from tests.support.messages import says
from tests.support.scenes import ROOT, configured


def flag(key, text):
    return Override(key, text, f"--{key}")


@pytest.fixture
def file(tmp_path):
    """Write a TOML file; its path."""

    def write(text):
        path = tmp_path / "mine.toml"
        path.write_text(text)
        return path

    return write


def complaint(**arguments):
    """The one line that loading ends with."""
    with pytest.raises(InputError) as caught:
        load_settings(**arguments)
    text = caught.value.text
    assert "\n" not in text
    return text


# what wins


def test_defaults_yield_to_the_preset_this_to_a_file_and_that_to_flags_and_the_source_names_them(file):
    settings = load_settings()
    assert (settings.config, settings.source) == (Config(), "defaults")
    for dimension in (2, 3):
        settings = load_settings(dimension)
        assert settings.config == configured(dimension) != configured(5 - dimension)
        says(settings.source, f"preset lidar{dimension}d of {dimension}D logs")
    mine = file("[matching]\nmax_distance_m = 0.7\nkernel_scale_m = 2\n")
    changes = {"matching.max_distance_m": 0.7, "matching.kernel_scale_m": 2.0}
    assert load_settings(2, file=mine).config == configured(2, changes)
    flags = [flag("log.every", "2"), flag("matching.max_distance_m", "0.9"), flag("loops.refine", "off")]
    settings = load_settings(2, file=mine, overrides=[*flags, flag("log.every", "5")])
    changes |= {"matching.max_distance_m": 0.9, "loops.refine": False, "log.every": 5}
    assert settings.config == configured(2, changes)
    says(settings.source, "preset lidar2d", str(mine), "matching.max_distance_m 0.9", "loops.refine false")


@pytest.mark.parametrize("name", ["lidar2d", "lidar3d"])
def test_a_preset_holds_only_what_differs_from_the_defaults(name):
    layer = read_layer(shipped("configs") / f"{name}.toml")
    assert shipped("configs") == ROOT / "configs"
    assert {key for key, value in layer.items() if value == config_keys()[key].default} == set()


@pytest.mark.parametrize(
    ("key", "text", "value"),
    [
        ("loops.enabled", "off", False),
        ("loops.enabled", "TRUE", True),
        ("log.every", "3.0", 3),
        ("log.end_s", "inf", float("inf")),
        ("maps.slice_min_z_m", "-2", -2.0),
        ("matching.tolerance_m", "1e-4", 1e-4),
        ("log.topic", "/front/scan", "/front/scan"),
    ],
)
def test_a_flag_is_read_as_its_key_holds_it(key, text, value):
    found = flatten(load_settings(overrides=[flag(key, text)]).config)[key]
    assert found == value and type(found) is type(value)


# what is refused


UNKNOWN = " is not a configuration key; "


@pytest.mark.parametrize(
    ("key", "text", "said"),
    [
        (
            "matching.max_distanc_m",
            1,
            UNKNOWN + "did you mean --matching.max_distance_m? all keys: scanchain config",
        ),
        ("odometry.place_radius_m", 1, UNKNOWN + "did you mean --loops.place_radius_m?"),
        ("log.nosuch", 1, UNKNOWN + "all keys: scanchain config show"),
        ("matching.max_distance_m", "far", " is 'far'; it must be a number > 0"),
        ("loops.enabled", "maybe", " is 'maybe'; it must be true or false"),
        (
            "matching.optimizer",
            "magic",
            " is 'magic'; it must be one of gauss-newton, gradient-descent, levenberg",
        ),
        ("matching.matcher", "icp", " is 'icp'; it must be one of plicp, svd or a class of yours, MODULE:CLASS"),
        ("matching.max_distance_m", -1, " is -1; it must be a number > 0, in m"),
        ("matching.max_distance_m", np.nan, " is nan; it must be a number > 0, in m"),
        ("matching.min_inlier_share", 1.5, " is 1.5; it must be a number from 0 to 1"),
        ("log.every", 1.5, " is 1.5; it must be a whole number >= 1"),
        ("log.every", np.inf, " is inf; it must be a whole number >= 1"),
        ("local_map.voxel_size_m", np.inf, " is inf; it must be a number > 0 and finite, in m"),
        ("matching.max_distance_m", 1e308, " is 1e+308; it must be a number > 0 and at most 1e+50, in m"),
        ("log.start_s", -0.1, " is -0.1; it must be a number >= 0, in s"),
        ("maps.slice_min_z_m", -np.inf, " is -inf; it must be a number and finite, in m"),
    ],
)
def test_a_wrong_key_or_value_is_named_with_the_nearest_key_or_the_demand_by_flag_and_in_a_file(
    file, key, text, said
):
    says(complaint(overrides=[flag(key, str(text))]), f"--{key}{said}")
    section, name = key.split(".")
    path = file(f"[{section}]\n{name} = {text!r}\n")
    says(complaint(file=path), f"{path}: {key}{said.replace('--', '')}")


@pytest.mark.parametrize(
    ("text", "key", "said"),
    [
        ("[matchin]\nmatcher = 'svd'\n", "matchin.matcher", "did you mean matching.matcher"),
        ("matcher = 'svd'\n", "matcher", "did you mean matching.matcher"),
        ("[matching]\nmax_distance_m = true\n", "matching.max_distance_m", "it must be a number > 0"),
        ("[loops]\nenabled = 'true'\n", "loops.enabled", "it must be true or false"),
        ("[matching]\nmatcher = 3\n", "matching.matcher", "it must be one of plicp, svd"),
        ("[log]\ntopic = 7\n", "log.topic", "it must be text"),
        ("[lops]\n", "lops", "not a configuration key"),
    ],
)
def test_a_value_of_another_type_or_a_section_in_a_file_is_named_with_the_file(file, text, key, said):
    path = file(text)
    says(complaint(file=path), f"{path}: {key} is ", said)


def test_limits_the_wrong_way_round_are_refused():
    text = complaint(dimension=3, overrides=[flag("loops.min_radius_m", "60")])
    says(text, "loops.min_radius_m is 60.0; it must be below loops.max_radius_m (30.0)")
    says(complaint(overrides=[flag("log.start_s", "9"), flag("log.end_s", "5")]), "log.start_s is 9.0", "(5.0)")
    with pytest.raises(InputError, match=r"config: loops\.min_radius_m is 60\.0"):
        Odometry(Config(loops=LoopsConfig(min_radius_m=60.0)), dimension=3)


def test_a_file_that_is_no_toml_or_not_there_is_named(tmp_path):
    (tmp_path / "mine.toml").write_text("[matching\n")
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe")
    for name, words in (
        ("mine.toml", "is not TOML"),
        ("bytes.toml", "is not TOML"),
        ("absent.toml", "No such file"),
        (".", "--config takes a TOML file"),
    ):
        says(complaint(file=tmp_path / name), str(tmp_path / name), words, ";")


# out and in again


@pytest.mark.parametrize("dimension", [None, 2, 3])
def test_what_is_dumped_loads_as_the_same_configuration(file, dimension):
    changes = [("matching.tolerance_m", "1.25e-7"), ("log.topic", 'a "quoted" ü'), ("log.end_s", "inf")]
    config = load_settings(dimension, overrides=[flag(*change) for change in changes]).config
    assert config.matching.tolerance_m == 1.25e-7
    path = file(dump(config))
    assert load_settings(file=path).config == load_settings(dimension or 3, file=path).config == config


def test_a_file_made_for_the_other_dimension_is_refused(file, dimension):
    path = file(dump(load_settings(5 - dimension, overrides=[flag("loops.drift", "0.02")]).config))
    text = complaint(dimension=dimension, file=path)
    says(text, f"made for {5 - dimension}D scans", f"dump --lidar {dimension}d")


def test_every_key_is_in_the_tree_with_its_default_and_a_description():
    assert list(flatten(Config()).items()) == [(name, key.default) for name, key in config_keys().items()]
    for name, key in config_keys().items():
        assert key.check(key.default, name) == key.default and len(key.description) > 15, name
    units = {"odometry.max_speed_m_s": "m/s", "log.max_bad_scans_percent": "%", "matching.min_signal": ""}
    assert {name: config_keys()[name].unit for name in units} == units
    for section in fields(Config):
        described = re.findall(r"^ {4}(\w+) : ", section.type.__doc__, re.MULTILINE)
        assert described == [field.name for field in fields(section.type)]
