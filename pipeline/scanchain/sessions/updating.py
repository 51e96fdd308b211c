"""A map that follows its newest session: points of older keyframes that newer sessions saw through are removed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from scanchain import lie
from scanchain.config import Config
from scanchain.data import Keyframe, KeyframePoints, Matrix, Points
from scanchain.errors import InputError
from scanchain.maps import Session
from scanchain.sessions.changes import Label, Part, changes_between

_SEEN_AGAIN = 0.3  # share of a keyframe's points near those of a later one, from which on it was seen again
_CELL_VOXELS = 4.0  # edge of the cells, in voxels of the map, in which points are near each other


@dataclass(frozen=True, slots=True)
class RemainingPoints:
    """Points of a keyframe for which ``kept`` (M,) holds."""

    stored: KeyframePoints
    kept: NDArray[np.bool_]

    def read(self) -> Points:
        """(N, d) meters."""
        return self.stored.read()[self.kept]


@dataclass(frozen=True, slots=True)
class Updated:
    """Keyframes of an updated map.

    Attributes
    ----------
    keyframes : without the points that newer sessions saw through
    removed : (K,) number of these
    last_seen_ns : (K,) stamp of the newest keyframe that saw the surroundings of each, its own at least
    warnings : sessions that nothing was removed by, since they do not fit on those before
    """

    keyframes: tuple[Keyframe, ...]
    removed: NDArray[np.int64]
    last_seen_ns: NDArray[np.int64]
    warnings: tuple[str, ...]


def updated(
    keyframes: Sequence[Keyframe],
    poses: Matrix,
    session: NDArray[np.int64],
    sessions: Sequence[Session],
    config: Config,
) -> Updated:
    """Keyframes at these poses (K, d+1, d+1) without what vanished from one session to the next.

    session : (K,) number of each keyframe's session; the later session has the higher number
    """
    result, removed, warnings = list(keyframes), np.zeros(len(keyframes), np.int64), []
    for number in range(1, len(sessions)):
        older, newer = np.flatnonzero(session < number), np.flatnonzero(session == number)
        earlier, later = (
            Part("", [result[k] for k in chosen.tolist()], poses[chosen]) for chosen in (older, newer)
        )
        try:
            changes = changes_between(earlier, later, config)
        except InputError:
            warnings.append(
                f"{sessions[number].name}: too little in common with older sessions, nothing removed by it"
            )
            continue
        if not (changes.labels == Label.VANISHED).any():
            continue
        label_of = KDTree(changes.points)
        reach_m = np.sqrt(changes.dimension) * changes.voxel_size_m
        is_vanished = np.append(changes.labels == Label.VANISHED, False)  # the last one: no point within reach
        for k in older.tolist():
            points = lie.transform(poses[k], result[k].points)
            gone = is_vanished[label_of.query(points, distance_upper_bound=reach_m)[1]]
            if gone.any():
                removed[k] += gone.sum()
                result[k] = replace(result[k], stored=RemainingPoints(result[k].stored, ~gone))
    last_seen_ns = _last_seen(result, poses, _CELL_VOXELS * config.maps.voxel_size_m)
    return Updated(tuple(result), removed, last_seen_ns, tuple(warnings))


def _last_seen(keyframes: Sequence[Keyframe], poses: Matrix, cell_m: float) -> NDArray[np.int64]:
    """(K,) stamp since which a share of each keyframe's points was seen, by any session; its own at least."""
    stamps_ns = np.array([keyframe.stamp_ns for keyframe in keyframes], np.int64)
    cells = [
        np.unique(_packed(np.floor(lie.transform(pose, keyframe.points) / cell_m).astype(np.int64)))
        for keyframe, pose in zip(keyframes, poses, strict=True)
    ]
    number = np.unique(np.concatenate(cells), return_inverse=True)[1]
    counts = np.array([len(each) for each in cells])
    newest_ns = np.full(number.max(initial=-1) + 1, np.iinfo(np.int64).min)
    np.maximum.at(newest_ns, number, np.repeat(stamps_ns, counts))
    last_ns = stamps_ns.copy()
    for k, seen in enumerate(np.split(newest_ns[number], np.cumsum(counts)[:-1])):
        if len(seen):
            last_ns[k] = np.sort(seen)[::-1][int(_SEEN_AGAIN * (len(seen) - 1))]
    return last_ns


def _packed(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Cells (N, d) as one number each (N,)."""
    return (cells & ((1 << 21) - 1)) @ (1 << 21 * np.arange(cells.shape[1], dtype=np.int64))
