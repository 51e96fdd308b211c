"""Reports in a real browser: everything is there, nothing overlaps or is cut, nothing of a log is ever obeyed."""

import html
import json
import re
import subprocess
import sys
from base64 import b64decode, b64encode
from functools import cache
from hashlib import sha256

import msgspec
import numpy as np
import pyarrow as pa
import pytest
from rerun.chunk import RrdReader

from scanchain.__main__ import main
from scanchain.comparison.table import COLUMNS, read_table
from scanchain.maps import read_ply
from scanchain.runs.metrics import Metrics, summary
from scanchain.verdict import Judged, Kind, Segment, Verdict
from scanchain_viz.pictures.figure import Line
from scanchain_viz.pictures.maps import surroundings
from scanchain_viz.pictures.trajectories import DrawnTrajectory
from scanchain_viz.report.page import (
    SCRIPT,
    Chip,
    Collapsible,
    Drawing,
    Grid,
    Head,
    Page,
    Row,
    Section,
    interactive_map,
    verdict_cell,
    write_page,
)  # fmt: skip
from scanchain_viz.report.run import map_section, sensor_section, trajectory_lines
from scanchain_viz.report.sections import loop_section
from tests.support import made
from tests.support.browser import find_browser, look
from tests.support.in_process import here

EVIL = "<script>alert(1)"
BOTH = pytest.mark.parametrize("which", ["comparison", "one_run"])


@pytest.fixture(scope="module")
def evil(tmp_path_factory):
    """Twelve seconds in the office, in a log whose name begins a script."""
    log = made.log("office", tmp_path_factory.mktemp("log"), seconds=12)
    return log.rename(log.with_name(f"{EVIL}.mcap"))


@pytest.fixture(scope="module")
def comparison(evil, tmp_path_factory):
    """The directory of a comparison, in this process, of ours, a variant of an evil name, and one that raises."""
    folder = tmp_path_factory.mktemp("compared")
    (folder / "a.toml").write_text(
        f'["{EVIL}"]\nmethod = "bad_odometries:Shifted"\n'
        '[raises]\nmethod = "bad_odometries:Bad"\nnature = "raises"\n'
    )

    with pytest.MonkeyPatch.context() as patch:
        here(patch)
        words = ["--settings", str(folder / "a.toml"), "--methods", f"plicp,plicp+loops,{EVIL},raises"]
        assert main(["compare", str(evil), "--out", str(folder / "out"), *words]) == 1
    return folder / "out"


@pytest.fixture(scope="module")
def one_run(evil, tmp_path_factory):
    """The directory of a run."""
    folder = tmp_path_factory.mktemp("run") / "out"
    arguments = ["--odometry.prior", "constant-velocity", "--loops.min_travel_m", "5", "--rerun", "off"]
    assert main(["run", str(evil), "--out", str(folder), *arguments]) == 0
    return folder


@pytest.fixture(scope="module")
def pages(comparison, one_run):
    """The reports by name, as files."""
    return {"comparison": comparison / "report.html", "one_run": one_run / "report.html"}


@pytest.fixture(scope="module")
def seen(pages, tmp_path_factory):
    """What a report is like in a browser; each is opened once in every size."""

    @cache
    def looked(which, width=1200, dark=False):
        return look(pages[which], tmp_path_factory.mktemp("look"), width=width, dark=dark)

    return looked


@pytest.mark.parametrize(
    ("width", "dark"),
    [
        (1200, False),
        (390, True),
        *(pytest.param(*each, marks=pytest.mark.slow) for each in ((1200, True), (390, False))),
    ],
)
@BOTH
def test_nothing_is_cut_and_nothing_overlaps(which, width, dark, seen):
    page = seen(which, width, dark)
    assert page["wide"] <= page["width"] and page["outside"] == []
    for number, drawing in enumerate(page["svgs"]):
        assert drawing["cut"] == [] and drawing["overlapping"] == [], number
        assert drawing["width"] > 200 and drawing["height"] > 80
    assert page["scrolled"] == 0
    assert page["paper"] == ("rgb(20, 23, 27)" if dark else "rgb(255, 255, 255)")


def test_a_comparison_shows_every_figure_and_a_row_for_every_method(comparison, seen):
    page, table = seen("comparison"), read_table(comparison)
    for title in (
        "Summary", "More on accuracy", "More on time",
        "Trajectories", "Plan", "Error", "Over the distance", "Distribution", "Time per scan", "Along the log",
        "Covariance consistency", "Observability", "Maps", "Loop closures of plicp+loops",
        "Disagreement", "Command", "Versions", "Settings",
    ):  # fmt: skip
        assert title in page["text"], title
    assert len(page["svgs"]) >= 9 and page["tables"] >= 2 and page["bold"] >= 5
    for row in table.rows:
        assert row.name in page["text"]
    assert "raises crashed: at scan 10: ValueError: no more <b>patience</b>" in page["text"]
    for column in COLUMNS:
        for cell in column.cells(table.figures):
            assert cell.text in page["text"], column.key


def test_closures_are_counted_by_verdict_and_cause_and_where_none_was_tried_the_report_says_why():
    closures = pa.table({
        "target_scan": [0, 1, 2, 3], "source_scan": [5, 6, 7, 8],
        "rejected_by": ["", "verification", "verification", "verification"],
        "cause": ["verified", "small overlap", "few points", "small overlap"],
        "overlap": [0.9, 0.2, 0.8, 0.4], "residual_m": [0.01, 0.02, 0.03, 0.04],
    })  # fmt: skip
    unknown, positions = np.full(9, np.nan), np.random.default_rng(0).normal(size=(9, 3))
    path = DrawnTrajectory("a", "#2f7de1", False, positions, np.arange(9.0), *[unknown] * 5)
    (section,) = loop_section(path, closures, "Loop closures")
    assert [tuple(getattr(cell, "text", cell) for cell in row.cells) for row in section.grid.rows] == [
        ("2", "30", "30", "small overlap"), ("1", "90", "10", "verified"), ("1", "80", "30", "few points"),
    ]  # fmt: skip
    (section,) = loop_section(path, closures[:0], "Loop closures")
    assert "of 8.0 m does not revisit a place after loops.min_travel_m" in section.text


def test_a_run_says_its_verdict_and_result_first_and_its_time_last(one_run, pages, seen):
    text = pages["one_run"].read_text(encoding="utf-8")
    assert re.findall(r"<h2>(.*?)</h2>", text) == [
        "Accuracy", "Trajectory and map", "Checks", "Loop closures", "Trajectories", "Error", "Uncertainty",
        "Time per scan", "How it was made",
    ]  # fmt: skip
    facts = re.findall(r"<dt>(.*?)</dt>", text)
    assert facts[0] == "scans" and {"trajectory", "expected ATE", "ATE"} < set(facts)
    assert facts[-3:] == ["configuration", "machine", "made"]
    metrics = msgspec.json.decode((one_run / "metrics.json").read_bytes(), type=Metrics)
    assert 'class="verdict trustworthy"' in text and metrics.verdict_error in text
    assert re.fullmatch(r"ATE \d\.\d{3} to \d\.\d{3} m", metrics.verdict_error)
    assert metrics.ground_truth.optimized.kitti_definition == ""  # no segment of 10 m fits
    assert "Versions" in seen("one_run")["text"] and len(seen("one_run")["svgs"]) >= 8


@pytest.mark.parametrize("verdict", list(Verdict))
def test_the_verdict_stands_at_the_head_in_its_color_with_its_error_and_a_line_a_reason(tmp_path, verdict):
    judged = Judged(verdict, "first <b>; second", error="ATE below 1 m")
    write_page(tmp_path, Page("title", "", (("fact", "1"),), ("warned",), (), (), judged=judged))
    page = (tmp_path / "report.html").read_text(encoding="utf-8").partition("<main>")[2]
    (head,) = re.findall(r'<div class="verdict ([\w-]+)"', page)
    assert head == verdict.replace(" ", "-")
    assert f"<strong>{verdict}</strong>" in page and "<li>first &lt;b&gt;</li><li>second</li>" in page
    assert page.index("<strong>") < page.index("warned") < page.index("<dt>fact")
    assert ("ATE below 1 m" in page) is (verdict is not Verdict.NOT_TRUSTWORTHY)
    assert ("otherwise ATE" in page) is (verdict is Verdict.CHECK)


def test_an_error_bar_that_the_ground_truth_refutes_is_told_in_red_and_in_the_summary(one_run, tmp_path, pages):
    metrics = msgspec.json.decode((one_run / "metrics.json").read_bytes(), type=Metrics)
    bar = msgspec.structs.replace(metrics.expected_ate_m, low=1.0, high=2.0)
    wrong = msgspec.structs.replace(metrics, expected_ate_m=bar)
    refuted = wrong.refuted
    assert refuted.startswith("the ground truth refutes the error bar: ATE 0.0")
    write_page(tmp_path, Page("title", "", refuted=refuted))
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert page.count(f'<div class="warning refuted" role="alert">{refuted}</div>') == 1
    assert f"\naccuracy       {refuted}\n" in summary(wrong, "", "", ())
    assert metrics.refuted == "" and "refutes the error bar" not in pages["one_run"].read_text(encoding="utf-8")


def test_the_same_directory_gives_the_same_page_without_matplotlib(pages):
    program = """
import sys
from pathlib import Path
from scanchain_viz.report.comparison import write_compare_report
from scanchain_viz.report.run import write_run_report
write_compare_report(Path(sys.argv[1]))
write_run_report(Path(sys.argv[2]))
assert "matplotlib" not in sys.modules
"""
    before = {page: page.read_bytes() for page in pages.values()}
    subprocess.run([sys.executable, "-c", program, *(page.parent for page in before)], check=True)
    assert {page: page.read_bytes() for page in before} == before


def test_the_map_of_a_run_is_drawn_in_the_page_under_its_own_security_policy(one_run, tmp_path):
    page = (one_run / "report.html").read_text(encoding="utf-8")
    digest = b64encode(sha256(SCRIPT.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in html.unescape(page) and page.count("<script") == 1
    shown = dumped(one_run / "report.html", tmp_path)
    drawn = re.search(r'data-drawn="(\d+)"', shown)
    assert drawn and int(drawn[1]) == len(read_ply(one_run / "map.ply"))
    assert shown.count("<button") == 3  # "from above" is left out of a flat map


def dumped(page, profile):
    """The elements of a page after five seconds in a browser."""
    command = [
        find_browser(), "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={profile}",
        "--window-size=1000,900", "--virtual-time-budget=5000", "--dump-dom", f"file://{page}",
    ]  # fmt: skip
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False).stdout


_HANDLED = """
<script>
(async () => {
  const canvas = document.querySelector("canvas.scene");
  const [plus, minus, above, reset] = document.querySelectorAll("button");
  const frame = () => new Promise(done => setTimeout(done, 50));
  const look = async () => { await frame(); return canvas.toDataURL(); };
  const point = (type, x, y, shiftKey) => canvas.dispatchEvent(
    new PointerEvent(type, {pointerId: 1, clientX: x, clientY: y, buttons: 1, shiftKey}));
  const drag = shift => {
    point("pointerdown", 300, 300, shift); point("pointermove", 360, 330, shift); point("pointerup");
  };
  const wheel = () => canvas.dispatchEvent(new WheelEvent("wheel", {deltaY: -50, cancelable: true}));
  canvas.setPointerCapture = () => {};  // there is no such finger
  const seen = {first: await look()};
  wheel(); seen.scrolled = await look();
  drag(false); seen.turned = await look();
  wheel(); seen.zoomed = await look();
  drag(true); seen.moved = await look();
  reset.click(); seen.reset = await look();
  plus.click(); seen.larger = await look();
  minus.click(); above.click(); seen.above = await look();
  const names = Object.keys(seen), images = Object.values(seen);
  const same = Object.fromEntries(names.map((name, i) => [name, names[images.indexOf(images[i])]]));
  document.title = "PROBE" + JSON.stringify(same);
})();
</script></body>"""


def test_the_map_is_turned_moved_and_zoomed_and_the_page_scrolls_unless_it_was_clicked(tmp_path):
    points = np.random.default_rng(2).uniform([-20.0, -10.0, 0.0], [20.0, 10.0, 6.0], (5000, 3))
    low, high = points.min(axis=0), points.max(axis=0)
    solid, dashed = Line("", np.linspace(low, high, 50), "red"), Line("", np.linspace(high, low, 9), "", 1.0, True)
    drawing = interactive_map(points, [solid, dashed], low, high, grain_m=0.2, is_flat=False)
    write_page(tmp_path, Page("a", "b", sections=[Section("Map", drawings=[drawing])]))
    text = re.sub('<meta http-equiv="Content-Security-Policy"[^>]*>', "", (tmp_path / "report.html").read_text())
    frames = "<script>window.requestAnimationFrame = act => setTimeout(act, 10);</script>"  # none without a window
    (tmp_path / "b.html").write_text(text.replace("<body>", f"<body>{frames}").replace("</body>", _HANDLED))
    same = json.loads(
        html.unescape(re.search("<title>PROBE(.*?)</title>", dumped(tmp_path / "b.html", tmp_path / "profile"))[1])
    )
    assert same == {name: name for name in same} | {"scrolled": "first", "reset": "first"}
    assert len(same) == 8


def test_the_map_in_a_page_stays_small_and_lies_where_the_points_are():
    random = np.random.default_rng(3)
    points = random.normal(0.0, [80.0, 50.0, 4.0], (900_000, 3)).astype(np.float32)
    path = np.linspace([-60.0, 0.0, 0.0], [60.0, 5.0, 1.0], 20_000)
    low, high = surroundings(path, [points])
    broken = np.where(np.arange(20_000)[:, None] % 7 < 5, path, np.nan)
    lines = [Line("", path, "red", 1.0), Line("", broken[:500], "", 1.0)]
    scene = interactive_map(points, lines, low, high, grain_m=0.3, is_flat=False).svg
    assert len(scene) < 2_000_000
    told = json.loads(html.unescape(re.search('data-scene="(.*?)"', scene)[1]))

    def positions(text):
        fractions = np.frombuffer(b64decode(text), "<u2").reshape(-1, 3) / 65535.0
        return low + fractions * (high - low)

    shown = positions(told["points"])
    assert 140_000 < len(shown) <= 160_000
    np.testing.assert_allclose(shown.std(axis=0), points.std(axis=0), rtol=0.02)
    first, second = (positions(line["points"]) for line in told["lines"])
    np.testing.assert_allclose(first[[0, -1]], path[[0, -1]], atol=0.01)
    assert [line["pairs"] for line in told["lines"]] == [False, True]
    assert len(first) <= 4000 and len(second) % 2 == 0
    np.testing.assert_allclose(second[:2], path[:2], atol=0.01)


def test_a_map_is_shown_whole_whatever_the_trajectory_but_for_outliers():
    random = np.random.default_rng(0)
    points = random.uniform([-90.0, -20.0, -2.0], [70.0, 20.0, 8.0], (20_000, 3))
    points[:30, 0] = 130.0  # a gable far away
    points[30:40] = [[9000.0, -3000.0, 50.0]] * 10
    low, high = surroundings(np.array([[-1.0, -1.0, 0.0], [30.0, 1.0, 0.1]]), [points])
    assert (low > [-102.0, -22.5, -3.0]).all() and (low < [-89.9, -19.9, -1.9]).all()
    assert (high > [129.9, 19.9, 7.9]).all() and (high < [142.0, 22.5, 9.0]).all()


def test_a_verdict_in_a_column_of_text_stands_where_the_text_of_the_others_does(tmp_path):
    rows = [Row(each, (verdict_cell(each),)) for each in (Verdict.TRUSTWORTHY, Verdict.NOT_TRUSTWORTHY)]
    grid = Grid((Head("method"), Head("verdict", is_text=True)), rows)
    write_page(tmp_path, Page("a", "b", sections=[Section("Summary", grid=grid)]))
    assert re.findall(r'<td class="(.*?)"', (tmp_path / "report.html").read_text()) == ["text", "bad text"]


def test_segments_and_closures_by_verdict_are_told_apart_and_a_scan_of_several_findings_counts_in_each():
    states = ["contradicted"] * 2 + ["ok"] * 8 + ["degenerate"] * 4 + ["ok"] * 5 + ["lost"] * 3 + ["ok"] * 18
    keyframes = [k // 5 if k % 5 == 0 else -1 for k in range(40)]
    steps = pa.table({"state": states, "keyframe": keyframes})
    closures = pa.table(
        {
            "target_scan": [0, 5, 0], "source_scan": [30, 35, 20], "rejected_by": ["", "back end", "verification"],
        }
    )  # fmt: skip
    positions = np.stack([np.arange(40.0), np.zeros(40), np.zeros(40)], axis=1)
    points = np.random.default_rng(1).uniform(-5.0, 45.0, (300, 3))
    segment = Segment(Kind.ACCELERATION, 0, 3, 4, 0.3, 0.4, 0.5)
    lines = trajectory_lines(positions, steps, closures, [segment], positions + 0.1)
    section = map_section(lines, points, positions, 0.2)
    assert [chip.name for chip in section.chips] == [
        "trajectory",
        "closures rejected by verification: 1", "closures rejected by the back end: 1", "closures accepted: 1",
        "at closures rejected by the back end: 10 scans",
        "degenerate: 4 scans", "lost: 3 scans", "contradicted: 2 scans", "impossible acceleration: 4 scans",
        "ground truth",
    ]  # fmt: skip
    told = json.loads(html.unescape(re.search('data-scene="(.*?)"', section.drawings[-1].svg)[1]))
    assert len(told["lines"]) == len(section.chips) == len({chip.color for chip in section.chips})
    assert [line["color"] for line in told["lines"]] == [chip.color for chip in section.chips]
    assert all(chip.color in section.drawings[0].svg for chip in section.chips)
    flat = map_section(lines, points * [1.0, 1.0, 0.0], positions, 0.2)
    shown = [[drawing.is_still for drawing in each.drawings] for each in (section, flat)]
    assert shown == [[True, False], [True, False]]  # the map is there once


def test_innovations_of_other_sensors_are_drawn_where_there_are_any():
    assert not list(sensor_section(pa.table({"innovation": [1.0]})))
    values = np.where(np.arange(1000) % 10, np.nan, 2.0)
    (section,) = sensor_section(pa.table({"innovation_gnss": values, "innovation_gyro": np.ones(1000)}))
    assert [chip.name for chip in section.chips] == ["gyro", "GNSS"]
    assert "root mean square of 4" in section.drawings[0].caption
    assert all(chip.color in section.drawings[0].svg for chip in section.chips)


@BOTH
def test_a_log_that_is_called_a_script_is_shown_as_text_and_a_page_needs_nothing_but_itself(which, seen, pages):
    text = pages[which].read_text(encoding="utf-8")
    assert EVIL in seen(which)["text"] and html.escape(EVIL) in text
    assert text.count("<script") == 1 and seen(which)["scripts"] == 2  # of maps or tables, and that of the probe
    assert "default-src 'none'" in text and len(text) < 3_000_000
    linked = re.findall(r'(?:src|href|url)\s*[=(]\s*["\']?([^"\')\s>]+)', text)
    beside = {"compare.rrd", "table.csv"} if which == "comparison" else set()  # to follow, not loaded
    assert beside <= set(linked), set(linked)
    assert all(link.startswith(("data:", "#")) for link in set(linked) - beside), set(linked)


def test_a_recording_holds_way_map_and_plots_of_every_method_that_ended(comparison):
    entities = {str(chunk.entity_path) for chunk in RrdReader(comparison / "compare.rrd").stream()}
    for method in ("plicp", "plicp\\+loops"):
        for part in ("world/{}/trajectory", "world/{}/lidar", "world/{}/map", "plots/error/{}", "plots/time/{}"):
            assert "/" + part.format(method) in entities
    assert "/world/ground_truth" in entities


def test_every_text_of_a_page_is_escaped(tmp_path):
    chip, drawing = Chip(EVIL, "red"), Drawing(EVIL, EVIL, svg="<svg></svg>")
    grid = Grid((Head(EVIL, EVIL, EVIL),), (Row(EVIL, ()),), (EVIL,))
    section = Section(EVIL, EVIL, (chip,), (drawing,), grid)
    fold = Collapsible(EVIL, EVIL)
    write_page(tmp_path, Page(EVIL, EVIL, ((EVIL, EVIL),), (EVIL,), (EVIL,), (section,), (fold,)))
    assert "<script" not in (tmp_path / "report.html").read_text()
