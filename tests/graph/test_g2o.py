import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scanchain import lie
from scanchain.__main__ import main
from scanchain.errors import InputError
from scanchain.graph.edge_checks import positive_semidefinite
from scanchain.graph.factors import Prior
from scanchain.graph.g2o import read_g2o, write_g2o
from scanchain.settings import load_settings
from tests.support.graphs import graph_of
from tests.support.scenes import shared_data

SQUARE = """\
# a comment
VERTEX_SE2 10 0 0 0
VERTEX_SE2 20 1.1 0.1 1.5
VERTEX_XY 7 3 4
FIX 20
VERTEX_SE2 30 1 1.2 3.1
EDGE_SE2 10 20 1 0 1.5707963267948966 4 0.5 0.25 5 0 6
EDGE_SE2 20 30 1 0 1.5707963267948966 4 0 0 5 0 6
EDGE_SE2 30 10 1.4142135623730951 0 0 4 0 0 5 0 6
EDGE_SE2_XY 10 7 1 2 1 0.5 3
EDGE_BEARING_SE2_XY 10 7 1 2
"""


@pytest.fixture
def read(tmp_path):
    """Write this text to a file and read it as a graph."""

    def written(text, name="x.g2o", **options):
        (tmp_path / name).write_text(text)
        return read_g2o(tmp_path / name, **options)

    return written


@pytest.mark.parametrize("suffix", [".g2o", ".graph"])
@pytest.mark.parametrize("name", ["manhattan", "intel", "smallGrid3D"])
def test_what_is_written_reads_back_the_same(name, suffix, tmp_path):
    first, path = read_g2o(shared_data(f"graphs/{name}.g2o")), tmp_path / f"again{suffix}"
    write_g2o(path, first.graph, ids=first.ids, other_lines=first.other_lines)
    second = read_g2o(path)
    assert second.has_guess and second.other_lines == first.other_lines
    assert_same(first.graph, second.graph)


def assert_same(first, second):
    for name in ("edges", "is_point", "information", "held"):
        assert np.array_equal(getattr(first, name), getattr(second, name))
    for name in ("poses", "measurements"):
        assert np.allclose(getattr(first, name), getattr(second, name), rtol=0, atol=1e-12)


def test_the_numbers_of_a_line_go_where_they_belong(read):
    file = read(SQUARE)
    graph = file.graph
    assert file.ids.tolist() == [10, 20, 30, 7]
    assert graph.edges.tolist() == [[0, 1], [1, 2], [2, 0], [0, 3]]
    assert graph.is_point.tolist() == [False, False, False, True]
    assert np.allclose(graph.poses[3], lie.pose_2d(3.0, 4.0, 0.0))
    assert np.allclose(graph.measurements[3], lie.pose_2d(1.0, 2.0, 0.0))
    assert graph.information[3].tolist() == [[1, 0.5, 0], [0.5, 3, 0], [0, 0, 0]]
    assert np.allclose(graph.poses[1], lie.pose_2d(1.1, 0.1, 1.5))
    assert np.allclose(graph.measurements[0], lie.pose_2d(1.0, 0.0, np.pi / 2))
    assert graph.information[0].tolist() == [[4, 0.5, 0.25], [0.5, 5, 0], [0.25, 0, 6]]
    assert graph.held == [1] and graph.fixed.tolist() == [False, True, False, False]
    assert not graph.is_loop.any()


def test_points_and_lines_not_understood_are_kept_and_counted(read, tmp_path):
    file, copy = read(SQUARE), tmp_path / "copy.g2o"
    assert dict(file.other_tags) == {"#": 1, "EDGE_BEARING_SE2_XY": 1}
    write_g2o(copy, file.graph, ids=file.ids, other_lines=file.other_lines)
    again = read_g2o(copy)
    assert again.other_lines == file.other_lines and again.ids.tolist() == [10, 20, 30, 7]
    assert_same(file.graph, again.graph)
    with pytest.raises(InputError, match="TORO has no points, and the graph has 1"):
        write_g2o(tmp_path / "x.graph", file.graph)


def test_points_without_vertices_begin_where_they_are_seen(read):
    file = read("EDGE_SE2 0 1 1 0 1.5707963267948966 1 0 0 1 0 1\nEDGE_SE2_XY 1 9 2 0.5 1 0 1\n")
    assert file.ids.tolist() == [0, 1, 9] and not file.has_guess
    assert np.allclose(file.graph.poses[2][:2, 2], [0.5, 2.0])


def test_toro_orders_the_information_of_the_plane_in_its_own_way(read):
    text = "VERTEX2 0 0 0 0\nVERTEX2 1 1 0 0\nEDGE2 0 1 1 0 0.1 11 12 22 33 13 23\n"
    graph = read(text, "pair.graph").graph
    assert graph.information[0].tolist() == [[11, 12, 13], [12, 22, 23], [13, 23, 33]]


@pytest.mark.parametrize("pitch", [0.0, 1.0, np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-7])
def test_toro_angles_are_roll_pitch_and_yaw_also_looking_straight_up(pitch, tmp_path):
    angles, poses = [(0.3, pitch, -2.0), (-3.0, pitch, 0.5)], np.tile(lie.identity(3), (2, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("ZYX", np.array(angles)[:, ::-1]).as_matrix()
    graph = graph_of(poses, [(0, 1)], poses[1:], np.eye(6))
    path = tmp_path / "up.graph"
    write_g2o(path, graph)
    assert np.allclose(read_g2o(path).graph.poses, graph.poses, rtol=0, atol=1e-12)
    if abs(pitch) < 1.5:
        assert np.allclose(np.array(path.read_text().split()[5:8], float), angles[0])


def test_a_quaternion_edge_keeps_its_order_and_its_information(read):
    omega, half = np.diag([1.0, 2, 3, 4, 5, 6]) + 0.01, np.sqrt(0.5)
    upper = " ".join(map(str, omega[np.triu_indices(6)].tolist()))
    graph = read(f"EDGE_SE3:QUAT 0 1 1 2 3 {2 * half} 0 0 {2 * half} {upper}\n").graph  # not of length 1
    assert np.allclose(graph.measurements[0], [[1, 0, 0, 1], [0, 0, -1, 2], [0, 1, 0, 3], [0, 0, 0, 1]])
    assert np.allclose(graph.information[0], omega)


def test_information_is_of_a_rotation_vector_or_as_the_comment_says_of_a_quaternion(tmp_path):
    """g2o's own error is the vector part of the unit quaternion, which is half the rotation vector."""
    path, Z = tmp_path / "x.g2o", lie.exp(np.array([1.0, 0.2, 0.0, 0.1, 0.0, 0.4]))
    root = np.random.default_rng(0).normal(size=(6, 6))
    graph = graph_of([np.eye(4), Z], [(0, 1)], [Z], root @ root.T)
    for rotation, unit in (("rotation vector", 1.0), ("unit quaternion", 2.0)):
        write_g2o(path, graph, rotation=rotation.split()[1], force=True)
        comment, *_, edge = path.read_text().splitlines()
        units = lie.by_component(6, 1.0, unit)
        upper = (np.outer(units, units) * graph.information[0])[np.triu_indices(6)]
        assert rotation in comment and np.allclose([float(word) for word in edge.split()[-21:]], upper)
        back = read_g2o(path)
        assert np.allclose(back.graph.information, graph.information, rtol=1e-12) and back.other_lines == ()
    as_vector = read_g2o(path, rotation="vector").graph.information[0]
    np.testing.assert_allclose(as_vector[3:, 3:], 4.0 * graph.information[0, 3:, 3:], rtol=1e-12)
    with pytest.raises(InputError, match="exists; choose another name or pass force=True"):
        write_g2o(path, graph)
    with pytest.raises(InputError, match="rotation is 'euler'; it must be one of vector, quaternion"):
        write_g2o(path, graph, rotation="euler")


def test_a_file_without_vertices_starts_from_its_odometry():
    file = read_g2o(shared_data("graphs/manhattan.g2o"))
    graph = file.graph
    assert not file.has_guess and len(graph) == 3500
    steps = graph.edges[:, 1] == graph.edges[:, 0] + 1
    i, j = graph.edges[steps].T
    relative = lie.inverse(graph.poses[i]) @ graph.poses[j]
    assert np.allclose(relative, graph.measurements[steps], atol=1e-9)


def test_a_graph_of_priors_alone_is_read_as_graph_rejected_may_be_one(tmp_path):
    path, prior = tmp_path / "priors.g2o", "EDGE_PRIOR_SE2 1 1.5 0 0 1 0 0 1 0 1\n"
    path.write_text(f"VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\n{prior}")
    with pytest.warns(UserWarning, match="with 0 fixed"):
        graph = read_g2o(path).graph
    assert graph.edges.tolist() == [[-1, 1]] and graph.is_of_origin.all() and graph.measurements[0, 0, 2] == 1.5


def test_suspect_loops_are_the_edges_that_skip_poses():
    graph = read_g2o(shared_data("graphs/intel.g2o"), loops="robust").graph
    apart = np.abs(graph.edges[:, 0] - graph.edges[:, 1])
    assert np.array_equal(graph.is_loop, apart != 1)


EDGE = "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "holds no EDGE_SE2"),
        ("VERTEX_SE2 0 0 0 0\n", "holds no EDGE_SE2"),
        ("EDGE_PRIOR_SE2 0 0 0 0 1 0 0 1 0 1\n", "holds no EDGE_SE2"),
        ("EDGE_SE2 0 1 1 0 0 1 0 0 1 0\n", r":1: EDGE_SE2 has 10 values, needs 11"),
        (f"{EDGE}\nEDGE_SE2 1 two 1 0 0 1 0 0 1 0 1\n", r":2: EDGE_SE2: vertex id 'two' is not a 64-bit integer"),
        (f"{EDGE}\nEDGE_SE2 1 2 1 0 zero 1 0 0 1 0 1\n", r":2: EDGE_SE2: could not convert"),
        (f"{EDGE}\nEDGE_SE2 1 2 1 0 0 1e300 0 0 1 0 1\n", r":2: EDGE_SE2 1 2 has a value .* over 1e\+50"),
        (f"{EDGE}\nEDGE_SE2 1 2 1 0 nan 1 0 0 1 0 1\n", r":2: EDGE_SE2 1 2 has a value that is not finite"),
        (f"VERTEX_SE2 0 0 0 0\n{EDGE}\n", r":2: vertex 1 is not in the file"),
        (f"VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 0 0 0\nVERTEX_SE2 0 1 0 0\n{EDGE}\n", r":3: vertex 0 is .* twice"),
        ("EDGE_SE2 0 1 1 0 0 1 0 0 -1 0 1\n", r":1: information matrix of edge 0-1 is not positive semidefinite"),
        ("EDGE_SE2 1 1 1 0 0 1 0 0 1 0 1\n", r":1: edge 1-1 joins a vertex to itself"),
        (
            f"{EDGE}\nVERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 0 0 0\nEDGE_SE2_XY 0 8 1 1 1 0 1\n",
            r":4: vertex 8 is not in",
        ),
        (f"{EDGE}\nEDGE_SE2_XY 0 1 1 1 1 0 1\n", r"vertex 1 is a pose and a point"),
        (
            f"{EDGE}\nEDGE_SE2_XY 0 8 1 1 1 5 1\n",
            r":2: information matrix of edge 0-8 is not positive semidefinite",
        ),
        (f"{EDGE}\nFIX 5\n", r":2: vertex 5 is not in the file"),
        (f"{EDGE}\nVERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n", r":2: VERTEX_SE3:QUAT in an SE\(2\) graph"),
        ("EDGE_SE3:QUAT 0 1 0 0 0 0 0 0 0 " + "0 " * 21 + "\n", r":1: quaternion of length 0"),
    ],
)
def test_a_malformed_file_is_refused_in_one_line_that_names_the_place(text, words, read):
    with pytest.raises(InputError, match=words) as caught:
        read(text, indefinite="refuse")
    assert "x.g2o" in str(caught.value) and "\n" not in str(caught.value)


def test_a_missing_file_a_folder_and_bytes_are_refused(tmp_path):
    (tmp_path / "bytes.g2o").write_bytes(b"\xff\xfe\x00\x81")
    for path in (tmp_path / "none.g2o", tmp_path, tmp_path / "bytes.g2o"):
        with pytest.raises(InputError, match="cannot be read as g2o"):
            read_g2o(path)


def test_a_poor_fit_points_to_the_robust_losses_which_leave_the_chain_alone(call, tmp_path):
    lines = [f"VERTEX_SE2 {k} {k} 0 0" for k in range(8)]
    lines += [f"EDGE_SE2 {k} {k + 1} 1 0 0 100 0 0 100 0 100" for k in range(7)]
    lines += [f"EDGE_SE2 {k} {k + 2} 2 0 0 100 0 0 100 0 100" for k in range(6)]
    lines.append("EDGE_SE2 0 7 0 0 0 1000 0 0 1000 0 1000")
    (tmp_path / "false.g2o").write_text("\n".join(lines))
    _, output, _ = call("optimize", tmp_path / "false.g2o")
    assert "per degree of freedom, where 1 is expected" in output and "--robust truncated" in output
    for loss in ("truncated", "huber"):
        out = tmp_path / f"{loss}.g2o"
        _, output, _ = call("optimize", tmp_path / "false.g2o", "--robust", loss, "--out", out)
        assert "where 1 is expected" not in output
        assert "on 7 loop edges; the other 7 edges (odometry, points, priors) in full weight" in output
        assert read_g2o(out).graph.poses[-1][0, 2] == pytest.approx(7.0, abs=0.01)


@pytest.mark.parametrize("tag", ["EDGE2 0 1 1 0 0 1 0 1 1 5 0", "EDGE_SE2 0 1 1 0 0 1 0 5 1 0 1"])
def test_indefinite_matrices_are_projected_with_a_warning_that_says_how_many_how_far_and_which_first(tag, read):
    with pytest.warns(UserWarning, match="1 of 2 edges have an indefinite .* first 0-1 in line 1"):
        file = read(f"{tag}\nEDGE_SE2 1 2 1 0 0 1 0 0 1 0 1\n", "bad.graph")
    assert (file.projection.edges, file.projection.of) == (1, 2)
    assert file.projection.median == file.projection.most == pytest.approx(4.0 / np.sqrt(53.0))
    assert np.allclose(file.graph.information, [[[3, 0, 3], [0, 1, 0], [3, 0, 3]], np.eye(3)])


@pytest.mark.parametrize(
    "text",
    [
        "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 180\nEDGE_SE2 0 1 1 0 180 1 0 0 1 0 1\n",
        "VERTEX3 0 0 0 0 0 0 0\nVERTEX3 1 1 0 0 0 0 90\n"
        "EDGE3 0 1 1 0 0 0 0 90 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1\n",
    ],
)
def test_angles_that_may_be_degrees_are_told(tmp_path, text):
    (tmp_path / "x.g2o").write_text(text)
    with pytest.warns(UserWarning, match=r"x\.g2o:2: an angle of (180|90); degrees\?"):
        read_g2o(tmp_path / "x.g2o")


GRAPHS = ("MIT", "intel", "manhattan", "smallGrid3D", "sphere2500", "torus3D")


@pytest.mark.parametrize("name", GRAPHS)
def test_a_graph_has_as_many_loops_as_the_robust_loss_is_given_to(name):
    path = shared_data(f"graphs/{name}.g2o")
    quadratic, robust = read_g2o(path).graph, read_g2o(path, loops="robust").graph
    assert not quadratic.is_loop.any()
    assert robust.is_loop.sum() > 0
    assert f"{robust.is_loop.sum():,} of them loops" in repr(robust)
    assert repr(quadratic) == repr(robust)


def test_edges_to_points_and_to_the_next_pose_are_no_loops(read):
    with pytest.warns(UserWarning, match="EDGE_BEARING"):
        assert "4 edges, 1 of them loops" in repr(read(SQUARE).graph)


LINE = """\
# made here
VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 1 1 0 0 0 0 0 1
PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1
EDGE_SE3:QUAT 0 1 1.5 0 0 0 0 0 1 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1
"""
PRIORS = (
    "EDGE_SE3_XYZPRIOR 1 0 5 0 0 1 0 0 1 0 1",
    "EDGE_POINTXYZ_PRIOR 1 5 0 0 1 0 0 1 0 1",
    "GPS 1 5 0 0",
)


@pytest.mark.parametrize("prior", PRIORS)
def test_constraints_that_are_not_understood_are_said_to_be_in_neither_chi2_nor_certificate(read, prior, capsys):
    tag = prior.split()[0]
    with pytest.warns(UserWarning, match=f"2 lines {tag} not understood: in neither χ² nor certificate"):
        file = read(LINE + f"{prior}\n{prior}\n")
    graph = file.graph.copy()
    graph.optimize(load_settings(3).config.graph)
    for verdict in (graph.certify().verdict, file.graph.copy().certify().verdict):
        assert verdict.startswith((f"globally optimal of the problem without 2 lines {tag}", "not certified"))
    assert f"without 2 lines {tag}" in repr(graph)


def test_where_every_constraint_is_understood_nothing_is_said(read, recwarn):
    graph = read(LINE).graph
    graph.optimize(load_settings(3).config.graph)
    assert graph.certify().verdict.startswith("globally optimal: ")
    assert "without" not in repr(graph) and not recwarn.list


def test_optimize_says_that_lines_it_does_not_know_do_not_count_and_keeps_them(tmp_path, capsys):
    (tmp_path / "a.g2o").write_text(LINE + PRIORS[0] + "\n")
    assert main(["optimize", str(tmp_path / "a.g2o"), "--out", str(tmp_path / "b.g2o")]) == 0
    text = capsys.readouterr().out
    assert "1 line EDGE_SE3_XYZPRIOR not understood: in neither chi2 nor certificate" in text
    assert "globally optimal of the problem without 1 line EDGE_SE3_XYZPRIOR" in text
    assert PRIORS[0] in (tmp_path / "b.g2o").read_text().splitlines()


PLANE = "".join(f"VERTEX_SE2 {k} {k} 0 0\n" for k in (0, 1)) + "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n"
SPACE = "".join(f"VERTEX_SE3:QUAT {k} {k} 0 0 0 0 0 1\n" for k in (0, 1))
UNIT = " ".join("1" if a == b else "0" for a in range(6) for b in range(a, 6))
SPACE += f"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 {UNIT}\n"
PRIOR = f"EDGE_SE3_PRIOR 1 0 1 0 0 0 0 0 1 {UNIT}\n"


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (f"{PLANE}EDGE_PRIOR_SE2 1 1 0 0 1 0 0 -1 0 1\n", 4),
        (f"{PLANE}EDGE_PRIOR_SE2_XY 1 1 0 1 5 1\n", 4),
        (f"{SPACE}{PRIOR.replace(UNIT, UNIT[:-1] + '-1')}", 4),
    ],
)
def test_indefinite_information_of_a_prior_is_projected_as_that_of_edges(text, line, read):
    with pytest.warns(UserWarning, match=f"1 of 2 edges have an indefinite .* first 1 in line {line}"):
        file = read(text)
    assert positive_semidefinite(file.graph.information).all() and file.graph.edges[1, 1] == 1
    with pytest.raises(InputError, match=rf"x\.g2o:{line}: information matrix of prior 1 is not positive"):
        read(text, indefinite="refuse")


def test_a_prior_is_of_a_pose_or_of_a_point_as_its_tag_says(read, tmp_path):
    text = f"{PLANE}VERTEX_XY 7 2 3\nEDGE_SE2_XY 0 7 2 3 1 0 1\n"
    for tag, vertex, numbers in (
        ("EDGE_PRIOR_SE2", 7, "2 3 0 1 0 0 1 0 1"),
        ("EDGE_PRIOR_SE2_XY", 7, "2 3 1 0 1"),
        ("EDGE_PRIOR_XY", 1, "2 3 1 0 1"),
    ):
        with pytest.raises(InputError, match=rf"x\.g2o:6: the prior is of a .*, and vertex {vertex} is a "):
            read(f"{text}{tag} {vertex} {numbers}\n")
    file = read(f"{text}EDGE_PRIOR_XY 7 2 3 4 1 4\n")
    write_g2o(tmp_path / "y.g2o", file.graph, ids=file.ids)
    again = read_g2o(tmp_path / "y.g2o").graph
    assert_same(file.graph, again)
    assert again.edges[-1].tolist() == [-1, 2] and again.is_point[2]
    with pytest.raises(InputError, match="Prior measures a rotation, which points have not"):
        again.add_factor(Prior(), 2, np.eye(3))


@pytest.mark.parametrize(
    ("offset", "line", "words"),
    [
        ("PARAMS_SE3OFFSET 0 0.1 0 0 0 0 0 1", 4, "EDGE_SE3_PRIOR with an offset of the sensor"),
        ("PARAMS_SE3OFFSET 0 zero 0 0 0 0 0 1", 5, "PARAMS_SE3OFFSET: could not convert"),
        ("PARAMS_SE3OFFSET 0 0 0 0", 5, "PARAMS_SE3OFFSET has 4 values, needs 8"),
        ("PARAMS_SE3OFFSET x 0 0 0 0 0 0 1", 5, "PARAMS_SE3OFFSET: vertex id 'x' is not"),
    ],
)
def test_the_offset_of_a_sensor_counts_wherever_it_stands(offset, line, words, read):
    with pytest.raises(InputError, match=rf"x\.g2o:{line}: {words}"):
        read(f"{SPACE}{PRIOR}{offset}\n")
    assert read(f"{SPACE}{offset}\n").other_lines == (offset,)  # no prior needs it


def test_a_sensor_offset_of_other_lines_keeps_its_id(read, tmp_path):
    graph = read(SPACE + PRIOR).graph
    others = ["PARAMS_SE3OFFSET 0 0.1 0 0 0 0 0 1", "PARAMS_CAMERACALIB 1 0 0 0 0 0 0 1 1 1 1 1"]
    for _ in range(2):
        write_g2o(tmp_path / "y.g2o", graph, other_lines=others, force=True)
        again = read_g2o(tmp_path / "y.g2o")
        assert set(again.other_lines) == {*others, "PARAMS_SE3OFFSET 2 0 0 0 0 0 0 1"}
        assert_same(graph, again.graph)
        others = again.other_lines


# as in GTSAM's victoria_park.txt and w20000.txt
PARK = """\
ODOMETRY 3 4 1 0 1.5707963267948966 0.01 0 0 0.04 0 0.0001
LANDMARK 4 5 2 0.5 0.25 0.1 0.5
ODOMETRY 4 6 1 0 0 0.01 0 0 0.04 0 0.0001
LANDMARK 6 5 1 0.5 0.4 0 0.4
"""


def test_gtsam_odometry_and_landmarks_are_edges_with_covariances(read):
    file = read(PARK, "park.txt")
    assert file.ids.tolist() == [3, 4, 6, 5] and file.graph.is_point.tolist() == [False] * 3 + [True]
    assert file.graph.edges.tolist() == [[0, 1], [1, 2], [1, 3], [2, 3]]
    assert np.allclose(file.graph.information[0], np.diag([100, 25, 1e4]))
    expected = np.array([[0.5, -0.1, 0], [-0.1, 0.25, 0], [0, 0, 0]]) / (0.25 * 0.5 - 0.01)
    assert np.allclose(file.graph.information[2], expected)
    assert np.allclose(file.graph.poses[3][:2, 2], [0.5, 2.0])  # left of the turn at (1, 0)
    (note,) = file.notes
    assert "park.txt:1: noise of 4 edges read as covariances" in note


@pytest.mark.parametrize(
    ("noise", "expected"),
    [
        ("auto", np.diag([0.25, 0.25, 0.2])),
        ("covariance", np.diag([0.25, 0.25, 0.2])),
        ("information", np.diag([4, 4, 5])),
        ("square-root", np.diag([16, 16, 25])),
    ],
)
def test_edges_by_rows_are_covariances_as_in_gtsam_or_what_is_said(noise, expected, read):
    graph = read("EDGE2 0 1 1 0 0 4 0 0 4 0 5\nEDGE2 1 2 1 0 0 4 0 0 4 0 5\n", noise=noise).graph
    assert np.allclose(graph.information, expected)


@pytest.mark.parametrize("tag", ["EDGE2", "EDGE_SE2", "ODOMETRY"])
def test_a_square_root_is_by_rows_whatever_its_tag(tag, read):
    graph = read(f"{tag} 0 1 1 0 0 1 2 3 4 5 6\n", noise="square-root").graph
    assert np.allclose(graph.information[0], [[1, 2, 3], [2, 20, 26], [3, 26, 70]])


def test_a_square_root_in_space_and_covariances_of_priors_are_converted_too(read):
    entries = np.zeros((6, 6))
    entries[np.diag_indices(6)] = [10, 10, 10, 100, 100, 25]
    text = " ".join(map(str, entries[np.triu_indices(6)]))
    graph = read(f"EDGE3 0 1 1 0 0 0 0 0 {text}\n", noise="square-root").graph
    assert np.allclose(graph.information[0], np.diag([100, 100, 100, 1e4, 1e4, 625]))
    graph = read(f"{EDGE}\nEDGE_PRIOR_SE2 1 1 0 0 0.25 0 0 0.25 0 0\n", noise="covariance").graph
    assert graph.information[1].tolist() == [[4, 0, 0], [0, 4, 0], [0, 0, 0]]


def test_bearings_and_ranges_are_edges_to_points_that_begin_where_they_are_seen(read):
    text = (
        "VERTEX2 0 1 0 0\nVERTEX2 1 2 0 0\nEDGE2 0 1 1 0 0 1 0 1 1 0 0\nBR 0 144 1.5707963267948966 10 0.02 0.5\n"
    )
    file = read(text, "br.graph")
    assert file.ids.tolist() == [0, 1, 144] and file.has_guess
    assert np.allclose(file.graph.poses[2][:2, 2], [1, 10])
    assert np.allclose(file.graph.information[1], np.diag([25, 4, 0]))
    assert np.allclose(file.graph.information[0], np.eye(3))  # TORO's order, no covariance


@pytest.mark.parametrize(
    ("name", "order", "poses", "points"),
    [
        ("w100_30.g2o", "AUTO", 30, 0),
        ("w100.graph", "TORO", 100, 0),
        ("example.graph", "AUTO", 95, 24),
        ("victoria_park.txt", "AUTO", 6969, 151),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_edges_of_the_files_that_gtsam_brings_are_those_that_it_reads(name, order, poses, points):
    gtsam = pytest.importorskip("gtsam", reason="gtsam is not installed")
    path, form = gtsam.findExampleDataFile(name), getattr(gtsam.NoiseFormat, f"NoiseFormat{order}")
    theirs = gtsam.load2D(path, None, 0, False, True, form)[0]
    theirs = [theirs.at(k) for k in range(theirs.size()) if isinstance(theirs.at(k), gtsam.BetweenFactorPose2)]
    roots = np.array([factor.noiseModel().R() for factor in theirs])
    ours = read_g2o(path)
    is_point = ours.graph.is_point[ours.graph.edges[:, 1]]
    assert ours.ids[ours.graph.edges[~is_point]].tolist() == [list(factor.keys()) for factor in theirs]
    assert np.allclose(ours.graph.information[~is_point], np.swapaxes(roots, 1, 2) @ roots, rtol=1e-9)
    assert np.bincount(ours.graph.is_point, minlength=2).tolist() == [poses, points]


def test_landmarks_may_have_the_ids_of_poses(read):
    file = read("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\nLANDMARK2 0 1 2 0 1 0 1\nLANDMARK2 1 1 1 0 1 0 1\n")
    assert file.ids.tolist() == [0, 1, 2] and file.graph.is_point.tolist() == [False, False, True]
    assert file.graph.edges.tolist() == [[0, 1], [0, 2], [1, 2]]
    assert "1 landmarks have ids of poses; they are numbered from 2 on" in file.notes[0]


def test_a_graph_with_covariances_has_the_minimum_of_the_same_graph_with_information(tmp_path, read):
    first = read_g2o(shared_data("graphs/intel.g2o"))
    write_g2o(tmp_path / "same.g2o", first.graph, ids=first.ids)
    lines = []
    for line in (tmp_path / "same.g2o").read_text().splitlines():
        tag, *words = line.split()
        if tag == "EDGE_SE2":
            Omega = np.zeros((3, 3))
            Omega[np.triu_indices(3)] = words[5:]
            C = np.linalg.inv(Omega + np.triu(Omega, 1).T)
            line = " ".join(["ODOMETRY", *words[:5], *map(repr, C[np.triu_indices(3)].tolist())])
        lines.append(line)
    second = read("\n".join(lines), "same.txt").graph
    config = load_settings(2).config.graph
    chi2 = [graph.optimize(config).chi2_after for graph in (first.graph, second)]
    assert chi2[1] == pytest.approx(chi2[0], rel=1e-6)


TRIANGLE = ((0, 1), (1, 2), (2, 0))
AT = "1 0 2.0 4 0 0 5 0 6"  # of edges of a triangle that does not quite close


def triangle(first, measured=AT):
    return "".join(f"EDGE_SE2 {first + i} {first + j} {measured}\n" for i, j in TRIANGLE)


def test_each_part_of_a_graph_that_no_edge_joins_has_a_gauge_of_its_own(read):
    file, alone = read(triangle(0) + triangle(40)), read(triangle(0)).graph
    assert file.graph.held == [0, 3] and alone.held == [] and "with 40 fixed" in file.notes[0]
    config = load_settings(2).config.graph
    alone.optimize(config)
    file.graph.optimize(config)
    assert np.allclose(file.graph.poses[:3], alone.poses) and np.allclose(file.graph.poses[3:], alone.poses)
    together, single = file.graph.certify(), alone.certify()
    assert together.certified and together.gap == pytest.approx(2.0 * single.gap, abs=1e-9)


@pytest.mark.parametrize(
    ("lines", "held"),
    [("FIX 41\n", [0, 4]), ("EDGE_PRIOR_SE2 41 0 0 0 1 0 0 1 0 1\n", [0]), ("FIX 2\nFIX 40\n", [2, 3])],
)
def test_a_part_that_a_line_fixes_or_a_prior_holds_needs_no_other_gauge(lines, held, read):
    assert read(triangle(0) + triangle(40) + lines).graph.held == held


def test_a_vertex_without_edges_keeps_its_place(read):
    vertices = "".join(f"VERTEX_SE2 {k} {k} 0 0\n" for k in (0, 1, 2, 9))
    graph = read(vertices + triangle(0)).graph
    graph.optimize(load_settings(2).config.graph)
    assert np.array_equal(graph.poses[3], lie.pose_2d(9.0, 0.0, 0.0))


PLAIN = triangle(0)
HUGE = 8646911284551352320  # of x0, as GTSAM packs a character and a number in 64 bits


@pytest.mark.parametrize(
    ("text", "first"),
    [
        ("\ufeff" + PLAIN, 0),
        (PLAIN.replace("\n", "\r\n"), 0),
        (PLAIN.replace("\n", "\r"), 0),
        (PLAIN.replace(" ", "\t  "), 0),
        (triangle(HUGE), HUGE),
        (triangle(-7), -7),
        (triangle(2**63 - 3), 2**63 - 3),
    ],
    ids=["byte order mark", "Windows", "Macintosh", "tabs", "symbols", "negative", "largest"],
)
def test_line_ends_spaces_and_ids_of_any_kind_change_nothing(text, first, tmp_path):
    (tmp_path / "x.g2o").write_bytes(text.encode())
    file = read_g2o(tmp_path / "x.g2o")
    assert file.ids.tolist() == [first, first + 1, first + 2] and file.notes == ()
    assert file.graph.information[0].tolist() == [[4, 0, 0], [0, 5, 0], [0, 0, 6]]


def test_an_edge_that_is_repeated_counts_each_time_and_is_said(read):
    file = read(PLAIN + PLAIN + "EDGE_SE2 0 1 1 0 2.1 4 0 0 5 0 6\n")
    assert len(file.graph.edges) == 7
    assert "3 edges repeated to the digit" in file.notes[0]


def test_quaternions_that_are_not_of_unit_length_are_normalized_and_said(read):
    edge = "EDGE_SE3:QUAT {} {} 1 0 0 0 0 {} {} " + " ".join(map(str, np.eye(6)[np.triu_indices(6)])) + "\n"
    file = read(edge.format(0, 1, 0, 1.004) + edge.format(1, 2, 3, 3) + edge.format(2, 3, 0, 0.5))
    assert np.allclose(lie.to_quaternion(file.graph.measurements[1, :3, :3]), [0, 0, 0.5**0.5, 0.5**0.5])
    (note,) = file.notes
    assert note.endswith("x.g2o:2: quaternion of length 4.24, the first of 2 to be normalized")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("odom2 0.0 1.0 0.0 0.0 0.1 0.1 0.1\nrange2 0.0 3.1 0.1 1 2 0\n", "libRSF's measurements over time"),
        (PLAIN.replace(" ", ","), "its first line is 'EDGE_SE2,0,1,1,0,2.0"),
        (
            "VERTEX_SE2 0 0 0 0\n" + PLAIN,
            ":2: vertex 1 is not .*, or remove all VERTEX lines to start from odometry",
        ),
        (triangle(2**63), f":1: EDGE_SE2: vertex id '{2**63}' is not a 64-bit integer"),
        (PLAIN + "EDGE2 1 2 1 0 0\n", ":4: EDGE2 has 5 values, needs 11; it has no information"),
        ("ODOMETRY 0 1 1 0 0 0 0 0 1 0 1\n", ":1: covariance is not positive definite; .*--noise"),
        ("ODOMETRY 0 1 1 0 0 1 2 0 1 0 1\n", ":1: covariance is not positive definite"),
        (PLAIN + "LANDMARK 1 9 1 0 1 1 1\n", ":4: covariance is not positive definite"),
        (PLAIN + "BR 1 9 1 2 0 0.1\n", ":4: covariance is not positive definite"),
        (PLAIN + "BR 1 9 1 2 0.1\n", ":4: BR has 5 values, needs 6$"),
        (PLAIN + "EDGE_SE2 0 2 1 0 0 -4 0 0 5 0 6\n", ":4: information matrix of edge 0-2 is not positive semi"),
    ],
)
def test_a_broken_file_ends_optimize_with_one_line_that_says_what_it_is(text, words, tmp_path, capsys):
    (tmp_path / "x.g2o").write_text(text)
    assert main(["optimize", str(tmp_path / "x.g2o"), "--indefinite", "refuse"]) == 2
    captured = capsys.readouterr()
    (line,) = captured.err.splitlines()
    assert re.search(f"x.g2o.*{words}", line) and not captured.out


@pytest.mark.parametrize("seed", range(40))
def test_a_file_with_words_swapped_lost_and_changed_is_read_or_refused_in_one_line(seed, tmp_path):
    rng = np.random.default_rng(seed)
    words = [line.split() for line in (SQUARE + PARK.replace("LANDMARK", "BR") + PARK + PLAIN).splitlines()]
    for _ in range(4):
        row = words[rng.integers(len(words))]
        column = int(rng.integers(len(row)))
        with_this = rng.choice(["-1", "nan", "x", "1e400", "", "9" * 20, "0.5", "EDGE2", "BR", "LANDMARK", "FIX"])
        row[column : column + int(rng.integers(1, 3))] = [str(with_this)]
    (tmp_path / "x.g2o").write_text("\n".join(map(" ".join, words)))
    try:
        graph = read_g2o(tmp_path / "x.g2o").graph
        assert np.isfinite(graph.poses).all() and positive_semidefinite(graph.information).all()
    except InputError as error:
        assert "\n" not in str(error) and "x.g2o" in str(error)
