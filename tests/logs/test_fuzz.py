"""Thousands of damaged logs and messages, from a fixed seed; tests/benchmarks/fuzz.py reads more of them."""

import numpy as np
import pytest

from tests.support import fuzzing, fuzzing_formats

MAKES = 13
FORMATS = 20
SHARES = [pytest.param(2, id="half"), pytest.param(1, id="all", marks=pytest.mark.slow)]
FILES_OF_A_MAKE = 300  # and four cuts at every record
LOGS_OF_A_FORMAT = 60
MESSAGES = 3000


@pytest.fixture(scope="module")
def seeds(tmp_path_factory):
    return list(fuzzing.seeds(tmp_path_factory.mktemp("mcap")))


@pytest.fixture(scope="module")
def formats(tmp_path_factory):
    return list(fuzzing_formats.seeds(tmp_path_factory.mktemp("formats")))


def test_the_corpus_is_as_large_as_it_should_be(seeds, formats):
    assert len(seeds) == MAKES and len(formats) == FORMATS


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("make", range(MAKES))
def test_damaged_files_are_read_in_bounds_and_all_that_is_whole_is_recovered(seeds, make, share):
    bad = fuzzing.file_complaints(seeds[make], np.random.default_rng(make), FILES_OF_A_MAKE // share)
    assert [f"{damaged.what}: {wrong}" for damaged, wrong in bad] == []


@pytest.mark.parametrize("name", fuzzing.REAL)
def test_of_real_logs_cut_off_with_bits_flipped_every_untouched_scan_is_read_and_none_is_invented(tmp_path, name):
    bad = fuzzing.real_complaints(name, tmp_path, np.random.default_rng(3), 5)
    assert [f"{damaged.what}: {wrong}" for damaged, wrong in bad] == []


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("number", range(FORMATS))
def test_so_are_damaged_logs_of_any_other_format(formats, number, share):
    bad = fuzzing_formats.complaints(formats[number], np.random.default_rng(number), LOGS_OF_A_FORMAT // share)
    assert [f"{name}: {damaged.what}: {wrong}" for name, damaged, wrong in bad] == []


@pytest.mark.parametrize("share", SHARES)
def test_damaged_messages_are_decoded_or_called_malformed(tmp_path, share):
    assert list(fuzzing.payload_complaints(tmp_path, np.random.default_rng(0), MESSAGES // share)) == []


def test_a_reader_that_loses_a_chunk_is_found_out(seeds, formats, monkeypatch):
    def forgetful(whole):
        def read(*log):
            scans, told = whole(*log)
            return scans[:-1], told

        return read

    for module, bad, seed in (
        (fuzzing, fuzzing.file_complaints, seeds[0]),
        (fuzzing_formats, fuzzing_formats.complaints, formats[0]),
    ):
        monkeypatch.setattr(module, "read", forgetful(module.read))
        assert list(bad(seed, np.random.default_rng(0), 20))
