"""Matchers: the protocol, and the one that the configuration names."""

from __future__ import annotations

from typing import Protocol

from scanchain import checks, plugins
from scanchain.config import MATCHERS, MatchingConfig
from scanchain.data import Match, Points, Pose, Prior
from scanchain.registration.own_matcher import CheckedMatcher
from scanchain.registration.voxel_map import VoxelMap


class Matcher(Protocol):
    """Scan-to-map registration; made with a MatchingConfig.

    Stateless: a match follows from the arguments and the configuration alone. A run that is resumed makes its
    matcher anew from the name and the configuration.
    """

    def align(
        self, points: Points, target: VoxelMap, T_first: Pose, prior: Prior | None = None, *, wide: bool = False
    ) -> Match:
        """Pose of the scan in the map's frame, near the first one.

        points : (N, d) meters, lidar frame
        target : ``target.points()`` are its voxel means (V, d), map frame; ``target.voxels`` is for kernels
        T_first : (d+1, d+1), where the search begins
        prior : predicted pose and its covariance, None where nothing is predicted
        wide : search far, for a first pose that is little more than a guess
        """
        ...


def create_matcher(config: MatchingConfig) -> Matcher:
    """The matcher that the configuration names. Raises InputError where a user's class cannot be had."""
    checks.instance(config, MatchingConfig, "config", "load_settings(dimension).config.matching")
    name = config.matcher
    kind = plugins.load(MATCHERS.get(name, name), "align")
    return kind(config) if name in MATCHERS else CheckedMatcher(name, kind, config)
