"""A simulated office: a map of its first half, in which the rest is localized."""

import io
import json
import shutil
import zipfile
import zlib
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest

from scanchain import (
    InputError,
    Localizer,
    Trajectory,
    lie,
    localize,
    open_log,
    read_tum,
    simulate,
    write_tum,
)
from scanchain.config import LogConfig
from scanchain.data import Keyframe
from scanchain.maps import Edges, SavedPoints, Session, open_saved_map, write_saved_map
from scanchain.sessions.localize import measure, pose_near
from scanchain.sessions.localizer import MapState
from scanchain.settings import load_settings
from scanchain.verdict import Verdict
from tests.support import made


@pytest.fixture(scope="module")
def office(tmp_path_factory):
    """Folder with office.mcap, the truth and the map of the first 100 s."""
    folder = tmp_path_factory.mktemp("office")
    made.log("office", folder, seed=3)
    made.run("office", folder, seed=3, log__end_s=100.0).rename(folder / "map")
    return folder


def in_the_map(folder):
    """True poses of the lidar in the frame of the map, whose first scan stands at the identity."""
    truth = lie.flatten(read_tum(folder / "office.tum").poses)
    return lie.between(np.broadcast_to(truth[0], truth.shape), truth)


def test_a_log_is_followed_in_the_map_from_a_rough_pose(office, tmp_path, call):
    stamps_ns = read_tum(office / "office.tum").stamps_ns
    true = in_the_map(office)
    rough = true @ lie.exp(np.array([0.4, -0.3, 0.1]))
    write_tum(tmp_path / "rough.tum", Trajectory(stamps_ns, rough))
    code, out, _ = call(
        "localize", office / "office.mcap", "--start", 110, "--map", office / "map", "--out", tmp_path / "loc",
        "--initial", tmp_path / "rough.tum",
    )  # fmt: skip
    assert code == 0 and out.startswith("verdict        trustworthy: found in map after 0.0 m"), out
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
    assert "Stretches without the map" in html and "Stretches to check" not in html
    for name in ("report.html", "recording.rrd", "summary.txt", "config.toml", "run.json"):
        assert (tmp_path / "loc" / name).stat().st_size > 100, name
    metrics = json.loads((tmp_path / "loc/metrics.json").read_text())
    assert metrics["placed"] == metrics["scans"] == len(states)
    assert "ground truth   /ground_truth: " in out and metrics["ground_truth"]["optimized"]["ate_rmse_m"] < 0.03
    assert call("view", tmp_path / "loc", "--png", tmp_path / "loc.png")[0] == 0
    assert (tmp_path / "loc.png").stat().st_size > 10_000


def test_a_log_of_another_place_is_never_placed(office, tmp_path, call):
    made.log("identical", tmp_path, seed=5, seconds=40.0).rename(tmp_path / "other.mcap")
    code, out, error = call(
        "localize", tmp_path / "other.mcap", "--map", office / "map", "--out", tmp_path / "loc"
    )
    assert code == 1 and "not trustworthy: not from this place: nothing in " in out and "is in map" in error
    assert not (tmp_path / "loc/trajectory.tum").exists()
    assert json.loads((tmp_path / "loc/metrics.json").read_text())["placed"] == 0
    code, _, error = call("view", tmp_path / "loc", "--png", tmp_path / "loc.png")
    assert code == 2 and "there is no trajectory to draw" in error


def test_a_whole_log_of_another_place_that_returns_to_its_start_is_refused_in_one_line(office, tmp_path):
    made.run("identical", tmp_path, seed=5, seconds=60.0).rename(tmp_path / "other")
    found = localize(office / "office.mcap", tmp_path / "other", tmp_path / "loc", recording=False)
    metrics = found.metrics
    assert metrics.sentence.startswith("not trustworthy: not from this place: nothing in ")
    assert metrics.placed == metrics.matches == 0 and metrics.states[MapState.SEARCHING] == metrics.scans


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
    assert "% of the scans within the map matched, 3 % outside of it; log-odds " in text
    nowhere = replace(
        found, is_placed=np.zeros_like(found.is_placed), result=replace(found.result, map_log_odds=2.5)
    )
    assert "not certain: 300 scans over" in found_text(nowhere, saved, config)
    assert "log-odds of 2.5" in found_text(nowhere, saved, config)
    monkeypatch.setattr("scanchain.sessions.localize.repeated_paths", lambda *_: (2, 6))
    alike = measure(found, saved, config, 1.0, ())
    assert alike.verdict == Verdict.CHECK and "2 of 6 paths in it look like other places, too" in alike.reason


def test_a_map_that_is_damaged_or_of_another_kind_is_refused_in_one_line(office, tmp_path, call):
    with pytest.raises(InputError, match=r"holds no map \(map/map.json\); give the directory of a finished run"):
        open_saved_map(tmp_path)
    whole = open_saved_map(office / "map")

    def copy(name):
        write_saved_map(tmp_path / name, whole.keyframes, whole.poses, whole.session, whole.sessions, whole.edges)
        return tmp_path / name

    points = copy("cut") / "points.i16"
    points.write_bytes(points.read_bytes()[:-7])
    with pytest.raises(InputError, match=r"points.i16: is damaged or cut off: .*; make the map again"):
        open_saved_map(tmp_path / "cut")
    index = copy("newer") / "map.json"
    index.write_text(index.read_text().replace('"version": 2', '"version": 1'))
    with pytest.raises(InputError, match=r"is of version 1, this scanchain reads 2 .*; make the map again"):
        open_saved_map(tmp_path / "newer")
    index.write_text("{")
    with pytest.raises(InputError, match=r"map.json: cannot be read"):
        open_saved_map(tmp_path / "newer")
    for name in ("keyframes.npz", "edges.npz"):
        broken = copy(name.split(".")[0]) / name
        broken.write_bytes(broken.read_bytes()[:100])
        with pytest.raises(InputError, match=f"{name}: is damaged or cut off"):
            open_saved_map(broken.parent)
        broken.unlink()
        with pytest.raises(InputError, match=f"{name}: cannot be read"):
            open_saved_map(broken.parent)
    simulate("town", tmp_path / "town.mcap", duration_s=1.0)
    code, _, error = call("localize", tmp_path / "town.mcap", "--map", office / "map", "--out", tmp_path / "loc")
    assert code == 2 and "has 3D scans, the map map is 2D; give a map of the same kind" in error
    code, _, error = call("localize", office / "office.mcap", "--map", office / "map", "--out", tmp_path / "loc",
                          "--initial", "1,2")  # fmt: skip
    assert code == 2 and "--initial is '1,2'; give x,y,yaw in meters and degrees, or a file .tum" in error


def test_a_localized_log_never_replaces_its_map(office, call):
    before = sorted(path.name for path in (office / "map").iterdir())
    for out in (office / "map", office / "map" / "map"):
        code, _, error = call("localize", office / "office.mcap", "--map", office / "map", "--out", out, "--force")
        assert code == 2 and "is the map; choose another --out" in error
    assert sorted(path.name for path in (office / "map").iterdir()) == before


def test_without_loop_closures_nothing_can_be_localized(office, tmp_path, call):
    words = office / "office.mcap", "--map", office / "map", "--out", tmp_path / "loc", "--loops.enabled=false"
    code, _, error = call("localize", *words)
    assert code == 2 and "a place in a map is found by loop closures; leave it true" in error
    assert not list(tmp_path.iterdir())


def test_a_saved_map_holds_its_keyframes_to_the_millimeter_and_the_poses_to_the_bit(office, tmp_path):
    saved = open_saved_map(office / "map")
    twice = saved.edges.among(np.arange(len(saved.keyframes)))
    write_saved_map(tmp_path / "again", saved.keyframes, saved.poses, saved.session, saved.sessions, twice)
    again = open_saved_map(tmp_path / "again")
    assert again.sessions == saved.sessions and (again.poses == saved.poses).all()
    assert all(np.array_equal(a, b) for a, b in zip(vars_of(again.edges), vars_of(saved.edges), strict=True))
    for one, other in zip(again.keyframes, saved.keyframes, strict=True):
        np.testing.assert_allclose(one.points, other.points, atol=1e-3)
        assert replace(one, stored=None, T_odom_lidar=None) == replace(other, stored=None, T_odom_lidar=None)
    half = saved.edges.among(np.arange(5, 20))
    assert half.pairs.max() < 15 and len(half.pairs) < len(saved.edges.pairs)


def test_every_flipped_bit_of_a_saved_map_is_refused_with_its_file(office, tmp_path):
    shutil.copytree(office / "map" / "map", tmp_path / "map")
    random = np.random.default_rng(0)
    for name in ("keyframes.npz", "edges.npz", "points.i16"):
        file = tmp_path / "map" / name
        whole = file.read_bytes()
        for place in random.integers(len(whole), size=20).tolist():
            file.write_bytes(whole[:place] + bytes([whole[place] ^ 0x10]) + whole[place + 1 :])
            with pytest.raises(InputError, match=f"{name}: is damaged"):
                open_saved_map(tmp_path)
        file.write_bytes(whole)
    open_saved_map(tmp_path)


@pytest.mark.parametrize(
    ("file", "name", "change", "message"),
    [
        ("keyframes", "count", lambda a: 3 * a, "keyframes.npz: holds other keyframes and points than map.json"),
        (
            "keyframes",
            "poses",
            lambda a: np.tile(np.eye(4), (len(a), 1, 1)),
            "keyframes.npz: holds other keyframes",
        ),
        ("keyframes", "stamps_ns", lambda a: a[3:], "map: is not as scanchain writes it"),
        ("edges", "another", lambda a: np.zeros(3), "map: is not as scanchain writes it"),
    ],
)
def test_a_saved_map_that_contradicts_itself_is_refused_with_its_file(
    office, tmp_path, file, name, change, message
):
    folder = shutil.copytree(office / "map" / "map", tmp_path / "map")
    with np.load(folder / f"{file}.npz") as arrays:
        np.savez(folder / f"{file}.npz", **(dict(arrays) | {name: change(arrays.get(name))}))
    index = json.loads((folder / "map.json").read_text())
    index["crc32"][f"{file}.npz"] = zlib.crc32((folder / f"{file}.npz").read_bytes())  # as if written so
    (folder / "map.json").write_text(json.dumps(index))
    with pytest.raises(InputError, match=message):
        open_saved_map(tmp_path)


def test_archives_that_no_reader_unpacks_are_refused_with_their_name(office, tmp_path):
    file = shutil.copytree(office / "map" / "map", tmp_path / "map") / "keyframes.npz"
    index = json.loads((tmp_path / "map" / "map.json").read_text())
    huge = io.BytesIO()
    np.lib.format.write_array_header_1_0(huge, {"descr": "<f8", "fortran_order": False, "shape": (10**11, 3, 3)})
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("poses.npy", huge.getvalue())
    claims = file.read_bytes()
    np.savez_compressed(file, poses=np.random.default_rng(0).normal(size=(99, 3, 3)))
    packed = bytearray(file.read_bytes())
    packed[200:260] = bytes(60)
    encrypted = bytearray(claims)
    encrypted[6] |= 1
    encrypted[encrypted.index(b"PK\x01\x02") + 8] |= 1
    for data in (claims, packed, encrypted):
        file.write_bytes(data)
        index["crc32"]["keyframes.npz"] = zlib.crc32(data)
        (tmp_path / "map" / "map.json").write_text(json.dumps(index))
        with pytest.raises(InputError, match=r"keyframes.npz: cannot be read"):
            open_saved_map(tmp_path)


def test_one_far_return_does_not_make_the_points_of_its_keyframe_coarse(tmp_path):
    near, far = np.array([[1.2345, -2.0], [0.0, 3.3333]]), np.array([[5e4, 0.0]])
    keyframes = [
        Keyframe(k, k, k, SavedPoints(points, 1.0), np.eye(3), float(k), 1.0)
        for k, points in enumerate((near, np.vstack([near, far]), near))
    ]
    none = Edges(np.empty((0, 2), int), np.empty((0, 3, 3)), np.empty((0, 3, 3)), np.empty(0, bool), np.empty(0))
    session = Session("made up", 0, 2, 3)
    write_saved_map(tmp_path / "map", keyframes, np.tile(np.eye(3), (3, 1, 1)), np.zeros(3, int), (session,), none)
    for before, after in zip(keyframes, open_saved_map(tmp_path).keyframes, strict=True):
        np.testing.assert_allclose(after.points, before.points, atol=1e-3)


def vars_of(edges: Edges):
    return edges.pairs, edges.measurements, edges.information, edges.is_loop, edges.weight


def test_the_localizer_takes_scans_as_a_driver_has_them(office):
    saved = open_saved_map(office / "map")
    localizer = Localizer(office / "map", initial=saved.keyframes[0].T_odom_lidar)
    first = saved.keyframes[0].points
    placed = [localizer.track(first, 0.1 * k) for k in range(5)]
    assert all(each.state is not MapState.SEARCHING for each in placed)
    off_m, off_rad = lie.apart(placed[-1].T_map_lidar, saved.keyframes[0].T_odom_lidar)
    assert off_m < 0.01 and off_rad < 0.01 and placed[-1].covariance.shape == (3, 3)
    with pytest.raises(InputError, match="stamp"):
        localizer.track(first, 0.1)


def test_a_heading_in_degrees_turns_the_pose_of_the_nearest_keyframe(office):
    saved = open_saved_map(office / "map")
    np.testing.assert_allclose(pose_near(1.0, 2.0, 90.0)(0, saved), lie.pose_2d(1.0, 2.0, np.pi / 2), atol=1e-12)
