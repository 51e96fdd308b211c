"""SVD-ICP and LM-PLICP against a voxel map."""

from typing import Protocol

from scanchain import checks
from scanchain.config import MatchingConfig
from scanchain.data import Match, Points, Pose, Prior
from scanchain.matching.correlative import CorrelativeMap, Seed
from scanchain.matching.matcher import PointToShapeMatcher
from scanchain.matching.svd import DegeneratePairsError, rigid_transform
from scanchain.matching.svd_icp import SvdMatcher
from scanchain.matching.voxel_map import VoxelMap

__all__ = [
    "CorrelativeMap",
    "DegeneratePairsError",
    "Matcher",
    "PointToShapeMatcher",
    "Seed",
    "SvdMatcher",
    "VoxelMap",
    "create_matcher",
    "rigid_transform",
]


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
