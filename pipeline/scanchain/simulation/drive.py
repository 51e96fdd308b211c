"""A drive before it is recorded: world, motion, lidar, and stamps of its scans."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix, Trajectory
from scanchain.errors import InputError
from scanchain.simulation.another_day import Change, another_day
from scanchain.simulation.motion import Motion
from scanchain.simulation.sensors import SENSORS, Sensor
from scanchain.simulation.solids import Solids
from scanchain.simulation.worlds.registry import World, find_world

EPOCH_NS = 1_700_000_000_000_000_000  # stamp of the first scan
PLACE, DEVIATION, WHEELS, RANGES = range(4)  # every purpose draws its own random numbers
_DROPOUT_S = 1.0
_PATH_STEP_S = 0.1  # between the positions of a drive that objects must not be moved to
_LONGEST_S = 36_000.0
_FARTHEST_M = 1e5


@dataclass(frozen=True, slots=True)
class Drive:
    """A drive to record.

    Attributes
    ----------
    sensor : its reach is what the world lets it see
    T_base_lidar : (4, 4)
    scans : (K,) int64, which scans are recorded, counted from the first instant; the others fall into dropouts
    solids_of_instant : the solids at the begin of a scan, where some of them move
    changes : of the world since the drive of the same seed on the first day
    """

    solids: Solids
    motion: Motion
    sensor: Sensor
    T_base_lidar: Matrix
    scans: NDArray[np.int64]
    solids_of_instant: Callable[[float], Solids] | None = None
    changes: tuple[Change, ...] = ()

    def solids_at(self, time_s: float) -> Solids:
        """The solids during the scan that begins then."""
        return self.solids if self.solids_of_instant is None else self.solids_of_instant(time_s)

    def truth(self) -> Trajectory:
        """T_world_lidar at the stamp of every recorded scan: SE(2) for a laser scanner, SE(3) for a lidar."""
        starts_ns = self.scans * self.sensor.period_ns
        poses = self.motion.lidar(starts_ns * 1e-9)
        return Trajectory(EPOCH_NS + starts_ns, lie.flatten(poses) if self.sensor.dimension == 2 else poses)


def plan(
    world: str,
    *,
    seed: int = 0,
    duration_s: float | None = None,
    sensor: str | None = None,
    noise_m: float | None = None,
    dropout: float | None = None,
    changed: int | None = None,
    reverse: bool = False,
    start_m: float = 0.0,
) -> Drive:
    """The drive that ``simulate`` records for the same arguments."""
    place = find_world(world)
    lidar = _sensor(sensor or place.sensor, noise_m, dropout, place.sight_m)
    length_s = place.duration_s if duration_s is None else duration_s
    check_range("duration_s", length_s, lidar.period_ns * 1e-9, _LONGEST_S)
    count = int(length_s * 1e9 / lidar.period_ns + 1e-6)
    check_range("start_m", start_m, 0.0, _FARTHEST_M)
    if isinstance(place.route, tuple) and (reverse or start_m):
        raise InputError(f"{world} is no route round which one could drive; leave reverse and start_m out")
    solids = place.build(random_numbers(seed, PLACE))
    motion = place.motion(
        solids,
        duration_s=length_s + lidar.period_ns * 1e-9,
        rng=random_numbers(seed, DEVIATION, changed),
        reverse=reverse,
        start_m=start_m,
    )
    changes: tuple[Change, ...] = ()
    if changed is not None:
        path = motion.base(np.arange(0.0, length_s, _PATH_STEP_S))[:, :2, 3]
        free_m = place.vehicle.radius_m + place.vehicle.deviation_m
        solids, changes = another_day(solids, path, free_m, random_numbers(seed, PLACE, changed))
    scans = _recorded(place, motion, lidar, count)
    return Drive(solids, motion, lidar, place.vehicle.T_base_lidar, scans, changes=changes)


def random_numbers(seed: int, purpose: int, changed: int | None = None) -> np.random.Generator:
    """Random numbers for one purpose of a drive, on the first day or another one."""
    for name, number in (("seed", seed), ("changed", changed or 0)):
        if number < 0:
            raise InputError(f"{name} {number} is negative; choose one from 0 up")
    day = () if changed is None else (changed,)
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(purpose, *day)))


def check_range(name: str, value: float, low: float, high: float) -> None:
    """Refuse a value outside its limits, or one that is not a number."""
    if not low <= value <= high:
        raise InputError(f"{name} {value:g} is out of range; choose one from {low:g} to {high:g}")


def _recorded(world: World, motion: Motion, sensor: Sensor, count: int) -> NDArray[np.int64]:
    """All scans outside the dropouts: one second each, centered on the first moment nearest to its location."""
    scans = np.arange(count)
    lacking = round(_DROPOUT_S * 1e9 / sensor.period_ns)
    kept = np.ones(count, dtype=bool)
    for first in _passed(world.dropouts, motion, scans * (sensor.period_ns * 1e-9)):
        kept[max(first - lacking // 2, 0) :][:lacking] = False
    return scans[kept]


def _passed(places: Sequence[tuple[float, float]], motion: Motion, times_s: NDArray[np.floating]) -> list[int]:
    """Index of the instant at which each location is first passed, for those that are."""
    if not places:
        return []
    path = motion.base(times_s)[:, :2, 3]
    passed = []
    for place in places:
        distance_m = np.linalg.norm(path - place, axis=1)
        near = np.flatnonzero(distance_m < 6.0)
        visit = near[: np.argmax(np.append(np.diff(near) > 1, True)) + 1]
        if len(visit) and visit[-1] + 1 < len(times_s):
            passed.append(int(visit[np.argmin(distance_m[visit])]))
    return passed


def _sensor(name: str, noise_m: float | None, dropout: float | None, sight_m: float) -> Sensor:
    if name not in SENSORS:
        raise InputError(f"sensor {name!r} does not exist; choose one of {', '.join(SENSORS)}")
    sensor = SENSORS[name]
    sensor = replace(
        sensor,
        max_range_m=min(sensor.max_range_m, sight_m),
        noise_m=sensor.noise_m if noise_m is None else noise_m,
        dropout=sensor.dropout if dropout is None else dropout,
    )
    check_range("noise_m", sensor.noise_m, 0.0, 10.0)
    check_range("dropout", sensor.dropout, 0.0, 1.0)
    return sensor
