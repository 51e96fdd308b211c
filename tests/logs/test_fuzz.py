"""Thousands of damaged logs, messages and runs, from a fixed seed; tests/benchmarks/fuzz.py reads more of them."""

import numpy as np
import pytest

from tests.support import fuzzing, fuzzing_formats, fuzzing_runs

MAKES, FORMATS = 13, 20
MESSAGES = 500
CASES = {fuzzing.McapSeed: 50, fuzzing.Seed: 10}  # of files in MCAP, and four cuts at every record; others


@pytest.fixture(scope="module")
def seeds(tmp_path_factory):
    mcap = [*fuzzing.seeds(tmp_path_factory.mktemp("mcap"))]
    formats = [*fuzzing_formats.seeds(tmp_path_factory.mktemp("formats"))]
    assert (len(mcap), len(formats)) == (MAKES, FORMATS)
    assert {len(seed.scans) for seed in formats} == {fuzzing_formats.SCANS}
    return mcap + formats


def said(seed, rng, count):
    return [f"{name}: {damaged.what}: {wrong}" for name, damaged, wrong in fuzzing.complaints(seed, rng, count)]


@pytest.mark.parametrize("number", range(MAKES + FORMATS))
def test_damaged_logs_are_read_in_bounds_and_all_that_is_whole_is_recovered(seeds, number):
    seed, random = seeds[number], np.random.default_rng(number if number < MAKES else number - MAKES)
    assert said(seed, random, CASES[type(seed)]) == []


@pytest.mark.parametrize("name", fuzzing.REAL)
def test_of_real_logs_cut_off_with_bits_flipped_every_untouched_scan_is_read_and_none_is_invented(tmp_path, name):
    (seed,) = fuzzing.real_seeds(tmp_path, [name])
    assert said(seed, np.random.default_rng(3), 5) == []


def test_damaged_messages_are_decoded_or_called_malformed(tmp_path):
    assert list(fuzzing.payload_complaints(tmp_path, np.random.default_rng(0), MESSAGES)) == []


@pytest.mark.parametrize(
    ("complaints", "count"), [(fuzzing_runs.run_complaints, 100), (fuzzing_runs.checkpoint_complaints, 20)]
)
def test_damaged_run_directories_are_refused_in_a_line_and_runs_go_on_from_them_to_the_same(
    tmp_path, complaints, count
):
    assert [wrong for wrong, _ in complaints(tmp_path, np.random.default_rng(0), count)] == []


def test_a_reader_that_loses_a_chunk_is_found_out(seeds, monkeypatch):
    whole = fuzzing.read

    def forgetful(seed):
        scans, told = whole(seed)
        return scans[:-1], told

    monkeypatch.setattr(fuzzing, "read", forgetful)
    for seed in (seeds[0], seeds[MAKES]):
        assert said(seed, np.random.default_rng(0), 20)
