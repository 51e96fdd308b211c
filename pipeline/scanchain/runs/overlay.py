"""overlay.npz: the points of two passes over the place where a trajectory is contradicted most."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Points
from scanchain.evaluation.absolute import path_length
from scanchain.slam import SlamResult
from scanchain.verdict import Kind, WorstPlace

OVERLAY_FILE = "overlay.npz"
_REACH_M = {2: 6.0, 3: 15.0}  # path of a pass by dimension
_MAX_POINTS = 60_000


@dataclass(frozen=True, slots=True)
class Overlay:
    """Points (M, d) of two passes and the positions (N, d) of their scans, as the trajectory places them.

    ``text`` : the stretch in words; ``place`` (d,) : position of the second pass
    """

    text: str
    before: Points
    after: Points
    path_before: Points
    path_after: Points
    place: NDArray[np.float64]


def write_overlay(path: Path, worst: WorstPlace, result: SlamResult) -> None:
    """Write the points of the keyframes before and after a contradiction, or of both passes of a loop."""
    poses = result.trajectory.poses
    path_m = path_length(poses)
    reach_m = _REACH_M[result.trajectory.dimension]
    is_loop = worst.stretch.kind is Kind.LOOPS
    arrays: dict[str, NDArray[np.floating] | str] = {
        "text": worst.stretch.text,
        "place": poses[worst.after, :-1, -1],
    }
    for name, scan, low_m, high_m in (
        ("before", worst.before, -reach_m, reach_m if is_loop else 0.0),
        ("after", worst.after, -reach_m if is_loop else 0.0, reach_m),
    ):
        away_m = path_m - path_m[scan]
        is_near = (away_m >= low_m) & (away_m <= high_m)
        if not is_loop:  # where the lidar stands, one place belongs to the scans of both sides
            numbers = np.arange(len(poses))
            is_near &= numbers <= scan if name == "before" else numbers >= scan
        arrays[name] = _points(result, is_near, scan)
        arrays[f"path_{name}"] = poses[is_near, :-1, -1]
    np.savez_compressed(path, **arrays)  # pyright: ignore[reportArgumentType]


def read_overlay(path: Path) -> Overlay:
    """Read what ``write_overlay`` wrote."""
    with np.load(path) as file:
        clouds = (file[name] for name in ("before", "after", "path_before", "path_after", "place"))
        return Overlay(str(file["text"]), *clouds)


def _points(result: SlamResult, is_near: NDArray[np.bool_], scan: int) -> NDArray[np.float32]:
    """Points (M, d) of the keyframes among these scans, of the nearest one where there is none."""
    chosen = [k for k, keyframe in enumerate(result.keyframes) if is_near[keyframe.scan_index]]
    if not chosen:
        chosen = [int(np.argmin([abs(keyframe.scan_index - scan) for keyframe in result.keyframes]))]
    poses = result.T_world_keyframes
    points = np.concatenate([lie.transform(poses[k], result.keyframes[k].points) for k in chosen])
    return points[:: max(1, -(-len(points) // _MAX_POINTS))].astype(np.float32)
