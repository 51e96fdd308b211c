"""Odometries made by others, behind one verb, by name."""

from __future__ import annotations

from collections.abc import Callable

from pipeline.baselines.baseline import Baseline
from pipeline.baselines.genz import GenzIcp
from pipeline.baselines.gicp import SmallGicpModel, SmallGicpPairs
from pipeline.baselines.kiss import KissIcp
from pipeline.baselines.open3d_pairs import Open3dPairs
from pipeline.errors import InputError

__all__ = ["Baseline", "create", "names"]

_MAKERS: dict[str, Callable[[], Baseline]] = {
    "kiss-icp": KissIcp,
    "small-gicp": SmallGicpModel,
    "small-gicp-pairs": SmallGicpPairs,
    "genz-icp": GenzIcp,
    "genz-icp-indoor": lambda: GenzIcp("indoor"),
    "genz-icp-kitti": lambda: GenzIcp("kitti"),
    "open3d-p2l": lambda: Open3dPairs("point-to-plane"),
    "open3d-p2p": lambda: Open3dPairs("point-to-point"),
}


def names() -> tuple[str, ...]:
    """The baselines there are, for 3D scans."""
    return tuple(_MAKERS)


def create(name: str) -> Baseline:
    """A fresh baseline; its package is imported here and not before."""
    if name not in _MAKERS:
        raise InputError(f"there is no baseline {name!r}; choose among {', '.join(_MAKERS)}")
    return _MAKERS[name]()
