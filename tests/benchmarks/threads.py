"""Time of a 3D scan against the number of threads and of points, for ours and others, as a table and a picture.

A lidar of so many points a sweep drives through the simulated town; ranges come with 2 cm of noise. After it
come the first scans of logs. All are in memory. Each method and number of threads has a process of its own,
with as many cores as threads, and tracks the scans three times from the beginning, of which the fastest counts.
Time is the median over the scans, without the first three, from one pose to the next on the clock: ours
prepares scans ahead where it has threads, as ``scanchain run`` does. The last pose of ours is the same to the
last bit for any number of threads, or the benchmark fails.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import msgspec
import numpy as np

from scanchain import lie
from scanchain.comparison.methods import resolve
from scanchain.comparison.worker import start
from scanchain.data import Pose, Scan
from scanchain.logs import open_log
from scanchain.odometry import Odometry
from scanchain.preprocess import prepare_ahead
from scanchain.settings import load_settings
from scanchain.simulation import record
from scanchain.simulation.drive import plan
from scanchain.simulation.sensors import SENSORS, spinning
from scanchain.threads import threads, use_threads
from tests.benchmarks.harness import in_fresh_process, options_of
from tests.support.scenes import DATA

OURS = "plicp"
METHODS = [OURS, "kiss-icp", "small-vgicp", "genz-icp"]
WITH_THREADS = ("kiss-icp", "small-vgicp", "small-gicp")  # that have a setting of that name; others use all cores
REPEATS, WARM_UP = 3, 3
STYLES = ("-", "--", "-.", ":")
RINGS, PERIOD_NS = 64, 100_000_000


def tracked(path: Path, method: str, count: int, most: int) -> tuple[float, int, bytes]:
    """Seconds a scan, points a scan, and the last pose: at most so many scans, so many threads in this process."""
    use_threads(count)
    log = open_log(path)
    scans = list(islice(log.scans(), most))
    chosen = resolve((method,), 3, file=None)[0]
    if method in WITH_THREADS:
        chosen = msgspec.structs.replace(chosen, settings=chosen.settings | {"threads": count})
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:count])
    medians_s, pose = [], lie.identity(3)
    for _ in range(REPEATS):
        poses = (
            our_poses(scans, log.T_base_lidar)
            if method == OURS
            else map(start(chosen, log.T_base_lidar).track, scans)
        )
        clock_s = [perf_counter()]
        for each in poses:
            clock_s.append(perf_counter())
            pose = each
        medians_s.append(float(np.median(np.diff(clock_s)[WARM_UP:])))
    return min(medians_s), round(float(np.mean([len(scan.points) for scan in scans]))), pose.tobytes()


def our_poses(scans: list[Scan], T_base_lidar: Pose) -> Iterator[Pose]:
    """Track all scans, prepared ahead where there are threads."""
    odometry = Odometry(load_settings(3).config, T_base_lidar)
    for scan in prepare_ahead(iter(scans), odometry.resolution) if threads() > 1 else scans:
        yield odometry.process(scan).T_odom_lidar


def measured(path: Path, methods: list[str], counts: list[int], scans: int) -> list[tuple[str, int, int, float]]:
    """Method, threads, points and seconds a scan of a log; a line is printed for each number of threads."""
    rows: list[tuple[str, int, int, float]] = []
    poses: set[bytes] = set()
    for count in counts:
        line, ours_s = "", 0.0
        for method in methods:
            taken_s, points, pose = in_fresh_process(tracked, path, method, count, scans)
            rows.append((method, count, points, taken_s))
            poses |= {pose} if method == OURS else set()
            ours_s = ours_s or taken_s
            line += f"{1e3 * taken_s:12.2f}" + f" x{taken_s / ours_s:.2f}".rjust(8)
        print(f"{path.stem[:23]:24}{rows[-1][2]:9,}{count:9}{line}", flush=True)
    assert len(poses) < 2, f"{path}: the last pose depends on the number of threads"
    return rows


def draw(path: Path, rows: list[tuple[str, int, int, float]]) -> None:
    """Milliseconds a scan over points: a color for each method, a line style for each number of threads."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 4.5), layout="constrained")
    axes = figure.subplots()
    methods, counts = (list(dict.fromkeys(row[k] for row in rows)) for k in (0, 1))
    for method, count in dict.fromkeys((row[0], row[1]) for row in rows):
        chosen = [row for row in rows if row[:2] == (method, count)]
        style = STYLES[counts.index(count) % len(STYLES)]
        color, label = f"C{methods.index(method)}", f"{method}, {count}"
        axes.plot(
            [r[2] for r in chosen], [1e3 * r[3] for r in chosen], style, color=color, marker=".", label=label
        )
    axes.set(xscale="log", yscale="log", xlabel="points per scan", ylabel="ms per scan")
    figure.legend(title="method, threads", fontsize="small", loc="outside right center")
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=120)


def main() -> None:
    arguments = options_of(
        __doc__, cache=False, points=[10_000, 30_000, 100_000, 300_000, 1_000_000], log=[], threads=[1, 2, 4, 8],
        methods=METHODS, scans=40, png=Path,
    )  # fmt: skip
    print(f"{os.cpu_count()} cores, load average of the last minute {os.getloadavg()[0]:.1f}; quiet is below 2")
    print(
        f"{'log':24}{'points':>9}{'threads':>9}" + "".join(f"{f'{method} ms':>20}" for method in arguments.methods)
    )
    rows: list[tuple[str, int, int, float]] = []
    with TemporaryDirectory() as folder:
        for points in arguments.points:
            path = Path(folder) / f"town_{points}.mcap"
            drive = plan("town", sensor="hdl-64", duration_s=arguments.scans * PERIOD_NS * 1e-9)
            rays = spinning(np.linspace(-24.0, 4.0, RINGS), round(points / RINGS), PERIOD_NS)  # so many a sweep
            record(replace(drive, sensor=replace(SENSORS["hdl-64"], rays=rays)), path)
            rows += measured(path, arguments.methods, arguments.threads, arguments.scans)
        for name in arguments.log:  # not in the picture, which is of one place
            path = Path(name) if Path(name).exists() else DATA / "3d" / name
            measured(path, arguments.methods, arguments.threads, arguments.scans)
    if arguments.png:
        draw(arguments.png, rows)


if __name__ == "__main__":
    main()
