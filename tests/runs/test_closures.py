"""Final verdicts of loop closures: wrong ones are rejected in the end; the table says what became of each."""

import json
import re
from collections import Counter, defaultdict

import msgspec
import numpy as np
import pyarrow.parquet as pq
import pytest

from scanchain.__main__ import main
from scanchain.config import GraphConfig
from scanchain.data import VERIFICATION, ClosureVerdict, Proposal
from scanchain.graph.g2o import read_g2o
from scanchain.logs import open_log
from scanchain.runs.closures import closures_table, final_verdicts
from scanchain.runs.metrics import Metrics, lines_of
from scanchain.runs.step_table import write_table
from scanchain.slam import Slam
from tests.benchmarks.harness import ate_m
from tests.support import made
from tests.support.drifting import MADE_UP, false_closures
from tests.support.scenes import configured


@pytest.fixture(scope="module")
def log():
    """Round the office's ring once and on for a while."""
    return open_log(made.log("office", seconds=110))


def driven(log):
    """The chain after the last scan, before it is asked for its result."""
    slam = Slam(configured(2), log.T_base_lidar)
    for scan in log.scans():
        slam.process(scan)
    return slam


@pytest.fixture(scope="module")
def undisturbed(log):
    return driven(log).finish()


@pytest.fixture(scope="module")
def disturbed(log):
    slam = driven(log)
    slam.back_end.placement.record(false_closures(slam, 0.3))
    return slam.finish()


def made_up(result, judged):
    return [item for item, tried in zip(judged, result.closures, strict=True) if tried.reason == MADE_UP]


def test_with_thirty_percent_wrong_loops_the_map_is_as_good_and_all_of_them_are_named(log, undisturbed, disturbed):
    judged = final_verdicts(disturbed.closures, disturbed.state)
    wrong = made_up(disturbed, judged)
    accepted = [item for item in judged if item.verdict is ClosureVerdict.ACCEPTED]
    assert len(wrong) >= 0.3 * (len(wrong) + len(accepted)) and len(wrong) >= 5
    assert all(item.verdict is ClosureVerdict.REJECTED and "contradicts" in item.reason for item in wrong)
    errors_m = [ate_m(result.trajectory, log.ground_truth()) for result in (disturbed, undisturbed)]
    assert errors_m[0] == pytest.approx(errors_m[1], rel=0.2)


def test_a_wrong_closure_keeps_a_large_chi2_and_a_true_one_ends_with_a_small_one(disturbed):
    judged = final_verdicts(disturbed.closures, disturbed.state)
    accepted = [item for item in judged if item.verdict is ClosureVerdict.ACCEPTED]
    wrong = made_up(disturbed, judged)
    assert max(item.chi2_after for item in accepted) < min(item.chi2_after for item in wrong)
    assert sum(item.chi2_after for item in accepted) < sum(item.chi2_before for item in accepted)


def test_two_closures_of_the_same_keyframes_each_have_their_own_edge(disturbed):
    judged = final_verdicts(disturbed.closures, disturbed.state)
    entered = [item for item in judged if item.rejected_by != VERIFICATION]
    loops = disturbed.state.edge_chi2[disturbed.state.is_loop]
    assert sorted(item.chi2_after for item in entered) == pytest.approx(sorted(loops.tolist()))


def test_the_table_says_who_proposed_and_what_the_graph_said(tmp_path, disturbed):
    judged = final_verdicts(disturbed.closures, disturbed.state)
    write_table(tmp_path / "loops.parquet", closures_table(judged, disturbed.keyframes, 2))
    table = pq.read_table(tmp_path / "loops.parquet").to_pydict()
    assert set(table["proposed_by"]) == {str(Proposal.POSITION)}
    for closure, before, after in zip(disturbed.closures, table["chi2_before"], table["chi2_after"], strict=True):
        entered = closure.verdict is ClosureVerdict.ACCEPTED
        assert (before is not None and before >= 0.0) == entered
        assert (after is not None and after >= 0.0) == entered


def test_the_table_groups_closures_by_a_cause_without_figures(forced):
    table = pq.read_table(forced / "loops.parquet").to_pydict()
    causes = defaultdict(set)
    for cause, reason in zip(table["cause"], table["reason"], strict=True):
        causes[cause].add(reason)
    assert len(causes["contradicts the rest of the graph"]) >= 5
    assert causes["verified by matching"] == {"verified by matching"}
    assert len(causes["overlap < loops.min_overlap"]) > 1
    assert len(causes) <= 8 < len(set(table["reason"]))


@pytest.fixture(scope="module")
def forced(log, tmp_path_factory):
    """The directory of a run into which false loops were forced at its end."""

    finish = Slam.finish

    def finish_forced(slam, progress):
        slam.back_end.placement.record(false_closures(slam, 0.3))
        return finish(slam, progress)

    out = tmp_path_factory.mktemp("forced") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Slam, "finish", finish_forced)
        main(["run", str(log.paths[0]), "--out", str(out), "--odometry.prior", "constant-velocity"])
    return out


@pytest.fixture
def metrics(forced):
    return json.loads((forced / "metrics.json").read_bytes())


def moved_m(poses, others):
    return np.linalg.norm((poses - others)[:, :-1, -1], axis=1).max()


def by_gtsam(path):
    """The poses of a graph's minimum by GTSAM, started from the file's own."""
    gtsam = pytest.importorskip("gtsam")
    graph, values = gtsam.readG2o(str(path), False)
    graph.add(gtsam.PriorFactorPose2(0, values.atPose2(0), gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return np.array([found.atPose2(index).matrix() for index in range(found.size())])


def test_optimizing_the_graph_of_a_run_with_false_loops_does_not_move_its_poses(forced, metrics):
    assert metrics["closures_rejected_by_back_end"] >= 5
    graph = read_g2o(forced / "graph.g2o").graph
    before = graph.poses
    answer = graph.optimize(GraphConfig())
    assert moved_m(graph.poses, before) < 1e-3
    assert answer.chi2_before == pytest.approx(metrics["chi2"], rel=1e-6)
    assert (
        answer.state.degrees_of_freedom == metrics["degrees_of_freedom"] == 3 * (len(graph.edges) - len(graph) + 1)
    )
    assert moved_m(by_gtsam(forced / "graph.g2o"), before) < 1e-3


def test_rejected_loops_stand_in_a_file_of_their_own(forced, metrics):
    rejected = read_g2o(forced / "graph_rejected.g2o").graph
    table = pq.read_table(forced / "loops.parquet").to_pylist()
    named = [[row["target"], row["source"]] for row in table if "contradicts" in row["reason"]]
    assert rejected.edges.tolist() == named and len(named) == metrics["closures_rejected_by_back_end"]
    kept = read_g2o(forced / "graph.g2o").graph
    assert np.array_equal(rejected.poses, kept.poses)
    kept.add_edges(rejected.edges, rejected.measurements, rejected.information, np.zeros(len(named), bool))
    before = kept.poses
    kept.optimize(GraphConfig(), initialize="given")
    assert moved_m(kept.poses, before) > 0.5  # what a graph with all of them would do


def test_chi2_counts_what_is_in_force_with_its_degrees_of_freedom(forced, metrics):
    assert metrics["chi2"] < 5.0 * metrics["degrees_of_freedom"]
    said = re.search(
        r"χ² ([0-9.,]+) over ([0-9,]+) degrees of freedom, ([0-9]+) closures rejected by the back end",
        (forced / "summary.txt").read_text(encoding="utf-8"),
    )
    chi2, degrees, rejected = (float(word.replace(",", "")) for word in said.groups())
    assert chi2 == pytest.approx(metrics["chi2"], rel=0.01)
    assert (degrees, rejected) == (metrics["degrees_of_freedom"], metrics["closures_rejected_by_back_end"])
    assert said[0] in (forced / "report.html").read_text(encoding="utf-8")


def test_closures_tried_are_those_rejected_by_verification_or_by_the_back_end_and_those_accepted(forced, metrics):
    tried, by_verification, verified, by_back_end, accepted = (
        metrics[f"closures_{name}"]
        for name in ("tried", "rejected_by_verification", "verified", "rejected_by_back_end", "accepted")
    )
    assert min(by_verification, by_back_end, accepted) > 0
    assert tried == by_verification + verified and verified == by_back_end + accepted
    rows = pq.read_table(forced / "loops.parquet").to_pylist()
    assert Counter(row["rejected_by"] for row in rows) == {
        "verification": by_verification, "back end": by_back_end, "": accepted
    }  # fmt: skip
    assert all((row["verdict"] == "accepted") == (not row["rejected_by"]) for row in rows)
    line = (
        f"{tried:,} tried: {by_verification:,} rejected by verification, {by_back_end:,} by the back end, "
        f"{accepted:,} accepted"
    )
    page = (forced / "report.html").read_text(encoding="utf-8")
    assert f"loop closures  {line}\n" in (forced / "summary.txt").read_text(encoding="utf-8")
    assert f"<dd>{line}</dd>" in page
    legend = Counter(re.findall(r"</i>(?:closures )?((?:rejected by|accepted)[^:<]*: [\d,]+)", page))
    assert legend == {
        f"rejected by verification: {by_verification:,}": 1,
        f"rejected by the back end: {by_back_end:,}": 1,
        f"accepted: {accepted:,}": 1,
    }


def test_loops_without_degrees_of_freedom_are_not_said_to_be_none(forced):
    metrics = msgspec.json.decode((forced / "metrics.json").read_bytes(), type=Metrics)
    said = dict(lines_of(msgspec.structs.replace(metrics, chi2=2.0, degrees_of_freedom=0)))
    assert said["pose graph"].startswith("χ² 2 over 0 degrees")


def test_a_run_without_loops_has_none_to_check(tmp_path, log):
    words = ["run", log.paths[0], "--out", tmp_path / "run", "--end", "3", "--no-loops", "--rerun", "off"]
    assert main([str(word) for word in words]) == 0
    said = (tmp_path / "run" / "summary.txt").read_text(encoding="utf-8")
    assert "no loops to check" in said and "χ²" not in said
    assert not (tmp_path / "run" / "graph_rejected.g2o").exists()
