"""The effective configuration: what wins over what, and what a wrong key or value is told."""

import re
import tomllib

import msgspec
import pytest
from msgspec.structs import fields

from scanchain.config import Config
from scanchain.errors import InputError
from scanchain.settings import Override, config_keys, dump, flatten, load_settings, read_layer, shipped
from tests.support.messages import says
from tests.support.scenes import ROOT, configured


def flag(key, text):
    return Override(key, text, f"--{key}")


def written(tmp_path, text):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    return path


def complaint(**arguments):
    """The one line that loading ends with."""
    with pytest.raises(InputError) as caught:
        load_settings(**arguments)
    text = caught.value.text
    assert "\n" not in text
    return text


# what wins


def test_without_anything_the_defaults_hold_and_say_so():
    settings = load_settings()
    assert settings.config == Config()
    assert settings.source == "defaults"


@pytest.mark.parametrize(("dimension", "name"), [(2, "lidar2d"), (3, "lidar3d")])
def test_the_preset_is_chosen_by_the_dimension_and_named(dimension, name):
    settings = load_settings(dimension)
    assert settings.config == configured(dimension)
    says(settings.source, name, f"{dimension}D")


def test_the_two_presets_differ():
    assert load_settings(2).config != load_settings(3).config


@pytest.mark.parametrize("name", ["lidar2d", "lidar3d"])
def test_a_preset_holds_only_what_differs_from_the_defaults(name):
    layer = read_layer(shipped("configs") / f"{name}.toml")
    assert shipped("configs") == ROOT / "configs"
    assert {key for key, value in layer.items() if value == config_keys()[key].default} == set()


def test_a_file_changes_the_preset(tmp_path):
    file = written(tmp_path, "[matching]\nmax_distance_m = 0.7\n")
    settings = load_settings(2, file=file)
    assert settings.config == configured(2, {"matching.max_distance_m": 0.7})
    says(settings.source, "preset lidar2d", str(file))


def test_flags_beat_the_file_and_the_preset_and_are_told(tmp_path):
    file = written(tmp_path, "[matching]\nmax_distance_m = 0.7\nkernel_scale_m = 0.2\n")
    settings = load_settings(2, file=file, overrides=[flag("matching.max_distance_m", "0.9")])
    assert settings.config.matching.max_distance_m == 0.9
    assert settings.config.matching.kernel_scale_m == 0.2
    says(settings.source, str(file), "matching.max_distance_m 0.9")
    assert load_settings(2, overrides=[flag("matching.max_distance_m", "0.9")]).config == configured(
        2, {"matching.max_distance_m": 0.9}
    )


def test_booleans_are_told_as_a_file_holds_them():
    says(load_settings(2, overrides=[flag("loops.refine", "off")]).source, "loops.refine false")


def test_of_two_flags_for_one_key_the_later_wins():
    settings = load_settings(2, overrides=[flag("log.every", "2"), flag("log.every", "5")])
    assert settings.config.log.every == 5


@pytest.mark.parametrize(
    ("key", "text", "value"),
    [
        ("loops.enabled", "off", False),
        ("loops.enabled", "TRUE", True),
        ("log.every", "3", 3),
        ("log.every", "3.0", 3),
        ("log.end_s", "inf", float("inf")),
        ("maps.slice_min_z_m", "-2", -2.0),
        ("matching.tolerance_m", "1e-4", 1e-4),
        ("matching.matcher", "svd", "svd"),
        ("log.topic", "/front/scan", "/front/scan"),
    ],
)
def test_a_flag_is_read_as_its_key_holds_it(key, text, value):
    found = flatten(load_settings(overrides=[flag(key, text)]).config)[key]
    assert found == value and type(found) is type(value)


def test_a_whole_number_in_a_file_stands_for_a_length_too(tmp_path):
    value = load_settings(
        file=written(tmp_path, "[matching]\nmax_distance_m = 2\n")
    ).config.matching.max_distance_m
    assert value == 2.0 and isinstance(value, float)


# what is refused


def test_an_unknown_flag_names_itself_and_the_nearest_key():
    text = complaint(overrides=[flag("matching.max_distanc_m", "1")])
    says(text, "--matching.max_distanc_m", "did you mean matching.max_distance_m?", "scanchain config show")


def test_a_key_in_the_wrong_section_is_told_the_right_one():
    says(complaint(overrides=[flag("odometry.place_radius_m", "1")]), "did you mean loops.place_radius_m?")


@pytest.mark.parametrize(
    ("text", "unknown", "nearest"),
    [
        ("[matching]\nmax_distanc_m = 1\n", "matching.max_distanc_m", "matching.max_distance_m"),
        ("[matchin]\nmatcher = 'svd'\n", "matchin.matcher", "matching.matcher"),
        ("[matchin]\nmax_distance_m = 1\n", "matchin.max_distance_m", "matching.max_distance_m"),
        ("[matchin]\n", "matchin", "matching."),
        ("matching = 3\n", "matching", "matching."),
        ("matcher = 'svd'\n", "matcher", "matching.matcher"),
    ],
)
def test_an_unknown_key_in_a_file_names_file_key_and_the_nearest_one(tmp_path, text, unknown, nearest):
    file = written(tmp_path, text)
    says(complaint(file=file), f"{file}: {unknown} is not a configuration key", f"did you mean {nearest}")


@pytest.mark.parametrize("key", ["zzz.qqq", "log.nosuch"])
def test_a_key_like_none_there_is_points_to_the_list(key):
    text = complaint(overrides=[flag(key, "1")])
    assert "did you mean" not in text
    says(text, f"--{key}", "scanchain config show")


@pytest.mark.parametrize(
    ("key", "text", "limit"),
    [
        ("matching.max_distance_m", "-1", "a number > 0, in m"),
        ("matching.max_distance_m", "0", "a number > 0, in m"),
        ("matching.max_distance_m", "nan", "a number > 0, in m"),
        ("matching.min_inlier_share", "1.5", "a number from 0 to 1"),
        ("matching.max_iterations", "0", "a whole number >= 1"),
        ("log.every", "0", "a whole number >= 1"),
        ("log.every", "1.5", "a whole number >= 1"),
        ("log.every", "inf", "a whole number >= 1"),
        ("local_map.voxel_size_m", "inf", "a number > 0 and finite, in m"),
        ("matching.max_distance_m", "1e+308", "a number > 0 and at most 1e+50, in m"),
        ("log.start_s", "-0.1", "a number >= 0, in s"),
        ("maps.slice_min_z_m", "-inf", "a number and finite, in m"),
    ],
)
def test_a_value_out_of_range_names_key_value_and_range(tmp_path, key, text, limit):
    says(complaint(overrides=[flag(key, text)]), f"--{key} is {text}; it must be {limit}")
    section, name = key.split(".")
    file = written(tmp_path, f"[{section}]\n{name} = {text}\n")
    says(complaint(file=file), f"{file}: {key} is {text}; it must be {limit}")


@pytest.mark.parametrize(
    ("key", "value", "demand"),
    [
        ("matching.max_distance_m", '"far"', "a number > 0"),
        ("matching.max_distance_m", "true", "a number > 0"),
        ("matching.max_distance_m", "[1.0]", "a number > 0"),
        ("matching.max_distance_m", "{a = 1}", "a number > 0"),
        ("loops.enabled", "1", "true or false"),
        ("loops.enabled", '"true"', "true or false"),
        ("matching.matcher", '"icp"', "one of plicp, svd"),
        ("matching.matcher", "3", "one of plicp, svd"),
        ("log.topic", "7", "text"),
    ],
)
def test_a_wrong_type_in_a_file_names_key_value_and_demand(tmp_path, key, value, demand):
    section, name = key.split(".")
    file = written(tmp_path, f"[{section}]\n{name} = {value}\n")
    says(complaint(file=file), f"{file}: {key} is ", f"it must be {demand}")


@pytest.mark.parametrize(
    ("key", "text", "demand"),
    [
        ("matching.max_distance_m", "far", "a number > 0"),
        ("matching.max_distance_m", "", "a number > 0"),
        ("loops.enabled", "maybe", "true or false"),
        (
            "graph.robust",
            "welsch",
            "one of none, huber, cauchy, geman-mcclure, tukey, truncated or a class of yours",
        ),
    ],
)
def test_a_wrong_type_in_a_flag_names_flag_value_and_demand(key, text, demand):
    says(complaint(overrides=[flag(key, text)]), f"--{key} is {text!r}; it must be {demand}")


def test_a_quoted_dotted_key_is_taken_as_the_key_it_spells(tmp_path):
    settings = load_settings(file=written(tmp_path, '"matching.matcher" = "svd"\n'))
    assert settings.config.matching.matcher == "svd"


def test_limits_the_wrong_way_round_name_both():
    text = complaint(dimension=2, overrides=[flag("log.start_s", "5"), flag("log.end_s", "3")])
    says(text, "--log.start_s", "log.start_s is 5; it must be below log.end_s (3)")
    says(complaint(overrides=[flag("log.start_s", "5"), flag("log.end_s", "3")]), "below log.end_s (3)")


def test_a_limit_that_only_fits_the_preset_is_not_held_against_the_defaults():
    change = [flag("loops.max_radius_m", "3")]  # 2D: at least 1 m; by default at least 5
    assert load_settings(overrides=change).config.loops.max_radius_m == 3.0
    assert load_settings(2, overrides=change).config.loops.max_radius_m == 3.0
    says(complaint(dimension=3, overrides=change), "loops.min_radius_m is 5; it must be below loops.max_radius_m")


@pytest.mark.parametrize(
    ("content", "word"), [(b"[matching\n", "is not TOML"), (b"\xff\xfe", "is not TOML"), (None, "no such file")]
)
def test_a_file_that_is_no_toml_or_not_there_is_named(tmp_path, content, word):
    file = tmp_path / "mine.toml"
    if content is not None:
        file.write_bytes(content)
    says(complaint(file=file), str(file), word, ";")


def test_a_folder_as_a_file_is_named(tmp_path):
    says(complaint(file=tmp_path), str(tmp_path), "--config takes a TOML file")


# out and in again


@pytest.mark.parametrize("dimension", [None, 2, 3])
def test_what_is_dumped_loads_as_the_same_configuration(tmp_path, dimension):
    changes = [
        flag("matching.tolerance_m", "1.25e-7"),
        flag("log.topic", 'a "quoted" ü'),
        flag("log.end_s", "inf"),
    ]
    config = load_settings(dimension, overrides=changes).config
    assert config.matching.tolerance_m == 1.25e-7
    file = written(tmp_path, dump(config))
    assert load_settings(file=file).config == load_settings(dimension or 3, file=file).config == config


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_file_made_for_the_other_dimension_is_refused(tmp_path, dimension):
    file = written(tmp_path, dump(load_settings(5 - dimension, overrides=[flag("loops.drift", "0.02")]).config))
    with pytest.raises(InputError, match=rf"made for {5 - dimension}D scans.*dump --lidar {dimension}d"):
        load_settings(dimension, file=file)


def test_a_dump_holds_every_key_and_nothing_else():
    tree = tomllib.loads(dump(Config()))
    assert {f"{section}.{leaf}" for section, branch in tree.items() for leaf in branch} == set(config_keys())


def test_flatten_and_the_list_of_keys_agree_with_the_tree():
    values = flatten(Config())
    assert values == {name: key.default for name, key in config_keys().items()}
    assert list(values) == list(config_keys())
    tree = msgspec.to_builtins(Config())
    assert values["graph.robust"] == tree["graph"]["robust"]


def test_every_default_and_every_preset_lies_within_its_own_range():
    for name, key in config_keys().items():
        assert key.check(key.default, name) == key.default
    for dimension in (2, 3):
        for name, value in flatten(load_settings(dimension).config).items():
            assert config_keys()[name].check(value, name) == value


def test_every_key_has_a_description_and_every_description_a_key():
    for name, key in config_keys().items():
        assert len(key.description) > 15, name
    for section in fields(Config):
        described = re.findall(r"^ {4}(\w+) : ", section.type.__doc__, re.MULTILINE)
        assert described == [field.name for field in fields(section.type)]


@pytest.mark.parametrize(
    ("key", "unit"),
    [
        ("odometry.max_speed_m_s", "m/s"), ("odometry.max_turn_rad_s", "rad/s"), ("log.start_s", "s"),
        ("matching.max_distance_m", "m"), ("log.max_bad_scans_percent", "%"), ("matching.min_signal", ""),
    ],
)  # fmt: skip
def test_a_key_has_the_unit_that_its_name_ends_with(key, unit):
    assert config_keys()[key].unit == unit
