"""3D odometry, ours against others, on the same decoded scans, scan by scan in turn.

    python -m tests.benchmarks.odometry3d [LOG ...] [--methods plicp,svd,kiss-icp,...] [--scans N]

The scans are decoded once into memory. Each method first gets the first few scans on a throwaway instance, so that
compilation and imports are done; then every scan goes through all methods in turn, starting with another one each
time, so that whatever else the machine does meets all of them alike. The time is that of ``track`` alone.
"""

import argparse
import os
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from time import perf_counter

import numpy as np

from pipeline import baselines, lie
from pipeline.config import LogConfig
from pipeline.data import Scan, Trajectory
from pipeline.errors import InputError
from pipeline.evaluate import SHORT_LENGTHS_M, absolute_error, kitti_error, pair
from pipeline.logs import open_log
from pipeline.odometry import Odometry
from pipeline.settings import Override, load_settings

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("SCANCHAIN_DATA", ROOT.parent / "shared" / "data")) / "3d"
DEFAULT_LOGS = ("kitti_0005_first60.mcap", "kitti_0001_first54.mcap")
WARM_UP_SCANS = 4


class Ours:
    """Our odometry behind the verb of the baselines, with the configuration that a run would choose."""

    def __init__(self, matcher):
        config = load_settings(3, overrides=(Override("matching.matcher", matcher, "--methods"),)).config
        self.odometry = Odometry(config, np.eye(4))
        self.description = f"ours, {matcher}, scan to map, one thread, preset lidar3d"
        self.index = 0

    def track(self, points, times_s, stamp_ns):
        scan = Scan(self.index, stamp_ns, stamp_ns, points, times_s, 0, None)
        self.index += 1
        return self.odometry.track(scan).T_odom_lidar


OURS = ("plicp", "svd")


@dataclass(frozen=True, slots=True)
class Recording:
    """A log in memory: scans and, where the log has it, the ground truth."""

    scans: list[Scan]
    ground_truth: Trajectory | None


@dataclass(frozen=True, slots=True)
class Run:
    """What a method made of a recording."""

    name: str
    description: str
    trajectory: Trajectory
    seconds: np.ndarray


def read(path, count):
    """The first ``count`` scans of a log, and its ground truth."""
    log = open_log([path], LogConfig())
    if log.dimension != 3:
        raise InputError(f"{path}: {log.topic} is 2D; this benchmark is for 3D lidars")
    return Recording(list(islice(log.scans(), count)), log.ground_truth())


def create(name):
    return Ours(name) if name in OURS else baselines.create(name)


def track(racer, scan):
    return racer.track(scan.points, scan.times_s, scan.stamp_ns)


def run(recording, methods):
    """All methods over all scans, in turn."""
    for name in methods:
        throwaway = create(name)
        for scan in recording.scans[:WARM_UP_SCANS]:
            track(throwaway, scan)
    racers = [create(name) for name in methods]
    poses = np.zeros((len(methods), len(recording.scans), 4, 4))
    seconds = np.zeros((len(methods), len(recording.scans)))
    for k, scan in enumerate(recording.scans):
        for place in range(len(methods)):
            m = (place + k) % len(methods)
            started = perf_counter()
            poses[m, k] = track(racers[m], scan)
            seconds[m, k] = perf_counter() - started
    stamps_ns = np.array([scan.stamp_ns for scan in recording.scans])
    return [
        Run(name, racer.description, Trajectory(stamps_ns, poses[m]), seconds[m])
        for m, (name, racer) in enumerate(zip(methods, racers, strict=True))
    ]


def disagreement_m(a, b):
    """Median over the scans of the distance between two methods' motions since the scan before."""
    first = lie.inverse(a.trajectory.poses[:-1]) @ a.trajectory.poses[1:]
    second = lie.inverse(b.trajectory.poses[:-1]) @ b.trajectory.poses[1:]
    return float(np.median(np.linalg.norm((lie.inverse(first) @ second)[:, :3, 3], axis=1)))


def accuracy(result, ground_truth):
    """ATE and KITTI metric as text, dashes where the log has no ground truth or is too short for it."""
    if ground_truth is None:
        return f"{'-':>11}" * 3
    pairs = pair(result.trajectory, ground_truth)
    ate = f"{absolute_error(pairs).translation_m.rmse:11.4f}"
    try:
        drift = kitti_error(pairs, SHORT_LENGTHS_M, every=1)
    except InputError:
        return ate + f"{'-':>11}" * 2
    return f"{ate}{100 * drift.translation_share:11.3f}{np.degrees(drift.rotation_rad_per_m):11.4f}"


def report(path, recording, results):
    """One line a method; ratios are of medians, to the first of ours if it ran, else to the first method."""
    base = next((r for r in results if r.name in OURS), results[0])
    kiss = next((r for r in results if r.name == "kiss-icp"), None)
    points = np.mean([len(scan.points) for scan in recording.scans])
    print(f"\n{Path(path).name}: {len(recording.scans)} scans of {points:.0f} points, {os.cpu_count()} cores")
    heads = ("median ms", "p95 ms", "ratio", "ATE m", "KITTI %", "deg/m", "to KISS mm")
    print(f"{'method':18}" + "".join(f"{head:>11}" for head in heads))
    for result in results:
        ms = 1e3 * result.seconds
        ratio = np.median(result.seconds) / np.median(base.seconds)
        to_kiss = f"{1e3 * disagreement_m(result, kiss):.1f}" if kiss else "-"
        print(
            f"{result.name:18}{np.median(ms):11.2f}{np.percentile(ms, 95):11.2f}{ratio:11.2f}"
            f"{accuracy(result, recording.ground_truth)}{to_kiss:>11}"
        )
    for result in results:
        print(f"  {result.name}: {result.description}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", nargs="*", type=Path, default=[DATA / name for name in DEFAULT_LOGS])
    parser.add_argument("--methods", default=",".join((*OURS, *baselines.names())))
    parser.add_argument("--scans", type=int, default=10**9)
    arguments = parser.parse_args()
    for path in arguments.logs:
        recording = read(path, arguments.scans)
        report(path, recording, run(recording, arguments.methods.split(",")))


if __name__ == "__main__":
    main()
