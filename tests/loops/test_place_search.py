"""The schedule of searches for the newest segment among older keyframes, with a finder that counts."""

from types import SimpleNamespace

import numpy as np
import pytest

from scanchain import lie
from scanchain.data import Closure, ClosureVerdict, Keyframe
from scanchain.loops.connectivity import Segments
from scanchain.loops.place_search import PlaceSearch, candidates, completed
from scanchain.registration.search import Found


class Counting:
    """A finder whose searches take some scans each; ``found`` and ``drawn`` are what it was called with."""

    first_m, least_m, most_m, match_m = 3.0, 1.0, 5.0, 2.0

    def __init__(self, scans=1):
        self.scans, self.drawn, self.found = scans, [], []

    def draw(self, keyframes, folder=None):
        self.drawn.append([each.index for each in keyframes])
        return self.drawn[-1]

    def find(self, keyframes, start, target):
        self.found.append((keyframes[-1].index, start, target))
        for _ in range(self.scans - 1):
            yield
        return ["closure"]


KEYFRAMES = [Keyframe(k, k, k, None, lie.pose_2d(float(k), 0.0, 0.0), float(k)) for k in range(80)]
POSES = np.array([each.T_odom_lidar for each in KEYFRAMES])


def closed(search, count, components):
    """Closures after the first so many keyframes, a meter apart, of these components."""
    return search.close(KEYFRAMES[:count], SimpleNamespace(poses=POSES[:count]), np.asarray(components)[:count])


def begun(finder, *starts):
    """The search for a segment behind others, and the numbers of the segments."""
    segments = Segments()
    for start in starts:
        segments.start(start)
    return PlaceSearch(finder, segments), segments.of(np.arange(80))


def test_searches_come_a_fifth_of_the_path_apart_within_their_limits():
    finder = Counting()
    search, components = begun(finder, 10)
    for count in range(11, 81):
        closed(search, count, components)
    newest, wanted = 13.0, []
    while newest < 80.0:
        wanted.append(int(newest))
        newest = np.ceil(newest + np.clip(0.2 * (newest - 10.0), 1.0, 5.0))
    assert [each for each, _, _ in finder.found] == wanted
    assert {(start, *target) for _, start, target in finder.found} == {(10, *range(10))}


def test_a_search_takes_its_scans_and_no_other_begins_before_it_is_done():
    finder = Counting(scans=3)
    search, components = begun(finder, 10)
    for count in range(11, 15):
        assert closed(search, count, components) == ()
    assert search.underway is not None and closed(search, 16, components) == ()
    assert [search.advance() for _ in range(3)] == [(), ("closure",), ()]
    assert len(finder.found) == 1
    closed(search, 17, components)
    assert len(finder.found) == 2 and search.finish() == ("closure",) and search.finish() == ()
    closed(search, 19, components)
    search.skip()
    assert len(finder.found) == 3 and search.underway is None and search.advance() == ()
    closed(search, 21, components)
    joined = np.zeros(22, int)
    assert len(finder.found) == 4 and closed(search, 22, joined) == () and search.underway is None


def test_components_take_turns_and_each_is_preprocessed_again_only_where_its_poses_changed():
    finder = Counting()
    search, components = begun(finder, 4, 10)
    for count in range(11, 24):
        closed(search, count, components)
    of_first, of_second = [0, 1, 2, 3], [4, 5, 6, 7, 8, 9]
    targets = [target for _, _, target in finder.found]
    assert len(targets) > 4 and targets[::2] == [of_first] * len(targets[::2])
    assert targets[1::2] == [of_second] * len(targets[1::2])
    finder.drawn.clear()
    search.segments.starts = [0, 10]  # now of one component
    components = search.segments.of(np.arange(80))
    for count in range(24, 40):
        closed(search, count, components)
    assert finder.drawn == [[*range(10)]] and len(finder.found) > len(targets) + 2


@pytest.mark.parametrize("verdict", [ClosureVerdict.ACCEPTED, ClosureVerdict.REJECTED])
def test_a_log_in_a_map_is_searched_for_again_once_it_has_not_matched_it_for_a_while(verdict):
    finder = Counting()
    search, _ = begun(finder, 10)
    search.add_map(KEYFRAMES[:10], None)
    joined = np.zeros(80, int)
    for count in range(11, 81):
        if count == 16:
            search.record(KEYFRAMES[:count], [Closure(10, 15, None, 1.0, verdict, "")])  # not with the map
            assert not search.is_tracking(KEYFRAMES[:count])
            search.record(KEYFRAMES[:count], [Closure(3, 15, None, 1.0, verdict, "")])
            is_matched = verdict is ClosureVerdict.ACCEPTED
            assert [search.has_just_matched(KEYFRAMES[:end]) for end in (16, 17, 18)] == [is_matched] * 2 + [False]
            assert [search.is_tracking(KEYFRAMES[:end]) for end in (16, 36, 37)] == [is_matched] * 2 + [False]
        closed(search, count, joined)
    searched = [newest for newest, _, _ in finder.found]
    assert searched[:2] == [13, 36 if is_matched else 18] and max(searched) > 70
    assert finder.drawn == [[*range(10)]]
    search.record(KEYFRAMES, [Closure(3, 79, None, 1.0, ClosureVerdict.ACCEPTED, "")])
    search.search_again()
    assert not search.is_tracking(KEYFRAMES)


def test_candidates_are_refined_after_the_slices_of_their_search_and_the_best_come_first():
    poses = [lie.pose_2d(float(k), 0.0, 0.0) for k in range(4)]
    shares = {0.0: [0.3], 1.0: [], 2.0: [0.9, 0.5], 3.0: [0.7]}
    search = SimpleNamespace(slices=0, is_done=False, poses=lambda: [Found(T, 0.0) for T in poses])

    def advance():
        search.slices += 1
        search.is_done = search.slices == 3

    search.advance = advance

    def refine(T):
        assert search.is_done
        return [Found(T, share) for share in shares[T[0, 2]]]

    best = completed(candidates(search, refine))
    assert [each.share for each in best] == [0.9, 0.7, 0.5, 0.3]
    search.slices, search.is_done = 0, False
    assert len([*candidates(search, refine)]) == 2
