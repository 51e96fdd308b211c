"""Loop closure with a search as wide as the drift, too narrow and wider.

    python -m tests.benchmarks.loops_window

The simulated office, 240 s of an LMS-270, with every motion of the odometry shortened by 3 % and turned by 10 mrad
a meter. Prints a Markdown table: closures rejected by verification and by the back end, accepted, and the ATE
against the truth before and after optimization.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from scanchain.evaluation import absolute_error, pair
from scanchain.logs import open_log
from scanchain.runs.closures import final_verdicts
from scanchain.settings import Override, load_settings
from scanchain.simulation import simulate
from scanchain.trajectory import read_tum
from tests.support.drifting import drifting_slam, stretched

LONGER, TURN_RAD_M = -0.03, 0.01
WINDOWS = (
    {},
    {"loops.drift": 0.005, "loops.min_radius_m": 0.1},
    {"loops.drift": 0.3, "loops.max_radius_m": 40.0},
)


def line(path: Path, window: dict[str, float]) -> str:
    """A row of the table."""
    log = open_log(path)
    overrides = tuple(Override(key, value, f"--{key}") for key, value in window.items())
    config = load_settings(log.dimension, overrides=overrides).config
    slam = drifting_slam(config, log.T_base_lidar, stretched(LONGER, TURN_RAD_M))
    for scan in log.scans():
        slam.process(scan)
    result, truth = slam.finish(), read_tum(path.with_suffix(".tum"))
    before_m, after_m = (
        absolute_error(pair(trajectory, truth)).translation_m.rmse
        for trajectory in (result.odometry, result.trajectory)
    )
    by = [judged.rejected_by for judged in final_verdicts(result.closures, result.state)]
    counts = " | ".join(str(by.count(kind)) for kind in ("verification", "back end", ""))
    name = ", ".join(f"{key} {value:g}" for key, value in window.items()) or "default"
    return f"| {name} | {counts} | {before_m:.2f} to {after_m:.2f} m |"


def main() -> None:
    print("| | rejected by verification | by the back end | accepted | ATE |")
    print("|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "office.mcap"
        simulate("office", path, duration_s=240.0, sensor="lms-270")
        for window in WINDOWS:
            print(line(path, window), flush=True)


if __name__ == "__main__":
    main()
