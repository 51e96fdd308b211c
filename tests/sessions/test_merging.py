"""Sessions of one place, each with a start of its own, become one map in one frame; strangers stay apart."""

import json
import shutil
from unittest.mock import create_autospec

import numpy as np
import pytest

import scanchain as sc
from scanchain import lie
from scanchain.data import Trajectory
from scanchain.errors import InputError, ScanchainError
from scanchain.graph.pose_graph import PoseGraph
from scanchain.loops.planar_map_search import PlanarMapSearch
from scanchain.loops.verification import Verifier
from scanchain.maps import open_saved_map, read_ply
from scanchain.runs.job import Job, Progress
from scanchain.sessions.merging import _opened, merge
from scanchain.trajectory import read_tum
from scanchain_viz.pictures.maps import draw_run
from tests.benchmarks import harness
from tests.support import made

PARTS = {"morning": (0.0, 18.0), "noon": (6.0, 24.0), "evening": (14.0, 34.0)}
FILES = ("map/points.i16", "map/edges.npz", "map/keyframes.npz", "map.ply", "map.pgm", "evening.tum", "graph.g2o")


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Three sessions in an office and one elsewhere, and the truth."""
    folder = tmp_path_factory.mktemp("sessions")
    truth = read_tum(made.log("office", folder, seed=2, seconds=34.0).with_suffix(".tum"))
    truth = Trajectory(truth.stamps_ns, lie.flatten(truth.poses))
    for name, (start_s, end_s) in PARTS.items():
        part = made.run("office", folder, seed=2, seconds=34.0, log__start_s=start_s, log__end_s=end_s)
        part.rename(folder / name)
    made.run("identical", folder, seconds=12.0).rename(folder / "stranger")
    return folder, truth


@pytest.fixture(scope="module")
def merged(runs, tmp_path_factory):
    folder, _ = runs
    out = tmp_path_factory.mktemp("merged") / "all"
    return sc.merge([folder / name for name in (*PARTS, "stranger")], out)


def quietly(*runs, out, **options):
    return merge(Job(runs, out), Progress(), lambda folder: None, **options)


def ate_m(out, truth, names):
    """ATE over the scans of all sessions, rigidly aligned as one."""
    parts = [read_tum(out / f"{name}.tum") for name in names]
    stamps_ns, poses = np.concatenate([part.stamps_ns for part in parts]), np.concatenate([p.poses for p in parts])
    return harness.ate_m(Trajectory(stamps_ns, poses), Trajectory(truth.stamps_ns, lie.lift(truth.poses)))


def test_sessions_with_unknown_starts_become_one_certified_map(runs, merged):
    folder, truth = runs
    saved = open_saved_map(merged.path)
    assert [session.name for session in saved.sessions] == list(PARTS)
    assert len(saved.keyframes) == sum(len(open_saved_map(folder / name).keyframes) for name in PARTS)
    assert ate_m(merged.path, truth, PARTS) < 0.02
    assert merged.metrics.certified
    assert all(session.closures > 0 for session in merged.metrics.sessions)
    traveled_m = [keyframe.traveled_m for keyframe in saved.keyframes]
    assert (np.diff(traveled_m) >= 0.0).all()


def test_every_scan_of_a_session_keeps_its_motion_to_the_next(runs, merged):
    folder, _ = runs
    for name in PARTS:
        before, after = read_tum(folder / name / "trajectory.tum"), read_tum(merged.path / f"{name}.tum")
        assert np.array_equal(before.stamps_ns, after.stamps_ns)
        moves = [lie.between(each.poses[:-1], each.poses[1:]) for each in (before, after)]
        assert np.abs(moves[0] - moves[1]).max() < 0.02


def test_a_session_of_another_place_stays_apart_and_is_named(merged):
    assert merged.metrics.apart == (("stranger",),)
    assert any("stranger" in line and "not in this map" in line for line in merged.warnings)
    assert "stranger" in merged.summary
    assert not (merged.path / "stranger.tum").exists()
    assert "not in this map" in (merged.path / "report.html").read_text()


def test_a_merge_leaves_what_a_run_leaves(merged):
    names = "map map.ply map.pgm map.yaml summary.txt metrics.json run.json config.toml report.html recording.rrd"
    tables = {"loops.parquet", "graph.g2o", *(f"{name}.tum" for name in PARTS)}
    assert {path.name for path in merged.path.iterdir()} >= {*names.split(), *tables}
    assert json.loads((merged.path / "run.json").read_text())["complete"]
    draw_run(merged.path, merged.path.with_suffix(".png"))
    assert merged.path.with_suffix(".png").stat().st_size > 10_000


def test_the_first_run_keeps_its_frame_and_the_order_of_the_others_does_not_matter(runs, merged, tmp_path):
    folder, _ = runs
    names = ("morning", "stranger", "evening", "noon")
    other = quietly(*(folder / name for name in names), out=tmp_path / "other")
    for file in FILES:
        assert (other.path / file).read_bytes() == (merged.path / file).read_bytes(), file
    first = read_tum(folder / "morning" / "trajectory.tum").poses[0]
    assert np.abs(read_tum(merged.path / "morning.tum").poses[0] - first).max() < 1e-8
    third = quietly(*(folder / name for name in reversed(names)), out=tmp_path / "third")
    between = [
        lie.between(*(read_tum(out.path / f"{name}.tum").poses[7] for name in ("noon", "evening")))
        for out in (merged, third)
    ]
    assert np.abs(between[0] - between[1]).max() < 1e-7


def test_fixed_leaves_the_poses_of_the_first_run_to_the_bit_and_is_certified(runs, tmp_path):
    folder, truth = runs
    out = quietly(folder / "noon", folder / "morning", out=tmp_path / "fixed", fixed=True)
    saved, before = open_saved_map(out.path), open_saved_map(folder / "noon")
    number = [session.name for session in saved.sessions].index("noon")
    assert np.array_equal(saved.poses[saved.session == number], before.poses)
    written, given = read_tum(out.path / "noon.tum"), read_tum(folder / "noon" / "trajectory.tum")
    assert np.abs(written.poses - given.poses).max() < 1e-8
    assert out.metrics.certified
    assert ate_m(out.path, truth, ("noon", "morning")) < 0.02


def test_nothing_that_belongs_together_is_an_error_of_one_line_and_leaves_nothing(runs, call, tmp_path):
    folder, _ = runs
    code, output, said = call("merge", folder / "noon", folder / "stranger", "--out", tmp_path / "out")
    assert (code, output) == (1, "")
    assert "error: no two of the maps belong together" in said
    with pytest.raises(ScanchainError, match=r"nothing belongs to .*noon"):
        quietly(folder / "noon", folder / "stranger", out=tmp_path / "out", fixed=True)
    assert not list(tmp_path.iterdir())


def test_a_merge_that_is_killed_leaves_the_runs_as_they_were_and_nothing_else(runs, tmp_path):
    folder, _ = runs
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}

    def interrupted(directory):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        merge(Job((folder / "morning", folder / "noon"), tmp_path / "out"), Progress(), interrupted)
    assert not list(tmp_path.iterdir())
    assert before == {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_maps_that_cannot_be_merged_are_refused_before_the_search(runs, merged, tmp_path):
    folder, _ = runs
    noon, out = folder / "noon", tmp_path / "out"
    for runs_, message in (
        ((noon,), "at least two run directories"),
        ((noon, noon), "holds a session"),
        ((merged.path, noon), "holds a session"),
    ):
        with pytest.raises(InputError, match=message):
            quietly(*runs_, out=out)
    with pytest.raises(InputError, match="is one of the maps"):
        sc.merge((noon, folder / "morning"), noon, force=True)
    assert not out.exists()


@pytest.fixture(scope="module")
def updates(runs, tmp_path_factory):
    """A session of another day, merged with one before it without and with ``update``."""
    folder, _ = runs
    out = tmp_path_factory.mktemp("updates")
    drive = {"seed": 2, "seconds": 34.0, "changed": 1}
    made.log("office", out, **drive).rename(out / "later.mcap")
    made.run("office", out, **drive, log__start_s=6.0, log__end_s=24.0).rename(out / "later")
    sc.merge([folder / "morning", out / "later"], out / "plain")
    return out, sc.merge([folder / "morning", out / "later"], out / "updated", update=True)


def test_an_update_says_of_which_session_how_many_points_went(updates):
    folder, merged = updates
    plain, new = open_saved_map(folder / "plain"), open_saved_map(merged.path)
    assert np.array_equal(plain.poses, new.poses)
    assert len(read_ply(merged.path / "map.ply")) < len(read_ply(folder / "plain" / "map.ply"))
    lost = [sum(len(k.points) for k in m.keyframes) for m in (plain, new)]
    sessions = {session.name: session.removed_points for session in merged.metrics.sessions}
    assert sessions == {"morning": lost[0] - lost[1], "later": 0}
    assert f"{sessions['morning']:,} points removed as gone" in merged.summary
    assert f"{sessions['morning']:,}" in (merged.path / "report.html").read_text()


def test_an_updated_map_is_localized_in_and_merged_further(runs, updates, tmp_path):
    folder, truth = runs
    out, merged = updates
    log, options = out / "later.mcap", {"recording": False, "log__end_s": 16.0}
    found = sc.localize(log, merged.path, tmp_path / "found", **options)
    assert found.metrics.placed == found.metrics.scans > 50
    three = quietly(merged.path, folder / "evening", out=tmp_path / "three", fixed=True)
    assert ate_m(three.path, truth, ("morning", "later", "evening")) < 0.04
    before, after = open_saved_map(merged.path), open_saved_map(three.path)
    assert set(np.unique(after.session)) == {0, 1, 2}
    kept = np.isin(after.session, [k for k, each in enumerate(after.sessions) if each.name != "evening"])
    assert [len(k.points) for k in np.array(after.keyframes)[kept]] == [len(k.points) for k in before.keyframes]


def test_a_join_without_enough_evidence_is_not_made_but_told_with_its_pose(runs, call, tmp_path, monkeypatch):
    folder, truth = runs
    evening = list(PARTS).index("evening")

    def objection(joined, old, config):
        return "a reason" if evening in joined.maps else ""

    monkeypatch.setattr("scanchain.sessions.joining.objection_to", objection)
    code, _, said = call("merge", *(folder / name for name in PARTS), "--out", tmp_path / "out")
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert code == 0
    assert metrics["apart"] == [["evening"]]
    (join,) = (each for each in metrics["uncertain"] if each["session"] == "noon")
    assert (join["frame"], join["reason"]) == ("evening", "a reason")
    true = [
        truth.poses[np.searchsorted(truth.stamps_ns, open_saved_map(folder / name).keyframes[0].stamp_ns)]
        for name in ("evening", "noon")
    ]
    assert np.linalg.norm(lie.between(*true)[:2, 2] - join["position_m"]) < 0.1
    assert "noon might begin at" in said + (tmp_path / "out" / "summary.txt").read_text()
    assert "noon might begin at" in (tmp_path / "out" / "report.html").read_text()
    monkeypatch.setattr("scanchain.sessions.joining.objection_to", lambda joined, old, config: "a reason")
    code, _, said = call("merge", folder / "noon", folder / "evening", "--out", tmp_path / "two")
    assert code == 1
    assert "no two of the maps belong together for certain: noon might begin at" in said
    assert not (tmp_path / "two").exists()


@pytest.mark.slow
def test_merging_searches_and_aligns_no_more_than_runs_do(runs, tmp_path, monkeypatch):
    folder, _ = runs
    truth = read_tum(made.log("office", seed=2).with_suffix(".tum"))
    quarter_s = float(np.ptp(truth.stamps_ns)) * 1e-9 / 4.0
    parts = [tmp_path / f"part-{k}" for k in range(4)]
    for k, part in enumerate(parts):
        span = {"log__start_s": k * quarter_s, "log__end_s": (k + 1) * quarter_s}
        made.run("office", tmp_path, seed=2, **span).rename(part)
    work = {}
    for owner, name in ((PlanarMapSearch, "searched"), (Verifier, "scan"), (PoseGraph, "optimize")):
        act = getattr(owner, name)
        work[owner] = create_autospec(act, side_effect=act)
        monkeypatch.setattr(owner, name, work[owner])
    merged = quietly(*parts, folder / "stranger", out=tmp_path / "out")
    assert merged.metrics.apart == (("stranger",),)
    assert 0 < work[PlanarMapSearch].call_count < merged.metrics.keyframes / 4
    assert 0 < work[Verifier].call_count < merged.metrics.keyframes
    assert 0 < work[PoseGraph].call_count < merged.metrics.keyframes / 5


def test_sessions_of_the_same_times_are_one_only_if_their_keyframes_are(tmp_path):
    runs = [made.run("office", tmp_path / str(seed), seed=seed, seconds=8.0) for seed in (1, 2)]
    places = [run.rename(tmp_path / f"run_{k}") for k, run in enumerate(runs)]
    first, second = (open_saved_map(place).sessions[0] for place in places)
    assert first.first_stamp_ns == second.first_stamp_ns and first.last_stamp_ns == second.last_stamp_ns
    assert len(_opened(places, tmp_path / "out")) == 2
    with pytest.raises(InputError, match="begin at the same time"):
        quietly(*places, out=tmp_path / "out", update=True)
    copied = shutil.copytree(places[0], tmp_path / "copy")
    with pytest.raises(InputError, match="holds a session that"):
        _opened([places[0], copied], tmp_path / "out")
