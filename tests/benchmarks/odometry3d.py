"""3D odometry, ours against others, on the same decoded scans, scan by scan in turn.

    python -m tests.benchmarks.odometry3d [LOG ...] [--methods plicp,svd,kiss-icp,...] [--scans N]

The scans are decoded once into memory. Each method first gets the first few scans on a throwaway instance, so that
compilation and imports are done; then every scan goes through all methods in turn, starting with another one each
time, so that whatever else the machine does meets all of them alike. The time is that of ``track`` alone.
"""

import argparse
import os
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import msgspec
import numpy as np

from pipeline import baselines, lie
from pipeline.config import Config
from pipeline.data import Scan, Trajectory
from pipeline.errors import InputError
from pipeline.evaluate import SHORT_LENGTHS_M, absolute_error, kitti_error, pair
from pipeline.odometry import Odometry

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("SCANCHAIN_DATA", ROOT.parent / "shared" / "data")) / "3d"
DEFAULT_LOGS = ("kitti_0005_first60.mcap", "kitti_0001_first54.mcap")
WARM_UP_SCANS = 4
NO_TIMES = np.empty(0, np.float32)


class Ours:
    """Our odometry behind the verb of the baselines."""

    def __init__(self, matcher):
        config = Config()
        matching = msgspec.structs.replace(config.matching, matcher=matcher)
        self.odometry = Odometry(msgspec.structs.replace(config, matching=matching), np.eye(4))
        self.description = f"ours, {matcher}, scan to map, one thread, default configuration"
        self.index = 0

    def track(self, points, times_s, stamp_ns):
        scan = Scan(self.index, stamp_ns, stamp_ns, points, times_s, 0, None)
        self.index += 1
        return self.odometry.track(scan).T_odom_lidar


def ours_plicp():
    return Ours("plicp")


def ours_svd():
    return Ours("svd")


OURS = {"plicp": ours_plicp, "svd": ours_svd}


@dataclass(frozen=True, slots=True)
class Recording:
    """A log in memory: stamps, clouds and, where the log has it, the ground truth."""

    stamps_ns: np.ndarray
    clouds: list
    ground_truth: Trajectory | None


@dataclass(frozen=True, slots=True)
class Run:
    """What a method made of a recording."""

    name: str
    description: str
    trajectory: Trajectory
    seconds: np.ndarray


def read(path, count):
    """The first ``count`` clouds of a log, and its ground truth."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    stamps_ns, clouds, truth_ns, truth = [], [], [], []
    with Path(path).open("rb") as file:
        for schema, channel, _, message in make_reader(
            file, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            stamp = getattr(message, "header", None)
            stamp_ns = stamp.stamp.sec * 10**9 + stamp.stamp.nanosec if stamp else 0
            if schema.name == "sensor_msgs/msg/PointCloud2" and len(clouds) < count:
                stamps_ns.append(stamp_ns)
                clouds.append(decode_cloud(message))
            elif channel.topic == "/ground_truth":
                truth_ns.append(stamp_ns)
                truth.append(decode_pose(message.pose.pose))
    if not clouds:
        raise SystemExit(f"{path} has no point cloud")
    ground_truth = Trajectory(np.array(truth_ns), np.array(truth)) if truth else None
    return Recording(np.array(stamps_ns), clouds, ground_truth)


def decode_cloud(message):
    """(N, 3) float32 out of x, y, z of a little-endian cloud without padded rows."""
    offsets = [field.offset for field in message.fields if field.name in "xyz"]
    fields = np.dtype(
        {"names": ["x", "y", "z"], "formats": ["<f4"] * 3, "offsets": offsets, "itemsize": message.point_step}
    )
    cloud = np.frombuffer(bytes(message.data), fields)
    return np.stack([cloud["x"], cloud["y"], cloud["z"]], axis=1)


def decode_pose(pose):
    T = np.eye(4)
    q, p = pose.orientation, pose.position
    T[:3, :3] = lie.from_quaternion(np.array([q.x, q.y, q.z, q.w]))
    T[:3, 3] = p.x, p.y, p.z
    return T


def create(name):
    return OURS[name]() if name in OURS else baselines.create(name)


def run(recording, methods):
    """All methods over all scans, in turn."""
    for name in methods:
        throwaway = create(name)
        for stamp_ns, cloud in zip(recording.stamps_ns[:WARM_UP_SCANS], recording.clouds, strict=False):
            throwaway.track(cloud, NO_TIMES, int(stamp_ns))
    racers = [create(name) for name in methods]
    poses = np.zeros((len(methods), len(recording.clouds), 4, 4))
    seconds = np.zeros((len(methods), len(recording.clouds)))
    for k, (stamp_ns, cloud) in enumerate(zip(recording.stamps_ns, recording.clouds, strict=True)):
        for place in range(len(methods)):
            m = (place + k) % len(methods)
            started = perf_counter()
            poses[m, k] = racers[m].track(cloud, NO_TIMES, int(stamp_ns))
            seconds[m, k] = perf_counter() - started
    return [
        Run(name, racer.description, Trajectory(recording.stamps_ns, poses[m]), seconds[m])
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
    points = np.mean([len(cloud) for cloud in recording.clouds])
    print(f"\n{Path(path).name}: {len(recording.clouds)} scans of {points:.0f} points, {os.cpu_count()} cores")
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
    parser.add_argument("--methods", default=",".join([*OURS, *baselines.names()]))
    parser.add_argument("--scans", type=int, default=10**9)
    arguments = parser.parse_args()
    for path in arguments.logs:
        recording = read(path, arguments.scans)
        report(path, recording, run(recording, arguments.methods.split(",")))


if __name__ == "__main__":
    main()
