"""What several tests share: real logs, configurations, and points of rooms and streets."""

import os
import tomllib
from itertools import islice
from pathlib import Path

import msgspec
import numpy as np
import pytest

from scanchain.config import Config
from scanchain.logs import open_log
from scanchain.point_store import PointStore, StoredPoints

SHORT_WINDOWS = {2: 12, 3: 4}  # scans that error bars are measured on, where nothing is tested of them
ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("SCANCHAIN_DATA", ROOT.parent / "shared" / "data"))


def shared_data(name: str) -> Path:
    """Path of a real recording, or a skip that says what is missing."""
    path = DATA / name
    if not path.exists():
        pytest.skip(f"{path} is absent: real recordings are not part of the project (set SCANCHAIN_DATA)")
    return path


def kitti_scans(count):
    """The first sweeps of KITTI 0001, which has ground truth."""
    return list(islice(open_log(shared_data("3d/kitti_0001_first54.mcap")).scans(), count))


def configured(dimension, changes=None):
    """The preset of a dimension, some keys changed."""
    preset = ROOT / "configs" / f"lidar{dimension}d.toml"
    tree = msgspec.to_builtins(Config())
    for section, keys in tomllib.loads(preset.read_text()).items():
        tree[section] |= keys
    for key, value in (changes or {}).items():
        section, name = key.split(".")
        tree[section][name] = value
    return msgspec.convert(tree, Config)


def square(half_m):
    """A room around the lidar."""
    along = np.linspace(-half_m, half_m, 200)
    sides = [np.column_stack([along, np.full(200, side)]) for side in (-half_m, half_m)]
    return np.vstack([*sides, *(side[:, ::-1] for side in sides)])


def stored(points) -> StoredPoints:
    """Points of a keyframe, in a store of their own."""
    return PointStore(points.shape[1]).add(points)


def walls(rng, count, side_m):
    """Points along walls that run with the axes."""
    lines = []
    for _ in range(count):
        start, axis = rng.uniform(0.0, side_m, 2), rng.integers(2)
        line = np.tile(start, (20, 1))
        line[:, axis] += np.linspace(0.0, 0.3 * side_m, 20)
        lines.append(line)
    return np.concatenate(lines)


def sloping_street(rng):
    """Points of a sloping ground of 80 x 80 m and of walls on it, dense in their height."""
    ground = rng.uniform(-40.0, 40.0, (30_000, 2))
    feet = walls(rng, 12, 60.0) - 30.0
    high = np.repeat(feet, 12, axis=0)
    ground, high = (np.column_stack([xy, 0.05 * xy[:, 0] - 1.7]) for xy in (ground, high))
    high[:, 2] += np.tile(np.linspace(0.0, 4.0, 12), len(feet))
    return ground, high
