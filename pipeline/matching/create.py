"""The matcher that the configuration names."""

from __future__ import annotations

from typing import Protocol

from scanchain import checks
from scanchain.config import MatchingConfig
from scanchain.data import Match, Points, Pose, Prior
from scanchain.matching.matcher import PointToShapeMatcher
from scanchain.matching.svd_icp import SvdMatcher
from scanchain.matching.voxel_map import VoxelMap


class Matcher(Protocol):
    """Whatever aligns a scan to a voxel map."""

    def align(
        self, points: Points, target: VoxelMap, T_first: Pose, prior: Prior | None = None, *, wide: bool = False
    ) -> Match:
        """Pose of the scan in the map's frame, near the first one."""
        ...


def create_matcher(config: MatchingConfig) -> Matcher:
    """The matcher that the configuration names."""
    checks.instance(config, MatchingConfig, "config", "load_settings(dimension).config.matching")
    return PointToShapeMatcher(config) if config.matcher == "plicp" else SvdMatcher(config)
