"""Matchers: the protocol, and creation of the one that the configuration names."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np

from scanchain import checks, plugins
from scanchain.config import MATCHERS, MatchingConfig
from scanchain.data import AnyPoints, Match, Pose, Prior
from scanchain.errors import InputError, shown
from scanchain.registration.voxel_map import VoxelMap

_COUNTS = ("inliers", "points", "iterations")
_NUMBERS = ("cost", "residual_m", "fit", "degeneracy_eigenvalue", "observability")


class Matcher(Protocol):
    """Scan-to-map registration; made with a MatchingConfig.

    Stateless: a match depends on the arguments and the configuration alone. A resumed run recreates its matcher
    from the name and the configuration.
    """

    def align(
        self, points: AnyPoints, target: VoxelMap, T_first: Pose, prior: Prior | None = None, *, wide: bool = False
    ) -> Match:
        """Pose of the scan in the map's frame, near the initial one.

        points : (N, d) meters, lidar frame
        target : ``target.points()`` are its voxel means (V, d), map frame; ``target.voxels`` is for kernels
        T_first : (d+1, d+1), initial pose
        prior : predicted pose and its covariance, None where nothing is predicted
        wide : use a larger search radius, for an inaccurate initial pose
        """
        ...


class CheckedMatcher:
    """A user-defined class as a ``Matcher``. Raises InputError where it does not return a valid Match."""

    def __init__(self, name: str, kind: type, config: MatchingConfig) -> None:
        self.name = name
        with plugins.own_code(f"{name}: __init__(self, config) with a MatchingConfig"):
            self.own = kind(config)

    def align(
        self, points: AnyPoints, target: VoxelMap, T_first: Pose, prior: Prior | None = None, *, wide: bool = False
    ) -> Match:
        """The result of the user's ``align``, with arrays of the required shape and dtype."""
        with plugins.own_code(f"{self.name}: align"):
            match = self.own.align(points, target, T_first, prior, wide=wide)
        with plugins.own_code(self.name):
            return self._checked(match, len(T_first) - 1)

    def _checked(self, match: object, d: int) -> Match:
        if not isinstance(match, Match):
            raise InputError(f"align returned {shown(match)}; wanted a scanchain.Match")
        of = "of the Match that align returned,"
        k = d * (d + 1) // 2
        for field in (*_COUNTS, *_NUMBERS):
            value = getattr(match, field)
            if not isinstance(value, int | np.integer if field in _COUNTS else int | float | np.number):
                wanted = "a whole number" if field in _COUNTS else "a number"
                raise InputError(f"{of} {field} is {shown(value)}; wanted {wanted}")
        worst = match.degeneracy_direction if np.size(match.degeneracy_direction) else np.eye(k)[0]
        return replace(
            match,
            T_target_source=checks.pose(match.T_target_source, f"{of} T_target_source", d),
            information=checks.matrices(match.information, f"{of} information", (k, k)),
            degeneracy_direction=checks.matrices(worst, f"{of} degeneracy_direction", (k,)),
        )


def create_matcher(config: MatchingConfig) -> Matcher:
    """The matcher that the configuration names. Raises InputError where a user-defined class cannot be loaded."""
    checks.instance(config, MatchingConfig, "config", "load_settings(dimension).config.matching")
    name = config.matcher
    kind = plugins.load(MATCHERS.get(name, name), "align")
    return kind(config) if name in MATCHERS else CheckedMatcher(name, kind, config)
