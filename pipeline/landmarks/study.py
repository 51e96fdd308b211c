"""Study of a landmark problem by ``scanchain landmarks``: before and after, every method, accuracy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix, Pose, Trajectory
from scanchain.landmarks.accuracy import Accuracy
from scanchain.landmarks.compare import MethodResult
from scanchain.landmarks.minimize import Optimizer
from scanchain.landmarks.problem import Values
from scanchain.landmarks.ranges.dead_reckoning import OdometryNoise

Guess = Literal["odometry", "disturbed", "origin"]


@dataclass(frozen=True, slots=True)
class Options:
    """Options of a study.

    ``methods`` are the linear solvers by name, or "all"; the first one estimates what a file holds.
    ``robot`` and ``noise`` are for MRCLAM folders, where a noise of None is to be estimated; ``guess`` and
    ``optimizer`` for nonlinear files.
    """

    methods: tuple[str, ...]
    repeats: int
    robot: int
    noise: OdometryNoise | None
    guess: Guess
    optimizer: Optimizer


@dataclass(frozen=True, slots=True)
class Fact:
    """A line about a problem: label, and value as text."""

    label: str
    value: str


def left_out_fact(what: str) -> list[Fact]:
    """The line about a method that was not compared, none where all were."""
    return [Fact("not compared", what)] if what else []


@dataclass(frozen=True, slots=True)
class Estimate:
    """Poses and landmarks, their accuracy, and T_truth_estimate (3, 3) that aligns them to the truth."""

    state: Values
    accuracy: Accuracy
    T_truth_estimate: Pose


@dataclass(frozen=True, slots=True)
class Study:
    """Results of a study.

    Attributes
    ----------
    name, facts : of the problem, and lines about it
    before, after : optimization
    converged : whether every iteration came to an end by itself
    pose_covariance, landmark_covariance : (K, p, p), (L, 2, 2) after it; m, rad
    true_poses, true_landmarks : (k, 2), (L, 2) m; empty or NaN where unknown
    landmarks : (L,) names, as numbers
    rows, columns, entries, build_s : of A, and the time to put it together
    methods : how every method fared
    trajectory : the poses after it with their stamps; None for a file, which has no stamps
    """

    name: str
    facts: tuple[Fact, ...]
    before: Estimate
    after: Estimate
    converged: bool
    pose_covariance: Matrix
    landmark_covariance: Matrix
    true_poses: Matrix
    true_landmarks: Matrix
    landmarks: NDArray[np.int64]
    rows: int
    columns: int
    entries: int
    build_s: float
    methods: tuple[MethodResult, ...]
    trajectory: Trajectory | None
