"""Every figure of README is one that a command prints, and prints still.

README is read, not repeated here: a claim finds its figures by the words around them, and computes what they have
to be. A figure without a claim is an error. Examples, and what they print, are run by test_examples.py. Of the
rest

- MEASURED and the errors of the rows in the plane, whose command is run as it stands, are measured again, on
  ../shared/data;
- CLAIMS and all rows are compared with the pages of docs: for odometry3d (methods of others in space, the town),
  trust, imu, odometry3d --set (ten worlds), whose commands take minutes to hours, that is the only comparison.
"""

import math
import re
import tomllib
from functools import cache
from importlib import metadata

import pytest
from packaging.requirements import Requirement

import scanchain
from scanchain.__main__ import main
from scanchain.comparison.table import read_table
from scanchain.evaluation import read_relations, relation_error
from scanchain.settings import load_settings
from scanchain.trajectory import read_tum
from tests.support import made
from tests.support.scenes import ROOT, shared_data

FIGURE = r"\d[\d,]*(?:\.\d+)?"
NAMES = re.compile(  # of things, with digits in them
    r"\b[23]D\b|KITTI raw \d+|PandaSet \d+|CC BY 4\.0|KITTI odometry 00 to 10|g2o|nav2|Open3D|\(N, [23]\)"
)
WORDS = {
    "two": 2,
    "three": 3,
    "four": 4,
    "ten": 10,
    "half": 1 / 2,
    "quarter": 1 / 4,
    "sixth": 1 / 6,
    "tenth": 1 / 10,
}
ROW = re.compile(r"\| ([^|]+) \| ([\d.]+) m(?:, ([\d.]+)°)? \| ([\w-]+ [\d.]+ m[^|]+) \| [^|]+ \|")
OTHER = re.compile(r"([\w-]+) ([\d.]+) m(?:, ([\d.]+)°)? \(([\d.]+) / ([\d.]+)\)")
IN_2D = {"Intel": "Intel", "simulated office": "office"}
IN_3D = {"PandaSet": (1, 2), "KITTI": (4, 6), "simulated town": (7, 9)}  # columns of ATE and time
AGAIN = 0.1  # share by which errors of others differ from run to run


@cache
def readme():
    """README in one line, without examples, code, addresses, and names that have digits."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    text = re.sub(r"^(```+)\w*\n.*?^\1$", "", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"\]\([^)]*\)", "]", re.sub(r"`[^`]*`", "`", text))
    return " ".join(text.replace("*", "").split())


def page(name):
    """A page of docs in one line."""
    return " ".join((ROOT / "docs" / name).read_text(encoding="utf-8").split())


def rows(name, heading):
    """Cells of each row of the tables under a heading of a page."""
    section = (
        (ROOT / "docs" / name).read_text(encoding="utf-8").partition(f"\n## {heading}\n")[2].partition("\n#")[0]
    )
    lines = [line for line in section.splitlines() if line.startswith("|")]
    assert lines, f"{name} has no table under {heading}"
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def figures(text):
    return [float(each.replace(",", "")) for each in re.findall(FIGURE, text)]


def agree(said, true, share=0.0):
    """Whether a figure as written is this value, rounded, or differs from it by at most a share."""
    unit = 10.0 ** -len(said.partition(".")[2])
    value = WORDS[said] if said in WORDS else float(said.replace(",", ""))
    return abs(value - true) <= max(0 if said in WORDS else 0.501 * unit, share * true)


def of_benchmarks(pattern):
    """The figures of a sentence of docs/benchmarks.md."""

    def found():
        (groups,) = re.findall(pattern, page("benchmarks.md"))
        return [WORDS.get(each) or float(each) for each in groups]

    return found


def drift_in_space():
    """Share of the path, and km, within which loops are searched in space."""
    ((percent, most_km),) = re.findall(
        r"up to (\d+) % of the path between them .*?, at most (\d+) km", page("method.md")
    )
    return [0.01 * float(percent), float(most_km)]


def command_in_the_plane():
    """The command of the rows in the plane."""
    (words,) = re.findall(r"`scanchain (compare intel\.mcap [^`]*)`", (ROOT / "README.md").read_text())
    return words


def in_3d(method, log):
    """ATE, time and CPU time of a method of the table of odometry3d, relative to ours."""
    (cells,) = (
        cells for cells in rows("benchmarks.md", "3D odometry against others") if method in cells[0].split(",")[0]
    )
    error, time = IN_3D[log]
    return [*figures(cells[error]), *figures(cells[time])]


def in_2d(log):
    """Errors of ours, those of KISS-ICP, and its time and CPU time, of a row of that table."""
    (cells,) = (cells for cells in rows("benchmarks.md", "2D odometry against KISS-ICP") if log in cells[0])
    return [figures(cell) for cell in cells[1:]]


def ratios_to_kiss():
    times = [in_3d("KISS-ICP", log)[1] for log in IN_3D]
    return [1.0 / round(min(times)), 1.0 / round(max(times))]


def ratios_of_svd():
    (cells,) = (cells for cells in rows("benchmarks.md", "3D odometry against others") if "svd" in cells[0])
    times = [float(cells[k]) for k in (2, 3, 6, 9)]
    return [min(times), max(times)]


def contained():
    """Runs whose error bar contains the truth, and all of them."""
    table = [
        (int(cells[1]), figures(cells[2])[0]) for cells in rows("results.md", "Verdict") if cells[1].isdigit()
    ]
    return [sum(round(0.01 * percent * runs) for runs, percent in table), sum(runs for runs, _ in table)]


def nees():
    """NEES in simulated worlds, of every second scan in them, and on real drives, of logs with point times."""
    table = rows("benchmarks.md", "Consistency of the covariances")[2:]
    known = {cells[0]: float(cells[3]) for cells in table if cells[3] and "no times" not in cells[0]}
    drives = [value for log, value in known.items() if log.startswith(("KITTI", "PandaSet"))]
    thinned = [value for log, value in known.items() if log.endswith(", every 2")]
    others = [value for log, value in known.items() if re.search(r" (?:lms|utm|os1)-\d+ \d(?!, every)", log)]
    return [min(others), max(others), max(thinned), min(drives), max(drives)]


def time_in_2d():
    times = [figures(cells[3])[0] for cells in rows("benchmarks.md", "2D odometry against KISS-ICP")[2:]]
    (ours,), (theirs,), _ = in_2d("office")
    return [min(times), max(times), round(theirs / ours, -1)]


def installed():
    """Least Python, and GB of all packages that an installation without extras brings."""
    least = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["requires-python"].removeprefix(">=")
    waiting, names = ["scanchain"], set()
    while waiting:
        for text in metadata.requires(waiting.pop()) or []:
            need = Requirement(text)
            if need.name not in names and (need.marker is None or need.marker.evaluate({"extra": ""})):
                names.add(need.name)
                waiting.append(need.name)
    sizes = [file.size or 0 for name in names for file in metadata.files(name) or []]
    return [float(least), 1e-9 * sum(sizes)]


CLAIMS = {  # sentence of README, its figures as groups, to what they have to be
    r"contained the truth in (\d+) of (\d+) simulated and real runs": contained,
    r"a (quarter) to a (sixth) of KISS-ICP's time": ratios_to_kiss,
    r"Python ([\d.]+) or newer on Linux or macOS; all dependencies are wheels, ([\d.]+) GB": installed,
    r"SVD-ICP has the same errors in ([\d.]+) to ([\d.]+) times the time": ratios_of_svd,
    r"wheels is off by (\d+) to (\d+) m after (\d+) s, with an IMU ([\d.]+) to (\d+) m": of_benchmarks(
        r"wheels is off by (\d+) to (\d+) m after (\d+) s, with an IMU by ([\d.]+) to (\d+) m"
    ),
    r"a (quarter) to a (half) of the barely observable scans": of_benchmarks(
        r"a (\w+) to a (\w+) of the barely observable scans"
    ),
    r"fail in (four) of (ten) simulated worlds, in (three) with an IMU": of_benchmarks(
        r"fail in (\w+) of the (\w+) worlds.*?\[With an IMU\]\(sensors.md\) (\w+)\."
    ),
    r"with a range of (\d+) m, in corridors and without wheels, is off by meters": of_benchmarks(
        r"at a range of (\d+) m, in corridors and without wheels, is off by meters"
    ),
    r"Intel \(2D\), (\d+) s: mean error": lambda: figures(re.search(r"--end (\d+)", command_in_the_plane())[1]),
    r"up to (\d+) m in 2D": lambda: [load_settings(2).config.loops.max_radius_m],
    r"a (tenth) of the path, at most (\d+) km": drift_in_space,
    r"is ([\d.]+) to ([\d.]+) in simulated worlds, with every second scan up to (\d+), ([\d.]+) to ([\d.]+)": nees,
    r"takes ([\d.]+) to ([\d.]+) of our time, at (\d+) times the error in the office": time_in_2d,
}
SHARES = {installed: 0.15}  # by which figures may differ: versions of the dependencies


@cache
def run_of(name, **options):
    """The finished run of a real log without error bars, and the log."""
    path, out = shared_data(name), ROOT / "build" / "made" / "readme" / name
    return scanchain.run(path, out, recording=False, force=True, outputs__error_bars="quick", **options), path


def of_intel():
    done, path = run_of("2d/intel.mcap")
    error = relation_error(read_tum(done.path), read_relations(path.with_suffix(".relations")))
    return done.metrics, error.translation_m.mean


def of_drive(name, **options):
    """Number of sweeps, ATE, ATE from the second sweep on, and length of the path."""
    done, _ = run_of(name, **options)
    found, errors = done.metrics, scanchain.evaluate(done.path, done.path / "ground_truth.tum")
    after_start = errors.after_start or errors.ate  # of PandaSet the first sweep has no true pose
    return (
        found.scans,
        errors.ate.translation_m.rmse,
        after_start.translation_m.rmse,
        found.ground_truth.path_length_m,
    )


def of_pandaset():
    return of_drive("3d/pandaset_002_sweeps30to55.mcap", log__topic="/pandar64/points")


MEASURED = {  # the same, measured now
    r"Intel Research Lab, ([\d,]+) scans": lambda: [of_intel()[0].scans],
    r"(\d+) minutes in the Intel Research Lab, mean error ([\d.]+) m over": (
        lambda: [of_intel()[0].log_span_s / 60.0, of_intel()[1]]
    ),
    r"Map of (\d+) sweeps while a car sets off, ([\d.]+) m off": lambda: of_pandaset()[:2],
    r"PandaSet 002 \(3D\), (\d+) sweeps: ATE \| ([\d.]+) m": lambda: of_pandaset()[::2],
    r"KITTI raw 0001 \(3D\), (\d+) m: ATE \| ([\d.]+) m": lambda: of_drive("3d/kitti_0001_first54.mcap")[:1:-1],
}


def said(pattern, text=None):
    """The figures of a sentence that README has once."""
    found = list(re.finditer(pattern, text or readme()))
    assert len(found) == 1, f"README says {len(found)} times: {pattern}"
    return found[0].groups()


def check(name, given, true, share=0.0):
    true = [float(each) for each in true]
    assert len(given) == len(true), name
    wrong = [f"{a} for {b:.6g}" for a, b in zip(given, true, strict=True) if not agree(a, b, share)]
    assert not wrong, f"{name}: README says {', '.join(wrong)}"


def without_origin(text):
    """What is left of the figures of a text without those of rows and claims."""
    for row in ROW.finditer(text):
        text = text.replace(row[0], OTHER.sub("", f"{row[1]} | {row[4]}"))
    for pattern in [*CLAIMS, *MEASURED]:
        text = re.sub(pattern.partition(r": ATE \|")[0], "", text)
    return re.findall(rf".{{0,40}}{FIGURE}.{{0,20}}", NAMES.sub("", text))


def row_of(log, text=None):
    """Figures of ours, and of each other method, of a row."""
    (row,) = (row for row in ROW.findall(text or readme()) if row[0].startswith(log))
    return [each for each in row[1:3] if each], {
        each[0]: [x for x in each[1:] if x] for each in OTHER.findall(row[3])
    }


def test_every_figure_has_an_origin():
    assert len(ROW.findall(readme())) == 5
    left = without_origin(readme())
    assert not left, f"figures of README that no command prints: {left}"


@pytest.mark.parametrize("pattern", CLAIMS)
def test_figures_are_those_of_docs(pattern):
    true = CLAIMS[pattern]
    check(pattern, said(pattern), true(), SHARES.get(true, 0.0))


@pytest.mark.parametrize("log", IN_3D)
def test_rows_in_space_are_those_of_odometry3d(log):
    ours, others = row_of(log)
    check(log, ours, in_3d("plicp", log)[:1])
    assert len(others) == 3
    for name, given in others.items():
        check(f"{log}, {name}", given, in_3d(name, log))


@pytest.mark.parametrize("log", IN_2D)
def test_rows_in_the_plane_are_those_of_docs(log):
    ours, others = row_of(log)
    table = in_2d(IN_2D[log])
    check(log, ours, table[0])
    check(log, others["KISS-ICP"], table[1] + table[2])


def test_intel_is_as_in_the_table_of_matchers():
    (cells,) = (
        cells for cells in rows("benchmarks.md", "The two matchers") if cells[0] == "Intel, with wheel odometry"
    )
    check("Intel", said(r"mean error ([\d.]+) m over manually")[:1], figures(cells[3])[:1])


@pytest.mark.slow
@pytest.mark.parametrize("pattern", MEASURED)
def test_figures_are_measured_again(pattern):
    check(pattern, said(pattern), MEASURED[pattern]())


@pytest.mark.slow
@pytest.mark.parametrize("log", IN_2D)
def test_rows_in_the_plane_are_measured_again_by_their_command(log, tmp_path):
    words = command_in_the_plane()
    if log.startswith("Intel"):
        words = re.sub(r"intel\.\w+", lambda name: str(shared_data(f"2d/{name[0]}")), words)
    else:
        words = re.sub(r" --(?:end|relations) \S+", "", words)
        words = words.replace("intel.mcap", str(made.log("office", seconds=120)))
    quick = "--outputs.error_bars", "quick"  # not in README
    assert main([*words.split(), *quick, "--out", str(tmp_path / "compared")]) == 0
    plicp, kiss = (row.figures for row in read_table(tmp_path / "compared").rows)
    ours, others = row_of(log)
    names = ("relations_m", "relations_rad") if log.startswith("Intel") else ("ate_m",)
    scale = [1.0, 180.0 / math.pi]
    check(log, ours, [plicp[name] * factor for name, factor in zip(names, scale, strict=False)])
    errors = others["KISS-ICP"][:-2]  # times are compared with docs only: they depend on what else runs
    check(log, errors, [kiss[name] * factor for name, factor in zip(names, scale, strict=False)], AGAIN)


def test_a_figure_that_is_wrong_or_new_is_found():
    log = "PandaSet"
    for changed in ("0.0109 m (4.7", "0.0209 m (4.7"), ("(4.7 / 8.5)", "(4.7 / 9.5)"):
        assert changed[0] in readme()
        given = row_of(log, readme().replace(*changed))[1]["VGICP"]
        with pytest.raises(AssertionError, match="README says"):
            check(log, given, in_3d("VGICP", log))
    assert without_origin(f"{readme()} It is 37 % better.") and not without_origin(readme())
    pattern = next(iter(CLAIMS))
    for wrong in ("contained the truth in 109 of 114 simulated and real runs", "contained the truth in all runs"):
        with pytest.raises(AssertionError, match="README says"):
            check(pattern, said(pattern, wrong), contained())
