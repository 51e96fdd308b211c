"""Changes between two maps of one place: what appeared, vanished and moved, by free space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Literal

import numpy as np
from msgspec import structs
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from scanchain.config import Config
from scanchain.data import Keyframe, Matrix, Points, brief
from scanchain.errors import InputError
from scanchain.maps import clearly_through, reach_of, sightings
from scanchain.runs.results import cloud_of, views_of

_SAME_VOXELS = 1.5  # distance, in voxels, within which the other map has the same surface
_JOINED_VOXELS = {2: 4.0, 3: 3.0}  # distance within which changed points belong to one cluster
_LEAST_POINTS = {2: 3, 3: 6}  # least number of points of a cluster
_LEG_M, _LEGS_M = 0.2, 1.0  # size of legs of furniture, and distance within which they belong to one piece
_LEAST_AGREEMENT = 0.4  # least share of unchanged points among those that both maps observed
_ALIKE = (0.1, 1.0)  # by which lengths of one object may differ between two views: share, and voxels
_MOVED_SIZES = 5.0  # largest distance at which an object is recognized by its size alone, in lengths of it
_UNRIVALED = 0.33  # largest ratio of that distance to that of any other cluster of the same size
_THIN_VOXELS = 1.25  # thickness of a cluster, in voxels, below which it can be a surface that rays grazed
_ADJACENT_VOXELS = 4.0  # largest distance of such a cluster's points from that surface, in voxels


class Label(IntEnum):
    """Fate of a point from the earlier map to the later one."""

    SAME = 0
    APPEARED = 1
    VANISHED = 2
    UNKNOWN = 3


Kind = Literal["appeared", "vanished"]


@dataclass(frozen=True, slots=True)
class Part:
    """A map, or sessions of one, to compare.

    name : for messages and results
    keyframes, poses : (K, d+1, d+1) T_common_lidar of the keyframes
    """

    name: str
    keyframes: Sequence[Keyframe]
    poses: Matrix


@dataclass(frozen=True, slots=True)
class Cluster:
    """Points close to each other that all appeared or all vanished.

    kind, number : clusters of both kinds are numbered together, from 1, the largest first
    center : (d,) middle of its box, meters, frame of the earlier map
    size_m : (d,) of the box: the longer and the shorter side on the ground, the height
    yaw_rad : direction of the longer side
    points : number of its points, one per voxel
    counterpart : number of the cluster at the other position of an object that moved, 0 for one that did not
    """

    kind: Kind
    number: int
    center: NDArray[np.float64]
    size_m: NDArray[np.float64]
    yaw_rad: float
    points: int
    counterpart: int = 0

    @property
    def volume(self) -> float:
        """Volume of the box in m³; in 2D its area in m²."""
        return float(np.prod(self.size_m))


@dataclass(frozen=True, slots=True)
class Changes:
    """The difference of two maps.

    names : of the earlier and the later map
    points : (N, d) of both maps, one per voxel; unchanged ones are of the earlier map
    labels : (N,) uint8 values of ``Label``
    of_cluster : (N,) number of each point's cluster, 0 for none
    clusters : in the order of their numbers
    agreement : share of unchanged points among those that both maps observed
    voxel_size_m : edge of the voxels
    """

    __repr__ = brief
    names: tuple[str, str]
    points: Points
    labels: NDArray[np.uint8]
    of_cluster: NDArray[np.int64]
    clusters: tuple[Cluster, ...]
    agreement: float
    voxel_size_m: float

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return self.points.shape[1]

    @property
    def reach_m(self) -> float:
        """Range up to which scans were compared with points."""
        return reach_of(self.voxel_size_m)


def changes_between(
    earlier: Part, later: Part, config: Config, *, voxel_size_m: float | None = None, min_size_m: float = 0.2
) -> Changes:
    """The changes from one map to the other, both in one frame.

    A point vanished if the later map clearly saw through its position, and appeared if the earlier one did; if the
    other map did not observe the position, the change is unknown. What moved while a map was recorded is removed
    beforehand.

    voxel_size_m : of the comparison; ``maps.voxel_size_m`` by default
    min_size_m : least length of a cluster; the points of smaller ones are unknown
    Raises InputError if the maps do not match.
    """
    size_m = config.maps.voxel_size_m if voxel_size_m is None else voxel_size_m
    maps = structs.replace(config.maps, voxel_size_m=size_m, remove_moving=True)
    still = structs.replace(config, maps=maps)
    before, after = (cloud_of(part.keyframes, part.poses, still).points for part in (earlier, later))
    labels_before = _labels(before, after, later, Label.VANISHED, size_m, config)
    labels_after = _labels(after, before, earlier, Label.APPEARED, size_m, config)
    counts = np.bincount(np.concatenate([labels_before, labels_after]), minlength=len(Label))
    agreement = float(counts[Label.SAME] / max(counts.sum() - counts[Label.UNKNOWN], 1))
    if agreement < _LEAST_AGREEMENT:
        raise InputError(
            f"{later.name}: only {100.0 * agreement:.0f} % of what both maps observed is the same as in "
            f"{earlier.name}: not in one frame; give another --transform or none, and maps of one place"
        )
    is_new = labels_after != Label.SAME
    points, labels = np.vstack([before, after[is_new]]), np.append(labels_before, labels_after[is_new])
    of_cluster, clusters = _clusters(points, labels, size_m, min_size_m)
    labels[((labels == Label.VANISHED) | (labels == Label.APPEARED)) & (of_cluster == 0)] = Label.UNKNOWN
    return Changes(
        (earlier.name, later.name), points, labels, of_cluster, _paired(clusters, size_m), agreement, size_m
    )


def _labels(
    points: Points, others: Points, other: Part, changed: Label, size_m: float, config: Config
) -> NDArray[np.uint8]:
    """Labels (N,) of points by the cloud of the other map and what its scans saw."""
    seen, seen_through = sightings(points, size_m, views_of(other.keyframes, other.poses, config))
    distance_m = KDTree(others).query(points, distance_upper_bound=_SAME_VOXELS * size_m)[0]
    is_same = np.isfinite(distance_m)
    is_changed = clearly_through(seen, seen_through) & ~is_same
    return np.select([is_changed, is_same | (seen > 0)], [changed, Label.SAME], Label.UNKNOWN).astype(np.uint8)


def _clusters(
    points: Points, labels: NDArray[np.uint8], size_m: float, min_size_m: float
) -> tuple[NDArray[np.int64], list[Cluster]]:
    """Number of each point's cluster (N,), 0 for none, and the clusters, the largest first."""
    found: list[tuple[Cluster, NDArray[np.int64]]] = []
    rest = KDTree(points[(labels == Label.SAME) | (labels == Label.UNKNOWN)])
    kinds: tuple[Kind, ...] = ("vanished", "appeared")
    for kind in kinds:
        for members in _groups(points, np.flatnonzero(labels == Label[kind.upper()]), size_m):
            center, size, yaw_rad = _box(points[members], size_m)
            if size.max() >= min_size_m and not _is_grazed(points[members], rest, size_m):
                found.append((Cluster(kind, 0, center, size, yaw_rad, len(members)), members))
    found.sort(key=lambda each: -each[0].points)
    of_cluster = np.zeros(len(points), np.int64)
    for number, (_, members) in enumerate(found, start=1):
        of_cluster[members] = number
    return of_cluster, [replace(cluster, number=k) for k, (cluster, _) in enumerate(found, start=1)]


def _is_grazed(points: Points, rest: KDTree, size_m: float) -> bool:
    """True for 3D points on a level plane or a line, most of which are next to unchanged points along it.

    Rays that graze the ground, an edge or a pole pass close to its points.
    """
    if points.shape[1] == 2:
        return False
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    across = axes[1:] if len(axes) > 2 and np.ptp(points @ axes[1]) < _THIN_VOXELS * size_m else np.eye(3)[2:]
    if np.ptp(points @ across.T, axis=0).max() >= _THIN_VOXELS * size_m:
        return False
    others = np.asarray(rest.data)
    continued = 0
    for point, found in zip(points, rest.query_ball_point(points, _ADJACENT_VOXELS * size_m), strict=True):
        away = others[found] - point
        is_adjacent = (np.abs(away @ across.T) < size_m).all(axis=1) & (away[:, 2] > -size_m)
        continued += bool(is_adjacent.any())
    return continued > 0.5 * len(points)


def _groups(points: Points, chosen: NDArray[np.int64], size_m: float) -> list[NDArray[np.int64]]:
    """Rows of the chosen points that belong together: close to each other, or legs of one piece of furniture."""
    dimension = points.shape[1]
    groups = _connected(points, chosen, _JOINED_VOXELS[dimension] * size_m)
    groups = [group for group in groups if len(group) >= _LEAST_POINTS[dimension]]
    is_leg = [np.ptp(points[group], axis=0).max() + size_m < _LEG_M for group in groups]
    legs = [group for group, short in zip(groups, is_leg, strict=True) if short]
    others = [group for group, short in zip(groups, is_leg, strict=True) if not short]
    return others + _connected(points, np.concatenate([*legs, chosen[:0]]), _LEGS_M)


def _connected(points: Points, chosen: NDArray[np.int64], reach_m: float) -> list[NDArray[np.int64]]:
    """Rows of the chosen points, in groups of those within reach of each other."""
    count = len(chosen)
    if not count:
        return []
    pairs = KDTree(points[chosen]).query_pairs(reach_m, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(count, count))
    group = connected_components(links, directed=False)[1]
    return [chosen[group == number] for number in range(group.max() + 1)]


def _box(points: Points, size_m: float) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Center (d,), size (d,) and heading of the upright box of least area around points, enlarged by a voxel."""
    yaws = np.arange(90) * (0.5 * np.pi / 90)
    axes = np.stack([np.cos(yaws), np.sin(yaws), -np.sin(yaws), np.cos(yaws)], axis=-1).reshape(-1, 2, 2)
    turned = axes @ points[:, :2].T
    low, high = turned.min(axis=2), turned.max(axis=2)
    extent = high - low + size_m
    best = int(np.argmin(extent.prod(axis=1)))
    size, yaw_rad = extent[best], float(yaws[best])
    center = axes[best].T @ (0.5 * (low[best] + high[best]))
    if size[1] > size[0]:
        size, yaw_rad = size[::-1], yaw_rad + 0.5 * np.pi
    if points.shape[1] == 3:
        bottom, top = float(points[:, 2].min()), float(points[:, 2].max())
        center, size = np.append(center, 0.5 * (bottom + top)), np.append(size, top - bottom + size_m)
    return center, size, yaw_rad


def _paired(clusters: Sequence[Cluster], size_m: float) -> tuple[Cluster, ...]:
    """The clusters with counterparts: the nearest one of the same size, if all others are much farther away."""
    gone = [cluster for cluster in clusters if cluster.kind == "vanished"]
    come = [cluster for cluster in clusters if cluster.kind == "appeared"]
    if not gone or not come or len(gone[0].center) == 2:  # outlines of furniture are too similar
        return tuple(clusters)
    away_m = np.array([[np.linalg.norm(a.center - b.center) for b in come] for a in gone])
    away_m[[[not _alike(a, b, size_m) for b in come] for a in gone]] = np.inf
    lengths_m = np.maximum.outer(*([cluster.size_m.max() for cluster in part] for part in (gone, come)))
    counterpart: dict[int, int] = {}
    for row, column in zip(*np.nonzero(away_m < _MOVED_SIZES * lengths_m), strict=True):
        rivals = np.concatenate([np.delete(away_m[row], column), np.delete(away_m[:, column], row)])
        if away_m[row, column] < _UNRIVALED * float(rivals.min(initial=np.inf)):
            a, b = gone[row].number, come[column].number
            counterpart |= {a: b, b: a}
    return tuple(replace(each, counterpart=counterpart.get(each.number, 0)) for each in clusters)


def _alike(a: Cluster, b: Cluster, size_m: float) -> bool:
    """True if the boxes can be two views of the same object."""
    longer = np.maximum(a.size_m, b.size_m)
    return bool((np.abs(a.size_m - b.size_m) < _ALIKE[0] * longer + _ALIKE[1] * size_m).all())
