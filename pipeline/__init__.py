"""Lidar logs in, trajectory and map out.

The names below are the Python API; each is imported when it is first used, so that ``import scanchain`` is cheap.
"""

from __future__ import annotations

TYPE_CHECKING = False  # that of typing, whose import is a moment in which Ctrl-C would show a traceback
if TYPE_CHECKING:
    from typing import Any

    from scanchain.api import changes, compare, downsample, localize, merge, optimize, run
    from scanchain.config import Config
    from scanchain.data import Match, Scan, State, Step, Trajectory
    from scanchain.errors import InputError, ScanchainError
    from scanchain.evaluation.metrics import evaluate
    from scanchain.graph.files.g2o import read_g2o
    from scanchain.graph.files.g2o_write import write_g2o
    from scanchain.graph.pose_graph import PoseGraph
    from scanchain.logs import open_log
    from scanchain.odometry import Odometry
    from scanchain.registration import VoxelMap, align, create_matcher, rigid_transform
    from scanchain.sessions.localizer import Localizer
    from scanchain.settings import load_settings
    from scanchain.simulation import simulate
    from scanchain.slam import Slam, SlamResult
    from scanchain.trajectory import read_tum, write_tum

_HOMES = {
    "Config": "config",
    "InputError": "errors",
    "Localizer": "sessions.localizer",
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
    "VoxelMap": "registration",
    "align": "registration",
    "changes": "api",
    "compare": "api",
    "create_matcher": "registration",
    "downsample": "api",
    "evaluate": "evaluation.metrics",
    "load_settings": "settings",
    "localize": "api",
    "merge": "api",
    "open_log": "logs",
    "optimize": "api",
    "read_g2o": "graph.files.g2o",
    "read_tum": "trajectory",
    "rigid_transform": "registration",
    "run": "api",
    "simulate": "simulation",
    "write_g2o": "graph.files.g2o_write",
    "write_tum": "trajectory",
}

_COMPILED = {
    "Localizer",
    "Odometry",
    "PoseGraph",
    "Slam",
    "VoxelMap",
    "align",
    "changes",
    "compare",
    "create_matcher",
    "downsample",
    "evaluate",
    "localize",
    "merge",
    "run",
    "simulate",
}

__all__ = [
    "Config",
    "InputError",
    "Localizer",
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
    "changes",
    "compare",
    "create_matcher",
    "downsample",
    "evaluate",
    "load_settings",
    "localize",
    "merge",
    "open_log",
    "optimize",
    "read_g2o",
    "read_tum",
    "rigid_transform",
    "run",
    "simulate",
    "write_g2o",
    "write_tum",
]


def __dir__() -> list[str]:
    return [*(name for name in globals() if name.startswith("__")), *__all__]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'scanchain' has no attribute {name!r}")
    from importlib import import_module

    if name in _COMPILED:
        import_module("scanchain.clock").warn_of_compilation()
    return globals().setdefault(name, getattr(import_module(f"scanchain.{_HOMES[name]}"), name))
