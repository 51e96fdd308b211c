"""Lidar logs in, trajectory and map out.

The names below are the Python API; each is imported when it is first used, so that ``import scanchain`` is cheap.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scanchain.config import Config
    from scanchain.data import Match, Scan, State, Step, Trajectory
    from scanchain.errors import InputError, ScanchainError
    from scanchain.graph.pose_graph import PoseGraph
    from scanchain.logs import open_log
    from scanchain.matching import VoxelMap, align, create_matcher, rigid_transform
    from scanchain.odometry import Odometry
    from scanchain.settings import load_settings
    from scanchain.slam import Slam, SlamResult
    from scanchain.trajectory import read_tum, write_tum

_HOMES = {
    "Config": "config",
    "InputError": "errors",
    "Match": "data",
    "Odometry": "odometry",
    "PoseGraph": "graph.pose_graph",
    "Scan": "data",
    "ScanchainError": "errors",
    "Slam": "slam",
    "SlamResult": "slam",
    "State": "data",
    "Step": "data",
    "Trajectory": "data",
    "VoxelMap": "matching",
    "align": "matching",
    "create_matcher": "matching",
    "load_settings": "settings",
    "open_log": "logs",
    "read_tum": "trajectory",
    "rigid_transform": "matching",
    "write_tum": "trajectory",
}

_COMPILED = {
    "Odometry",
    "PoseGraph",
    "Slam",
    "VoxelMap",
    "align",
    "create_matcher",
}  # a minute at first

__all__ = [
    "Config",
    "InputError",
    "Match",
    "Odometry",
    "PoseGraph",
    "Scan",
    "ScanchainError",
    "Slam",
    "SlamResult",
    "State",
    "Step",
    "Trajectory",
    "VoxelMap",
    "align",
    "create_matcher",
    "load_settings",
    "open_log",
    "read_tum",
    "rigid_transform",
    "write_tum",
]


def __dir__() -> list[str]:
    return [*(name for name in globals() if name.startswith("__")), *__all__]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'scanchain' has no attribute {name!r}")
    if name in _COMPILED:
        import_module("scanchain.clock").tell_compilation()
    return globals().setdefault(name, getattr(import_module(f"scanchain.{_HOMES[name]}"), name))
