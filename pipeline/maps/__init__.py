"""Maps of the world: a point cloud and an occupancy grid, written in formats others read."""

from pipeline.maps.map_files import grid_image, write_map, write_png
from pipeline.maps.occupancy_grid import OccupancyGrid, draw_grid, fitting_resolution
from pipeline.maps.ply import write_ply
from pipeline.maps.point_map import PointMap, build_point_map

__all__ = [
    "OccupancyGrid",
    "PointMap",
    "build_point_map",
    "draw_grid",
    "fitting_resolution",
    "grid_image",
    "write_map",
    "write_ply",
    "write_png",
]
