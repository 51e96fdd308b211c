"""``scanchain optimize``: what is solved, certified, warned of, and written."""

import errno
import json
import re
from pathlib import Path

import numpy as np
import pytest

from scanchain.graph.g2o import read_g2o
from tests.commands.conftest import FULL
from tests.support.messages import says

FALSE_LOOP = "EDGE_SE2 1 3 9 9 1 100 0 0 100 0 1000\n"


@pytest.fixture
def false_ring(ring):
    """The same with a second false edge, which contradicts all others."""
    ring.write_text(ring.read_text() + FALSE_LOOP)
    return ring


@pytest.fixture
def tree(call):
    """What optimize prints as JSON."""
    return lambda *words: json.loads(call("optimize", *words, "--json")[1])


def test_optimize_prints_what_it_did_and_writes_the_graph(call, tree, tmp_path, ring):
    code, output, errors = call("optimize", ring, "--out", tmp_path / "done.g2o")
    assert (code, errors) == (0, "")
    says(output, "2D, 4 poses, 5 edges", "1 line PARAMS", "odometry, as the file has no vertices")
    says(output, "chi2", "iterations", "below the tolerance", "certificate    globally optimal to rounding")
    written = (tmp_path / "done.g2o").read_text()
    assert written.count("VERTEX_SE2") == 4 and written.count("EDGE_SE2") == 5 and written.endswith("PARAMS 7\n")
    again = tree(tmp_path / "done.g2o")
    assert again["chi2_before"] == pytest.approx(again["chi2_after"], rel=1e-9)
    assert again["certificate"]["certified"] and again["certificate"]["relative_gap"] < 1e-6
    assert again["initialization"] == "given" and again["kept_lines"] == {"PARAMS": 1}


def test_optimize_rejects_a_false_edge_when_told_to_be_suspicious(call, monkeypatch, tree, tmp_path, false_ring):
    trusting = tree(false_ring)
    assert trusting["robust_edges"] == 0 and trusting["rejected"] == [] and trusting["chi2_after"] > 1000.0
    titles = []
    monkeypatch.setattr("matplotlib.axes.Axes.set_title", lambda _, text, **how: titles.append(text))
    code, output, _ = call("optimize", false_ring, "--robust", "truncated", "--png", tmp_path / "a.png")
    assert code == 0 and "warning" not in output
    before = trusting["chi2_before"]
    says(
        output,
        "rejected       1 of 3 loop edges",
        f"chi2           {before:.6g} before, ",
    )
    says(output, " after, over 9 and 6 degrees of freedom\n")
    says(titles[0], "over 9 degrees of freedom")
    says(titles[1], "over 6 degrees of freedom, 1 edge rejected")
    assert "rejected" not in titles[0]
    found = tree(false_ring, "--graph.robust", "truncated")
    assert found["rejected"] == [[1, 3]] and found["certificate"]["chi2"] < 1.0 and found["warnings"] == []
    assert found["chi2_after"] == pytest.approx(found["certificate"]["chi2"]) and found["degrees_of_freedom"] == 6
    assert found["chi2_before"] == pytest.approx(before) and found["degrees_of_freedom_before"] == 9


@pytest.mark.parametrize("robust", ["truncated", "huber"])
def test_an_answer_that_rests_on_a_minority_of_the_loop_edges_says_so_first(call, ring, robust):
    ring.write_text(ring.read_text() + "".join(f"EDGE_SE2 {i} 3 9 {i} 1 100 0 0 100 0 1000\n" for i in (0, 1, 1)))
    output = call("optimize", ring, "--robust", robust)[1]
    assert re.match(r"warning        \d of 5 loop edges are rejected or have a weight below ½", output)
    says(output, "not their selection", "certificate    globally optimal")


@pytest.mark.parametrize("robust", ["truncated", "geman-mcclure", "huber"])
def test_the_graph_of_a_robust_answer_holds_what_is_in_force_and_its_own_minimum(
    refused, tree, tmp_path, false_ring, robust
):
    done, rejected = tmp_path / "done.g2o", tmp_path / "done_rejected.g2o"
    found = tree(false_ring, "--robust", robust, "--graph.tolerance", "1e-12", "--out", done)
    assert found["rejected"] == [[1, 3]] and str(rejected) in found["written"]
    assert done.read_text().count("EDGE_SE2") == 5 and rejected.read_text().count("EDGE_SE2 1 3") == 1
    before = read_g2o(done).graph.poses
    again = tree(done, "--out", tmp_path / "again.g2o")
    assert again["chi2_before"] == pytest.approx(found["chi2_after"], rel=1e-9)
    assert np.abs(read_g2o(tmp_path / "again.g2o").graph.poses - before).max() < 1e-6
    done.unlink()
    says(refused("optimize", false_ring, "--out", done), "done_rejected.g2o", "--force")
    tree(false_ring, "--out", done, "--force")
    assert not rejected.exists(), "edges that an earlier answer rejected stay behind"


def test_optimize_names_the_poses_that_are_free_before_it_certifies_anything(call, tree, ring):
    lines = ring.read_text().splitlines()[:3]
    ring.write_text("\n".join([*lines, "EDGE_SE2 3 17 1 0 0 100 0 0 100 0 0"]) + "\n")
    code, output, errors = call("optimize", ring)
    assert (code, errors) == (0, "")
    says(output, "free           the edges leave 1 pose free: 17")
    says(output, "certificate    not certified: the edges leave 1 pose free: 17")
    found = tree(ring)
    assert found["free"] == [17]
    assert not found["certificate"]["certified"]
    ring.write_text("\n".join([*lines, "EDGE_SE2 3 17 1 0 0 1e-7 0 0 1e-7 0 1e-6"]) + "\n")
    says(call("optimize", ring)[1], "weakly joined  pose 17 by edges of less than a millionth")


def test_optimize_says_loudly_that_it_projects_indefinite_information(call, refused, ring):
    ring.write_text(ring.read_text().replace("0 2 1 1.01 3.14 100 0 0 100", "0 2 1 1.01 3.14 100 150 0 100"))
    code, output, errors = call("optimize", ring)
    assert code == 0
    says(errors, "warning: ", "1 of 5 edges have an indefinite information matrix", "first 0-2 in line 5")
    says(errors, "nearest", "--indefinite refuse")
    says(output, "projected      1 of 5")
    _, output, errors = call("optimize", ring, "--json")
    assert json.loads(output)["projected"]["edges"] == 1 and "warning: " in errors
    says(refused("optimize", ring, "--indefinite", "refuse"), "ring.g2o:5: information matrix of edge 0-2")


CHAIN = [f"EDGE_SE2 {i} {i + 1} 1 0 0 100 0 0 100 0 1000" for i in range(2)]


@pytest.mark.parametrize(
    ("lines", "chi2"),
    [
        (CHAIN, "chi2           no loops to check"),
        (
            [*CHAIN, "EDGE_SE2 0 2 3 0 0 100 0 0 0 0 0"],
            "chi2           100 before, 33.333333 after, over 1 degree of freedom\n",
        ),
        (
            ["EDGE_SE2 0 1 1 0 0 100 0 0 100 0 0", CHAIN[1], "EDGE_SE2 0 2 3 0 0 100 0 0 0 0 0"],
            " after, over 0 degrees of freedom",
        ),
    ],
)
def test_loops_that_leave_no_degrees_of_freedom_have_a_chi2_but_a_chain_has_none(call, ring, lines, chi2):
    ring.write_text("\n".join([*lines, ""]))
    code, output, _ = call("optimize", ring)
    assert code == 0 and chi2 in output and output.count("no loops") == chi2.count("no loops")


def test_optimize_writes_covariances_a_picture_and_a_recording(call, tmp_path, ring):
    png, rrd = tmp_path / "ring.png", tmp_path / "ring.rrd"
    words = ["--out", tmp_path / "done.graph", "--marginals", "0,2", "--png", png, "--recording", rrd]
    code, output, errors = call("optimize", ring, *words)
    assert (code, errors) == (0, "")
    says(output, png, rrd, tmp_path / "done.marginals.csv")
    rows = [line.split(",") for line in (tmp_path / "done.marginals.csv").read_text().splitlines()]
    assert rows[0] == ["id", "x_x", "x_y", "x_yaw", "y_y", "y_yaw", "yaw_yaw"]
    assert [row[0] for row in rows[1:]] == ["0", "2"]
    assert float(rows[1][1]) == 0.0 and 0.0 < float(rows[2][1]) < 0.02
    assert png.read_bytes().startswith(b"\x89PNG") and rrd.read_bytes().startswith(b"RRF")
    assert (tmp_path / "done.graph").read_text().startswith("VERTEX2 0 ")


@pytest.mark.parametrize("name", ["done.g2o", "done_rejected.g2o", "done.marginals.csv", "ring.png", "a.rrd"])
def test_a_full_disk_leaves_the_files_of_an_earlier_answer_as_they_are(
    call, monkeypatch, tmp_path, false_ring, name
):
    words = ["--out", tmp_path / "done.g2o", "--png", tmp_path / "ring.png", "--recording", tmp_path / "a.rrd"]
    words += ["--robust", "truncated", "--marginals", "all"]
    assert call("optimize", false_ring, *words)[0] == 0
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    write_bytes = Path.write_bytes

    def fill_up(path, data):
        if not path.name.startswith(name):
            return write_bytes(path, data)
        write_bytes(path, data[:100])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", fill_up)
    code, output, errors = call("optimize", false_ring, *words, "--force")
    assert (code, output, errors) == (1, "", f"error: {tmp_path / name}: {FULL}\n")
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_an_answer_that_did_not_converge_is_written_and_says_so(call, tmp_path, ring):
    words = ["optimize", ring, "--graph.max_iterations", "1", "--out", tmp_path / "done.toro", "--force"]
    code, output, errors = call(*words)
    assert (code, errors) == (1, "") and (tmp_path / "done.toro").exists()
    says(output, "iterations     1 in", "; DID NOT CONVERGE: 1 iteration reached")
    code, output, _ = call(*words, "--json")
    assert code == 1 and json.loads(output)["converged"] is False


def test_optimize_takes_an_optimizer_and_a_first_guess(tree, ring):
    words = ["--optimizer", "gauss-newton", "--initialize", "spanning-tree", "--graph.max_iterations", "99"]
    found = tree(ring, *words)
    assert found["initialization"] == "spanning-tree" and found["converged"]
