"""SVD-ICP and LM-PLICP against a voxel map."""

from scanchain.registration.align import AMBIGUOUS, align, as_ambiguous, with_source_frame
from scanchain.registration.birds_eye import BirdsEye
from scanchain.registration.correlative import CorrelativeMap, Seed, Window
from scanchain.registration.matcher import Matcher, create_matcher
from scanchain.registration.plicp import PointToShapeMatcher
from scanchain.registration.svd import DegeneratePairsError, rigid_transform
from scanchain.registration.svd_icp import SvdMatcher
from scanchain.registration.voxel_map import VoxelMap

__all__ = [
    "AMBIGUOUS",
    "BirdsEye",
    "CorrelativeMap",
    "DegeneratePairsError",
    "Matcher",
    "PointToShapeMatcher",
    "Seed",
    "SvdMatcher",
    "VoxelMap",
    "Window",
    "align",
    "as_ambiguous",
    "create_matcher",
    "rigid_transform",
    "with_source_frame",
]
