"""A run directory as one picture: its ways over its map."""

from __future__ import annotations

import json
from pathlib import Path

from scanchain.errors import InputError
from scanchain.evaluation import on_the_estimate
from scanchain.maps import read_map, read_ply
from scanchain.runs.directory import TRUTH_FILE
from scanchain.trajectory import read_tum
from scanchain.viz.pictures.plots import GridPicture, draw_map


def draw_run(directory: Path, picture: Path) -> None:
    """Draw trajectories, ground truth and map of a run to a PNG: the occupancy grid in 2D, the cloud in 3D.

    Raises InputError where the directory is no run's, or the picture cannot be written.
    """
    if not (directory / "trajectory.tum").exists():
        raise InputError(f"{directory}: holds no trajectory.tum; give the directory of a finished run")
    points = read_ply(directory / "map.ply")
    is_planar = not points[:, 2].any()
    cells, resolution_m, origin_m = read_map(directory)
    optimized, odometry = read_tum(directory / "trajectory.tum"), read_tum(directory / "odometry.tum")
    truth_file = directory / TRUTH_FILE
    truth = None
    if truth_file.exists():
        judged = json.loads((directory / "metrics.json").read_bytes())["ground_truth"] or {}
        truth = on_the_estimate(optimized, read_tum(truth_file), gap_s=judged.get("max_gap_s"))
    try:
        draw_map(
            picture,
            title=directory.resolve().name,
            optimized=optimized.poses,
            odometry=odometry.poses,
            ground_truth=None if truth is None else truth.poses,
            points=None if is_planar else points,
            grid=GridPicture(cells, resolution_m, origin_m) if is_planar else None,
        )
    except OSError as error:
        raise InputError(f"{picture}: not writable ({error.strerror}); choose another place") from error
