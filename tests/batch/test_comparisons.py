"""Comparisons on several logs: each is made once, one that fails touches no other, and the site is whole."""

import json
import re
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest

import scanchain
from scanchain import lie
from scanchain.__main__ import main
from scanchain.batch.comparisons import check_site, compare_each, logs_of
from scanchain.comparison.methods import Variation, resolve
from scanchain.comparison.overall import OVERALL_FILE
from scanchain.comparison.table import TABLE_FILE, read_table
from scanchain.errors import InputError
from scanchain.runs.job import Progress
from scanchain.settings import Override
from tests.support import made
from tests.support.browser import look
from tests.support.in_process import here
from tests.support.messages import unfolded

MINE = '[mine]\nmethod = "bad_odometries:Shifted"\n[other]\nmethod = "bad_odometries:Shifted"\nstep_m = 0.2\n'


class Announced(Progress):
    def __init__(self):
        self.lines = []

    def announce(self, line):
        self.lines.append(line)


@pytest.fixture(scope="module", autouse=True)
def quick():
    """Methods in this process, and sharpness at few points."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("scanchain.evaluation.consistency.MAX_QUERIES", 500)
        here(patch)
        yield


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Two drives in the office, one file each."""
    folder = tmp_path_factory.mktemp("logs")
    found = [made.log("office", folder=folder / name, seconds=8, seed=k) for k, name in enumerate("ab")]
    return [log.rename(folder / f"{name}.mcap") for log, name in zip(found, "ab", strict=True)]


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    path = tmp_path_factory.mktemp("settings") / "mine.toml"
    path.write_text(MINE)
    return path


def compare(logs, out, settings, *, methods=("mine", "other"), progress=None, **more):
    given = {"methods": methods, "config_file": settings} | more
    return compare_each([(log,) for log in logs], out, lambda _: None, progress or Progress(), **given)


def made_at(out):
    return {path.parent.name: path.stat().st_mtime_ns for path in out.glob(f"*/{TABLE_FILE}")}


def test_a_second_call_compares_only_what_has_no_result_yet(logs, settings, tmp_path):
    compare(logs[:1], tmp_path / "out", settings)
    before, progress = made_at(tmp_path / "out"), Announced()
    overall = compare(logs, tmp_path / "out", settings, progress=progress)
    after = made_at(tmp_path / "out")
    assert len(after) == 2 and before.items() <= after.items()
    assert "1 of 2 logs are compared already" in progress.lines
    assert [each.share for each in overall.standings] == ["2/2", "2/2"]
    compare(logs, tmp_path / "out", settings, force=True)
    forced = made_at(tmp_path / "out")
    assert forced.keys() == after.keys() and all(forced[name] > after[name] for name in after)


@pytest.mark.parametrize("change", ["methods", "repeat", "settings", "log"])
def test_a_result_belongs_to_log_methods_and_settings(logs, settings, tmp_path, change):
    log, more = tmp_path / "c.mcap", {}
    log.write_bytes(logs[0].read_bytes())
    own = tmp_path / "own.toml"
    own.write_text(MINE)
    compare([log], tmp_path / "out", own)
    match change:
        case "methods":
            more = {"methods": ("mine",)}
            own.write_text('[mine]\nmethod = "bad_odometries:Shifted"\n')
        case "repeat":
            more = {"repeat": 2}
        case "settings":
            own.write_text(MINE.replace("0.2", "0.3"))
        case "log":
            log.write_bytes(logs[1].read_bytes())
    compare([log], tmp_path / "out", own, **more)
    assert len(made_at(tmp_path / "out")) == 2


def test_a_log_that_cannot_be_read_is_a_row_with_the_reason_and_is_tried_again(logs, settings, tmp_path):
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(b"nothing")
    overall = compare([bad, logs[0]], tmp_path / "out", settings)
    assert [each.table is None for each in overall.logs] == [True, False]
    assert len(overall.failures) == 1 and overall.failures[0].startswith("bad.mcap: is not a recognized log")
    bad.write_bytes(logs[1].read_bytes())
    assert not compare([bad, logs[0]], tmp_path / "out", settings).failures


def test_with_force_an_earlier_result_hides_no_failure(logs, settings, tmp_path, monkeypatch):
    compare(logs[:1], tmp_path / "out", settings)

    def fail(*_, **__):
        raise InputError("the disk is full; make room")

    monkeypatch.setattr("scanchain.batch.comparisons.compare", fail)
    forced = compare(logs[:1], tmp_path / "out", settings, force=True)
    assert forced.failures == ["a.mcap: the disk is full; make room"]


def test_a_truth_that_was_corrected_is_compared_with_again(logs, settings, tmp_path):
    truth = tmp_path / "a.tum"
    truth.write_bytes(made.log("office", folder=tmp_path, seconds=8, seed=0).with_suffix(".tum").read_bytes())
    for _ in range(2):
        compare(logs[:1], tmp_path / "out", settings, ground_truth=truth)
        truth.write_text(truth.read_text() + "# corrected\n")
    assert len(made_at(tmp_path / "out")) == 2


def test_what_was_stopped_is_no_result_and_the_next_call_continues(logs, settings, tmp_path):
    class Stopping(Announced):
        def announce(self, line):
            super().announce(line)
            if line.startswith("other") and len(made_at(tmp_path / "out")) == 1:  # in the second log
                raise KeyboardInterrupt

    overall = compare(logs, tmp_path / "out", settings, progress=Stopping())
    assert [each.reason for each in overall.logs] == ["", "not compared: stopped by the user"]
    assert len(list((tmp_path / "out").iterdir())) == 4  # one log and three tables over all
    assert not compare(logs, tmp_path / "out", settings).failures


def test_a_log_whose_reading_the_user_stopped_is_no_result(logs, settings, tmp_path):
    class Stopped(Announced):
        stopped = True

        def track(self, scans, count):
            yield next(iter(scans))

    overall = compare(logs[:1], tmp_path / "out", settings, progress=Stopped())
    assert overall.failures == ["a.mcap: not compared: stopped by the user"] and not made_at(tmp_path / "out")


def test_the_truth_of_each_log_is_found_by_its_name(logs, settings, tmp_path):
    truth = made.log("office", folder=tmp_path, seconds=8, seed=0).with_suffix(".tum")
    for name in "ab":
        (tmp_path / f"{name}.tum").write_bytes(truth.read_bytes())
    overall = compare(logs, tmp_path / "out", settings, ground_truth=tmp_path / "{}.tum")
    assert [log.table.truth for log in overall.logs] == [str(tmp_path / f"{name}.tum") for name in "ab"]


def test_parts_of_one_drive_are_one_log_and_other_files_are_one_each(logs, tmp_path):
    whole, wheels = made.log("office", folder=tmp_path, seconds=3), tmp_path / "wheels"
    halves = [tmp_path / "1.mcap", tmp_path / "2.mcap"]
    for half, part in zip(halves, (("--end", "1.5"), ("--start", "1.5")), strict=True):
        assert main(["convert", str(whole), str(half), *part]) == 0
    assert logs_of(halves, "auto") == [tuple(halves)]
    assert logs_of(logs, "auto") == [(logs[0],), (logs[1],)]  # both begin at the same time
    town = made.log("town", folder=tmp_path / "town", seconds=1, sensor="vlp-16")
    assert logs_of([logs[0], town], "auto") == [(logs[0],), (town,)]
    assert logs_of([logs[0].parent], "auto") == [(logs[0],), (logs[1],)]
    assert logs_of([logs[0], wheels], "auto") == [(logs[0],), (wheels,)]  # which is missing, as its row says


def test_a_topic_holds_for_the_logs_that_have_it(logs, settings, tmp_path):
    town = made.log("town", folder=tmp_path / "town", seconds=1, sensor="vlp-16")
    topic = scanchain.open_log(town).topic
    given = {"overrides": (Override("log.topic", topic, "--topic"),), "progress": Announced()}
    overall = compare([logs[0], town], tmp_path / "out", settings, **given)
    assert [log.table.topic for log in overall.logs] == ["/scan", topic]
    assert f"{logs[0]}: has no topic {topic}; its own lidar is used" in given["progress"].lines


def test_the_kitti_benchmark_is_a_folder_of_logs(tmp_path, capfd):
    """Two simulated drives in its layout, poses in the frame of the camera."""
    T_camera_lidar = np.array(
        [[0.0, -1.0, 0.0, 0.1], [0.0, 0.0, -1.0, -0.2], [1.0, 0.0, 0.0, -0.3], [0.0, 0.0, 0.0, 1.0]]
    )
    (tmp_path / "poses").mkdir()
    true = {}
    for seed, name in enumerate(("00", "05")):
        log = made.log("town", seconds=3, seed=seed, sensor="vlp-16")
        sequence = tmp_path / "sequences" / name
        (sequence / "velodyne").mkdir(parents=True)
        scans = list(scanchain.open_log(log))
        for k, scan in enumerate(scans):
            rows = np.column_stack([scan.points, np.zeros(len(scan.points))]).astype("<f4")
            rows.tofile(sequence / "velodyne" / f"{k:06d}.bin")
        (sequence / "times.txt").write_text("".join(f"{0.1 * k:e}\n" for k in range(len(scans))))
        (sequence / "calib.txt").write_text("Tr: " + " ".join(f"{x:e}" for x in T_camera_lidar[:3].ravel()) + "\n")
        true[name] = scanchain.read_tum(log.with_suffix(".tum")).poses[: len(scans)]
        from_first = T_camera_lidar @ lie.between(true[name][0], true[name]) @ lie.inverse(T_camera_lidar)
        np.savetxt(tmp_path / "poses" / f"{name}.txt", from_first[:, :3].reshape(-1, 12))
    own = tmp_path / "own.toml"
    own.write_text('[mine]\nmethod = "bad_odometries:Shifted"\n')
    words = ["compare", str(tmp_path / "sequences"), "--methods", "plicp,mine", "--config", str(own)]
    assert main([*words, "--out", str(tmp_path / "out")]) == 0
    tables = {path.parent.name[:2]: read_table(path.parent) for path in (tmp_path / "out").glob(f"*/{TABLE_FILE}")}
    assert tables.keys() == true.keys()
    for name, table in tables.items():
        assert table.scans == len(true[name]) and table.truth == "/ground_truth"
        ours, mine = table.rows
        assert ours.figures["ate_m"] < 0.05 < mine.figures["ate_m"]
    assert "plicp    2/2" in capfd.readouterr().out


def test_a_directory_or_a_site_that_holds_something_else_is_left_alone(logs, settings, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis.tex").touch()
    with pytest.raises(InputError, match="is not empty and not a comparison of several logs"):
        compare(logs, tmp_path / "mine", settings)
    compare(logs[:1], tmp_path / "out", settings)
    (tmp_path / "home").mkdir()
    (tmp_path / "home/index.html").touch()
    for site in ("mine", "home", "out"):
        with pytest.raises(InputError, match="is not a site of comparisons; choose another --site"):
            check_site(tmp_path / site, tmp_path / "out")


@pytest.fixture(scope="module")
def site(logs, settings, tmp_path_factory):
    """The site of a comparison by the command line, one log of which cannot be read, and the exit code."""
    folder = tmp_path_factory.mktemp("site")
    bad = folder / "<script>bad.mcap"
    bad.write_bytes(b"nothing")
    words = [*map(str, logs), str(bad), "--methods", "mine,other", "--config", str(settings)]
    return folder / "site", main(["compare", *words, "--out", str(folder / "out"), "--site", str(folder / "site")])


def test_the_site_is_whole_and_escapes_what_logs_are_called(site):
    folder, code = site
    text = (folder / "index.html").read_text()
    assert code == 1 and "<script>bad" not in text
    links = re.findall(r'<a href="([^"]+)"', text)
    assert len([link for link in links if link.endswith("report.html")]) == 2
    for link in links:
        assert (folder / link).is_file()
        inside = re.findall(r'<a href="([^"]+)"', (folder / link).read_text()) if link.endswith("html") else ()
        for inner in inside:
            assert (folder / link).parent.joinpath(inner).is_file()
    assert {each["folder"] for each in json.loads((folder / OVERALL_FILE).read_text())["logs"]} >= {
        Path(link).parent.name for link in links if "/" in link
    }


@pytest.mark.parametrize("width", [1280, 390])
def test_its_page_fits_screens_and_phones(site, tmp_path, width):
    seen = look(site[0] / "index.html", tmp_path, width=width)
    assert seen["wide"] <= seen["width"] and not seen["outside"]
    assert all(not svg["cut"] and not svg["overlapping"] for svg in seen["svgs"])
    for words in ("Medians", "Accuracy against time", "Critical difference", "Wins", "ATE by log", "bad.mcap"):
        assert words in seen["text"]


def test_a_click_on_a_head_sorts_its_table(site, tmp_path):
    page = tmp_path / "sorted.html"
    click = """<script>
      const [table] = [...document.querySelectorAll("table")].filter(each => each.innerText.includes("rank"));
      const head = [...table.tHead.rows[0].cells].find(each => each.innerText.startsWith("ATE"));
      const order = () => [...table.tBodies[0].rows].map(row => row.cells[0].innerText.trim()).join(" ");
      head.click(); const rising = order(); head.click();
      document.querySelector("h1").innerText = `${rising}; ${order()}; ${head.ariaSort}`;
    </script></body>"""
    page.write_text((site[0] / "index.html").read_text().replace("</body>", click))
    (first,) = (line for line in look(page, tmp_path, width=1280)["text"].splitlines() if "descending" in line)
    rising, falling, _ = first.split("; ")
    assert {rising, falling} == {"mine other", "other mine"}


def test_a_setting_is_varied_for_the_methods_that_have_it(logs, tmp_path, settings, capfd):
    words = ["compare", str(logs[0]), "--methods", "mine,other", "--config", str(settings)]
    words += ["--vary", "step_m=0.1,0.3", "--vary", "every=1,2", "--out", str(tmp_path / "out")]
    assert main([*words, "--site", str(tmp_path / "site")]) == 0
    said = capfd.readouterr().out
    steps, every = (
        re.search(rf"\n({key} .*\n)(.*\n)+?(?=\n|written)", said)[0].split("\n") for key in ("step_m", "every")
    )
    assert steps[1].split() == ["step_m", "other"]  # which alone has it in its table
    assert every[1].split() == ["every", "mine", "other"] and [line.split()[0] for line in every[3:5]] == [
        "1",
        "2",
    ]
    (finer,) = (read_table(path.parent) for path in (tmp_path / "out/vary/every=2").glob(f"*/{TABLE_FILE}"))
    assert finer.scans == 40
    (changed,) = (read_table(path.parent) for path in (tmp_path / "out/vary/step_m=0.3").glob(f"*/{TABLE_FILE}"))
    assert [(row.name, row.settings) for row in changed.rows] == [("other", {"step_m": 0.3})]
    links = re.findall(r'<a href="(vary[^"]+)"', (tmp_path / "site/index.html").read_text())
    assert len(links) == 4 and all((tmp_path / "site" / unquote(link)).is_file() for link in links)
    assert main(words) == 0 and "compared already" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--vary", "every"], "--vary every: wanted KEY=VALUE,VALUE, as --vary every=1,2,5"),
        (["--vary", "nothing=1"], "--vary nothing: none of plicp, svd has such a setting"),
        (["--vary", "every=1,2", "--vary", "every=no"], "--vary every: log.every is 'no'"),
        (
            ["--vary", "max_iterations=5"],
            "--vary max_iterations: there are several, matching.max_iterations and graph",
        ),
        (["--vary", "loops.enabled=true"], "--vary loops.enabled distinguishes plicp, svd, +loops and +imu"),
        (["--vary", "every=0"], "--vary every: log.every is 0; it must be a whole number >= 1"),
    ],
)
def test_a_variation_that_is_none_is_refused_by_name(logs, tmp_path, capfd, words, complaint):
    code = main(["compare", str(logs[0]), "--methods", "plicp,svd", "--out", str(tmp_path / "out"), *words])
    said = "".join(capfd.readouterr())
    assert complaint in unfolded(said) and code == 2
    assert not (tmp_path / "out").exists()  # before anything is run


def test_variations_hold_for_ours_and_for_baselines_by_the_same_name():
    methods = resolve(
        ("plicp", "kiss-icp", "genz-icp", "plicp+loops"), 3, file=None, variation=Variation("voxel_size_m", "0.5")
    )
    assert [method.name for method in methods] == ["plicp", "kiss-icp", "plicp+loops"]
    assert methods[0].settings["local_map"]["voxel_size_m"] == methods[1].settings["voxel_size_m"] == 0.5
    (kiss,) = resolve(("kiss-icp",), 3, file=None, variation=Variation("max_iterations", "7"))
    assert kiss.settings["max_iterations"] == 7  # ours have several such keys, but take no part
    (fewer,) = resolve(("plicp", "small-gicp"), 3, file=None, variation=Variation("neighbors", "7"))
    assert (fewer.name, fewer.settings["neighbors"]) == ("small-gicp", 7)
    with pytest.raises(InputError, match=r"--vary neighbors: .*its keys are"):
        resolve(("small-gicp",), 3, file=None, variation=Variation("neighbors", '"many"'))
