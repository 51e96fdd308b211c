"""A drive through a world: planned, and recorded as an MCAP log with exact ground truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from heapq import merge
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain import checks, lie
from scanchain.data import Matrix, Trajectory
from scanchain.errors import InputError
from scanchain.geodesy import Geodesy
from scanchain.logs import writer
from scanchain.simulation.another_day import Change, another_day, write_changes
from scanchain.simulation.gnss import ORIGIN, RECEIVERS, GnssModel, GnssSamples
from scanchain.simulation.imu import IMUS, ImuModel
from scanchain.simulation.motion import Motion, begun_at, laps, pivots, wheel_odometry
from scanchain.simulation.sensors import SENSORS, Sensor, Sweep, take_sweep
from scanchain.simulation.solids import Solids
from scanchain.simulation.worlds import WORLDS, World
from scanchain.trajectory import write_tum

EPOCH_NS = 1_700_000_000_000_000_000  # stamp of the first scan, in November 2023
_PLACE, _DEVIATION, _WHEELS, _RANGES, _IMU, _GNSS = range(6)  # each purpose has random numbers of its own


class Slip(NamedTuple):
    """Distance that the wheels roll without moving the vehicle, spread evenly between two times of the drive."""

    start_s: float
    end_s: float
    size_m: float


NO_SLIP = Slip(0.0, 1.0, 0.0)


@dataclass(frozen=True, slots=True)
class Drive:
    """A drive to record.

    sensor : its maximum range is limited by the visibility in the world
    T_base_lidar : (4, 4)
    scans : (K,) int64, numbers of the recorded scans, counted from the start; the others fall into dropouts
    seed, changed : of all random numbers; ``changed`` is None on the first day
    drift : multiplies the errors of the wheel odometry, which slips once by ``wheels_slip``
    wheels_delay_s : how late its stamps are
    solids_of_instant : the solids at the start of a scan, if some of them move
    changes : of the world since the drive of the same seed on the first day
    imu, gnss : None if the vehicle has none
    """

    solids: Solids
    motion: Motion
    sensor: Sensor
    T_base_lidar: Matrix
    scans: NDArray[np.int64]
    seed: int = 0
    changed: int | None = None
    drift: float = 1.0
    wheels_slip: Slip = NO_SLIP
    wheels_delay_s: float = 0.0
    solids_of_instant: Callable[[float], Solids] | None = None
    changes: tuple[Change, ...] = ()
    imu: ImuModel | None = None
    gnss: GnssModel | None = None

    def truth(self) -> Trajectory:
        """T_world_lidar at the stamp of every recorded scan: SE(2) for a laser scanner, SE(3) for a lidar."""
        starts_ns = self.scans * self.sensor.period_ns
        poses = self.motion.lidar(starts_ns * 1e-9)
        return Trajectory(EPOCH_NS + starts_ns, lie.flatten(poses) if self.sensor.dimension == 2 else poses)


def plan(
    world: str,
    *,
    seed: int = 0,
    changed: int | None = None,
    duration_s: float | None = None,
    sensor: str | None = None,
    noise_m: float | None = None,
    dropout: float | None = None,
    drift: float = 1.0,
    wheels_slip: Slip = NO_SLIP,
    wheels_delay_s: float = 0.0,
    reverse: bool = False,
    start_m: float = 0.0,
    pace: float = 1.0,
    imu: str | None = None,
    gnss: str | None = None,
) -> Drive:
    """The drive that ``simulate`` records for the same arguments."""
    known = {"world": WORLDS, "IMU": IMUS, "GNSS receiver": RECEIVERS, "sensor": SENSORS}
    for (what, choices), name in zip(known.items(), (world, imu, gnss, sensor or None), strict=True):
        if name is not None and name not in choices:
            raise InputError(f"{what} {name!r} does not exist; choose one of {', '.join(choices)}")
    scene = WORLDS[world]
    lidar = SENSORS[sensor or scene.sensor]
    lidar = replace(
        lidar,
        max_range_m=min(lidar.max_range_m, scene.sight_m),
        noise_m=lidar.noise_m if noise_m is None else noise_m,
        dropout=lidar.dropout if dropout is None else dropout,
    )
    _check_range("noise_m", lidar.noise_m, 0.0, 10.0)
    _check_range("dropout", lidar.dropout, 0.0, 1.0)
    length_s = scene.duration_s if duration_s is None else duration_s
    _check_range("duration_s", length_s, lidar.period_ns * 1e-9, 36_000.0)  # 10 h: the plan is in memory
    count = int(length_s * 1e9 / lidar.period_ns + 1e-6)
    _check_range("start_m", start_m, 0.0, checks.LARGEST)
    _check_range("drift", drift, 0.0, 100.0)
    _check_range("pace", pace, 0.1, 10.0)
    _check_range("wheels_delay_s", wheels_delay_s, -10.0, 10.0)
    start_s, end_s, size_m = wheels_slip
    if not (0.0 <= start_s < end_s < np.inf and np.isfinite(size_m)):
        raise InputError(
            f"wheels_slip from {start_s:g} to {end_s:g} s by {size_m:g} m: must begin at 0 s or later and end "
            "after that"
        )
    solids = scene.build(_random(seed, _PLACE))
    driven_s = pace * (length_s + lidar.period_ns * 1e-9)
    if isinstance(scene.route, tuple):
        if reverse or start_m:
            raise InputError(f"{world} has no closed route; leave out reverse and start_m")
        moving = partial(pivots, scene.route, scene.vehicle, solids, duration_s=driven_s)
    else:
        route = begun_at(scene.route[::-1] if reverse else scene.route, start_m)
        moving = partial(laps, route, scene.vehicle, solids, duration_s=driven_s)
    motion = moving(rng=_random(seed, _DEVIATION, changed)).at_pace(pace)
    changes: tuple[Change, ...] = ()
    if changed is not None:
        path = motion.base(np.arange(0.0, length_s, 0.1))[:, :2, 3]
        free_m = scene.vehicle.radius_m + scene.vehicle.deviation_m + 0.25
        solids, changes = another_day(solids, path, free_m, _random(seed, _PLACE, changed))
        T_world_map = moving(rng=_random(seed, _DEVIATION)).lidar(np.zeros(1))[0]
        changes = tuple(change.seen_from(lie.inverse(T_world_map)) for change in changes)
    scans = _recorded(scene, motion, lidar, count)
    return Drive(
        solids, motion, lidar, scene.vehicle.T_base_lidar, scans, seed, changed, drift, wheels_slip,
        wheels_delay_s, changes=changes, imu=None if imu is None else IMUS[imu],
        gnss=None if gnss is None else RECEIVERS[gnss],
    )  # fmt: skip


def _random(seed: int, purpose: int, changed: int | None = None) -> np.random.Generator:
    """Random numbers for one purpose of a drive, on the first day or another one."""
    for name, number in (("seed", seed), ("changed", changed or 0)):
        if number < 0:
            raise InputError(f"{name} {number} is negative; choose 0 or a positive number")
    day = () if changed is None else (changed,)
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(purpose, *day)))


def _check_range(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise InputError(f"{name} {value:g} is out of range; choose one from {low:g} to {high:g}")


def _recorded(world: World, motion: Motion, sensor: Sensor, count: int) -> NDArray[np.int64]:
    """Numbers of all scans outside the dropouts: 1 s each, around the closest point of the first visit."""
    kept = np.ones(count, dtype=bool)
    lacking = round(1e9 / sensor.period_ns)  # of 1 s
    times_s = np.arange(count) * (sensor.period_ns * 1e-9)
    path = motion.base(times_s)[:, :2, 3] if world.dropouts else np.empty((count, 2))
    for middle in world.dropouts:
        distance_m = np.linalg.norm(path - middle, axis=1)
        near = np.flatnonzero(distance_m < 6.0)
        visit = near[: np.argmax(np.append(np.diff(near) > 1, True)) + 1]
        if len(visit) and visit[-1] + 1 < count:
            first = int(visit[np.argmin(distance_m[visit])])
            kept[max(first - lacking // 2, 0) :][:lacking] = False
    return np.flatnonzero(kept)


def simulate(
    world: str,
    destination: str | Path,
    *,
    force: bool = False,
    progress: Callable[[int, int], None] | None = None,
    **options: Any,
) -> Trajectory:
    """Write a log of a drive to ``destination``, next to it the truth as .tum; the same seed gives the same bytes.

    A scan's stamp is the instant of its first ray, point times are relative to it, and it is logged at its end.
    The log holds /scan or /points, /odom (50 Hz, T_odom_base, drifts), /ground_truth (T_world_lidar at the stamp
    of every scan, exact) and /tf_static (T_base_lidar); in the dropouts of a world, only /odom continues.
    With an IMU it also holds /imu/data (200 Hz, frame imu_link) and T_base_imu in /tf_static, with a GNSS receiver
    /fix (10 Hz, frame gnss_link) and the position of its antenna.

    force : whether existing files are replaced
    progress : called with the number of scans done and the total
    options : ``seed``, 0 by default; ``duration_s``; ``sensor``, by name; ``noise_m`` and ``dropout`` in
        place of the sensor's own; ``drift``, which multiplies the errors of the wheel odometry, and
        ``wheels_slip``, by which it slips once; ``wheels_delay_s``, by which its stamps are late; ``imu`` and
        ``gnss``, by name; ``pace``, a factor on the speed of the drive; ``reverse`` to drive in the opposite
        direction, from ``start_m`` along that route;
        ``changed``, a seed, for another day: furniture or parked cars appeared, vanished or moved, as listed in
        .changes.csv next to the log, and the drive is repeated with other deviations and noise

    Returns the ground truth, SE(2) for a laser scanner and SE(3) for a lidar.
    """
    return record(plan(world, **options), destination, force=force, progress=progress)


def record(
    drive: Drive,
    destination: str | Path,
    *,
    force: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Trajectory:
    """Write a log of any drive, and next to it the same files as ``simulate``."""
    destination = checks.path(destination, "destination")
    changes_file = destination.with_suffix(".changes.csv")
    for file in (destination.with_suffix(".tum"), *(() if drive.changed is None else (changes_file,))):
        if file.exists() and not force:
            raise InputError(f"{file}: exists; choose another name or pass --force to replace it")
    truth = drive.truth()
    period_ns = drive.sensor.period_ns
    with writer.LogWriter(destination, force=force) as log:
        links = [writer.Link("base_link", "lidar", writer.place(drive.T_base_lidar))]
        if drive.imu is not None and drive.imu.is_transform_known:
            links.append(writer.Link("base_link", "imu_link", writer.place(drive.imu.T_base_imu)))
        if drive.gnss is not None:
            antenna = writer.place_of(drive.gnss.antenna_m.tolist(), (0.0, 0.0, 0.0, 1.0))
            links.append(writer.Link("base_link", "gnss_link", antenna))
        log.append("/tf_static", "tf2_msgs/msg/TFMessage", writer.pack_transforms(EPOCH_NS, *links), EPOCH_NS)
        others = _OtherSensors(log, drive, int(truth.stamps_ns[-1]) + period_ns)
        for done, sweep in enumerate(_sweeps(drive)):
            stamp_ns = int(truth.stamps_ns[done])
            others.write_until(stamp_ns - 1)  # in a dropout
            pose = writer.pack_odometry(stamp_ns, "world", "lidar", writer.place(truth.poses[done]))
            log.append("/ground_truth", "nav_msgs/msg/Odometry", pose, stamp_ns)
            others.write_until(stamp_ns + period_ns)
            _write_sweep(log, sweep, drive.sensor, stamp_ns)
            if progress is not None:
                progress(done + 1, len(truth))
    write_tum(destination.with_suffix(".tum"), truth, force=True)
    if drive.changed is not None:
        write_changes(changes_file, drive.changes)
    return truth


def _sweeps(drive: Drive) -> Iterator[Sweep]:
    """All recorded scans in order; the next is cast in a thread while the previous one is written."""
    rng = _random(drive.seed, _RANGES, drive.changed)

    def take(index: int) -> Sweep:
        start_s = index * drive.sensor.period_ns * 1e-9
        solids = drive.solids if drive.solids_of_instant is None else drive.solids_of_instant(start_s)
        return take_sweep(solids, drive.motion, drive.sensor, index, start_s, rng)

    with ThreadPoolExecutor(max_workers=1) as caster:
        upcoming = caster.submit(take, int(drive.scans[0]))
        for index in drive.scans[1:]:
            sweep = upcoming.result()
            upcoming = caster.submit(take, int(index))
            yield sweep
        yield upcoming.result()


class _Message(NamedTuple):
    stamp_ns: int
    topic: str
    schema: str
    data: bytes


class _OtherSensors:
    """Messages of the wheels, the IMU and the GNSS receiver until ``last_ns``, in the order of their stamps."""

    def __init__(self, log: writer.LogWriter, drive: Drive, last_ns: int) -> None:
        self._log = log
        sources = [_wheels(drive, last_ns)]
        if drive.imu is not None:
            sources.append(_imu(drive, drive.imu, last_ns))
        if drive.gnss is not None:
            sources.append(_gnss(drive, drive.gnss, last_ns))
        self._messages = merge(*sources, key=lambda message: message.stamp_ns)
        self._next = next(self._messages, None)

    def write_until(self, time_ns: int) -> None:
        while self._next is not None and self._next.stamp_ns <= time_ns:
            stamp_ns, topic, schema, data = self._next
            self._log.append(topic, schema, data, stamp_ns)
            self._next = next(self._messages, None)


def _wheels(drive: Drive, last_ns: int) -> Iterator[_Message]:
    stamps_ns = np.arange(EPOCH_NS, last_ns + 1, 20_000_000)  # 50 Hz, as of most robots' drivers
    times_s = (stamps_ns - EPOCH_NS) * 1e-9 - drive.wheels_delay_s
    begin_s, end_s, size_m = drive.wheels_slip
    slips_m = np.diff(size_m * np.clip((times_s - begin_s) / (end_s - begin_s), 0.0, 1.0))
    poses, rng = drive.motion.base(times_s), _random(drive.seed, _WHEELS, drive.changed)
    poses = wheel_odometry(poses, drift=drive.drift, rng=rng, slips_m=slips_m)
    covariance = np.diag([1e-4, 1e-4, 1e-6, 1e-6, 1e-6, 1e-4]) * max(drive.drift, 1e-3) ** 2
    for stamp_ns, pose in zip(stamps_ns.tolist(), poses, strict=True):
        data = writer.pack_odometry(stamp_ns, "odom", "base_link", writer.place(pose), covariance)
        yield _Message(stamp_ns, "/odom", "nav_msgs/msg/Odometry", data)


def _imu(drive: Drive, imu: ImuModel, last_ns: int) -> Iterator[_Message]:
    stamps_ns = np.arange(EPOCH_NS, last_ns + 1, imu.period_ns)
    instants_s = (stamps_ns - EPOCH_NS - imu.delay_ns) * 1e-9
    samples = imu.measure(drive.motion, instants_s, _random(drive.seed, _IMU, drive.changed))
    for stamp_ns, *vectors in zip(stamps_ns.tolist(), *(values.tolist() for values in samples), strict=True):
        data = writer.pack_imu(stamp_ns, "imu_link", *vectors)
        yield _Message(stamp_ns, "/imu/data", "sensor_msgs/msg/Imu", data)


def fixes_of(drive: Drive, gnss: GnssModel, last_ns: int) -> tuple[NDArray[np.int64], GnssSamples]:
    """Stamps (N,) and samples of a receiver until a stamp."""
    stamps_ns = np.arange(EPOCH_NS, last_ns + 1, gnss.period_ns)
    instants_s = (stamps_ns - EPOCH_NS) * 1e-9
    return stamps_ns, gnss.measure(drive.motion, instants_s, _random(drive.seed, _GNSS, drive.changed))


def _gnss(drive: Drive, gnss: GnssModel, last_ns: int) -> Iterator[_Message]:
    stamps_ns, samples = fixes_of(drive, gnss, last_ns)
    positions = Geodesy(*ORIGIN).geodetic(samples.enu_m)
    for stamp_ns, position, is_out in zip(stamps_ns.tolist(), positions.tolist(), samples.is_out, strict=True):
        data = writer.pack_fix(stamp_ns, "gnss_link", position, None if is_out else gnss.sigma_m)
        yield _Message(stamp_ns, "/fix", "sensor_msgs/msg/NavSatFix", data)


def _write_sweep(log: writer.LogWriter, sweep: Sweep, sensor: Sensor, stamp_ns: int) -> None:
    end_ns = stamp_ns + sensor.period_ns
    if sensor.dimension == 3:
        points, ring = sweep.points(), sweep.rays.ring[sweep.returned]
        times_ns = np.rint(1e9 * sweep.times_s()).astype(np.uint32)
        log.point_cloud("/points", stamp_ns, "lidar", points, {"t": times_ns, "ring": ring}, end_ns)
        return
    first, second = sweep.rays.directions[:2]
    angle_min = float(np.arctan2(first[1], first[0]))
    data = writer.pack_laser_scan(
        stamp_ns,
        "lidar",
        angle_min,
        float(np.arctan2(second[1], second[0])) - angle_min,
        sweep.ranges_m,
        range_min_m=sensor.min_range_m,
        range_max_m=sensor.max_range_m,
        time_increment_s=float(sweep.rays.instants_ns[-1]) * 1e-9 / (len(sweep.ranges_m) - 1),
        scan_time_s=sensor.period_ns * 1e-9,
    )
    log.append("/scan", "sensor_msgs/msg/LaserScan", data, stamp_ns, end_ns)
