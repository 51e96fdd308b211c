"""Maps of the world: a point cloud and an occupancy grid, written in formats others read."""

from scanchain.maps.laz import write_laz
from scanchain.maps.map_files import read_map, write_map
from scanchain.maps.moving import View, moved
from scanchain.maps.occupancy_grid import OccupancyGrid, draw_grid, fitting_resolution
from scanchain.maps.pcd import write_pcd
from scanchain.maps.ply import read_ply, write_ply
from scanchain.maps.point_map import PointMap, build_point_map

__all__ = [
    "OccupancyGrid",
    "PointMap",
    "View",
    "build_point_map",
    "draw_grid",
    "fitting_resolution",
    "moved",
    "read_map",
    "read_ply",
    "write_laz",
    "write_map",
    "write_pcd",
    "write_ply",
]
