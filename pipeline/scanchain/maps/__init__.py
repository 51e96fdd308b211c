"""Maps of the world: a point cloud and an occupancy grid, written in common formats."""

from scanchain.maps.files import read_map, read_ply, write_laz, write_map, write_pcd, write_ply
from scanchain.maps.occupancy_grid import OccupancyGrid, draw_grid, fitting_resolution
from scanchain.maps.point_map import PointMap, View, build_point_map, clearly_through, moved, reach_of, sightings
from scanchain.maps.saved_map import (
    MAP_FOLDER,
    Edges,
    SavedMap,
    SavedPoints,
    Session,
    open_saved_map,
    write_saved_map,
)

__all__ = [
    "MAP_FOLDER", "Edges", "OccupancyGrid", "PointMap", "SavedMap", "SavedPoints", "Session", "View",
    "build_point_map", "clearly_through", "draw_grid", "fitting_resolution", "moved", "open_saved_map",
    "reach_of", "read_map", "read_ply", "sightings", "write_laz", "write_map", "write_pcd", "write_ply",
    "write_saved_map",
]  # fmt: skip
