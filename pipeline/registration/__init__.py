"""SVD-ICP and LM-PLICP against a voxel map."""

from scanchain.registration.align import align, with_source_frame
from scanchain.registration.birds_eye import BirdsEye
from scanchain.registration.correlative import CorrelativeMap, Seed
from scanchain.registration.matcher import Matcher, create_matcher
from scanchain.registration.plicp import PointToShapeMatcher
from scanchain.registration.svd import DegeneratePairsError, rigid_transform
from scanchain.registration.svd_icp import SvdMatcher
from scanchain.registration.voxel_map import VoxelMap

__all__ = [
    "BirdsEye",
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
    "with_source_frame",
]
