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
from scanchain.loops.recognizer import Candidate
from scanchain.loops.submaps import submap_around
from scanchain.runs.directory import POINTS_FILE
from scanchain.slam import Slam
from tests.support.graphs import chained
from tests.support.killing import taken_up
from tests.support.matching import Assumed
from tests.support.scenes import configured, shared_data, stored
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


class Proposing:
    """A recognizer whose candidates are given; it keeps the submaps and the queries."""

    def __init__(self, propose=lambda query: []):
        self.propose, self.anchors, self.queries = propose, [], []

    def add(self, submap):
        self.anchors.append(submap.anchor)

    def query(self, query):
        self.queries.append(query)
        return self.propose(query)


LINE = [
    Keyframe(k, k, k, stored(np.eye(2)), lie.pose_2d(2.0 * k, 0.0, 0.0), 2.0 * k) for k in range(60)
]  # a keyframe each 2 m; submaps have a radius of 10 m


def proposed(recognizer, is_connected=True, keyframes=LINE):
    """Closures with what a recognizer proposes, each verified as it is; the first half may be another segment."""
    places = LoopCloser(configured(2), 2).places
    places.recognizer, places.verifier = recognizer, Assumed(is_accepted=True)
    connected = np.arange(len(keyframes)) >= (0 if is_connected else 30)
    return places.close(keyframes, chained(keyframes, 0.01), connected, finish=True)


def test_submaps_lie_a_third_of_their_radius_apart_and_none_is_sought_where_it_shares_scans():
    recognizer = Proposing()
    proposed(recognizer)
    assert np.diff([each.traveled_m for each in recognizer.anchors]).tolist() == [4.0] * 29
    segments, old = LoopCloser(configured(2), 2).segments, [each.traveled_m for each in LINE]
    last = [np.searchsorted(old, query.max_traveled_m, side="right") - 1 for query in recognizer.queries]
    assert max(last) == 43
    for query, newest in zip(recognizer.queries, last, strict=True):
        for k in range(newest + 1):
            members = submap_around(LINE, k, query.submap.radius_m, segments).members
            assert members[-1].index < query.submap.members[0].index


def test_a_pose_is_expected_by_odometry_since_the_last_closure_before_the_graph_is_corrected():
    T_target_source = lie.pose_2d(40.5, 0.3, 0.1)
    recognizer = Proposing(lambda query: [Candidate(0, T_target_source, 1.0)][: query.submap.anchor.index == 20])
    (closure,) = proposed(recognizer)
    assert closure.verdict is ClosureVerdict.ACCEPTED
    expected = [query.T_world_anchor for query in recognizer.queries]
    since = [T_target_source @ lie.pose_2d(2.0 * k - 40.0, 0.0, 0.0) for k in range(22, 60, 2)]
    np.testing.assert_allclose(expected[:11], [each.T_odom_lidar for each in LINE[:22:2]], atol=1e-12)
    np.testing.assert_allclose(expected[11:], since, atol=1e-12)


AHEAD, FAR = lie.pose_2d(100.0, 0.0, 0.0), lie.pose_2d(50.0, 0.0, 0.0)  # as odometry has it, and not


@pytest.mark.parametrize(
    ("T", "options", "is_connected", "verdict"),
    [
        (AHEAD, {}, True, "verified by matching"),
        (AHEAD, {"rival": 7}, True, "another keyframe is as similar"),
        (FAR, {}, True, "far from the prediction"),
        (FAR, {}, False, "verified by matching"),  # odometry does not connect them
        (AHEAD, {"proposed_by": Proposal.POSITION}, True, "verified by matching"),
        (AHEAD, {"proposed_by": Proposal.POSITION}, False, None),  # it was not expected there
    ],
)
def test_a_candidate_is_accepted_where_it_has_no_rival_and_odometry_allows_it(T, options, is_connected, verdict):
    recognizer = Proposing(lambda query: [Candidate(0, T, 1.0, **options)][: query.submap.anchor.index == 50])
    closures = proposed(recognizer, is_connected)
    assert [closure.cause for closure in closures] == [verdict] * (verdict is not None)


def test_the_first_keyframe_of_a_log_may_be_recognized_in_all_of_a_map():
    places = LoopCloser(configured(2), 2).places
    places.recognizer = Proposing()
    start_m = places.add_map(LINE)
    keyframes = [*LINE, Keyframe(60, 60, 60, LINE[0].stored, lie.identity(2), start_m)]
    places.close(keyframes, chained(keyframes, 0.01), np.ones(61, bool), finish=True)
    (query,) = places.recognizer.queries
    assert query.max_traveled_m >= LINE[-1].traveled_m
