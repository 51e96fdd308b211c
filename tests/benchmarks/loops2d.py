"""Loop closure in the plane with drift turned up: ``python -m tests.benchmarks.loops2d``.

Each log is run as it is, which is what the rest is measured against, and with every motion of its odometry made
longer by a share of itself and turned by so much a meter. A closure is false where its relative pose is more than
half a meter from that reference. ATE is over all scans after rigid alignment. Prints a Markdown table.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scanchain import lie
from scanchain.data import ClosureVerdict, Trajectory
from scanchain.evaluation import absolute_error, pair
from scanchain.logs import open_log
from scanchain.runs.closures import final_verdicts
from scanchain.settings import load_settings
from scanchain.simulation import simulate
from scanchain.slam import SlamResult
from tests.support.drifting import drifting_slam, stretched

DATA = Path(os.environ.get("SCANCHAIN_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
DRIFTS = ((0.01, 0.002), (0.01, -0.005), (-0.03, 0.01))  # share of the way, radians a meter
FALSE_M = 0.5


@dataclass(frozen=True, slots=True)
class Score:
    """What closing loops did: ATE before and after, and the accepted closures, true and false."""

    before_m: float
    after_m: float
    true: int
    false: int


def result_of(log_path: Path, longer: float, turn_rad_m: float) -> SlamResult:
    log = open_log(log_path)
    slam = drifting_slam(load_settings(2).config, log.T_base_lidar, stretched(longer, turn_rad_m))
    for scan in log.scans():
        slam.process(scan)
    return slam.finish()


def score(result: SlamResult, truth: Trajectory) -> Score:
    before_m, after_m = (
        absolute_error(pair(trajectory, truth)).translation_m.rmse
        for trajectory in (result.odometry, result.trajectory)
    )
    true_poses = truth.poses[[keyframe.scan_index for keyframe in result.keyframes]]
    judged = final_verdicts(result.closures, result.state)
    closures = [item for item in judged if item.verdict is ClosureVerdict.ACCEPTED]
    false = 0
    for closure in closures:
        T_true = lie.inverse(true_poses[closure.target]) @ true_poses[closure.source]
        off = lie.inverse(T_true) @ closure.match.T_target_source
        false += bool(np.linalg.norm(off[:2, 2]) > FALSE_M)
    return Score(before_m, after_m, len(closures) - false, false)


def logs(folder: Path) -> Iterator[Path]:
    for name in ("intel", "mit_csail"):
        path = DATA / "2d" / f"{name}.mcap"
        if path.exists():
            yield path
        else:
            print(f"{path} is absent: set SCANCHAIN_DATA")
    path = folder / "identical.mcap"
    simulate("identical", path)
    yield path


def main() -> None:
    print("| log | drift | ATE before | after | accepted | of them false |")
    print("|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for path in logs(Path(folder)):
            truth = result_of(path, 0.0, 0.0).trajectory
            for longer, turn_rad_m in DRIFTS:
                found = score(result_of(path, longer, turn_rad_m), truth)
                drift = f"{100.0 * longer:g} %, {1e3 * turn_rad_m:g} mrad/m"
                print(
                    f"| {path.stem} | {drift} | {found.before_m:.2f} m | {found.after_m:.2f} m "
                    f"| {found.true + found.false} | {found.false} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
