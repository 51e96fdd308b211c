"""The cases of tests.benchmarks.vouching: simulated logs with incidents, and real ones with their references."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from scanchain import lie
from scanchain.data import Matrix, Pose
from scanchain.kernels.raycast import BOX, CYLINDER
from scanchain.simulation import SENSORS, Drive, plan, record
from scanchain.simulation.motion import Motion
from scanchain.simulation.solids import FIXED, Solids
from tests.support.scenes import DATA

WHEELS = ("wheels", "checked", "no wheels")  # prior and check; check alone; none in the log

_AHEAD_S = 9.0  # a kidnapped lidar goes on where it would have been so much later
_GAPS = ((0.35, 1.5), (0.65, 3.0))  # dropped scans: begin as a share of the drive, seconds
_CARRIED_S = 2.0  # without scans while it is carried
_WITHIN_M, _WITHIN_S = 30.0, 10.0  # begin along the corridor and duration of a drive within it
_MOUNTING = lie.exp(np.array([0.3, 0.0, 0.0, 0.0, 0.0, np.radians(6.0)]))  # error of the transform in the log
_SHARE_EVERY_S = 0.5  # between two looks at the true geometry
_SHARE_RAYS = 4000  # of a scan that such a look takes
_STEP_M = 1e-4  # of the differences of ranges; rays that leave a surface within it count for another
_PEOPLE, _AROUND_M, _NEAREST_M = 30, 8.0, 0.9
_WALK_M_S = 1.4
_ON_ROADS = ("town", "rounds", "highway", "gap")
_STAMP = struct.Struct("<iI")  # seconds and nanoseconds, after the four bytes that begin a CDR message
_STAMPED = ("LaserScan", "PointCloud2", "Odometry", "PoseStamped", "Imu")


@dataclass(frozen=True, slots=True)
class LogSpec:
    """A log: a simulated drive with an incident, or a file with its reference.

    Attributes
    ----------
    incident : "plain", "gap", "kidnapped", "carried" (kidnapped while no scan is recorded), "crowd", "mounting" or
        "within" (it begins in motion and ends between bare walls); of a file "plain" or "backward"
    file, reference : of a real log, whose ``world`` is its name
    overrides : configuration of every run on it
    reference_m, reference_rad : error of a motion by the reference, infinite where it is no truth
    """

    world: str
    sensor: str = ""
    incident: str = "plain"
    duration_s: float = 30.0
    dimension: int = 3
    file: Path | None = None
    reference: Path | None = None
    overrides: dict[str, object] = field(default_factory=dict)
    reference_m: float = 0.0
    reference_rad: float = 0.0

    @property
    def name(self) -> str:
        """World, sensor and incident."""
        return " ".join(part for part in (self.world, self.sensor, self.incident) if part)

    @property
    def seed(self) -> int:
        """Of the drive, by the name."""
        return zlib.crc32(self.name.encode()) % 1000

    def files(self, cache: Path) -> tuple[Path, Path | None]:
        """The log, made unless it is there, and its reference; None where the log holds it."""
        if self.file is not None and self.incident == "plain":
            return self.file, self.reference
        path = cache / "logs" / f"{self.name.replace(' ', '_')}_{self.duration_s:g}s.mcap"
        path.parent.mkdir(parents=True, exist_ok=True)
        if self.file is None or self.reference is None:
            if not path.exists():
                record(self.drive(), path)
            return path, path.with_suffix(".tum")
        if not path.exists():
            play_backward(self.file, self.reference, path)
        return path, path.with_suffix(self.reference.suffix)

    def open_shares(self, cache: Path) -> Matrix | None:
        """(K, 2) stamps in ns and the share of the returns that speak about the worst direction there."""
        if self.file is not None:
            return None
        path = self.files(cache)[0].with_suffix(".npy")
        if not path.exists():
            np.save(path, _open_shares(self.drive()))
        return np.load(path)

    def drive(self) -> Drive:
        """The drive with its incident."""
        duration_s, start_m = self.duration_s + _AHEAD_S, _WITHIN_M if self.incident == "within" else 0.0
        drive = plan(self.world, seed=self.seed, duration_s=duration_s, sensor=self.sensor, start_m=start_m)
        times_s = drive.scans * (drive.sensor.period_ns * 1e-9)
        kept = times_s < self.duration_s
        middle_s = round(0.5 * self.duration_s)
        if self.incident == "gap":
            for share, length_s in _GAPS:
                begin_s = share * self.duration_s
                kept &= (times_s < begin_s) | (times_s >= begin_s + length_s)
        elif self.incident == "carried":
            kept &= (times_s < middle_s) | (times_s >= middle_s + _CARRIED_S)
        drive = replace(drive, scans=drive.scans[kept])
        if self.incident in ("kidnapped", "carried"):
            return replace(drive, motion=Kidnapped(drive.motion, middle_s))
        if self.incident == "mounting":
            return replace(drive, T_base_lidar=drive.T_base_lidar @ _MOUNTING)
        if self.incident == "crowd":
            place = _traffic if self.world in _ON_ROADS else _people
            return replace(drive, solids_of_instant=place(drive, np.random.default_rng(self.seed)))
        return drive


@dataclass(frozen=True, slots=True)
class Case:
    """One run: a log, every n-th of its scans, and what becomes of the wheels."""

    log: LogSpec
    wheels: str = "wheels"
    every: int = 1

    @property
    def rate_hz(self) -> float:
        """Of the scans; 0 where the log does not say."""
        return 1e9 / SENSORS[self.log.sensor].period_ns / self.every if self.log.sensor in SENSORS else 0.0

    @property
    def name(self) -> str:
        """Unique among the cases."""
        rate = f"{self.rate_hz:g} Hz" if self.rate_hz else f"every {self.every}"
        return f"{self.log.name}, {rate}, {self.wheels}"

    @property
    def kind(self) -> str:
        """Row of the table."""
        d = f"{self.log.dimension}D"
        if self.log.file is not None:
            incident = "low rate" if self.every > 1 else self.log.incident
            return f"{d} real" if incident == "plain" else f"{d} real, {incident}"
        low = self.log.incident == "plain" and self.rate_hz < 8.0
        return f"{d} {'low rate' if low else self.log.incident}"

    @property
    def half(self) -> int:
        """0 or 1, by a hash of the log's name: runs on one log stay together."""
        return zlib.crc32(f"half of {self.log.name}".encode()) >> 7 & 1


class Kidnapped:
    """A motion whose lidar jumps along the route; wheels do not notice."""

    def __init__(self, motion: Motion, instant_s: float) -> None:
        self._motion, self._instant_s = motion, instant_s
        ends = motion.base(np.array([instant_s, instant_s + _AHEAD_S]))
        self._T_before_after = ends[0] @ lie.inverse(ends[1])

    def _is_after(self, times_s: NDArray[np.floating]) -> NDArray[np.bool_]:
        return times_s >= self._instant_s - 1e-9

    def _moved(self, times_s: NDArray[np.floating]) -> NDArray[np.floating]:
        return times_s + _AHEAD_S * self._is_after(times_s)

    def base(self, times_s: NDArray[np.floating]) -> Matrix:
        """T_world_base as the wheels roll."""
        poses = self._motion.base(self._moved(times_s))
        after = self._is_after(times_s)
        poses[after] = self._T_before_after @ poses[after]
        return poses

    def lidar(self, times_s: NDArray[np.floating]) -> Matrix:
        """T_world_lidar with the jump."""
        return self._motion.lidar(self._moved(times_s))


def _people(drive: Drive, rng: np.random.Generator) -> Callable[[float], Solids]:
    """People around the lidar: a third keep pace with it, the others walk straight on."""
    start = rng.uniform(-_AROUND_M, _AROUND_M, (_PEOPLE, 2))
    velocity = _WALK_M_S * np.stack([np.cos(a := rng.uniform(0.0, 2.0 * np.pi, _PEOPLE)), np.sin(a)], axis=1)
    velocity[: _PEOPLE // 3] = 0.0
    start[: _PEOPLE // 3] *= 0.5

    def solids(time_s: float) -> Solids:
        base, lidar = drive.motion.base(np.array([time_s]))[0], drive.motion.lidar(np.array([time_s]))[0]
        place = start + velocity * time_s
        place[_PEOPLE // 3 :] -= base[:2, 3]
        offset = (place + _AROUND_M) % (2.0 * _AROUND_M) - _AROUND_M
        distance_m = np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), 1e-6)
        place = lidar[:2, 3] + offset * np.maximum(1.0, _NEAREST_M / distance_m)
        size = np.tile([0.25, 0.25, 1.0, 0.0, base[2, 3] - 0.5, base[2, 3] + 1.75], (_PEOPLE, 1))
        return drive.solids.with_object(np.column_stack([np.full(_PEOPLE, CYLINDER), place, size]), FIXED)

    return solids


def _traffic(drive: Drive, rng: np.random.Generator) -> Callable[[float], Solids]:
    """Trucks that keep pace with a car, ahead and beside it, and others that overtake it or come towards it."""
    along = np.array([10.0, -2.0, *rng.uniform(-40.0, 40.0, 4)])
    across = np.array([0.0, -3.4, 3.4, 3.4, -3.4, 6.8])
    relative_m_s = np.array([0.0, 0.0, 3.0, -12.0, -2.0, -20.0])

    def solids(time_s: float) -> Solids:
        base = drive.motion.base(np.array([time_s]))[0]
        ahead = base[:2, 0] / np.linalg.norm(base[:2, 0])
        u = np.where(relative_m_s == 0.0, along, (along + relative_m_s * time_s + 40.0) % 80.0 - 40.0)
        place = base[:2, 3] + u[:, None] * ahead + across[:, None] * np.array([-ahead[1], ahead[0]])
        size = np.tile([4.0, 1.2, *ahead, base[2, 3] + 0.3, base[2, 3] + 3.2], (len(place), 1))
        return drive.solids.with_object(np.column_stack([np.full(len(place), BOX), place, size]), FIXED)

    return solids


def play_backward(log: Path, reference: Path, out: Path) -> None:
    """Write a ROS 2 log to ``out``, the last message first, and its .tum or .relations beside it.

    Time runs backward between the first and the last message; points have no times of their own. What a lidar
    that faces where it came from sees is in no map yet.
    """
    with log.open("rb") as file:
        messages = list(make_reader(file).iter_messages(log_time_order=False))
    times_ns = [message.log_time for _, _, message in messages]
    both_ns = min(times_ns) + max(times_ns)
    with out.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        channels: dict[int, int] = {}
        for schema, channel, message in sorted(messages, key=lambda each: -each[2].log_time):
            if channel.id not in channels:
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, known)
            data, time_ns = message.data, both_ns - message.log_time
            if schema.name.rpartition("/")[2] in _STAMPED:
                seconds, nanoseconds = _STAMP.unpack_from(data, 4)
                stamp_ns = both_ns - (seconds * 10**9 + nanoseconds)
                data = data[:4] + _STAMP.pack(*divmod(stamp_ns, 10**9)) + data[12:]
            writer.add_message(channels[channel.id], time_ns, data, time_ns)
        writer.finish()
    rows, both_s = np.loadtxt(reference), 1e-9 * both_ns
    if reference.suffix == ".relations":  # from the pose that is the earlier one now: the motion is the inverse
        turned = Rotation.from_euler("xyz", rows[:, 5:]).inv()
        rows = np.hstack([both_s - rows[:, [1, 0]], -turned.apply(rows[:, 2:5]), turned.as_euler("xyz")])
    else:
        rows[:, 0] = both_s - rows[:, 0]
        rows = rows[::-1]
    np.savetxt(out.with_suffix(reference.suffix), rows, "%.9f")


def _open_shares(drive: Drive) -> Matrix:
    """As ``LogSpec.open_shares``, from the true geometry without what moves."""
    truth = drive.truth()
    stride = max(1, round(_SHARE_EVERY_S * 1e9 / drive.sensor.period_ns))
    scans = drive.scans[::stride]
    poses = drive.motion.lidar(scans * (drive.sensor.period_ns * 1e-9))
    shares = [_least_share(drive, T, int(index)) for T, index in zip(poses, scans, strict=True)]
    return np.stack([truth.stamps_ns[::stride].astype(np.float64), shares], axis=1)


def _least_share(drive: Drive, T_world_lidar: Pose, index: int) -> float:
    """Share of the returns of an ideal scan, taken standing, that constrain the motion in its worst direction.

    A right twist ξ = (ρ, φ), T ← T exp(ξ), moves a return p with true normal n, both in the lidar's frame, by
        r = nᵀ(ρ + φ × p)        J = ∂r/∂ξ = [nᵀ, (p × n)ᵀ]        H = Σ JᵀJ
    There is neither noise nor loss; normals are parallel to the gradients of the ranges by the lidar's position.
    Rotations are measured by what they do to the returns: H is scaled by L = √(Σ|p × n|² / N), N = Σ|n|². Shares
    do not depend on the number of returns nor on units; 1e-4 means that H constrains the direction as well as if
    one return in ten thousand faced it squarely.
    """
    sensor = drive.sensor
    directions = sensor.rays(index).directions
    directions = directions[:: max(1, len(directions) // _SHARE_RAYS) | 1]  # some; an odd stride mixes the rings

    def ranges_m(shift_m: NDArray[np.float64]) -> NDArray[np.float64]:
        T = T_world_lidar.copy()
        T[:3, 3] += T[:3, :3] @ shift_m
        return drive.solids.cast(T[None], np.zeros(len(directions), np.int32), directions, sensor.max_range_m)

    reached_m = ranges_m(np.zeros(3))
    with np.errstate(invalid="ignore"):  # out of reach
        gradient = np.stack([ranges_m(step) - ranges_m(-step) for step in _STEP_M * np.eye(3)], axis=1)
    hit = np.isfinite(gradient).all(axis=1) & np.isfinite(reached_m) & (reached_m >= sensor.min_range_m)
    normals = gradient[hit] / np.linalg.norm(gradient[hit], axis=1, keepdims=True)
    J = np.hstack([normals, np.cross(directions[hit] * reached_m[hit, None], normals)])
    J = J[:, [0, 1, 5]] if sensor.dimension == 2 else J  # in the plane x, y and yaw
    count, levers = (float((part**2).sum()) for part in np.split(J, [sensor.dimension], axis=1))
    if count == 0.0:
        return 0.0
    J = J / lie.by_component(J.shape[1], 1.0, np.sqrt(max(levers, 1e-12 * count) / count))
    return max(float(np.linalg.eigvalsh(J.T @ J / count)[0]), 0.0)


_PLAIN_2D = (
    ("office", "lms-270"), ("office", "utm-30"), ("identical", "lms-270"), ("identical", "utm-30"),
    ("corridor", "lms-270"), ("corridor", "utm-30"), ("hall", "lms-270"), ("turns", "utm-30"),
)  # fmt: skip
_PLAIN_3D = (
    ("town", "hdl-64"), ("town", "vlp-16"), ("town", "rosette"), ("rounds", "os1-32"), ("highway", "vlp-16"),
    ("highway", "os1-32"), ("corridor", "vlp-16"), ("corridor", "os1-32"), ("field", "vlp-16"),
    ("forest", "os1-32"), ("forest", "rosette"), ("staircase", "os1-32"), ("staircase", "vlp-16"),
    ("hall", "vlp-16"), ("hall", "rosette"), ("turns", "os1-32"), ("turns", "vlp-16"), ("gap", "vlp-16"),
    ("office", "vlp-16"), ("identical", "os1-32"),
)  # fmt: skip
_INCIDENTS = {
    "gap": (
        "office utm-30", "identical lms-270", "town vlp-16", "forest os1-32", "staircase vlp-16", "turns lms-270",
        "highway vlp-16", "field os1-32", "hall os1-32",
    ),
    "kidnapped": (
        "office lms-270", "identical utm-30", "town vlp-16", "hall vlp-16", "office utm-30", "town os1-32",
        "forest vlp-16", "staircase os1-32",
    ),
    "carried": (
        "office utm-30", "identical lms-270", "rounds vlp-16", "forest os1-32", "hall lms-270", "highway vlp-16",
        "turns vlp-16",
    ),
    "crowd": (
        "office lms-270", "hall utm-30", "town vlp-16", "highway os1-32", "office rosette", "corridor vlp-16",
        "identical lms-270", "rounds vlp-16", "forest vlp-16",
    ),
    "mounting": ("office lms-270", "turns utm-30", "town vlp-16", "hall os1-32"),
    "within": ("corridor vlp-16", "corridor lms-270", "corridor os1-32"),
}  # fmt: skip


def cases() -> list[Case]:
    """All cases; every factor and the pairs that matter occur, not their product."""
    found = []
    for dimension, pairs in ((2, _PLAIN_2D), (3, _PLAIN_3D)):
        for k, (world, sensor) in enumerate(pairs):
            log = LogSpec(world, sensor, duration_s=40.0 if dimension == 2 else 24.0, dimension=dimension)
            tenth = 100_000_000 // SENSORS[sensor].period_ns
            slow = (2, 5) if k % 2 else (5, 2)
            found += [Case(log, "wheels", tenth), Case(log, "no wheels", slow[0] * tenth)]
            found.append(Case(log, *(("no wheels", tenth) if k % 3 else ("wheels", slow[1] * tenth))))
    for incident, pairs in _INCIDENTS.items():
        for k, pair in enumerate(pairs):
            world, sensor = pair.split()
            tenth = 100_000_000 // SENSORS[sensor].period_ns
            duration_s = _WITHIN_S if incident == "within" else 24.0
            log = LogSpec(world, sensor, incident, duration_s=duration_s, dimension=SENSORS[sensor].dimension)
            found += [Case(log, "wheels", tenth), Case(log, "checked" if k % 2 else "no wheels", tenth)]
    return found + _real()


def _real() -> list[Case]:
    found = []
    for name in ("intel", "aces"):
        file = DATA / f"2d/{name}.mcap"
        log = LogSpec(name, dimension=2, file=file, reference=file.with_suffix(".relations"))
        log = replace(log, reference_m=0.05, reference_rad=np.radians(1.0))  # made by hand
        found += [Case(log, wheels) for wheels in WHEELS]
        found += [Case(replace(log, incident="backward"), wheels) for wheels in WHEELS]
        cut = replace(log, world=f"{name} cut", overrides={"log__start_s": 300.0, "log__end_s": 700.0})
        found += [Case(cut, "no wheels"), Case(cut, "no wheels", 3), Case(cut, "wheels", 3)]
    csail = DATA / "2d/mit_csail.mcap"
    corrected = csail.with_name("mit_csail_corrected.tum")  # of another SLAM system
    log = LogSpec("csail", dimension=2, file=csail, reference=corrected, reference_m=np.inf)
    for each in (log, replace(log, incident="backward")):
        found += [Case(each, "wheels"), Case(each, "no wheels")]
    for room in (1, 2):
        topic = {"log__ground_truth_topic": "/vrpn_client_node/jackal/pose"}
        file = DATA / f"2d/mocap_room_{room}.bag"  # stamps are 25 ms off, it turns by up to 2 rad/s
        log = LogSpec(f"mocap {room}", "", dimension=2, file=file, overrides=topic)
        log = replace(log, reference_m=0.05, reference_rad=0.1)
        found += [Case(log, "no wheels", every) for every in (1, 2, 5)]
    kitti = DATA / "3d/kitti_0001_first54.mcap"
    log = LogSpec("kitti 0001", file=kitti, reference=kitti.with_suffix(".tum"))
    found += [Case(log, "no wheels", every) for every in (1, 2, 3, 5)]
    cut = replace(log, world="kitti 0001 cut", overrides={"log__start_s": 2.0})
    found += [Case(cut, "no wheels", every) for every in (1, 3)]
    panda = DATA / "3d/pandaset_002_sweeps30to55.mcap"
    for topic in ("/pandar64/points", "/pandar_gt/points"):
        log = LogSpec(f"pandaset {topic.split('/')[1]}", file=panda, overrides={"log__topic": topic})
        found.append(Case(log, "no wheels"))
    return [case for case in found if case.log.file is not None and case.log.file.exists()]
