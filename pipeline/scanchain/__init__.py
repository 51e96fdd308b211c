"""Lidar logs in, trajectory and map out.

The names below are the Python API; each is imported when it is first used, so that ``import scanchain`` is cheap.
"""

from __future__ import annotations

TYPE_CHECKING = False  # not typing's: Ctrl-C during that import would show a traceback
if TYPE_CHECKING:  # "as" says that the name is public here
    from typing import Any

    from scanchain import evaluation as evaluation
    from scanchain import lie as lie
    from scanchain.api import changes as changes
    from scanchain.api import cloud as cloud
    from scanchain.api import compare as compare
    from scanchain.api import downsample as downsample
    from scanchain.api import judge as judge
    from scanchain.api import localize as localize
    from scanchain.api import merge as merge
    from scanchain.api import optimize as optimize
    from scanchain.api import run as run
    from scanchain.config import Config as Config
    from scanchain.data import Fixes as Fixes
    from scanchain.data import Inertial as Inertial
    from scanchain.data import Match as Match
    from scanchain.data import Scan as Scan
    from scanchain.data import State as State
    from scanchain.data import Step as Step
    from scanchain.data import Trajectory as Trajectory
    from scanchain.errors import InputError as InputError
    from scanchain.errors import ScanchainError as ScanchainError
    from scanchain.evaluation.metrics import evaluate as evaluate
    from scanchain.georeference import Georeference as Georeference
    from scanchain.graph.g2o import read_g2o as read_g2o
    from scanchain.graph.g2o import write_g2o as write_g2o
    from scanchain.graph.pose_graph import PoseGraph as PoseGraph
    from scanchain.logs import open_log as open_log
    from scanchain.odometry import Odometry as Odometry
    from scanchain.registration import VoxelMap as VoxelMap
    from scanchain.registration import create_matcher as create_matcher
    from scanchain.registration import rigid_transform as rigid_transform
    from scanchain.registration.align import align as align
    from scanchain.sessions.localizer import Localizer as Localizer
    from scanchain.settings import load_settings as load_settings
    from scanchain.simulation import simulate as simulate
    from scanchain.slam import Slam as Slam
    from scanchain.slam import SlamResult as SlamResult
    from scanchain.trajectory import read_tum as read_tum
    from scanchain.trajectory import write_tum as write_tum

    __version__: str

_MODULES = {
    "api": "changes cloud compare downsample judge localize merge optimize run",
    "config": "Config",
    "data": "Fixes Inertial Match Scan State Step Trajectory",
    "errors": "InputError ScanchainError",
    "evaluation.metrics": "evaluate",
    "georeference": "Georeference",
    "graph.g2o": "read_g2o write_g2o",
    "graph.pose_graph": "PoseGraph",
    "logs": "open_log",
    "odometry": "Odometry",
    "registration": "VoxelMap create_matcher rigid_transform",
    "registration.align": "align",
    "sessions.localizer": "Localizer",
    "settings": "load_settings",
    "simulation": "simulate",
    "slam": "Slam SlamResult",
    "trajectory": "read_tum write_tum",
}
_HOMES = {name: module for module, names in _MODULES.items() for name in names.split()}
__all__ = sorted(_HOMES)  # pyright: ignore[reportUnsupportedDunderAll]


def __dir__() -> list[str]:
    return [*(name for name in globals() if name.startswith("__")), "__version__", "evaluation", "lie", *__all__]


def __getattr__(name: str) -> Any:
    import sys
    from importlib import import_module, metadata

    if name == "__version__":
        return metadata.version("scanchain")
    if name in ("evaluation", "lie"):
        return import_module(f"scanchain.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module 'scanchain' has no attribute {name!r}")
    value = getattr(import_module(f"scanchain.{_HOMES[name]}"), name)
    if "numba" in sys.modules:  # calling the value may compile kernels
        import_module("scanchain.clock").warn_of_compilation()
    return globals().setdefault(name, value)
