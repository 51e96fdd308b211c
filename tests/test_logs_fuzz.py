"""Thousands of damaged logs and messages, from a fixed seed; tests/benchmarks/fuzz.py reads more of them."""

import fuzzing
import numpy as np
import pytest

MAKES = 13
FILES_OF_A_MAKE = 200  # and four cuts at every record: 6,000 files in all
MESSAGES = 3000


@pytest.mark.parametrize("make", range(MAKES))
def test_damaged_files_are_read_in_bounds_and_all_that_is_whole_is_recovered(tmp_path, make):
    seeds = list(fuzzing.seeds(tmp_path))
    assert len(seeds) == MAKES
    bad = fuzzing.file_complaints(seeds[make], np.random.default_rng(make), FILES_OF_A_MAKE)
    assert [f"{damaged.what}: {wrong}" for damaged, wrong in bad] == []


def test_damaged_messages_are_decoded_or_called_malformed(tmp_path):
    assert list(fuzzing.payload_complaints(tmp_path, np.random.default_rng(0), MESSAGES)) == []


def test_a_reader_that_loses_a_chunk_is_found_out(tmp_path, monkeypatch):
    seed = next(fuzzing.seeds(tmp_path))
    whole = fuzzing.read

    def forgetful(path):
        scans, told = whole(path)
        return scans[:-1], told

    monkeypatch.setattr(fuzzing, "read", forgetful)
    assert list(fuzzing.file_complaints(seed, np.random.default_rng(0), 20))
