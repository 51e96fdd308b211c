import numpy as np
import pytest

from scanchain import lie
from scanchain.config import GraphConfig
from scanchain.errors import InputError
from scanchain.graph import schedule
from scanchain.graph.pose_graph import PoseGraph
from scanchain.graph.schedule import BackgroundOptimization, Plan, Schedule
from tests.support.graphs import graph_of, published

SIGMA = np.array([0.01, 0.01, 0.005])
LAP = 60  # poses


class Laps:
    """A graph of laps that grows, each pose closed to the one a lap before, and its schedule."""

    def __init__(self, wrong_at=-1):
        self.graph = PoseGraph(2)
        self.schedule = Schedule(self.graph, GraphConfig(), 0.5)
        self.wrong_at, self.rng = wrong_at, np.random.default_rng(1)
        self.optimized = []  # number of poses and the first that moved, each time

    def grow(self, count, *, closes=True, is_live=False):
        for index in range(len(self.graph), count):
            Z = lie.pose_2d(1.0, 0.0, 2 * np.pi / LAP) @ self.noise()
            moved = Z @ lie.pose_2d(-2.0, 1.0, 0.1) if index == self.wrong_at else Z
            if index:
                self.graph.add_pose(self.graph.poses[-1] @ moved, index)
                self.graph.add_edge(index - 1, index, moved, np.diag(SIGMA**-2))
            else:
                self.graph.add_pose(lie.identity(2), 0)
            if closes and index >= LAP:
                self.close(index - LAP, index)
            first = self.schedule.advance(is_live=is_live)
            if first < len(self.graph):
                self.optimized.append((len(self.graph), first))

    def noise(self):
        return lie.exp(0.3 * SIGMA * self.rng.normal(size=3))

    def close(self, target, source, off_m=0.0, **options):
        T_old, T_new = self.graph.poses[[target, source]]
        Z = lie.pose_2d(off_m, 0.0, 0.0) @ self.noise()
        error = lie.log(lie.between(Z, lie.between(T_old, T_new)))
        self.graph.add_edge(target, source, Z, np.diag(SIGMA**-2), is_loop=True)
        chi2 = float((error**2 / SIGMA**2).sum())
        self.schedule.record_closure(source, float(np.linalg.norm(error[:2])), chi2, **options)


def test_closures_that_fit_wait_until_the_graph_has_grown_by_a_share():
    laps = Laps()
    laps.grow(400)
    counts = np.array([count for count, _ in laps.optimized])
    assert counts[0] == LAP + 1 and counts[-1] > 370 and all(first == 0 for _, first in laps.optimized)
    assert (np.diff(counts) >= np.maximum(10, 0.05 * counts[:-1])).all()


def test_a_closure_that_moves_the_map_is_optimized_in_soon_and_one_that_joins_a_segment_at_once():
    laps = Laps()
    laps.grow(398)
    before = laps.schedule.optimized_at
    laps.close(LAP, 397, 1.0)
    laps.grow(max(before + 10, 400), closes=False)
    assert before < laps.optimized[-1][0] == max(before + 10, 399)
    laps.close(LAP, len(laps.graph) - 1, 1.0, joins=True)
    laps.grow(len(laps.graph) + 1, closes=False)
    assert laps.optimized[-1] == (len(laps.graph), 0)


def test_a_jump_of_a_large_graph_is_found_in_the_poses_since_the_last_closure_that_agreed(monkeypatch):
    monkeypatch.setattr(schedule, "LARGE", 200)
    monkeypatch.setattr(schedule, "LAG", 50)
    laps = Laps(wrong_at=600)
    laps.grow(659)
    assert laps.graph.corrections(np.arange(659))
    assert all(first >= 500 for count, first in laps.optimized if count > 601 and first)
    lap = laps.graph.poses[-10:, :2, 2]
    assert np.abs(lap - laps.graph.poses[-LAP - 10 : -LAP, :2, 2]).max() < 0.1


def test_all_poses_are_updated_where_that_is_little_work_and_else_the_last_ones(monkeypatch):
    monkeypatch.setattr(schedule, "LAG", 50)
    laps = Laps()
    laps.grow(300)
    laps.graph.work = 1e9
    laps.grow(330)
    assert laps.optimized[-1][1] == laps.optimized[-1][0] - 50
    laps.graph.work = 1e6
    laps.grow(360)
    assert laps.optimized[-1][1] == 0


def test_a_live_log_waits_for_no_long_optimization_of_a_large_graph(monkeypatch):
    monkeypatch.setattr(schedule, "LARGE", 200)
    laps = Laps()
    laps.grow(300, is_live=True)
    assert laps.schedule.background is not None and laps.schedule.background.due > 300
    laps.grow(laps.schedule.background.due, is_live=True)
    assert laps.optimized[-1] == (len(laps.graph), 0) and laps.schedule.background is None


def test_an_optimization_beside_takes_the_graph_as_it_was_and_moves_what_was_added_since():
    whole, graph = published("intel"), published("intel")
    before, last = graph.poses[-1].copy(), len(graph) - 1
    beside = BackgroundOptimization(graph, GraphConfig(), Plan(0, "judge"), len(graph) + 1)
    T_last_new, information = lie.pose_2d(1.0, 0.2, 0.3), np.eye(3)
    graph.add_edge(last, graph.add_pose(before @ T_last_new, 1), T_last_new, information)
    graph.add_edge(0, last, lie.pose_2d(90.0, 0.0, 0.0), information, is_loop=True)
    graph.adopt(beside.result())
    optimized = whole.optimize(GraphConfig(), initialize="given").state.poses
    assert np.array_equal(graph.poses[:-1], optimized) and not np.allclose(optimized[-1], before)
    assert np.allclose(lie.between(graph.poses[last], graph.poses[-1]), T_last_new, atol=1e-9)
    assert np.array_equal(graph.weight, [*whole.weight, 1.0, 1.0])


def test_an_error_of_an_optimization_beside_is_raised_where_its_result_is_taken():
    graph = graph_of([lie.identity(2)] * 2)
    beside = BackgroundOptimization(graph, GraphConfig(), Plan(0, "judge"), 2)
    with pytest.raises(InputError, match="not joined to a fixed one"):
        beside.result()
