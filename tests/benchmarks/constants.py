"""Constants of the product: how many there are, and which change nothing at half and at double their value.

    python -m tests.benchmarks.constants [--room ROOM ...] [--count]

A constant is a name in module scope bound to a number, or to a tuple or dictionary of numbers. Each is set to half
and to double its value in every module that holds it, and the cases below run again; their results are compared
to the bit. ROOM limits this to constants of files whose path contains it. Constants of kernels are compiled in and
are only counted; those from which others are computed on import show as "nothing".
"""

from __future__ import annotations

import ast
import hashlib
import importlib
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

import scanchain
from scanchain.commands.logs import doctor
from scanchain.slam import SlamResult
from tests.benchmarks.harness import options_of, table
from tests.support.scenes import DATA, ROOT

PACKAGES = {"pipeline": "scanchain", "viz": "scanchain_viz"}
FACTORS = (0.5, 2.0)


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
        self.constant, self.value = constant, scaled(constant.value, factor)
        self.holders = [
            module
            for name, module in list(sys.modules.items())
            if name.startswith("scanchain") and getattr(module, constant.name, None) is constant.value
            and (name == constant.module or not constant.name.startswith("_"))
        ]  # fmt: skip

    def __enter__(self) -> None:
        for module in self.holders:
            setattr(module, self.constant.name, self.value)

    def __exit__(self, *_: object) -> None:
        for module in self.holders:
            setattr(module, self.constant.name, self.constant.value)


def result_of(name: str, scans: int, **options: object) -> SlamResult:
    """SLAM on the first scans of a log of ../shared/data."""
    log = scanchain.open_log(DATA / name)
    slam = scanchain.Slam(scanchain.load_settings(log.dimension, overrides=options).config, log.stated_mounting)
    for scan in islice(log, scans):
        slam.process(scan)
    return slam.finish()


def of_slam(name: str, scans: int, **options: object) -> bytes:
    """Trajectories, graph, closures and verdict."""
    result = result_of(name, scans, **options)
    judged = scanchain.judge(result)
    arrays = (result.trajectory.poses, result.odometry.poses, result.state.poses, result.graph.information)
    words = (judged.sentence, [(each.target, each.source, each.reason) for each in result.closures])
    return b"".join(np.ascontiguousarray(each).tobytes() for each in arrays) + repr(words).encode()


def of_directory(folder: Path) -> bytes:
    """The files of a result that have no times in them."""
    names = ("*.tum", "*.g2o", "map.ply", "map.pgm")
    return b"".join(path.read_bytes() for name in names for path in sorted(folder.glob(name)))


def of_sessions(folder: Path) -> bytes:
    """Two parts of Intel: a run each, one localized in the other's map, both merged."""
    options = {"recording": False, "outputs__error_bars": "quick"}
    log = DATA / "2d/intel.mcap"
    one, other = (
        scanchain.run(log, folder / name, log__start_s=start, log__end_s=start + 60.0, **options).path
        for name, start in (("one", 0.0), ("other", 60.0))
    )
    found = scanchain.localize(log, one, folder / "found", recording=False, log__start_s=20.0, log__end_s=60.0)
    merged = scanchain.merge([one, other], folder / "merged")
    return b"".join(map(of_directory, (one, other, found.path, merged.path)))


def of_doctor(folder: Path) -> bytes:
    """What doctor says of logs that are easily misread."""
    from click.testing import CliRunner

    logs = sorted(path for path in (DATA / "reports").iterdir() if path.suffix in (".mcap", ".bag", ".db3"))
    return "".join(CliRunner().invoke(doctor, [str(log)]).output for log in logs).encode()


def of_graphs(folder: Path) -> bytes:
    """A published graph, with and without a robust loss, certified."""
    text = b""
    for robust in ("none", "truncated"):
        graph = scanchain.read_g2o(DATA / "graphs/MIT.g2o").graph
        scanchain.optimize(graph, robust=robust)
        text += graph.poses.tobytes() + graph.weight.tobytes() + graph.certify().verdict.encode()
    return text


def of_simulation(folder: Path) -> bytes:
    """Short simulated logs."""
    for world, options in (("office", {}), ("town", {}), ("office", {"changed": 1})):
        scanchain.simulate(world, folder / f"{world}{len(options)}.mcap", duration_s=3.0, **options)
    return b"".join(path.read_bytes() for path in sorted(folder.glob("*.mcap")))


Case = Callable[[Path], bytes]
SLAM: dict[str, Case] = {
    "csail": lambda folder: of_slam("2d/mit_csail.mcap", 400),
    "mocap": lambda folder: of_slam("2d/mocap_room_1.bag", 150),
    "kitti": lambda folder: of_slam("3d/kitti_0005_first60.mcap", 25),
}
CASES: dict[str, dict[str, Case]] = {  # by what the path of a constant contains; the first that does
    "/kernels/": {},
    "scanchain_viz": {},
    "/simulation/": {"simulate": of_simulation},
    "/logs/": {"doctor": of_doctor} | SLAM,
    "/sessions/": {"sessions": of_sessions},
    "/graph/": {"graph": of_graphs} | SLAM,
    "": SLAM | {"sessions": of_sessions},
}


def digest(case: Case) -> str:
    """Of the result of a case, or the kind of its error."""
    with TemporaryDirectory() as folder:
        try:
            return hashlib.sha256(case(Path(folder))).hexdigest()
        except Exception as error:
            return type(error).__name__


def main() -> None:
    arguments = options_of(__doc__, cache=False, room=[""], count=False)
    names = Counter(each.name for each in constants())
    kernels = sum("/kernels/" in str(each.path) for each in constants())
    shared = sum(count > 1 for count in names.values())
    print(f"{len(constants())} constants, {kernels} of them in kernels; {shared} names in several files\n")
    if arguments.count:
        return
    usual = cache(digest)
    row = table("constant", "value", *(f"at {factor:g}" for factor in FACTORS))
    for constant in constants():
        cases = next(cases for part, cases in CASES.items() if part in f"/{constant.path}")
        if not cases or not any(room in str(constant.path) for room in arguments.room):
            continue
        cells = []
        for factor in FACTORS:
            before = {name: usual(case) for name, case in cases.items()}
            with Changed(constant, factor):
                changed = [name for name, case in cases.items() if digest(case) != before[name]]
            cells.append(", ".join(changed) or "nothing")
        row(f"`{constant.module}.{constant.name}`", constant.value, *cells)


if __name__ == "__main__":
    main()
