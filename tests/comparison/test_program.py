"""A method that is a command: what it is given, what it may write, and how it fails."""

import json
import sys

import numpy as np
import pytest

from scanchain.comparison.compare import compare
from scanchain.comparison.processes import Status
from scanchain.errors import InputError
from scanchain.logs import open_log
from scanchain.runs.job import Progress
from tests.support import made
from tests.support.in_process import here
from tests.support.messages import says

PROGRAM = """
import json, sys, time
from pathlib import Path
clouds, poses, nature = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3]
stamps, seen = sorted(int(path.stem) for path in clouds.glob("*.ply")), []
for path in sorted(clouds.glob("*.ply"))[:3]:
    head, _, body = path.read_bytes().partition(b"end_header\\n")
    seen.append([head.decode(), list(memoryview(body).cast("f"))[:8], len(body) // 16])
Path(sys.argv[4]).write_text(json.dumps(seen))
if nature == "fails": sys.exit(3)
if nature == "is-slow": time.sleep(1.0)
if nature == "is-silent": sys.exit(0)
if nature == "falls-short": stamps = stamps[:10]
lines = []
for k, stamp in enumerate(stamps):
    if nature == "counts": stamp = k * 100_000_000
    lines.append(f"{stamp // 10**9}.{stamp % 10**9:09d} {5.0 + 0.1 * k} 1 2 0 0 0 1")
if nature == "is-unsorted": lines.reverse()
poses.write_text("\\n".join(lines) + "\\n")
"""


@pytest.fixture(scope="module")
def office():
    return made.log("office", seconds=3)


@pytest.fixture
def table(office, tmp_path, monkeypatch):
    """The comparison of a program of this nature, and what it was given."""
    here(monkeypatch)
    monkeypatch.setattr("scanchain.evaluation.consistency.MAX_QUERIES", 500)
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)

    def made_by(nature, command="{python} {program} {scans} {poses} {nature} {said}"):
        for name, value in (("python", sys.executable), ("program", program), ("said", tmp_path / "said.json")):
            command = command.replace(f"{{{name}}}", str(value))
        settings = tmp_path / "settings.toml"
        settings.write_text(f"[theirs]\ncommand = '{command.replace('{nature}', nature)}'\n")
        given = {"methods": ("theirs",), "config_file": settings, "force": True}
        return compare((office,), tmp_path / "out", lambda _: None, Progress(), **given).table

    return made_by


def test_it_is_given_every_scan_with_its_stamp_and_the_times_of_its_points(office, table, tmp_path):
    (row,) = table("is-good").rows
    scans = list(open_log(office))
    told = json.loads((tmp_path / "said.json").read_text())
    for (head, numbers, count), scan in zip(told, scans, strict=False):
        assert count == len(scan.points)
        assert [line for line in head.splitlines() if line.startswith("property")] == [
            f"property float {name}" for name in "xyzt"
        ]
        first = np.array(numbers).reshape(2, 4)
        np.testing.assert_allclose(first[:, :2], scan.points[:2], atol=1e-6)
        assert not first[:, 2].any()
        times_s = scan.times_s[:2] if len(scan.times_s) else np.full(2, np.nan)
        np.testing.assert_allclose(first[:, 3], times_s, atol=1e-6)
    assert row.status is Status.OK and row.figures["ate_m"] > 0.0 and row.description.startswith(sys.executable)


@pytest.mark.parametrize("nature", ["counts", "is-unsorted"])
def test_poses_are_those_of_the_stamps_or_in_order(table, nature):
    (row,), (other,) = table("is-good").rows, table(nature).rows
    assert row.figures["ate_m"] == pytest.approx(other.figures["ate_m"], abs=1e-9)


def test_its_time_is_shared_among_the_scans(table):
    (row,) = table("is-slow").rows
    assert 1.0 / 30 < row.figures["median_s"] == row.figures["p95_s"]
    assert row.figures["cpu_s"] < row.figures["median_s"] and row.figures["peak_mib"] > 5.0


@pytest.mark.parametrize(
    ("nature", "reason"),
    [
        ("fails", "ended with exit code 3; see its output.txt"),
        ("is-silent", "wrote no poses; it must write them to {poses}"),
        ("falls-short", "it wrote 10 poses for 30 scans; each needs one, of its stamp"),
    ],
)
def test_one_that_fails_is_a_row_that_says_how(table, nature, reason):
    (row,) = table(nature).rows
    assert row.status is Status.CRASHED
    says(row.reason, reason)


def test_a_program_that_is_not_there_is_named(table):
    (row,) = table("", "no_such_program {scans} {poses}").rows
    says(row.reason, "no_such_program: cannot be run (No such file or directory); check the command")


def test_a_command_without_its_places_is_refused(table):
    with pytest.raises(InputError, match=r"\[theirs\] command is 'slam {scans}'; wanted one in which"):
        table("", "slam {scans}")
