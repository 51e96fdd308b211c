"""Changes named between two maps of simulated places against what changed in truth.

For each seed the place is driven twice, the second time on another day (``simulate --changed``); logs and runs
stay in the cache. An object counts where it is larger than 0.3 m and both drives had it, or its place, in sight:
so many rays of their keyframes' scans end on it, or would, within the reach of the comparison. A cluster is
right where most of its points lie on an object that vanished or appeared. With ``--later-seconds`` the second
drive sees a part of the first one's world only, with ``--unchanged`` nothing changed: every cluster is wrong.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from scanchain import lie
from scanchain.data import Matrix
from scanchain.kernels.raycast import BOX, ELLIPSOID
from scanchain.maps import SavedMap, open_saved_map
from scanchain.sessions.alignment import align_maps
from scanchain.sessions.changes import Changes, Part, changes_between
from scanchain.settings import load_settings
from scanchain.simulation import Drive, plan
from scanchain.simulation.drive import EPOCH_NS
from scanchain.simulation.solids import FIXED, Solids
from tests.benchmarks.harness import options_of, recorded
from tests.support import made

LEAST_M = 0.3  # size of the objects that count
LEAST_RAYS = {2: 10, 3: 40}  # of the keyframes' scans, for an object to be in sight
REACH_M = {2: 8.6, 3: 34.0}  # farthest that scans are compared at: docs/maps.md
MARGIN_M = {2: 0.1, 3: 0.3}  # around an object, within which points belong to it
SURFACE_M = 1e-3  # as near as a ray ends to the solid that it hits


@dataclass(frozen=True, slots=True)
class Score:
    """Events are sides of a change: an object that vanished from a place, one that appeared."""

    events: int
    found: int
    clusters: int
    right: int
    moved_named: int
    moved_right: int


def main() -> None:
    options = options_of(
        __doc__, world="office", seeds=[1, 2, 3], sensor=str, seconds=float, later_seconds=float, unchanged=False
    )
    scores = [score_of(options, seed) for seed in options.seeds]
    total = Score(*(sum(getattr(score, name) for score in scores) for name in Score.__slots__))
    for name, score in (*zip(map(str, options.seeds), scores, strict=True), ("all", total)):
        print(
            f"{options.world} {name:>4s}: found {score.found:3d} of {score.events:3d} "
            f"({100 * score.found / max(score.events, 1):5.1f} %), right {score.right:3d} of {score.clusters:3d} "
            f"({100 * score.right / max(score.clusters, 1):5.1f} %), "
            f"counterparts right {score.moved_right} of {score.moved_named}"
        )


def score_of(options: argparse.Namespace, seed: int) -> Score:
    later_s = options.later_seconds or options.seconds
    first = plan(options.world, seed=seed, sensor=options.sensor, duration_s=options.seconds)
    second = plan(options.world, seed=seed, sensor=options.sensor, duration_s=later_s, changed=1)
    if options.unchanged:
        second = replace(second, solids=first.solids, changes=())
    stem = f"{options.world}_{options.sensor or 'own'}_{seed}_{options.seconds or 'all'}"
    tail = f"_b{options.later_seconds or ''}{'_unchanged' if options.unchanged else ''}"
    a = _mapped(first, f"{stem}_a", options.cache)
    b = _mapped(second, f"{stem}{tail}", options.cache)
    config = load_settings(a.dimension).config
    aligned = align_maps(a, b, config)
    found = changes_between(Part("a", a.keyframes, a.poses), Part("b", b.keyframes, aligned.poses), config)
    return _score(found, first, second, a, b)


def _mapped(drive: Drive, name: str, cache: Path) -> SavedMap:
    return open_saved_map(made.run_of(recorded(name, drive, cache), cache, name))


def _score(found: Changes, first: Drive, second: Drive, a: SavedMap, b: SavedMap) -> Score:
    d, points = a.dimension, _in_world(found.points, first, a)
    count = len(found.clusters) + 1
    size = np.bincount(found.of_cluster, minlength=count)
    right, owner = np.zeros(count, bool), np.full(count, -1)
    events = hits = 0
    for kind, here, there in (("vanished", (first, a), (second, b)), ("appeared", (second, b), (first, a))):
        solids, is_kind = here[0].solids, np.array([False, *(each.kind == kind for each in found.clusters)])
        changed = [
            each for each in second.changes if np.isfinite(each.before if here[0] is first else each.after).all()
        ]
        owners, others = [change.owner for change in changed], there[0].solids
        added, kept = np.isin(solids.owner, owners), ~np.isin(others.owner, owners)
        both = np.append(
            np.where(kept, others.owner, FIXED), solids.owner[added]
        )  # as they stand on the other day
        both = Solids(np.vstack([others.rows, solids.rows[added]]), both, others.ground)
        rays = np.minimum(_rays_by_owner(*here, solids), _rays_by_owner(*there, both))
        for change in changed:
            on = _on(points, solids, change.owner, MARGIN_M[d])
            mine = np.bincount(found.of_cluster[on], minlength=count)
            covers = is_kind & (mine > 0.5 * size)
            right |= covers
            owner[covers] = change.owner
            if change.size_m[:d].max() < LEAST_M or rays[change.owner] < LEAST_RAYS[d]:
                continue
            events += 1
            hits += bool((covers | (is_kind & (mine > 0.2 * on.sum()))).any())
    moved = [cluster for cluster in found.clusters if cluster.kind == "vanished" and cluster.counterpart]
    matched = sum(0 <= owner[each.number] == owner[each.counterpart] for each in moved)
    return Score(events, hits, len(found.clusters), int(right[1:].sum()), len(moved), matched)


def _in_world(points: Matrix, drive: Drive, saved: SavedMap) -> Matrix:
    """Points (N, 3) of the map in the simulator's world; those of the plane at the height of the lidar."""
    starts_s = np.array([keyframe.stamp_ns - EPOCH_NS for keyframe in saved.keyframes]) * 1e-9
    true = drive.motion.lidar(starts_s)
    T = (lie.flatten(true) if saved.dimension == 2 else true) @ lie.inverse(saved.poses)
    T_world_map = T[len(T) // 2]
    moved = lie.transform(T_world_map, points)
    return moved if saved.dimension == 3 else np.column_stack([moved, np.full(len(moved), true[0, 2, 3])])


def _on(points: Matrix, solids: Solids, owner: int, margin_m: float) -> np.ndarray:
    """True for points within a margin of the solids of one object."""
    on = np.zeros(len(points), bool)
    for kind, x, y, half_x, half_y, c, s, low, high in solids.rows[solids.owner == owner]:
        dx, dy = points[:, 0] - x, points[:, 1] - y
        if kind == ELLIPSOID:
            radii = np.array([half_x, half_y, high]) + margin_m
            on |= ((np.column_stack([dx, dy, points[:, 2] - low]) / radii) ** 2).sum(axis=1) < 1.0
            continue
        inside = np.hypot(dx, dy) < half_x + margin_m
        if kind == BOX:
            inside = np.abs(c * dx + s * dy) < half_x + margin_m
            inside &= np.abs(-s * dx + c * dy) < half_y + margin_m
        on |= inside & (points[:, 2] > low - margin_m) & (points[:, 2] < high + margin_m)
    return on


def _rays_by_owner(drive: Drive, saved: SavedMap, solids: Solids) -> np.ndarray:
    """Number of rays of a drive's keyframes that end on each object (O,) of a world, its own or another one."""
    counts = np.zeros(10_000, np.int64)
    for keyframe in saved.keyframes:
        start_s = (keyframe.stamp_ns - EPOCH_NS) * 1e-9
        rays = drive.sensor.rays(round(start_s / (drive.sensor.period_ns * 1e-9)))
        poses = drive.motion.lidar(start_s + rays.instants_ns * 1e-9)
        reach_m = min(drive.sensor.max_range_m, REACH_M[saved.dimension])
        ranges_m = solids.cast(poses, rays.instant_of_ray, rays.directions, reach_m)
        hits = np.isfinite(ranges_m)
        T = poses[rays.instant_of_ray[hits]]
        ends = T[:, :3, 3] + ranges_m[hits, None] * (T[:, :3, :3] @ rays.directions[hits, :, None])[..., 0]
        for owner in np.unique(solids.owner[solids.owner != FIXED]).tolist():
            counts[owner] += _on(ends, solids, owner, SURFACE_M).sum()
    return counts


if __name__ == "__main__":
    main()
