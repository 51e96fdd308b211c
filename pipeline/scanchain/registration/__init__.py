"""SVD-ICP and LM-PLICP against a voxel map."""

from scanchain.registration.matcher import Matcher as Matcher
from scanchain.registration.matcher import create_matcher as create_matcher
from scanchain.registration.plicp import PointToShapeMatcher as PointToShapeMatcher
from scanchain.registration.search import SearchGrid as SearchGrid
from scanchain.registration.search import Wanted as Wanted
from scanchain.registration.search import Window as Window
from scanchain.registration.search import find as find
from scanchain.registration.search import thinned as thinned
from scanchain.registration.svd_icp import DegeneratePairsError as DegeneratePairsError
from scanchain.registration.svd_icp import rigid_transform as rigid_transform
from scanchain.registration.voxel_map import MapKeeper as MapKeeper
from scanchain.registration.voxel_map import VoxelMap as VoxelMap
