"""Closures of recognized places; a recognizer of the user's own: loaded by name, queried, checked, resumed."""

import random
import subprocess
import sys
from functools import cache
from itertools import islice

import numpy as np
import pyarrow.parquet as pq
import pytest

from scanchain import lie
from scanchain.data import ClosureVerdict, Keyframe, Proposal
from scanchain.errors import InputError
from scanchain.logs import open_log
from scanchain.loops import LoopCloser
from scanchain.runs.directory import POINTS_FILE
from scanchain.slam import Slam
from tests.support.killing import taken_up
from tests.support.scenes import configured, shared_data
from tests.support.town import graph_of, passage, pose, street

RECOGNIZER = '''
import numpy as np
from scanchain import lie
from scanchain.loops.recognizer import Candidate


class Ranges:
    """Submaps by the histogram of their ranges, the pose by odometry."""

    def __init__(self, config, dimension):
        self.seen = []

    def add(self, submap):
        ranges_m = np.linalg.norm(submap.points(), axis=1)
        histogram, _ = np.histogram(ranges_m, 16, (0.0, submap.radius_m))
        self.seen.append((submap.anchor, histogram / max(np.linalg.norm(histogram), 1e-9)))

    def query(self, query):
        _, histogram = self.seen[-1]
        old = [(float(histogram @ h), a) for a, h in self.seen if a.traveled_m <= query.max_traveled_m]
        best = sorted(old, key=lambda each: -each[0])[:2]
        return [
            Candidate(a.index, lie.between(query.T_world[a.index], query.T_world_anchor), score)
            for score, a in best
        ]


class Careless(Ranges):
    def query(self, query):
        return [Candidate(query.submap.anchor.index, np.eye(3), 1.0)]


class Numbers(Ranges):
    def query(self, query):
        return [3]


class Nothing(Ranges):
    def query(self, query):
        return None


class Mute:
    def __init__(self, config, dimension):
        pass
'''
SMALL = {"loops.place_radius_m": 2.0, "loops.min_travel_m": 8.0}
CSAIL = "2d/mit_csail.mcap"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The working directory, with the module in it; what it adds to the search path is taken back."""
    (tmp_path / "my_places.py").write_text(RECOGNIZER)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield tmp_path
    sys.modules.pop("my_places", None)


def test_a_recognizer_of_ones_own_closes_loops_and_survives_checkpoints_bit_by_bit(folder):
    log = open_log(shared_data(CSAIL))
    config = configured(2, SMALL | {"loops.recognizer": "my_places:Ranges"})
    straight, broken = Slam(config, log.T_base_lidar), Slam(config, log.T_base_lidar, folder / POINTS_FILE)
    breaks = set(random.Random(2).sample(range(600), 4))
    for scan in islice(log.scans(), 600):
        a, b = straight.process(scan), broken.process(scan)
        assert a.T_world_lidar.tobytes() == b.T_world_lidar.tobytes()
        if scan.index in breaks:
            broken = taken_up(broken, folder)
    a, b = straight.finish(), broken.finish()
    accepted = [each for each in a.closures if each.verdict is ClosureVerdict.ACCEPTED]
    assert sum(each.proposed_by is Proposal.PLACE for each in accepted) > 3
    assert [(c.target, c.source, c.verdict) for c in a.closures] == [
        (c.target, c.source, c.verdict) for c in b.closures
    ]
    assert a.trajectory.poses.tobytes() == b.trajectory.poses.tobytes()


@pytest.mark.slow
def test_a_run_finds_it_in_the_working_directory_also_where_python_does_not_look_there(folder):
    command = [sys.executable, "-P", "-m", "scanchain", "run", shared_data(CSAIL), "--out", "run", "--end", "150"]
    command += [word for key, value in SMALL.items() for word in (f"--{key}", str(value))]
    command += ["--loops.recognizer", "my_places:Ranges", "--rerun", "off", "--error-bars", "quick"]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "place" in pq.read_table("run/loops.parquet")["proposed_by"].to_pylist()


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("my_places:Mute", ("my_places:Mute", "no method add")),
        ("my_places:", ("wanted module:Class",)),
        ("ranges", ("one of auto, none, outline", "module:Class")),
        ("outline", ("3D logs",)),
    ],
)
def test_a_name_that_leads_to_no_recognizer_is_refused_with_what_to_do(folder, name, parts):
    with pytest.raises(InputError) as error:
        LoopCloser(configured(2, {"loops.recognizer": name}), 2)
    assert all(part in str(error.value) for part in parts), str(error.value)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("Careless", "candidate 0 for keyframe 0 is not older"),
        ("Numbers", r"query returned 3 among its candidates; wanted scanchain\.loops\.recognizer\.Candidate"),
        ("Nothing", "query returned None; wanted a list of candidates"),
    ],
)
def test_what_is_no_candidate_and_one_that_is_not_older_are_refused(folder, name, said):
    log = open_log(shared_data(CSAIL))
    slam = Slam(configured(2, SMALL | {"loops.recognizer": f"my_places:{name}"}), log.T_base_lidar)
    with pytest.raises(InputError, match=f"my_places:{name}: {said}"):
        for scan in log.scans():
            slam.process(scan)


def test_without_one_nothing_is_loaded_from_the_working_directory(folder):
    before = list(sys.path)
    for name in ("auto", "none"):
        assert LoopCloser(configured(2, {"loops.recognizer": name}), 2).places.recognizer is None
    assert LoopCloser(configured(3), 3).places.recognizer is not None
    assert np.array_equal(before, sys.path)


@cache
def there_and_back(lost_m=0.0):
    """Keyframes of a street, and of it again the other way after a detour, odometry so far off."""
    there = passage(street())
    back = passage(street(4.0, True), len(there), there[-1].traveled_m + 120.0)
    shift = pose(lost_m, 0.5 * lost_m, yaw=0.02 * lost_m)
    moved = [
        Keyframe(k.index, k.scan_index, k.stamp_ns, k.stored, shift @ k.T_odom_lidar, k.traveled_m) for k in back
    ]
    return [*there, *moved], [k.T_odom_lidar for k in (*there, *back)]


@pytest.mark.parametrize("lost_m", [0.0, 8.0])
def test_a_street_driven_the_other_way_is_recognized_wherever_odometry_has_it(lost_m):
    keyframes, truth = there_and_back(lost_m)
    closer = LoopCloser(configured(3), 3).places
    accepted = [
        closure
        for k in range(1, len(keyframes) + 1)
        for closure in closer.close(
            keyframes[:k], graph_of(keyframes[:k]), np.ones(k, bool), finish=k == len(keyframes)
        )
        if closure.verdict is ClosureVerdict.ACCEPTED
    ]
    assert len(accepted) >= 3
    for closure in accepted:
        true = lie.inverse(truth[closure.target]) @ truth[closure.source]
        assert np.linalg.norm((lie.inverse(true) @ closure.match.T_target_source)[:3, 3]) < 0.2


@pytest.mark.parametrize(("sigma_rad", "are_refused"), [(0.002, True), (0.2, False)])
def test_a_place_is_refused_that_odometry_cannot_have_missed_by_so_much(monkeypatch, sigma_rad, are_refused):
    monkeypatch.setattr("scanchain.loops.recognizer.PLACE_DRIFT", 0.001)
    keyframes, _ = there_and_back(8.0)
    closures = LoopCloser(configured(3), 3).places.close(
        keyframes, graph_of(keyframes, sigma_rad), np.ones(len(keyframes), bool), finish=True
    )
    assert closures and all("of the path between" in closure.reason for closure in closures) == are_refused
