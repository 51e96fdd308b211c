"""Whether the covariances in steps.parquet say how far off the odometry was."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Trajectory
from scanchain.evaluation import motion_nees, pair

if TYPE_CHECKING:
    import pyarrow as pa

COLUMNS = ("covariance", "state")


def nees_of_steps(
    steps: pa.Table, odometry: Trajectory, truth: Trajectory, *, gap_s: float | None = None
) -> NDArray[np.float64]:
    """(N,) NEES of the motion up to each scan; NaN without a true pose at both ends, or where a scan was not ok.

    steps : with ``COLUMNS``, a row a scan; odometry : T_odom_lidar of the same scans, SE(2) or lifted
    """
    size = steps.schema.field("covariance").type.list_size
    unknown, k = [np.nan] * size, math.isqrt(size)
    covariances = np.array([row or unknown for row in steps["covariance"].to_pylist()]).reshape(-1, k, k)
    covariances[[state != "ok" for state in steps["state"].to_pylist()]] = np.nan
    pairs = pair(odometry, truth, gap_s=gap_s)
    place = pairs.places
    estimate, reference = pairs.estimate, pairs.reference
    if k == 3:
        estimate, reference = lie.flatten(estimate), lie.flatten(reference)
    nees = motion_nees(estimate, covariances[place], reference)
    nees[np.diff(place) != 1] = np.nan
    result = np.full(len(odometry), np.nan)
    result[place[1:]] = nees
    return result
