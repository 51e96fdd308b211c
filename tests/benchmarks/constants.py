"""Constants of the product: how many there are, and which change nothing at half and at double their value.

    python -m tests.benchmarks.constants [--room ROOM ...] [--cases NAME ...] [--workers N] [--count]

A constant is a name in module scope bound to a number, or to a tuple or dictionary of numbers. Each is set to half
and to double its value in every module that holds it, and those of the cases below that call a function which
reads it run again, the quick ones first, until the result of one differs in a bit. The table says which,
"nothing" where all are the same, and "not reached" where no case calls such a function. ROOM limits this to
constants of files whose path contains it, NAME to these cases. Constants of kernels are compiled in, and others
are read while modules are imported: both are only counted.
"""

from __future__ import annotations

import ast
import hashlib
import importlib
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import cache, partial
from itertools import islice, product
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from types import CodeType, FrameType
from typing import Any, NamedTuple

import numpy as np
from click.testing import CliRunner

import scanchain
from scanchain.commands.calibrate import calibrate
from scanchain.commands.landmarks import landmarks
from scanchain.commands.logs import doctor
from scanchain.data import Matrix, Scan
from scanchain.loops.evidence import WEIGHTS
from scanchain.maps import open_saved_map
from scanchain.sessions.elsewhere import import_map
from scanchain.settings import overrides_of
from scanchain.simulation import WORLDS
from tests.benchmarks.harness import CACHE, KITTI, drive_of, options_of, table
from tests.benchmarks.place_odds import right, wrong
from tests.benchmarks.places import PLACES, prepared, whole_of
from tests.benchmarks.wrong_edges import try_wrong_loops
from tests.support import made
from tests.support.drifting import drifting_slam, stretched
from tests.support.scenes import DATA, ROOT

PACKAGES = {"pipeline": "scanchain", "viz": "scanchain_viz"}
FOLDERS = tuple(str(ROOT / folder) for folder in PACKAGES)
FACTORS = (0.5, 2.0)
Case = Callable[[Path], bytes]


class Constant(NamedTuple):
    """A name in module scope bound to numbers."""

    path: Path
    name: str
    value: Any

    @property
    def module(self) -> str:
        return ".".join(self.path.with_suffix("").parts[1:]).removesuffix(".__init__")


def numbers(node: ast.expr) -> bool:
    """True for a number, an expression of numbers, and a tuple or dictionary of them."""
    if isinstance(node, ast.Tuple):
        return bool(node.elts) and all(map(numbers, node.elts))
    if isinstance(node, ast.Dict):
        return bool(node.values) and all(map(numbers, node.values))
    if isinstance(node, ast.BinOp):
        return numbers(node.left) and numbers(node.right)
    if isinstance(node, ast.UnaryOp):
        return numbers(node.operand)
    return (
        isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool)
    )


def bound(path: Path) -> Iterator[str]:
    """Names that a module binds to numbers."""
    for statement in ast.parse((ROOT / path).read_text()).body:
        if not isinstance(statement, ast.Assign | ast.AnnAssign) or statement.value is None:
            continue
        targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
        for target in targets:
            values = statement.value
            if isinstance(target, ast.Tuple) and isinstance(values, ast.Tuple):  # each name has its own number
                pairs = zip(target.elts, values.elts, strict=True)
                yield from (name.id for name, value in pairs if isinstance(name, ast.Name) and numbers(value))
            elif isinstance(target, ast.Name) and numbers(values):
                yield target.id


@cache
def constants() -> list[Constant]:
    """All of the product, those of kernels included."""
    found = []
    for folder in PACKAGES:
        for file in sorted((ROOT / folder).rglob("*.py")):
            path = file.relative_to(ROOT)
            names = list(bound(path))
            module = importlib.import_module(".".join(path.with_suffix("").parts[1:]).removesuffix(".__init__"))
            found += [Constant(path, name, getattr(module, name)) for name in names]
    return found


def scaled(value: Any, factor: float) -> Any:
    """The same kind of value, larger or smaller; whole numbers stay whole."""
    if isinstance(value, tuple):
        return tuple(scaled(each, factor) for each in value)
    if isinstance(value, dict):
        return {key: scaled(each, factor) for key, each in value.items()}
    return max(round(value * factor), 1) if isinstance(value, int) else value * factor


class Changed:
    """A constant with another value, in all modules that imported it."""

    def __init__(self, constant: Constant, factor: float) -> None:
        self.name = constant.name
        self.usual = getattr(importlib.import_module(constant.module), constant.name)
        self.value = scaled(self.usual, factor)
        self.holders = [
            module
            for name, module in list(sys.modules.items())
            if name.startswith("scanchain") and getattr(module, constant.name, None) is self.usual
            and (name == constant.module or not constant.name.startswith("_"))
        ]  # fmt: skip

    def __enter__(self) -> None:
        for module in self.holders:
            setattr(module, self.name, self.value)

    def __exit__(self, *_: object) -> None:
        for module in self.holders:
            setattr(module, self.name, self.usual)


def reading(code: CodeType) -> Iterator[str]:
    """Names that a function or one defined in it reads from its module."""
    yield from code.co_names
    for each in code.co_consts:
        if isinstance(each, CodeType):
            yield from reading(each)


def readers(constant: Constant, called: Iterable[tuple[str, str]]) -> bool:
    """True if one of the functions called (file, name read) reads a constant."""
    if constant.name.startswith("_"):
        return (str(ROOT / constant.path), constant.name) in called
    return any(name == constant.name for _, name in called)


def reached(case: Case) -> frozenset[tuple[str, str]]:
    """Files of the functions that a case calls, each with the names that it reads."""
    codes: set[CodeType] = set()

    def profile(frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            codes.add(frame.f_code)

    threading.setprofile(profile)
    sys.setprofile(profile)
    try:
        digest(case)
    finally:
        sys.setprofile(None)
        threading.setprofile(None)  # type: ignore[arg-type]  # as documented
    ours = [code for code in codes if code.co_filename.startswith(FOLDERS) and code.co_name != "<module>"]
    return frozenset((code.co_filename, name) for code in ours for name in reading(code))


def digest(case: Case) -> str:
    """Of the result of a case, or the kind of its error."""
    with TemporaryDirectory() as folder:
        try:
            return hashlib.sha256(case(Path(folder))).hexdigest()
        except Exception as error:
            return type(error).__name__


@cache
def usual(name: str) -> tuple[str, frozenset[tuple[str, str]], float]:
    """The result of a case as it is, what it reads, and how long it takes in seconds."""
    called = reached(CASES[name])
    started = time.perf_counter()
    return digest(CASES[name]), called, time.perf_counter() - started


def tried(constant: Constant, names: list[str]) -> str:
    """The first of the cases whose result differs with another value, and that value."""
    cases = sorted((name for name in names if readers(constant, usual(name)[1])), key=lambda name: usual(name)[2])
    for name in cases:
        for factor in FACTORS:
            with Changed(constant, factor):
                if digest(CASES[name]) != usual(name)[0]:
                    return f"{name} at {factor:g}"
    return f"nothing ({', '.join(cases)})" if cases else "not reached"


def slam_of(scans: Iterable[Scan], dimension: int, mounting: Matrix | None = None, **options: object) -> bytes:
    """Trajectories, graph, closures and verdict."""
    config = scanchain.load_settings(dimension, overrides=overrides_of(options)).config
    return result_of(scanchain.Slam(config, mounting, dimension=dimension), scans)


def result_of(slam: scanchain.Slam, scans: Iterable[Scan]) -> bytes:
    """Trajectories, graph, closures and verdict."""
    for scan in scans:
        slam.process(scan)
    result = slam.finish()
    judged = scanchain.judge(result)
    arrays = (result.trajectory.poses, result.odometry.poses, result.state.poses, result.graph.information)
    words = (judged.sentence, [(each.target, each.source, each.reason) for each in result.closures])
    return b"".join(np.ascontiguousarray(each).tobytes() for each in arrays) + repr(words).encode()


def of_log(name: str, scans: int, left_out: range = range(0), topic: str = "", **options: object) -> Case:
    """SLAM on the first scans of a log of ../shared/data, but for those left out."""

    def case(folder: Path) -> bytes:
        log = scanchain.open_log(DATA / name, topic=topic)
        chosen = (scan for k, scan in enumerate(islice(log, scans)) if k not in left_out)
        return slam_of(chosen, log.dimension, log.stated_mounting, **options)

    return case


def of_world(world: str, sensor: str, scans: int, every: int = 1) -> Case:
    """SLAM on every n-th of the first scans of a simulated drive."""

    def case(folder: Path) -> bytes:
        log = scanchain.open_log(drive_of(world, sensor, scans, CACHE), every=every)
        return slam_of(log, log.dimension)

    return case


def of_drifting(folder: Path) -> bytes:
    """A building whose odometry drifts by 3 % and 10 mrad/m."""
    log = scanchain.open_log(DATA / "2d/mit_csail.mcap")
    slam = drifting_slam(scanchain.load_settings(2).config, log.T_base_lidar, stretched(-0.03, 0.01))
    return result_of(slam, log)


def of_pairs(folder: Path) -> bytes:
    """Two scans aligned without a guess, near each other and far apart, by both methods."""
    found = b""
    for name, apart in (
        ("2d/mit_csail.mcap", (30, 100, 399)),
        ("2d/intel.mcap", (60, 699)),
        ("3d/" + KITTI[0], (4, 20)),
    ):
        scans = [scan.points for scan in islice(scanchain.open_log(DATA / name), apart[-1] + 1)]
        for k, matcher in product(apart, ("plicp", "svd")):
            match = scanchain.align(scans[0], scans[k], matcher=matcher)
            found += match.T_target_source.tobytes() + match.information.tobytes() + match.reason.encode()
    return found


def of_standing(folder: Path) -> bytes:
    """A lidar that stands for 5 s, moves on for 2 s, and stands again; in each scan a part of the points."""
    scans = list(islice(scanchain.open_log(DATA / "3d/kitti_0005_first60.mcap"), 20))
    shown = [0] * 50 + list(range(20)) + [19] * 40
    chosen = np.random.default_rng(0)

    def taken(k: int, scan: Scan) -> Scan:
        points = scan.points[chosen.random(len(scan.points)) < 0.2]
        return Scan.of(points + chosen.normal(0.0, 0.01, points.shape), 0.1 * k)

    return slam_of((taken(k, scans[number]) for k, number in enumerate(shown)), 3)


def of_directory(folder: Path) -> bytes:
    """The files of a result that have no times in them."""
    names = ("*.tum", "*.g2o", "map.ply", "map.pgm", "*.csv")
    return b"".join(path.read_bytes() for name in names for path in sorted(folder.glob(name)))


def of_sessions(folder: Path) -> bytes:
    """An office on two days: a run each, one localized in maps of the other, both merged and compared."""
    options = {"recording": False, "outputs__error_bars": "quick"}
    logs = [
        made.log("office", folder=CACHE, seconds=25.0),
        made.log("office", folder=CACHE, seconds=24.0, changed=1),
    ]
    one, other = (scanchain.run(log, folder / f"run {k}", **options).path for k, log in enumerate(logs))
    import_map(one / "map.yaml", folder / "imported")
    maps = enumerate((one, folder / "imported"))
    found = [scanchain.localize(logs[1], each, folder / f"found {k}", recording=False).path for k, each in maps]
    merged = scanchain.merge([one, other], folder / "merged").path
    scanchain.changes(one, other, folder / "changed")
    return b"".join(map(of_directory, (one, other, *found, merged, folder / "changed")))


def of_drive(folder: Path) -> bytes:
    """A simulated drive with error bars, evaluated."""
    log = drive_of("town", "vlp-16", 60, CACHE)
    done = scanchain.run(log, folder / "run", recording=False)
    figures = done.metrics.expected_ate_m, scanchain.evaluate(done.path, log.with_suffix(".tum"))
    return of_directory(done.path) + repr(figures).encode()


def of_doctor(folder: Path) -> bytes:
    """What doctor says of logs that are easily misread."""
    logs = sorted(path for path in (DATA / "reports").iterdir() if path.suffix in (".mcap", ".bag", ".db3"))
    return "".join(CliRunner().invoke(doctor, [str(log)]).output for log in logs).encode()


def of_calibration(folder: Path) -> bytes:
    """Parameters of lidar, IMU and wheels by a simulated drive."""
    log = drive_of("town", "vlp-16", 150, CACHE, imu="mems-half-late")
    return CliRunner().invoke(calibrate, [str(log), "--json"]).output.encode()


def of_graphs(folder: Path) -> bytes:
    """Published graphs, with and without a robust loss, certified; with covariances."""
    text = b""
    for name in ("MIT", "smallGrid3D"):
        for robust in ("none", "truncated"):
            graph = scanchain.read_g2o(DATA / f"graphs/{name}.g2o").graph
            scanchain.optimize(graph, robust=robust)
            text += graph.poses.tobytes() + graph.weight.tobytes() + graph.certify().verdict.encode()
    return text


def of_wrong_edges(folder: Path) -> bytes:
    """Graphs with wrong loops that agree with each other."""
    found = [try_wrong_loops(DATA / f"graphs/{name}.g2o", 0.3, "groups", 0) for name in ("MIT", "intel")]
    return repr([replace(each, time_s=0.0) for each in found]).encode()


def of_features(folder: Path) -> bytes:
    """What keyframes show at right poses in a map and at the best wrong ones, and its log-odds."""
    guest, host = (open_saved_map(whole_of(name, CACHE)) for name in ("csail", "intel"))
    shown = [*islice(right("csail-76", CACHE), 30), *islice(wrong(guest, host, []), 60)]
    ratios = [float(np.array(WEIGHTS) @ each) for each in shown]
    return repr((shown, ratios)).encode()


def of_places(folder: Path) -> bytes:
    """Parts of logs that enter a map late, and logs in maps of other places: all poses and their states."""
    found = []
    for name in ("csail-76", "forest"):
        prior, log, options, *_ = prepared(name, 0, CACHE)
        found.append(scanchain.localize(log, prior, folder / name, recording=False, **options).path)
    for guest, host in (("mocap", "csail"), ("kitti-5", "kitti-1")):
        log, options = PLACES[guest].of(0, CACHE)
        prior = made.run_of(PLACES[host].of(0, CACHE)[0], CACHE, f"{host}_0")
        options = options | {"log__end_s": 30.0}
        found.append(scanchain.localize(log, prior, folder / guest, recording=False, **options).path)
    return b"".join(map(of_directory, found))


def of_landmarks(folder: Path) -> bytes:
    """A log of ranges and bearings, and a problem far from its solution."""
    for name, options in (("utias_mrclam6", ()), ("2d_nonlinear.npz", ("--guess", "disturbed"))):
        words = [str(DATA / "landmarks" / name), "--out", str(folder / name), "--repeat", "1", *options]
        CliRunner().invoke(landmarks, words, catch_exceptions=False)
    return b"".join(of_directory(folder / name) for name in ("utias_mrclam6", "2d_nonlinear.npz"))


def of_simulation(folder: Path) -> bytes:
    """Short simulated logs."""
    for world in WORLDS:
        scanchain.simulate(
            world, folder / f"{world}.mcap", duration_s=0.3, changed=int(world in ("office", "town"))
        )
    return b"".join(path.read_bytes() for path in sorted(folder.glob("*.mcap")))


CASES: dict[str, Case] = {
    "csail": of_log("2d/mit_csail.mcap", 400),
    "intel": of_log("2d/intel.mcap", 700),
    "mocap": of_log("2d/mocap_room_1.bag", 150),
    "drifting": of_drifting,
    "lost in a building": of_log("2d/mit_csail.mcap", 300, range(60, 120), odometry__prior="constant-velocity"),
    "standing in a room": of_log("reports/rplidar_standing.bag", 100),
    "kitti": of_log("3d/kitti_0005_first60.mcap", 20),
    "elevation": of_log("3d/kitti_0005_first60.mcap", 45),
    "svd-icp": of_log("3d/kitti_0001_first54.mcap", 8, matching__matcher="svd"),
    "pandaset": of_log("3d/pandaset_002_sweeps30to55.mcap", 8, topic="/pandar64/points"),
    "pairs": of_pairs,
    "standing in a street": of_standing,
    "loops": of_world("town", "vlp-16", 600, every=3),
    "staircase": of_world("staircase", "vlp-16", 100),
    "lost in a street": of_world("gap", "vlp-16", 220),
    "corridor": of_world("corridor", "vlp-16", 80),
    "rosette": of_world("turns", "rosette", 60),
    "drive": of_drive,
    "calibration": of_calibration,
    "sessions": of_sessions,
    "graphs": of_graphs,
    "wrong edges": of_wrong_edges,
    "features": of_features,
    "places": of_places,
    "landmarks": of_landmarks,
    "doctor": of_doctor,
    "simulation": of_simulation,
}


def main() -> None:
    arguments = options_of(__doc__, cache=False, room=[""], count=False, cases=CASES, workers=1)
    names = Counter(each.name for each in constants())
    kernels = sum("/kernels/" in str(each.path) for each in constants())
    shared = sum(count > 1 for count in names.values())
    print(f"{len(constants())} constants, {kernels} of them in kernels; {shared} names in several files\n")
    if arguments.count:
        return
    row = table("constant", "value", "changes")
    chosen = [
        each
        for each in constants()
        if "/kernels/" not in str(each.path) and any(room in str(each.path) for room in arguments.room)
    ]
    with ProcessPoolExecutor(arguments.workers, get_context("spawn")) as executor:
        for constant, found in zip(
            chosen, executor.map(partial(tried, names=arguments.cases), chosen), strict=True
        ):
            row(f"`{constant.module}.{constant.name}`", constant.value, found)


if __name__ == "__main__":
    main()
