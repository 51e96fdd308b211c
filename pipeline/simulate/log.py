"""A drive through a world, written as an MCAP log with its exact truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline import lie
from pipeline.data import Matrix, Trajectory
from pipeline.errors import InputError
from pipeline.logs.write import LogWriter
from pipeline.simulate.motion import Motion
from pipeline.simulate.sensors import SENSORS, Sensor
from pipeline.simulate.solids import Solids
from pipeline.simulate.sweep import Sweep, take_sweep
from pipeline.simulate.wheels import wheel_odometry
from pipeline.simulate.worlds import find_world

EPOCH_NS = 1_700_000_000_000_000_000  # stamp of the first scan
ODOMETRY_PERIOD_NS = 20_000_000
_LONGEST_S = 36_000.0
_PLACE, _WANDER, _WHEELS, _RANGES = range(4)  # every purpose draws its own random numbers


def simulate(
    world: str,
    destination: Path,
    *,
    seed: int = 0,
    duration_s: float | None = None,
    sensor: str | None = None,
    drift: float = 1.0,
    noise_m: float | None = None,
    dropout: float | None = None,
    force: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Trajectory:
    """Write a log of a drive to ``destination`` and the truth beside it as .tum; the same seed, the same bytes.

    A scan's stamp is the instant of its first ray, point times count from there, and it is recorded at its end.
    The log holds /scan or /points, /odom (50 Hz, T_odom_base, drifts), /ground_truth (T_world_lidar at the stamp
    of every scan, exact) and /tf_static (T_base_lidar). ``drift`` multiplies the errors of the wheel odometry;
    ``noise_m`` and ``dropout`` replace the sensor's own; ``progress`` is told scans done and scans in all.

    Returns the truth, SE(2) for a laser scanner and SE(3) for a lidar.
    """
    place = find_world(world)
    lidar = _sensor(sensor or place.sensor, noise_m, dropout)
    length_s = place.duration_s if duration_s is None else duration_s
    _check(length_s, drift, lidar, destination, force)
    count = int(length_s * 1e9 / lidar.period_ns + 1e-6)
    solids = place.build(_random(seed, _PLACE))
    motion = Motion(
        place.route,
        place.vehicle,
        solids,
        duration_s=length_s + lidar.period_ns * 1e-9,
        rng=_random(seed, _WANDER),
    )
    truth = _truth(motion, lidar, count)
    with LogWriter(destination, force=force) as log:
        log.static_transform(EPOCH_NS, "base_link", "lidar", place.vehicle.T_base_lidar)
        wheels = _Wheels(log, motion, count * lidar.period_ns, drift, _random(seed, _WHEELS))
        for index, sweep in enumerate(_sweeps(solids, motion, lidar, count, _random(seed, _RANGES))):
            stamp_ns = EPOCH_NS + index * lidar.period_ns
            log.odometry("/ground_truth", stamp_ns, "world", "lidar", truth.poses[index])
            wheels.write_until(stamp_ns + lidar.period_ns)
            _write_sweep(log, sweep, lidar, stamp_ns)
            if progress is not None:
                progress(index + 1, count)
    write_tum(truth, destination.with_suffix(".tum"))
    return truth


def write_tum(trajectory: Trajectory, path: Path) -> None:
    """Write ``stamp x y z qx qy qz qw`` lines; stamps in seconds with all nine decimals."""
    poses = lie.lift(trajectory.poses)
    rows = np.column_stack([poses[:, :3, 3], lie.to_quaternion(poses[:, :3, :3])])
    lines = []
    for stamp_ns, row in zip(trajectory.stamps_ns.tolist(), rows.tolist(), strict=True):
        seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
        lines.append(f"{seconds}.{nanoseconds:09d} " + " ".join(f"{value:.9f}" for value in row))
    path.write_text("\n".join(lines) + "\n")


def _sweeps(
    solids: Solids, motion: Motion, sensor: Sensor, count: int, rng: np.random.Generator
) -> Iterator[Sweep]:
    """All scans in order; the next is cast in a thread while the last is written."""

    def take(index: int) -> Sweep:
        return take_sweep(solids, motion, sensor, index, index * sensor.period_ns * 1e-9, rng)

    with ThreadPoolExecutor(max_workers=1) as caster:
        upcoming = caster.submit(take, 0)
        for index in range(1, count):
            sweep = upcoming.result()
            upcoming = caster.submit(take, index)
            yield sweep
        yield upcoming.result()


class _Wheels:
    """Writes the wheel odometry as the log's clock goes on."""

    def __init__(
        self, log: LogWriter, motion: Motion, end_ns: int, drift: float, rng: np.random.Generator
    ) -> None:
        self._log = log
        self._stamps_ns = EPOCH_NS + np.arange(0, end_ns + 1, ODOMETRY_PERIOD_NS)
        times_s = (self._stamps_ns - EPOCH_NS) * 1e-9
        self._poses = wheel_odometry(motion.base(times_s), drift=drift, rng=rng)
        self._covariance = np.diag([1e-4, 1e-4, 1e-6, 1e-6, 1e-6, 1e-4]) * max(drift, 1e-3) ** 2
        self._next = 0

    def write_until(self, time_ns: int) -> None:
        while self._next < len(self._stamps_ns) and self._stamps_ns[self._next] <= time_ns:
            stamp_ns = int(self._stamps_ns[self._next])
            pose: Matrix = self._poses[self._next]
            self._log.odometry("/odom", stamp_ns, "odom", "base_link", pose, self._covariance)
            self._next += 1


def _write_sweep(log: LogWriter, sweep: Sweep, sensor: Sensor, stamp_ns: int) -> None:
    end_ns = stamp_ns + sensor.period_ns
    if sensor.dimension == 3:
        points, ring = sweep.points(), sweep.rays.ring[sweep.returned]
        log.point_cloud(
            "/points", stamp_ns, "lidar", points, times_s=sweep.times_s(), ring=ring, log_time_ns=end_ns
        )
        return
    first, second = sweep.rays.directions[:2]
    angle_min = float(np.arctan2(first[1], first[0]))
    log.laser_scan(
        "/scan",
        stamp_ns,
        "lidar",
        angle_min,
        float(np.arctan2(second[1], second[0])) - angle_min,
        float(sweep.rays.instants_ns[-1]) * 1e-9 / (len(sweep.ranges_m) - 1),
        sweep.ranges_m,
        range_min_m=sensor.min_range_m,
        range_max_m=sensor.max_range_m,
        scan_time_s=sensor.period_ns * 1e-9,
        log_time_ns=end_ns,
    )


def _truth(motion: Motion, sensor: Sensor, count: int) -> Trajectory:
    starts_ns = np.arange(count, dtype=np.int64) * sensor.period_ns
    poses = motion.lidar(starts_ns * 1e-9)
    return Trajectory(EPOCH_NS + starts_ns, lie.flatten(poses) if sensor.dimension == 2 else poses)


def _sensor(name: str, noise_m: float | None, dropout: float | None) -> Sensor:
    if name not in SENSORS:
        raise InputError(f"sensor {name!r} does not exist; choose one of {', '.join(SENSORS)}")
    sensor = SENSORS[name]
    return replace(
        sensor,
        noise_m=sensor.noise_m if noise_m is None else noise_m,
        dropout=sensor.dropout if dropout is None else dropout,
    )


def _check(duration_s: float, drift: float, sensor: Sensor, destination: Path, force: bool) -> None:
    shortest_s = sensor.period_ns * 1e-9
    for name, value, low, high in (
        ("duration_s", duration_s, shortest_s, _LONGEST_S),
        ("drift", drift, 0.0, 100.0),
        ("noise_m", sensor.noise_m, 0.0, 10.0),
        ("dropout", sensor.dropout, 0.0, 1.0),
    ):
        if not low <= value <= high:
            raise InputError(f"{name} {value:g} is out of range; choose one from {low:g} to {high:g}")
    truth = destination.with_suffix(".tum")
    if truth.exists() and not force:
        raise InputError(f"{truth}: exists; choose another name or pass --force to replace it")


def _random(seed: int, purpose: int) -> np.random.Generator:
    if seed < 0:
        raise InputError(f"seed {seed} is negative; choose one from 0 up")
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(purpose,)))
