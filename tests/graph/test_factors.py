"""Factors by kind: Jacobians, what one of a single pose takes part in, factors of one's own, priors in files."""

from dataclasses import replace

import numpy as np
import pytest

from scanchain import lie
from scanchain.config import GraphConfig
from scanchain.data import KeyframeErrors
from scanchain.errors import InputError
from scanchain.evaluation.consistency import with_map_errors
from scanchain.graph.factors import FACTORS, ORIGIN, Factor, Odometry, Position, Prior, RobustPosition, RobustPrior
from scanchain.graph.g2o import read_g2o, write_g2o
from scanchain.graph.optimization import GraphChange
from scanchain.graph.pose_graph import PoseGraph
from scanchain.loops.connectivity import Drift, Segments
from scanchain_viz.recording import entities
from scanchain_viz.recording.results import record_graph
from scanchain_viz.report.problems import draw_graph
from tests.support.graphs import graph_of
from tests.support.recordings import column
from tests.support.scenes import configured


class Range(Factor):
    """Distance of a beacon at a known place."""

    name = "range to a beacon"

    def __init__(self, beacon, range_m):
        self.beacon, self.range_m = np.asarray(beacon, float), range_m

    def error(self, T_ij, Z):
        d = Z.shape[-1] - 1
        return np.linalg.norm(self.beacon - T_ij[:, :d, d], axis=1)[:, None] - self.range_m


class Heading(Factor):
    """Yaw of a compass."""

    name = "heading"
    is_robust = True

    def error(self, T_ij, Z):
        return lie.wrap(lie.yaw(T_ij) - lie.yaw(Z))[:, None]


CUSTOM = (Range((3.0, -2.0), 4.0), Heading())


def drive(count=8, off=0.0):
    """A quarter of a circle in the plane, by odometry, and where it really is."""
    step = lie.pose_2d(1.0, 0.0, 0.2)
    true = [lie.identity(2)]
    for _ in range(count - 1):
        true.append(true[-1] @ step)
    edges = np.array([(k, k + 1) for k in range(count - 1)])
    measured = [step @ lie.exp(np.array([off, off, off])) for _ in edges]
    return graph_of(np.array(true), edges, measured, np.diag([100.0, 100.0, 1000.0])), np.array(true)


@pytest.mark.parametrize("factor", [*FACTORS, *CUSTOM], ids=lambda factor: f"{type(factor).__name__}")
@pytest.mark.parametrize("dimension", [2, 3])
def test_the_jacobian_is_that_of_left_twists_and_of_its_own_error(factor, dimension):
    if dimension == 3 and factor in CUSTOM:
        factor = Range((3.0, -2.0, 1.0), 4.0)
    rng, k = np.random.default_rng(3), lie.twist_size(lie.identity(dimension))
    poses, edges = lie.exp(rng.normal(size=(4, k))), np.array([[0, 1], [2, 3]])
    Z = lie.exp(rng.normal(size=(2, k)))
    errors = factor.residual(poses, edges, Z)
    own = factor.error(lie.between(*poses[edges.T]), Z)
    assert np.allclose(errors[:, : own.shape[1]], own) and not errors[:, own.shape[1] :].any()
    J = factor.linearize(poses, edges, Z, errors)
    for axis, twist in enumerate(1e-6 * np.eye(k)):
        for end, sign in ((1, 1.0), (0, -1.0)):
            ahead, behind = poses.copy(), poses.copy()
            ahead[edges[:, end]] = lie.exp(twist) @ ahead[edges[:, end]]
            behind[edges[:, end]] = lie.exp(-twist) @ behind[edges[:, end]]
            slope = (factor.residual(ahead, edges, Z) - factor.residual(behind, edges, Z)) / 2e-6
            assert np.allclose(sign * J[:, :, axis], slope, atol=1e-6)


def test_positions_in_the_world_place_a_graph_that_hangs_on_nothing_else():
    graph, true = drive(off=0.03)
    moved = lie.pose_2d(50.0, -20.0, 1.0) @ true
    for k in (0, 4, 7):
        graph.add_factor(Position(), k, 1e6 * np.eye(2), lie.pose_2d(*moved[k][:2, 2], 0.0))
    assert not graph.fixed.any()
    before = len(graph.poses)
    done = graph.optimize(GraphConfig())
    assert done.converged and len(graph.poses) == before
    assert np.allclose(graph.poses[[0, 4, 7], :2, 2], moved[[0, 4, 7], :2, 2], atol=0.02)
    assert np.allclose(lie.yaw(graph.poses), lie.yaw(moved), atol=0.15)
    deviations = np.sqrt(graph.covariances()[[0, 2], 0, 0])
    assert deviations[0] < 0.002 < deviations[1]
    assert done.state.degrees_of_freedom == 3 * 7 + 3 * 2 - 3 * 8


def test_a_position_of_one_pose_is_neither_odometry_nor_loop_and_enters_chi2_and_certificate():
    graph, true = drive()
    graph.add_edge(0, 7, lie.between(true[0], true[7]), 100.0 * np.eye(3), is_loop=True)
    without = graph.optimize(GraphConfig())
    graph.add_factor(Prior(), 0, 1e4 * np.eye(3))
    graph.add_factor(Position(), 7, np.eye(2), lie.pose_2d(*(true[7][:2, 2] + [0.1, 0.0]), 0.0))
    position = graph.edges[:, 0] == ORIGIN
    assert position.sum() == 2 and not (position & (graph.is_loop | graph.is_odometry)).any()
    after = graph.optimize(GraphConfig())
    assert without.chi2_after < 1e-12 < 1e-3 < after.chi2_after < 0.02
    assert after.state.edges[-1].tolist() == [0, 7]  # loops last
    assert graph.certify().certified
    assert "10 edges, 1 of them loops" in repr(graph)
    config, segments, drift = configured(2), Segments(), Drift(0.01)
    assert np.isfinite(drift.between(graph, 0, 10.0)).all()
    segments.start(4)
    assert segments.components(graph).max() == 0  # joined by the loop alone
    graph.remove_edges(graph.is_loop)
    assert segments.components(graph).tolist() == [0] * 4 + [1] * 4
    errors = [KeyframeErrors(1.0, np.zeros((3, 3)), 0.5)] * len(graph)
    judged, own = with_map_errors(graph, errors, config)
    position = graph.edges[:, 0] == ORIGIN
    assert np.array_equal(judged.information[position], graph.information[position])
    assert not np.array_equal(judged.information[~position], graph.information[~position])
    assert np.isfinite(own).all()


@pytest.mark.parametrize("with_position", [False, True])
def test_a_position_of_one_pose_switches_off_no_explanation(with_position):
    """Odometry is 3 % too short, and loops that agree show it."""
    count, step = 120, lie.pose_2d(1.0, 0.0, 2.0 * np.pi / 60)
    true = [lie.identity(2)]
    for _ in range(count - 1):
        true.append(true[-1] @ step)
    short = lie.pose_2d(0.97, 0.0, 2.0 * np.pi / 60)
    chain = [(k, k + 1) for k in range(count - 1)]
    loops = [(k, k + 60) for k in range(0, 60, 3)] + [(k, k + 20) for k in range(0, 90, 7)]
    measured = [short] * len(chain) + [lie.between(true[i], true[j]) for i, j in loops]
    is_loop = np.arange(len(measured)) >= len(chain)
    sigma = np.array([0.002, 0.002, 0.002])
    graph = graph_of(np.array(true), np.array(chain + loops), measured, np.diag(sigma**-2), is_loop)
    if with_position:
        graph.fix(0)
        graph.add_factor(Position(), 100, 1e-2 * np.eye(2), lie.pose_2d(*true[100][:2, 2], 0.0))
    graph.optimize(GraphConfig())
    assert graph.drift[0] == pytest.approx(1.0 / 0.97 - 1.0, rel=0.1) and not graph.is_rejected.any()


def test_a_range_and_a_heading_of_ones_own_move_the_poses_and_are_refused_by_the_certificate(tmp_path):
    graph, true = drive(off=0.02)
    graph.fix(0)
    for k in (3, 7):
        for beacon in ((10.0, 0.0), (0.0, 10.0)):
            distance_m = float(np.linalg.norm(beacon - true[k][:2, 2]))
            graph.add_factor(Range(beacon, distance_m), k, [[1e6]])
        graph.add_factor(Heading(), k, [[1e6]], true[k])
    assert graph.optimize(GraphConfig()).converged
    assert np.allclose(graph.poses[[3, 7]], true[[3, 7]], atol=2e-3)
    assert not np.allclose(graph.poses[5], true[5], atol=2e-3)
    found = graph.certify()
    assert not found.certified and found.verdict.endswith(
        "; bounded by zero: 6 edges of heading and range to a beacon"
    )
    with pytest.warns(UserWarning, match="no tag for 6 edges of custom factors"):
        write_g2o(tmp_path / "x.g2o", graph)
    assert len(read_g2o(tmp_path / "x.g2o").graph.edges) == 7


def test_a_robust_factor_of_ones_own_is_rejected_where_it_contradicts_the_rest():
    graph, true = drive()
    graph.fix(0)
    graph.add_factor(Heading(), 3, [[1e4]], true[3])
    graph.add_factor(Heading(), 5, [[1e4]], true[5] @ lie.pose_2d(0.0, 0.0, 2.0))
    graph.optimize(GraphConfig())
    assert graph.is_rejected.tolist() == [False] * 8 + [True]
    assert not graph.is_loop.any() and np.allclose(graph.poses, true, atol=1e-6)


@pytest.mark.parametrize("dimension", [2, 3])
def test_priors_go_to_a_file_and_back(dimension, tmp_path):
    rng, k = np.random.default_rng(1), lie.twist_size(lie.identity(dimension))
    true = lie.exp(rng.normal(size=(4, k)))
    edges = np.array([[0, 1], [1, 2], [2, 3]])
    measured = lie.between(true[edges[:, 0]], true[edges[:, 1]])
    graph = graph_of(true, edges, measured, 50.0 * np.eye(k))
    A = rng.normal(size=(k, k))
    graph.add_factor(Prior(), 0, A @ A.T + np.eye(k), true[0] @ lie.exp(0.01 * rng.normal(size=k)))
    graph.add_factor(Position(), 2, 7.0 * np.eye(dimension), true[2] @ lie.exp(0.01 * rng.normal(size=k)))
    ids = np.array([5, 6, 8, 9])
    write_g2o(tmp_path / "x.g2o", graph, ids=ids)
    again = read_g2o(tmp_path / "x.g2o").graph
    assert np.array_equal(again.edges, graph.edges) and not again.left_out
    config = GraphConfig(robust="none")
    one, other = graph.optimize(config), again.optimize(config)
    assert one.chi2_after == pytest.approx(other.chi2_after, rel=1e-6) and one.chi2_after > 1e-4
    assert np.allclose(graph.poses, again.poses, atol=1e-7)
    assert graph.certify().certified and again.certify().certified
    with pytest.raises(InputError, match="TORO has no priors, and the graph has 2"):
        write_g2o(tmp_path / "x.graph", graph)


def test_a_prior_of_a_sensor_beside_the_vertex_is_refused(tmp_path):
    omega = " ".join(["1" if a == b else "0" for a in range(6) for b in range(a, 6)])
    pose = "0 0 0 0 0 0 1"
    lines = ["PARAMS_SE3OFFSET 0 0.1 0 0 0 0 0 1", *(f"VERTEX_SE3:QUAT {k} {pose}" for k in (0, 1))]
    lines += [f"EDGE_SE3:QUAT 0 1 {pose} {omega}", f"EDGE_SE3_PRIOR 1 0 {pose} {omega}"]
    (tmp_path / "x.g2o").write_text("\n".join(lines))
    with pytest.raises(InputError, match=r"x.g2o:5: EDGE_SE3_PRIOR with an offset of the sensor"):
        read_g2o(tmp_path / "x.g2o")


def test_pictures_and_recordings_draw_no_line_to_the_origin(tmp_path):
    graph, true = drive()
    before = graph.state()
    for k in (0, 7):
        graph.add_factor(Prior(), k, np.eye(3), true[k])
    change = GraphChange("drive", before, graph.optimize(GraphConfig()).state)
    draw_graph(change, tmp_path / "graph.png")
    record_graph(change, tmp_path / "graph.rrd")
    chain = column(tmp_path / "graph.rrd", entities.ODOMETRY_EDGES, "LineStrips3D:strips")
    assert len(chain[-1]) == 7 and not column(tmp_path / "graph.rrd", entities.ACCEPTED, "LineStrips3D:strips")[-1]


class Flat(Factor):
    def error(self, T_ij, Z):
        return np.zeros(len(T_ij))


@pytest.mark.parametrize(
    ("factor", "words", "text"),
    [
        (Heading, {}, "factor is .*; wanted a Factor"),
        (Heading(), {"j": 9}, "factor of pose 9 joins a pose that is not there"),
        (Heading(), {"information": np.eye(2)}, r"Heading.error returned .*; wanted .* of the shape \(2, 2\)"),
        (Heading(), {"information": np.eye(4)}, r"information has the shape \(4, 4\); wanted \(m, m\)"),
        (Flat(), {}, r"Flat.error returned \[0.0, 0.0\]; wanted finite numbers of the shape \(2, 1\)"),
        (Range((np.nan, 0.0), 1.0), {}, "Range.error returned"),
    ],
)  # fmt: skip
def test_a_factor_that_cannot_be_is_one_line(factor, words, text):
    graph, _ = drive(3)
    with pytest.raises(InputError, match=text) as raised:
        graph.add_factor(factor, **({"j": 1, "information": [[1.0]]} | words))
    assert "\n" not in str(raised.value) and len(graph.edges) == 2


def test_a_copy_goes_on_with_the_factors_of_the_graph():
    graph, true = drive(off=0.02)
    graph.add_factor(Prior(), 0, 1e6 * np.eye(3))
    graph.add_factor(Heading(), 7, [[1e6]], true[7])
    copy = graph.copy()
    copy.optimize(GraphConfig())
    graph.optimize(GraphConfig())
    assert np.array_equal(copy.poses, graph.poses)
    assert isinstance(copy, PoseGraph) and replace(copy.state()).edges.min() == ORIGIN


class Slotted(Heading):
    __slots__ = ("yaw_rad",)

    def __init__(self, yaw_rad):
        self.yaw_rad = yaw_rad

    def error(self, T_ij, Z):
        return lie.wrap(lie.yaw(T_ij) - self.yaw_rad)[:, None]


def test_factors_with_parameters_stay_apart_and_a_prior_far_off_is_named_in_the_certificate():
    graph, true = drive(3)
    graph.fix(0)
    for k in (1, 2):
        graph.add_factor(Slotted(0.3 * k), k, [[1e8]])
    graph.optimize(GraphConfig())
    assert np.allclose(lie.yaw(graph.poses[1:]), [0.3, 0.6], atol=1e-3)
    graph, true = drive(4)
    graph.add_factor(Prior(), 0, np.eye(3), true[0])
    graph.add_factor(Prior(), 3, np.eye(3), true[3] @ lie.pose_2d(0.0, 0.0, 2.5))
    graph.optimize(GraphConfig())
    assert not graph.certify().certified
    with pytest.raises(InputError, match="Odometry is measured from another pose; give i, or take Prior"):
        graph.add_factor(Odometry(), 1, np.eye(3), true[1])


def test_a_prior_is_measured_anew_from_the_origin_and_no_custom_factor_places_a_point():
    graph, true = drive(4)
    graph.add_factor(Prior(), 2, np.eye(3), true[3])
    graph.remeasure(3)
    assert np.allclose(graph.measurements[3], true[2])
    graph.fix(0)
    point = graph.add_point(np.array([9.0, 9.0]), 4)
    graph.add_edge(3, point, lie.pose_2d(2.0, 0.0, 0.0), np.diag([1e4, 1e4, 0.0]))
    graph.add_factor(Range((0.0, 0.0), float(np.linalg.norm((true[3] @ [2.0, 0.0, 1.0])[:2]))), point, [[1.0]])
    assert graph.optimize(GraphConfig(), initialize="odometry").iterations <= 2
    assert np.allclose(graph.poses[point, :2, 2], (true[3] @ [2.0, 0.0, 1.0])[:2])


def test_a_prior_without_information_constrains_nothing():
    graph, true = drive(off=0.02)
    plain, _ = drive(off=0.02)
    graph.add_factor(Prior(), 4, np.zeros((3, 3)), true[4] @ lie.pose_2d(5.0, 0.0, 1.0))
    for initialize in ("auto", "odometry", "chordal"):
        graph.optimize(GraphConfig(), initialize=initialize)
        plain.optimize(GraphConfig(), initialize=initialize)
        assert np.allclose(graph.poses, plain.poses, atol=1e-9)
    assert graph.fixed.tolist() == [True] + [False] * 7 and graph.certify().certified
    assert np.isfinite(graph.covariances()).all()


def test_the_origin_is_no_pose_in_messages():
    graph, true = drive(3)
    graph.add_factor(Prior(), 0, np.eye(3), true[0])
    lone = graph.add_pose(lie.identity(2), 9)
    with pytest.raises(InputError, match=f"1 of 4 poses are not joined to a fixed one: {lone};"):
        graph.optimize(GraphConfig())
    graph, true = drive(4)
    graph.add_factor(Prior(), 2, np.eye(3), true[2] @ lie.pose_2d(0.0, 0.0, 2.5))
    graph.add_factor(Prior(), 0, np.eye(3), true[0])
    graph.optimize(GraphConfig())
    assert "the origin" not in graph.certify().verdict


@pytest.mark.parametrize("robust", ["truncated", "huber", "geman-mcclure"])
@pytest.mark.parametrize(("off_rad", "is_rejected"), [(3.2, False), (3.4, True)])
def test_a_factor_is_rejected_above_the_limit_for_its_own_number_of_residuals(robust, off_rad, is_rejected):
    """The 99.9 % quantile of χ² is 3.29² for one residual, and 4.03² for three."""
    graph, true = drive()
    graph.fix(0)
    for k in range(7):
        graph.add_edge(k, k + 1, lie.between(true[k], true[k + 1]), 1e8 * np.eye(3))
    graph.add_factor(Heading(), 5, [[1e4]], true[5] @ lie.pose_2d(0.0, 0.0, 1e-2 * off_rad))
    graph.optimize(GraphConfig(robust=robust))
    assert graph.is_rejected.tolist() == [False] * 14 + [is_rejected]


@pytest.mark.parametrize("robust", ["truncated", "huber", "cauchy"])
@pytest.mark.parametrize("factor", [RobustPosition(), RobustPrior()], ids=lambda factor: type(factor).__name__)
@pytest.mark.parametrize("dimension", [2, 3])
def test_outliers_among_robust_priors_are_rejected_and_are_seen_in_the_result(dimension, factor, robust, tmp_path):
    rng, k, count = np.random.default_rng(2), lie.twist_size(lie.identity(dimension)), 40
    step = lie.exp(np.eye(k)[0] + 0.15 * np.eye(k)[-1])
    true = [lie.exp(rng.normal(size=k))]
    for _ in range(count - 1):
        true.append(true[-1] @ step)
    true, sigma = np.array(true), np.full(k, 0.01)
    edges = np.array([(i, i + 1) for i in range(count - 1)])
    measured = lie.between(*true[edges.T]) @ lie.exp(sigma * rng.normal(size=(count - 1, k)))
    graph = graph_of(lie.inverse(true[0]) @ true, edges, measured, np.diag(sigma**-2.0))
    m = dimension if isinstance(factor, Position) else k
    for j in range(0, count, 2):
        graph.add_factor(factor, j, 100.0 * np.eye(m), true[j] @ lie.exp(0.1 * rng.normal(size=k)))
    for j in (6, 13, 20, 27):
        off = lie.exp(rng.choice([-3.0, 3.0], size=k) * (np.arange(k) < dimension))
        graph.add_factor(factor, j, 100.0 * np.eye(m), true[j] @ off)
    done = graph.optimize(GraphConfig(robust=robust))
    assert not graph.is_loop.any() and not graph.fixed.any()
    assert np.array_equal(done.rejected, np.arange(len(graph.edges)) >= len(graph.edges) - 4)
    assert np.array_equal(done.rejected, graph.is_rejected)
    assert np.linalg.norm((graph.poses - true)[:, :dimension, dimension], axis=1).max() < 0.3
    assert np.isfinite(graph.covariances()).all()
    write_g2o(tmp_path / "x.g2o", graph)
    assert len(read_g2o(tmp_path / "x.g2o").graph.edges) == len(graph.edges) - 4


def test_the_relative_covariance_is_of_two_poses_of_the_graph():
    graph, true = drive(3)
    graph.add_factor(Prior(), 0, np.eye(3), true[0])
    graph.optimize(GraphConfig())
    assert np.isfinite(graph.relative_covariance(0, 2)).all()
    for i, j in ((ORIGIN, 2), (0, ORIGIN), (0, 3)):
        with pytest.raises(InputError, match=r"is (-1|3), and the graph has 3 poses"):
            graph.relative_covariance(i, j)
