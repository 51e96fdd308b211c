"""Maps of the world: a point cloud and an occupancy grid, written in formats others read."""

from pipeline.maps.map_files import read_map, write_map
from pipeline.maps.occupancy_grid import OccupancyGrid, draw_grid, fitting_resolution
from pipeline.maps.ply import read_ply, write_ply
from pipeline.maps.point_map import PointMap, build_point_map

__all__ = [
    "OccupancyGrid",
    "PointMap",
    "build_point_map",
    "draw_grid",
    "fitting_resolution",
    "read_map",
    "read_ply",
    "write_map",
    "write_ply",
]
