"""Streams of samples next to the scans: looked up by stamp, whatever the sensor."""

from typing import NamedTuple

import pytest

from scanchain.logs.samples import SampleStream


class Turn(NamedTuple):
    """A gyroscope's reading."""

    stamp_ns: int
    rate_rad_s: float

    def interpolate(self, later, stamp_ns):
        share = (stamp_ns - self.stamp_ns) / (later.stamp_ns - self.stamp_ns)
        return Turn(stamp_ns, self.rate_rad_s + share * (later.rate_rad_s - self.rate_rad_s))


@pytest.fixture
def stream():
    stream = SampleStream()
    for time_ms in (0, 20, 10, 30, 900):  # logged out of order
        stream.add(Turn(time_ms * 1_000_000, 1e-3 * time_ms))
    return stream


def test_samples_are_sorted_by_stamp_whatever_the_order_of_the_log(stream):
    assert [each.rate_rad_s for each in stream.between(10_000_000, 30_000_000)] == [0.01, 0.02, 0.03]
    assert stream.between(31_000_000, 899_000_000) == []


def test_a_stamp_is_covered_once_a_sample_is_at_or_after_it(stream):
    assert stream.covers(900_000_000) and not stream.covers(900_000_001) and not SampleStream().covers(0)


def test_a_sample_is_interpolated_between_neighbors_within_half_a_second_else_the_nearest(stream):
    assert stream.at(20_000_000).rate_rad_s == 0.02
    assert stream.at(14_000_000).rate_rad_s == pytest.approx(0.014)
    assert stream.at(100_000_000).stamp_ns == 30_000_000  # the next is 0.8 s away
    assert stream.at(1_500_000_000) is None and SampleStream().at(0) is None


def test_a_clock_that_jumps_back_removes_the_samples_before(stream):
    stream.add(Turn(100_000_000, 0.5))
    assert stream.between(0, 10**9) == [Turn(100_000_000, 0.5)]


def test_memory_holds_the_latest_samples_only():
    stream = SampleStream()
    for stamp_ns in range(5000):
        stream.add(Turn(stamp_ns, 0.0))
    assert stream.at(0).stamp_ns > 0 and len(stream.between(0, 5000)) == 4096
