"""A server or a notebook that makes many runs: threads, files and errors of the runs before are not retained."""

import gc
import multiprocessing
import os
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest

import scanchain
from scanchain import InputError
from tests.support import made

pytestmark = pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs Linux's /proc")


class Failing:
    """A matcher that fails."""

    def __init__(self, config):
        pass

    def align(self, *_, **__):
        raise ValueError("no more")


def threads():
    return len(os.listdir("/proc/self/task"))


def files():
    """Open files by name; what is no file, as rerun's sockets, left out."""
    names = [os.readlink(file) for file in Path("/proc/self/fd").iterdir() if file.is_symlink()]
    return Counter(name for name in names if name.startswith("/"))


def after_runs(log, folder, numbers):
    """Threads and open files of this process after so many runs, and so many more, ..."""
    found = []
    for number in numbers:
        for _ in range(number):
            scanchain.run(log, folder / "run", force=True)
            scanchain.localize(log, folder / "run", folder / "localized", force=True)
        found.append((threads(), files()))
    return found


def test_runs_with_a_recording_leave_no_threads_behind_and_no_open_files(tmp_path):
    spawn = multiprocessing.get_context("spawn")  # a stream that another test's full disk broke frees no threads
    with ProcessPoolExecutor(1, mp_context=spawn) as process:
        before, after = process.submit(after_runs, made.log("office", seconds=2), tmp_path, (1, 4)).result()
    assert after == before


def test_errors_that_a_caller_keeps_hold_no_file_open(tmp_path):
    log, prior, kept = made.log("office", seconds=2), made.run("office", seconds=2), []
    failing = {"matching__matcher": f"{__name__}:Failing", "recording": False}
    (tmp_path / "bad.mcap").write_bytes(log.read_bytes()[:90] + bytes(2000) + log.read_bytes()[2090:])
    gc.collect()
    gc.disable()  # an error that refers to itself is freed when garbage is collected, who knows when
    try:
        before = files()
        for act in (
            lambda: scanchain.localize(log, prior, tmp_path / "out", **failing),
            lambda: scanchain.run(log, tmp_path / "out", **failing),
            lambda: scanchain.run(tmp_path / "bad.mcap", tmp_path / "out"),
        ):
            with pytest.raises(InputError) as caught:
                act()
            kept.append(caught.value)
            assert files() == before, caught.value
    finally:
        gc.enable()
    assert "no more" in str(kept[0]) and "no scan of" in str(kept[2])
