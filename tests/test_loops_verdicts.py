"""The last word on loop closures: wrong ones are found out, and the table says what became of each."""

import pyarrow.parquet as pq
import pytest
from false_loops import MADE_UP, false_closures
from scenes import configured

from pipeline.config import LogConfig
from pipeline.data import Proposal, Verdict
from pipeline.evaluate import absolute_error, pair
from pipeline.logs import open_log
from pipeline.runs.closure_table import write_closures
from pipeline.runs.verdicts import final_verdicts
from pipeline.simulate import simulate
from pipeline.slam import Slam

DURATION_S = 110.0  # round the office's ring once and on for a while


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("office") / "office.mcap"
    simulate("office", path, duration_s=DURATION_S)
    return open_log([path], LogConfig())


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
    slam._take(false_closures(slam, 0.3))
    return slam.finish()


def ate_m(result, log):
    return absolute_error(pair(result.trajectory, log.ground_truth())).translation_m.rmse


def test_with_thirty_percent_wrong_loops_the_map_is_as_good_and_all_of_them_are_named(log, undisturbed, disturbed):
    judged = final_verdicts(disturbed.closures, disturbed.state)
    wrong = [item for item in judged if item.closure.reason == MADE_UP]
    accepted = [item for item in judged if item.verdict is Verdict.ACCEPTED]
    assert len(wrong) >= 0.3 * (len(wrong) + len(accepted)) and len(wrong) >= 5
    assert all(item.verdict is Verdict.REJECTED and "contradicts" in item.reason for item in wrong)
    assert ate_m(disturbed, log) == pytest.approx(ate_m(undisturbed, log), rel=0.2)


def test_a_wrong_closure_keeps_a_large_chi2_and_a_true_one_ends_with_a_small_one(disturbed):
    judged = final_verdicts(disturbed.closures, disturbed.state)
    accepted = [item for item in judged if item.verdict is Verdict.ACCEPTED]
    wrong = [item for item in judged if item.closure.reason == MADE_UP]
    assert max(item.chi2_after for item in accepted) < min(item.chi2_after for item in wrong)
    assert sum(item.chi2_after for item in accepted) < sum(item.closure.chi2_before for item in accepted)


def test_two_closures_of_the_same_keyframes_each_have_their_own_edge(disturbed):
    judged = final_verdicts(disturbed.closures, disturbed.state)
    entered = [item for item in judged if item.closure.verdict is Verdict.ACCEPTED]
    loops = disturbed.state.edge_chi2[disturbed.state.is_loop]
    assert sorted(item.chi2_after for item in entered) == pytest.approx(sorted(loops.tolist()))


def test_the_table_says_who_proposed_and_what_the_graph_said(tmp_path, disturbed):
    judged = final_verdicts(disturbed.closures, disturbed.state)
    write_closures(tmp_path / "loops.parquet", judged, disturbed.keyframes, 2)
    table = pq.read_table(tmp_path / "loops.parquet").to_pydict()
    assert set(table["proposed_by"]) == {str(Proposal.POSITION)}
    for closure, before, after in zip(disturbed.closures, table["chi2_before"], table["chi2_after"], strict=True):
        entered = closure.verdict is Verdict.ACCEPTED
        assert (before is not None and before >= 0.0) == entered
        assert (after is not None and after >= 0.0) == entered
