"""SVD-ICP and LM-PLICP against a voxel map."""

from scanchain.matching.align import align
from scanchain.matching.correlative import CorrelativeMap, Seed
from scanchain.matching.create import Matcher, create_matcher
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
    "align",
    "create_matcher",
    "rigid_transform",
]
