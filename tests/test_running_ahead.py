"""Scans located ahead come in their order, with whatever went wrong in its place, and wait when asked to."""

import threading
import time

import pytest

from pipeline.runs.running_ahead import _AHEAD, InTurn, RunningAhead


class FrontEnd:
    """Passes numbers on; notes them, and chokes on one."""

    def __init__(self, chokes_on=-1):
        self.seen, self.chokes_on = [], chokes_on

    def locate(self, scan):
        if scan == self.chokes_on:
            raise ValueError("choked")
        self.seen.append(scan)
        return scan


both = pytest.mark.parametrize("locating", [InTurn, RunningAhead])


def failing_after(count, error):
    yield from range(count)
    raise error


@both
def test_scans_come_in_their_order(locating):
    with locating(FrontEnd(), range(200)) as located:
        assert list(located) == list(range(200))


@both
@pytest.mark.parametrize("error", [ValueError("the log"), KeyboardInterrupt()])
def test_an_error_of_the_log_comes_after_what_came_before_it(error, locating):
    placed = []
    with pytest.raises(type(error)), locating(FrontEnd(), failing_after(20, error)) as located:
        for scan in located:
            time.sleep(0.001)
            placed.append(scan)
    assert placed == list(range(20))


@both
def test_an_error_of_the_front_end_ends_it_after_what_came_before(locating):
    front_end, placed = FrontEnd(chokes_on=7), []
    with pytest.raises(ValueError, match="choked"), locating(front_end, range(20)) as located:
        for scan in located:
            placed.append(scan)
    assert placed == front_end.seen == list(range(7))


def test_it_is_so_far_ahead_and_no_further():
    front_end = FrontEnd()
    with RunningAhead(front_end, range(500)) as located:
        next(iter(located))
        time.sleep(0.2)
        assert len(front_end.seen) == _AHEAD


@both
def test_at_rest_all_that_was_located_is_placed(locating):
    front_end, placed, rests = FrontEnd(), [], []
    with locating(front_end, range(300)) as located:
        located.at_rest(
            lambda: rests.append((len(front_end.seen), len(placed))), when=lambda: len(placed) % 50 > 40
        )
        for scan in located:
            time.sleep(0.0005)
            placed.append(scan)
    assert len(rests) >= 3 and all(seen == done for seen, done in rests)
    assert placed == list(range(300))


@pytest.mark.parametrize("is_resting", [False, True])
def test_left_early_it_ends_its_thread(is_resting):
    before = threading.active_count()
    with pytest.raises(RuntimeError), RunningAhead(FrontEnd(), range(10_000)) as located:
        if is_resting:
            located.at_rest(lambda: None, when=lambda: True)
        for scan in located:
            if scan == 5:
                raise RuntimeError
    assert threading.active_count() == before
