"""Odometries by others behind one protocol, by name.

A new one is a file with a class as ``Baseline`` describes it and a line in ``BASELINES``. Outside the
package, ``scanchain compare --methods my_module:MyClass`` runs a class of yours, given its table of --config as
keywords.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from msgspec import Struct

from scanchain.baselines.baseline import Baseline, InPlane
from scanchain.baselines.genz import GENZ, GenzIcp, GenzSettings
from scanchain.baselines.gicp import GICP, PLANAR_GICP, PLANAR_VGICP, VGICP, SmallGicpModel, SmallGicpPairs
from scanchain.baselines.kiss import KISS, PLANAR_KISS, KissIcp
from scanchain.baselines.open3d_pairs import OPEN3D, PLANAR_OPEN3D, Open3dPairs, Residual
from scanchain.errors import InputError

__all__ = ["BASELINES", "Baseline", "Entry", "InPlane", "create", "find", "names"]


@dataclass(frozen=True, slots=True)
class Entry:
    """A registered baseline.

    Attributes
    ----------
    make : constructor, given the settings; the package is imported there and not before
    package : distribution whose version is reported
    settings : for 3D scans; planar: for 2D ones, None where it makes no sense for these: nothing sets point-to-
        plane the height, and GenZ-ICP's voxels grow until a scan has thousands of points
    is_raised : whether a 2D scan must be given height, because surfaces are looked for
    forgets : whether a second instance in a process is independent of the first
    """

    make: Callable[[Any], Baseline]
    package: str
    settings: Struct
    planar: Struct | None
    is_raised: bool = False
    forgets: bool = True


def _open3d(residual: Residual, planar: Struct | None, *, is_raised: bool = False) -> Entry:
    return Entry(partial(Open3dPairs, residual), "open3d", OPEN3D, planar, is_raised)


BASELINES: dict[str, Entry] = {
    "open3d-p2p": _open3d("point-to-point", PLANAR_OPEN3D),
    "open3d-p2l": _open3d("point-to-plane", None),
    "open3d-gicp": _open3d("plane-to-plane", PLANAR_OPEN3D, is_raised=True),
    "kiss-icp": Entry(KissIcp, "kiss-icp", KISS, PLANAR_KISS),
    "small-gicp": Entry(SmallGicpPairs, "small-gicp", GICP, PLANAR_GICP, is_raised=True),
    "small-vgicp": Entry(SmallGicpModel, "small-gicp", VGICP, PLANAR_VGICP, is_raised=True),
    "genz-icp": Entry(GenzIcp, "genz-icp", GENZ, None, forgets=False),
    "genz-icp-indoor": Entry(GenzIcp, "genz-icp", GenzSettings("indoor"), None, forgets=False),
    "genz-icp-kitti": Entry(GenzIcp, "genz-icp", GenzSettings("kitti"), None, forgets=False),
}


def names() -> tuple[str, ...]:
    """Names of all baselines."""
    return tuple(BASELINES)


def find(name: str) -> Entry:
    """Entry of a baseline. Raises InputError for an unknown name."""
    if name not in BASELINES:
        raise InputError(f"there is no baseline {name!r}; choose among {', '.join(BASELINES)}")
    return BASELINES[name]


def create(name: str) -> Baseline:
    """A fresh baseline for 3D scans, as its authors recommend it."""
    entry = find(name)
    return entry.make(entry.settings)
