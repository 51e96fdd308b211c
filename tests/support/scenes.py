"""What several tests share: where the real logs lie."""

import os
import tomllib
from itertools import islice
from pathlib import Path

import msgspec
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


def stored(points) -> StoredPoints:
    """Points of a keyframe, in a store of their own."""
    return PointStore(points.shape[1]).add(points)
