"""SVD-ICP and LM-PLICP against a voxel map."""

from scanchain.registration.align import AMBIGUOUS as AMBIGUOUS
from scanchain.registration.align import align as align
from scanchain.registration.align import as_ambiguous as as_ambiguous
from scanchain.registration.align import with_source_frame as with_source_frame
from scanchain.registration.birds_eye import BirdsEye as BirdsEye
from scanchain.registration.birds_eye import upright_columns as upright_columns
from scanchain.registration.correlative import CorrelativeMap as CorrelativeMap
from scanchain.registration.correlative import ScoreGrid as ScoreGrid
from scanchain.registration.correlative import Seed as Seed
from scanchain.registration.correlative import Window as Window
from scanchain.registration.correlative import evenly as evenly
from scanchain.registration.matcher import Matcher as Matcher
from scanchain.registration.matcher import create_matcher as create_matcher
from scanchain.registration.place_grid import PlaceGrid as PlaceGrid
from scanchain.registration.place_grid import PlaceSearch as PlaceSearch
from scanchain.registration.plicp import PointToShapeMatcher as PointToShapeMatcher
from scanchain.registration.svd_icp import DegeneratePairsError as DegeneratePairsError
from scanchain.registration.svd_icp import SvdMatcher as SvdMatcher
from scanchain.registration.svd_icp import rigid_transform as rigid_transform
from scanchain.registration.voxel_map import MapKeeper as MapKeeper
from scanchain.registration.voxel_map import VoxelMap as VoxelMap
