"""``scanchain changes``: maps brought into one frame and compared, and the files that it writes."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

import scanchain
from scanchain import lie
from scanchain.__main__ import main
from scanchain.logs.formats.clouds import read_ply
from scanchain.sessions.change_run import compare_maps
from scanchain.sessions.changes import Label, Part
from scanchain_viz.report.maps import _cluster_grid
from tests.support.rooms import BOX, hall, part, room, saved


def test_the_command_writes_labels_a_table_and_pictures(tmp_path, capsys):
    a, b = saved(tmp_path / "a", part("a", room(BOX))), saved(tmp_path / "b", part("b", room((3.0, 3.5))))
    assert main(["changes", str(a), str(b), "--aligned", "--out", str(tmp_path / "ab")]) == 0
    assert "1 cluster" in capsys.readouterr().out
    names = {path.name for path in (tmp_path / "ab").iterdir()}
    assert names == {
        "changes.ply", "changes.csv", "changes.parquet", "summary.txt", "metrics.json", "report.html",
        "recording.rrd", "run.json",
    }  # fmt: skip
    cloud = read_ply(tmp_path / "ab" / "changes.ply")
    assert set(cloud["label"]) >= {Label.SAME, Label.APPEARED, Label.VANISHED}
    with (tmp_path / "ab" / "changes.csv").open() as file:
        assert [row["kind"] for row in csv.DictReader(file)] == sorted(("appeared", "vanished"), reverse=True)


def test_boxes_in_the_plan_carry_the_numbers_of_the_table_which_has_no_empty_column(tmp_path):
    a, b = saved(tmp_path / "a", part("a", room(BOX))), saved(tmp_path / "b", part("b", room((3.0, 3.5))))
    found = scanchain.changes(a, b, tmp_path / "ab", T_earlier_later=lie.identity(2))
    page = (tmp_path / "ab" / "report.html").read_text()
    for number in ("1", "2"):
        assert page.count(f'text-anchor="start">{number}</text>') == 4  # wide, narrow, and in two close-ups
    assert "counterpart" not in page
    moved = replace(found, clusters=(replace(found.clusters[0], counterpart=2), found.clusters[1]))
    grid = _cluster_grid(moved)
    assert grid.heads[-1].text == "counterpart" and [row.cells[-1] for row in grid.rows] == ["2", ""]


def test_a_given_transform_brings_the_later_map_into_the_frame_of_the_earlier(tmp_path):
    T = lie.pose_2d(2.0, -1.0, np.pi / 2)
    a = saved(tmp_path / "a", part("a", room(BOX)))
    b = saved(tmp_path / "b", part("b", room(), lie.inverse(T)))
    found = scanchain.changes(a, b, tmp_path / "ab", T_earlier_later=T, recording=False)
    assert [each.kind for each in found.clusters] == ["vanished"]
    assert main(["changes", str(a), str(b), "--transform", "2,-1,90", "--out", str(tmp_path / "again")]) == 0
    assert (tmp_path / "again" / "changes.csv").read_bytes() == (tmp_path / "ab" / "changes.csv").read_bytes()


def test_the_newest_session_of_a_merged_map_is_compared_with_those_before(tmp_path):
    merged = saved(tmp_path / "m", part("monday", room(BOX)), part("friday", room()))
    found = scanchain.changes(merged, None, tmp_path / "out", recording=False)
    assert found.names == ("monday", "friday")
    assert [each.kind for each in found.clusters] == ["vanished"]


def test_a_map_with_another_start_is_found_in_the_earlier_one_and_its_changes_are_counted(tmp_path):
    posts = [(x, y) for x in np.arange(1.5, 10.5, 1.0) for y in (0.8, 3.2)]
    a = saved(tmp_path / "a", part("a", room(*posts, edge_m=0.3)))
    b = saved(tmp_path / "b", part("b", room(), lie.pose_2d(2.0, -1.0, 2.0)))
    stages, presented = [], []
    found = compare_maps([a, b], tmp_path / "ab", lambda *given: presented.append(given), stages.append)
    assert stages == ["placing b in a", "comparing", "writing"]
    ((folder, changes),) = presented
    assert changes is found and not folder.exists()
    count = len(found.clusters)
    assert count > 10 and {each.kind for each in found.clusters} == {"vanished"}
    summary = (tmp_path / "ab" / "summary.txt").read_text()
    assert "alignment      by 8 loop closures" in summary and f"vanished       {count} clusters" in summary
    assert f"and {count - 7} smaller ones: changes.csv" in summary
    metrics = json.loads((tmp_path / "ab" / "metrics.json").read_text())
    assert metrics["clusters"] == {"appeared": 0, "vanished": count, "moved": 0}
    assert metrics["points"] == {label.name.lower(): int((found.labels == label).sum()) for label in Label}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["A"], "has one session"),
        (["A", "B"], "is not found in"),
        (["A", "B", "--transform", "1,2"], "give X,Y,YAW"),
        (["A", "B", "--transform", "1,2,0", "--aligned"], "give one of them"),
        (["A", "none"], "holds no map"),
        (["A", "empty"], "has no keyframe"),
        (["A", "B", "--aligned", "--force", "--out", "A"], "is one of the maps"),
        (["A", "B", "--aligned", "--force", "--out", "B"], "is one of the maps"),
    ],
)
def test_what_cannot_be_compared_is_refused_and_leaves_the_maps_as_they_were(tmp_path, capsys, words, message):
    saved(tmp_path / "A", part("a", room(BOX), count=3))
    saved(tmp_path / "B", part("b", hall(), lie.pose_2d(70.0, 0.0, 1.0), count=3))
    saved(tmp_path / "empty", Part("empty", [], np.empty((0, 3, 3))))
    before = {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")}
    words = [str(tmp_path / word) if word in ("A", "B", "none", "empty") else word for word in words]
    assert main(["changes", "--out", str(tmp_path / "out"), *words]) == 2
    assert message in capsys.readouterr().err
    assert before == {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")}


def test_a_comparison_names_both_maps_and_is_no_run_to_check_or_draw(tmp_path, capsys):
    a, b = saved(tmp_path / "a", part("a", room(BOX))), saved(tmp_path / "b", part("b", room()))
    scanchain.changes(a, b, tmp_path / "ab", T_earlier_later=lie.identity(2), recording=False)
    made = json.loads((tmp_path / "ab" / "run.json").read_text())
    assert [log["path"] for log in made["logs"]] == [str(a / "map"), str(b / "map")]
    assert made["command"] == []  # not that of the program that called it
    assert main(["check", str(tmp_path / "ab")]) == 2
    assert "name a directory of scanchain run" in capsys.readouterr().err
    assert main(["view", str(tmp_path / "ab"), "--png", str(tmp_path / "ab.png")]) == 2
    assert "open report.html" in capsys.readouterr().err
