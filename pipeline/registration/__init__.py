"""SVD-ICP and LM-PLICP against a voxel map."""

from scanchain.registration.align import AMBIGUOUS, align, as_ambiguous, with_source_frame
from scanchain.registration.birds_eye import BirdsEye, upright_columns
from scanchain.registration.correlative import CorrelativeMap, ScoreGrid, Seed, Window, evenly
from scanchain.registration.matcher import Matcher, create_matcher
from scanchain.registration.place_grid import PlaceGrid, PlaceSearch
from scanchain.registration.plicp import PointToShapeMatcher
from scanchain.registration.svd_icp import DegeneratePairsError, SvdMatcher, rigid_transform
from scanchain.registration.voxel_map import VoxelMap

__all__ = [
    "AMBIGUOUS",
    "BirdsEye",
    "CorrelativeMap",
    "DegeneratePairsError",
    "Matcher",
    "PlaceGrid",
    "PlaceSearch",
    "PointToShapeMatcher",
    "ScoreGrid",
    "Seed",
    "SvdMatcher",
    "VoxelMap",
    "Window",
    "align",
    "as_ambiguous",
    "create_matcher",
    "evenly",
    "rigid_transform",
    "upright_columns",
    "with_source_frame",
]
