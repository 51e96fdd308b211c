"""state.checkpoint: the whole state of SLAM after a scan, to resume from."""

from __future__ import annotations

import zlib
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

from scanchain import data
from scanchain.clock import working_s
from scanchain.config import Config
from scanchain.errors import InputError
from scanchain.graph.background import BackgroundOptimization
from scanchain.graph.explanation import Explanation
from scanchain.graph.growing_array import GrowingArray
from scanchain.graph.pose_graph import PoseGraph
from scanchain.graph.robust.loosened import Loosened
from scanchain.graph.robust.update import Since
from scanchain.kernels.voxels.voxel_shapes import Voxels
from scanchain.loops.closer import LoopCloser, ProximityCloser
from scanchain.loops.closure_table import ClosureTable
from scanchain.loops.connectivity import Drift, Segments
from scanchain.loops.evidence import PlaceTest
from scanchain.loops.place_closer import PlaceCloser
from scanchain.loops.relocalization import Find, PlanarSearch, Relocalizer
from scanchain.loops.submaps import VoxelSubmaps
from scanchain.loops.verification import ScanVerifier, SubmapVerifier
from scanchain.odometry import FrontEnd, LiveStamps, Odometry
from scanchain.odometry.elevation import ElevationCalibration
from scanchain.odometry.front_end import KeyframeErrorTracker
from scanchain.odometry.intervals import Intervals
from scanchain.odometry.prediction import ErrorStatistics, MotionFilter, Predictor
from scanchain.odometry.recovery import Recovery
from scanchain.odometry.standstill import AgreeingMatches, Standstill
from scanchain.odometry.tracked import Tracked
from scanchain.point_store import PointStore, StoredPoints
from scanchain.preprocess import Resolution, Sweep
from scanchain.registration import MapKeeper, PointToShapeMatcher, VoxelMap, create_matcher
from scanchain.runs.directory import CHECKPOINT_FILE
from scanchain.runs.provenance import package_version
from scanchain.runs.resume.snapshot import Classes, read_snapshot, write_snapshot
from scanchain.settings import flatten
from scanchain.slam import Slam

_LEISURE = 20.0  # least time between two checkpoints over the time that one takes to write


def _version() -> str:
    """Version of the package and checksum of its code: other code would not give the same bits."""
    package = Path(__file__).parents[2]
    code = b"".join(path.read_bytes() for path in sorted(package.rglob("*.py")))
    return f"scanchain {package_version('scanchain')} (code {zlib.crc32(code):08x})"


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """SLAM after ``scans`` scans, which took ``run_s`` seconds of work.

    The first ``recorded_bytes`` of the recording hold these scans, none where it was not kept whole; ``process``
    numbers the processes that wrote to the run directory, from 0.
    """

    scans: int
    run_s: float
    process: int
    recorded_bytes: int
    slam: Slam


_CLASSES = Classes(
    [
        Checkpoint, Slam, FrontEnd, Odometry, LiveStamps, Predictor, MotionFilter, Intervals,
        ErrorStatistics, Recovery, Standstill, AgreeingMatches, Tracked, ElevationCalibration, MapKeeper,
        Resolution, Sweep, VoxelMap,
        Voxels, PointToShapeMatcher, LoopCloser, ProximityCloser, PlaceCloser, Relocalizer, Find, PlanarSearch,
        VoxelSubmaps, ScanVerifier, SubmapVerifier, Segments, Drift, PoseGraph, Explanation, Loosened,
        GrowingArray, Since, data.KeyframeErrors, KeyframeErrorTracker,
        ClosureTable, PlaceTest, BackgroundOptimization, PointStore, StoredPoints,
        data.Scan, data.Keyframe, data.Closure, data.Match, data.ClosureVerdict, data.Proposal, data.Prior,
        data.State,
        Config, *(type(getattr(Config(), section)) for section in Config.__struct_fields__),
    ],
    {
        (PoseGraph, "_problem"): lambda graph: None,
        (PoseGraph, "_factor_is_now"): lambda graph: False,
        (BackgroundOptimization, "_thread"): lambda beside: None,
        (BackgroundOptimization, "_optimized"): lambda beside: None,
        (BackgroundOptimization, "_error"): lambda beside: None,
        (VoxelSubmaps, "cached"): lambda submaps: OrderedDict(),
        (Relocalizer, "searched"): lambda relocalizer: None,
        (PlaceCloser, "recognizer"): lambda closer: None,
        (PointStore, "file"): lambda store: None,
        (PointStore, "lock"): lambda store: None,
        (PointStore, "waiting"): lambda store: bytearray(),
        (Odometry, "matcher"): lambda odometry: create_matcher(odometry.config.matching),
    },
    _version(),
)  # fmt: skip


class Checkpoints:
    """Writer of checkpoints, at an interval at which they take at most 5 % of the time."""

    def __init__(self, folder: Path, every_s: float, *, run_s: float = 0.0, process: int = 0) -> None:
        """run_s : seconds that the ``process`` earlier processes took up to the checkpoint."""
        self.path = folder / CHECKPOINT_FILE
        self.process = process
        self.every_s = every_s
        self.began_s = working_s() - run_s
        self.next_s = perf_counter() + every_s

    def are_due(self) -> bool:
        """True when it is time for the next."""
        return perf_counter() >= self.next_s

    def write(self, slam: Slam, recorded_bytes: int = 0) -> None:
        """Write one. Raises OSError on a full disk; the last one stays."""
        started = perf_counter()
        run_s = working_s() - self.began_s
        slam.points.flush()
        checkpoint = Checkpoint(len(slam.stamps_ns), run_s, self.process, recorded_bytes, slam)
        write_snapshot(self.path, checkpoint, _CLASSES)
        now = perf_counter()
        self.next_s = now + max(self.every_s, _LEISURE * (now - started))


def read_checkpoint(folder: Path, config: Config) -> Checkpoint:
    """The last checkpoint of a run. Raises InputError for one that is damaged or that other code made.

    config : of the resuming user, with which it must have been made
    """
    words = flatten(config).values()
    checkpoint = read_snapshot(
        folder / CHECKPOINT_FILE, _CLASSES, named=[word for word in words if isinstance(word, str)]
    )
    if checkpoint.slam.config != config:
        raise InputError(f"{folder / CHECKPOINT_FILE}: has another configuration; run again without --resume")
    return checkpoint
