"""A simulated office: a map of its first half, in which the rest is localized."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader

from scanchain import InputError, Localizer, Trajectory, lie, localize, open_log, read_tum, write_tum
from scanchain.config import LogConfig
from scanchain.data import Keyframe
from scanchain.maps import SavedMap, open_saved_map
from scanchain.runs.metrics import REASON
from scanchain.sessions.localize import measure, pose_near
from scanchain.sessions.localizer import MapState
from scanchain.settings import load_settings
from scanchain.verdict import Verdict
from tests.benchmarks.places import with_copy
from tests.support import made
from tests.support.naive_logs import Said, write


@pytest.fixture(scope="module")
def office(tmp_path_factory):
    """Folder with office.mcap, the truth and the map of the first 100 s."""
    folder = tmp_path_factory.mktemp("office")
    made.log("office", folder, seed=3)
    made.run("office", folder, seed=3, log__end_s=100.0).rename(folder / "map")
    return folder


def test_a_log_is_followed_in_the_map_from_a_rough_pose(office, tmp_path, call):
    truth = read_tum(office / "office.tum")
    stamps_ns, true = truth.stamps_ns, lie.flatten(lie.inverse(truth.poses[0]) @ truth.poses)  # in the map's frame
    rough = true @ lie.exp(np.array([0.4, -0.3, 0.1]))
    write_tum(tmp_path / "rough.tum", Trajectory(stamps_ns, rough))
    code, out, _ = call(
        "localize", office / "office.mcap", "--start", 110, "--map", office / "map", "--out", tmp_path / "loc",
        "--initial", tmp_path / "rough.tum",
    )  # fmt: skip
    assert code == 0 and out.startswith(f"verdict        trustworthy\n{REASON}found in map after 0.0 m"), out
    found = read_tum(tmp_path / "loc/trajectory.tum")
    where = np.searchsorted(stamps_ns, found.stamps_ns)
    off = [lie.apart(a, b) for a, b in zip(lie.flatten(found.poses), true[where], strict=True)]
    assert np.median(off, axis=0)[0] < 0.03 and np.max(off, axis=0)[0] < 0.15, np.max(off, axis=0)
    table = pq.read_table(tmp_path / "loc/localization.parquet").to_pydict()
    states = np.array(table["state"])
    known = states == MapState.LOCALIZED
    assert known.mean() > 0.5 and not (states == MapState.SEARCHING).any()
    live = np.column_stack([table["live_x_m"], table["live_y_m"]])[known]
    error_m = np.linalg.norm(live - true[where][known][:, :2, 2], axis=1)
    assert (error_m < 5.0 * np.array(table["sigma_m"])[known]).mean() > 0.95
    html = (tmp_path / "loc/report.html").read_text()
    assert "Segments without the map" in html and "Segments to check" not in html
    for name in ("report.html", "recording.rrd", "summary.txt", "config.toml", "run.json"):
        assert (tmp_path / "loc" / name).stat().st_size > 100, name
    metrics = json.loads((tmp_path / "loc/metrics.json").read_text())
    assert metrics["placed"] == metrics["scans"] == len(states)
    assert "ground truth   /ground_truth: " in out and metrics["ground_truth"]["optimized"]["ate_rmse_m"] < 0.03
    assert call("view", tmp_path / "loc", "--png", tmp_path / "loc.png")[0] == 0
    assert (tmp_path / "loc.png").stat().st_size > 10_000


def test_the_summary_of_a_localized_log_has_the_notes_that_a_run_has(office, tmp_path):
    with (office / "office.mcap").open("rb") as stream:
        said = [
            Said(channel.topic, schema.name, message.log_time, message.data)
            for schema, channel, message in make_reader(stream).iter_messages()
            if channel.topic != "/tf_static"
        ]
    log = write(tmp_path / "a.mcap", said)
    found = localize(log, office / "map", tmp_path / "loc", recording=False, log__end_s=40.0)
    assert "note           no static transform from base_link to lidar" in found.summary
    assert "note           mounting estimated from the wheels: " in found.summary


def test_a_whole_log_of_another_place_is_never_placed_though_it_returns_to_its_start(office, tmp_path, call):
    made.run("identical", tmp_path, seed=5, seconds=60.0).rename(tmp_path / "other")
    out = tmp_path / "loc"
    code, said, error = call("localize", office / "office.mcap", "--map", tmp_path / "other", "--out", out)
    assert (code, error) == (1, "")
    assert said.startswith(f"verdict        not trustworthy\n{REASON}not from this place: nothing in ")
    assert said.splitlines()[1].endswith(" matches other")
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["placed"] == metrics["matches"] == 0
    assert metrics["states"]["searching"] == metrics["scans"] and not (out / "trajectory.tum").exists()
    code, _, error = call("view", out, "--png", tmp_path / "loc.png")
    assert code == 2 and "there is no trajectory to draw" in error


def test_a_log_that_fits_several_places_of_its_map_alike_is_not_said_to_be_of_another_place(tmp_path):
    prior = made.run("hall", seconds=20.0, sensor="lms-270")
    log = made.log("hall", seconds=6.0, start_m=20.0, sensor="lms-270")
    found = localize(log, prior, tmp_path / "loc", recording=False)
    assert found.metrics.placed == 0
    assert found.metrics.reason.startswith("not certain: 60 scans over ")
    assert "fit several locations in hall" in found.metrics.reason


def test_a_localized_log_names_the_directory_that_it_was_written_to_and_its_map(
    office, tmp_path, monkeypatch, call
):
    monkeypatch.chdir(office)
    found = localize(
        "office.mcap", "map", tmp_path / "loc", recording=False, ground_truth="office.tum", log__end_s=20.0
    )
    assert found.path == tmp_path / "loc" and (found.path / "metrics.json").is_file()
    assert (
        found.metrics.ground_truth.source == "office.tum"
        and found.metrics.ground_truth.optimized.ate_rmse_m < 0.03
    )
    monkeypatch.chdir(tmp_path)
    assert call("view", "loc", "--png", "loc.png")[0] == 0


def test_a_log_that_was_found_at_a_look_alike_and_left_it_is_found_again_where_it_enters_the_map(tmp_path):
    """The map also holds a copy of the first meters of the log, far from all else: it is found there first."""
    walk = {"seconds": 70.0, "start_m": 0.0}
    prior = open_saved_map(made.run("office", seconds=60.0, start_m=60.0))
    copied = open_saved_map(made.run("office", log__end_s=12.0, **walk))
    with_copy(prior, copied, 4.0, tmp_path / "map")
    found = localize(made.log("office", **walk), tmp_path / "map", tmp_path / "loc", recording=False)
    T_map_world = lie.inverse(
        read_tum(made.log("office", seconds=60.0, start_m=60.0).with_suffix(".tum")).poses[0]
    )
    true = lie.flatten(T_map_world @ read_tum(made.log("office", **walk).with_suffix(".tum")).poses)
    states, poses = found.localization.states, found.localization.trajectory.poses
    first_m, last_m = (
        lie.apart(found.localization.live[k], true[k])[0] for k in (np.argmax(states != "searching"), -1)
    )
    assert first_m > 50.0, "it was found at the copy"
    assert last_m < 0.1 and np.max([lie.apart(*pair)[0] for pair in zip(poses, true, strict=True)]) < 0.1
    assert found.metrics.verdict == Verdict.CHECK and "place corrected later" in found.metrics.reason
    assert any(
        "more of the path matches at another location in the map" in c.reason for c in found.localization.closures
    )


def found_text(found, saved, config):
    return measure(found, saved, config, 1.0, ()).reason


def test_the_verdict_names_what_speaks_for_the_place(office, monkeypatch):
    saved, log = open_saved_map(office / "map"), open_log([office / "office.mcap"], LogConfig(end_s=30.0))
    config = load_settings(2).config
    localizer = Localizer(saved, config, log.T_base_lidar, is_live=False)
    for scan in log.scans(config.preprocess):
        localizer.process(scan)
    found = localizer.finish()
    assert measure(found, saved, config, 1.0, ()).verdict == Verdict.TRUSTWORTHY
    assert "100 % of the scans within the map matched" in found_text(found, saved, config)
    states = found.states.astype("U30")
    states[len(states) // 2 :], states[-10:] = MapState.UNMATCHED, MapState.OUTSIDE
    text = found_text(replace(found, states=states), saved, config)
    assert "% of the scans within the map matched, 3 % outside of it" in text and "log-odds" not in text
    nowhere = replace(
        found, is_placed=np.zeros_like(found.is_placed), result=replace(found.result, map_log_odds=2.5)
    )
    assert "not certain: 300 scans over" in found_text(nowhere, saved, config)
    assert "log-odds of 2.5" in found_text(nowhere, saved, config)
    monkeypatch.setattr("scanchain.sessions.localize.repeated_paths", lambda *_: (2, 6))
    left = replace(nowhere, result=replace(found.result, map_log_odds=np.nan))
    assert "scans had a location in map that was withdrawn" in found_text(left, saved, config)
    rival = replace(found, result=replace(found.result, map_rival_log_odds=9.0))
    assert "its last keyframes match another location in the map, too (log-odds 9" in found_text(
        rival, saved, config
    )
    alike = measure(found, saved, config, 1.0, ())
    assert alike.verdict == Verdict.CHECK and "2 of 6 paths in it also fit other locations" in alike.reason


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["--out", "OUT", "--initial", "1,2"],
            "--initial is '1,2'; give x,y,yaw in meters and degrees, or a file .tum",
        ),
        (["--out", "OUT", "--loops.enabled=false"], "localization in a map needs loop closures; leave it true"),
        (["--out", "MAP", "--force"], "is one of the maps; choose another --out"),
        (["--out", "MAP/map", "--force"], "lies in the run directory"),
    ],
)
def test_what_cannot_be_localized_is_refused_and_leaves_the_map_as_it_was(office, tmp_path, call, words, message):
    before = sorted((office / "map").rglob("*"))
    words = [word.replace("MAP", str(office / "map")).replace("OUT", str(tmp_path / "loc")) for word in words]
    code, _, error = call("localize", office / "office.mcap", "--map", office / "map", *words)
    assert code == 2 and message in error
    assert sorted((office / "map").rglob("*")) == before and not list(tmp_path.iterdir())


def test_a_log_of_another_dimension_than_the_map_is_refused(office, tmp_path):
    with pytest.raises(InputError, match="has 3D scans, the map map is 2D; give a map of the same kind"):
        localize(made.log("town", seconds=1), office / "map", tmp_path / "loc")


def test_a_position_and_heading_take_height_and_tilt_of_the_nearest_keyframe():
    poses = [lie.exp(np.array([x, 2.0, 3.0, 0.2, -0.1, 0.4])) for x in (1.0, 50.0)]
    prior = SavedMap(Path("map"), 3, tuple(Keyframe(0, 0, 0, None, T, 0.0) for T in poses), None, (), None)
    initial = pose_near(1.0, 2.0, 90.0)
    T = initial(0, prior)
    np.testing.assert_allclose(T[:3, 3], [1.0, 2.0, poses[0][2, 3]])
    np.testing.assert_allclose(T[2, :3], poses[0][2, :3])
    assert lie.yaw(lie.flatten(T)) == pytest.approx(np.pi / 2)
    np.testing.assert_allclose(
        initial(0, replace(prior, dimension=2)), lie.pose_2d(1.0, 2.0, np.pi / 2), atol=1e-9
    )
