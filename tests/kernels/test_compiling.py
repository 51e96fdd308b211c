"""What is compiled is told, once for each module of kernels, counts as no work, and is kept by its source."""

import json
import os
import pickle
import re
import shutil
import subprocess
import sys
from pathlib import Path
from time import perf_counter

import numpy as np
import pytest
from numba import config, njit

from scanchain import lie
from scanchain.api import open_recorder
from scanchain.clock import announcing_compilation, compiled_s, working_s
from scanchain.kernels import compiling
from scanchain.kernels.registration import icp, residuals
from scanchain.registration import VoxelMap
from scanchain.registration.plicp import settings_of
from scanchain.runs.job import Job, Progress
from scanchain.runs.run import run
from scanchain.settings import load_settings
from tests.support.scenes import ROOT


def kernel(module="scanchain.kernels.voxels"):
    def double(x):
        return 2 * x

    double.__module__ = module
    return njit(double)


def test_each_module_of_kernels_is_named_once_and_others_and_what_is_compiled_already_are_not():
    told, compiled = [], kernel("scanchain.kernels.scans")
    compiled(2)
    with announcing_compilation(told.append):
        compiled(3)
        for module in ("scanchain.kernels.voxels", "scanchain.kernels.voxels", "numba.np.arrayobj"):
            assert kernel(module)(2) == 4
    kernel("scanchain.kernels.matrices")(2)
    assert told == ["compiling, once after the installation:", "  kernels.voxels"]


def test_the_clock_stands_still_while_a_kernel_and_those_it_calls_are_compiled():
    inner = kernel()

    @njit
    def outer(x):
        return inner(x) + 1

    began_s, began_work_s, before_s = perf_counter(), working_s(), compiled_s()
    assert outer(2) == 5
    took_s, work_s, compile_s = perf_counter() - began_s, working_s() - began_work_s, compiled_s() - before_s
    assert compile_s > 0.02 and work_s < 0.5 * took_s
    assert work_s + compile_s == pytest.approx(took_s, abs=1e-3)
    outer(3)
    assert compiled_s() - before_s == compile_s


def test_a_run_tells_compilation_apart_from_work(office, tmp_path, monkeypatch):
    insert, compiled = VoxelMap.insert, []

    def slow(self, *words):
        if not compiled:
            before_s = compiled_s()
            while compiled_s() - before_s < 0.6:
                kernel()(2)
            compiled.append(compiled_s() - before_s)
        return insert(self, *words)

    monkeypatch.setattr(VoxelMap, "insert", slow)
    before_s, began_s = compiled_s(), perf_counter()
    done = run(Job(logs=(office,), out=tmp_path / "run", sinks=frozenset()), open_recorder, Progress())
    took_s, metrics = perf_counter() - began_s, json.loads((done.path / "metrics.json").read_text())
    assert 0.6 < compiled[0] <= metrics["compile_s"] <= compiled_s() - before_s + 1e-6
    assert f" s (and {metrics['compile_s']:.0f} s compiling, once after an installation) " in done.summary
    assert metrics["run_s"] + metrics["compile_s"] <= took_s + 0.01
    assert metrics["times_real_time"] == pytest.approx(metrics["log_span_s"] / metrics["run_s"])
    assert max(metrics["p95_ms"].values()) < 300.0


@pytest.mark.parametrize("d", [2, 3])
def test_normal_equations_count_no_references_from_point_to_point(d, tmp_path, monkeypatch):
    """A row of an array, handed on, was counted up and down for every point: two thirds of the time."""
    settings, T = load_settings(d).config, lie.identity(d)
    voxel_map, k = VoxelMap(d, settings.local_map), lie.twist_size(T)
    search = settings_of(settings.matching, voxel_map, wide=False)
    problem = icp.problem_of(voxel_map.voxels, np.empty((0, d)), T, np.zeros((k, k)), search)
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))
    compiled = compiling.njit()(residuals._sum_up.py_func)
    compiled(*residuals._arrays(problem, T), 1.0, (0.0,) * (k * (k + 1) // 2), (0.0,) * k)
    code = compiled.inspect_llvm(compiled.signatures[0])  # without the wrapper:
    begin = code.index("\ndefine ")
    blocks = re.split(r"^[^\s:]+:.*$", code[begin : code.index("\n}", begin)], flags=re.MULTILINE)
    assert sum("NRT_incref(" in block for block in blocks) <= 2  # at the begin, and of H in the end


def test_processes_that_compile_a_kernel_for_different_types_keep_all_of_it(tmp_path):
    (tmp_path / "kernel_of_a_test.py").write_text(
        "from scanchain.kernels.compiling import njit\n@njit()\ndef double(x):\n    return 2 * x\n"
    )
    place = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(tmp_path)}
    code = "import numpy as np; from kernel_of_a_test import double; x = {}; assert double(x) == 2 * x; "
    code += "print(sum(double.stats.cache_misses.values()))"
    values = ("3", "3.0", "3j")
    for first in (True, False):
        words = [[sys.executable, "-c", code.format(value)] for value in values]
        together = [subprocess.Popen(each, env=place, stdout=subprocess.PIPE, text=True) for each in words]
        told = [each.communicate(timeout=60)[0] for each in together]
        assert [each.returncode for each in together] == [0] * len(values)
        assert told == ["1\n" if first else "0\n"] * len(values)


MISSES = """import numpy as np
from kernel_of_a_test import double
x = np.arange(3.0)
assert np.array_equal(double(x), 2 * x) and double(3) == 6
print(sum(double.stats.cache_misses.values()))
"""


def calling(folder, code=MISSES, cached=(), before="", **environment):
    """A process that calls a kernel for two types; what it prints, and says on stderr."""
    (folder / "kernel_of_a_test.py").write_text(
        "from scanchain.kernels.compiling import njit\n@njit()\ndef double(x):\n    return 2 * x\n"
    )
    variables = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    variables |= {"PYTHONPATH": f"{folder}:{os.environ.get('PYTHONPATH', '')}", **environment}
    words = [sys.executable, "-c", before + code]
    done = subprocess.run(words, env=variables, capture_output=True, text=True, check=True)
    return done.stdout.strip(), done.stderr


def damages(data):
    """What a power loss and others leave of a file."""
    yield from (data[:length] for length in (0, 1, 2, 4, 5, len(data) // 3, len(data) - 4, len(data) - 1))
    yield from (bytes(len(data)), bytes(4), data[:4096] + bytes(len(data) - 4096), b"\xff" * len(data))
    page = len(data) // 2
    yield data[:page] + bytes(16) + data[page + 16 :]
    yield from (pickle.dumps(value) for value in (None, {}, (1, 2), "0.68.1", ("0.68.1", {})))


def twice(x):
    return 2 * x


def test_damaged_files_of_the_cache_are_compiled_again_without_a_word_and_whole_ones_are_not(
    tmp_path, monkeypatch, caplog
):
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))

    def missed():
        double = compiling.njit()(twice)
        assert double(3) == 6 and double(3.5) == 7.0
        return sum(double.stats.cache_misses.values())

    assert (missed(), missed()) == (2, 0)
    files = [path for path in tmp_path.rglob("*") if path.is_file() and path.stat().st_size]
    for path in files:
        whole = path.read_bytes()
        for damaged in damages(whole):
            path.write_bytes(damaged)
            assert missed() in (1, 2), damaged[:9]
            assert missed() == 0
        path.unlink()
        assert missed() in (1, 2)
    assert {path for path in tmp_path.rglob("*") if path.is_file() and path.stat().st_size} == set(files)
    assert not caplog.records


@pytest.mark.parametrize("kind", ["a file in its place", "a full disk", "no home"])
def test_where_no_kernel_can_be_kept_it_is_compiled_with_one_line(tmp_path, kind):
    place, nowhere = {"XDG_CACHE_HOME": str(tmp_path / "file"), "NUMBA_CACHE_DIR": ""}, "import tempfile\n"
    nowhere += "def none(**_): raise PermissionError\ntempfile.TemporaryFile = none\n"  # Numba's trial of a folder
    if kind == "a file in its place":
        (tmp_path / "file").touch()
        before = nowhere
        why = "Numba finds no folder that takes them"
    elif kind == "no home":
        before = f"{nowhere}import os, pwd\nfor each in ('HOME', 'XDG_CACHE_HOME'): os.environ.pop(each, None)\n"
        before += "def none(uid): raise KeyError(uid)\npwd.getpwuid = none\n"
        why = "Numba finds no folder that takes them"
    else:
        before = "import resource, signal\nsignal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        before += "resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))\n"
        why = f"{tmp_path / 'file' / 'scanchain' / 'kernels'}"
    printed, told = calling(tmp_path, before=before, **place)
    assert printed == "2" and told.count("\n") == 1
    assert told.startswith(f"compiled kernels are not kept, every process compiles them again: {why}")
    assert told.endswith("; set NUMBA_CACHE_DIR to a folder\n")


def test_a_cache_that_others_may_write_to_is_not_used(tmp_path):
    place = {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    folder = Path(cache_of(ROOT / "pipeline", tmp_path / "cache"))
    assert folder.stat().st_mode & 0o777 == 0o700
    for mode in (0o770, 0o702, 0o777):
        folder.chmod(mode)
        assert cache_of(ROOT / "pipeline", tmp_path / "cache") == ""
    folder.chmod(0o750)
    assert cache_of(ROOT / "pipeline", tmp_path / "cache") == str(folder)
    assert calling(tmp_path, **place)[0] == "2"


def cache_of(package, cache, **environment):
    """Folder in which a process that imports this package keeps its kernels."""
    variables = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    variables |= {"PYTHONPATH": str(package), "XDG_CACHE_HOME": str(cache), **environment}
    words = [sys.executable, "-c", "import scanchain.kernels.compiling, numba; print(numba.config.CACHE_DIR)"]
    done = subprocess.run(words, env=variables, capture_output=True, text=True, cwd=package, check=True)
    return done.stdout.strip()


def test_kernels_are_kept_by_the_source_of_all_of_them_or_where_the_user_wants_them(tmp_path):
    kernels, cache = tmp_path / "scanchain" / "kernels", tmp_path / "cache"
    source = Path(compiling.__file__).parent
    shutil.copytree(source, kernels, ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "scanchain" / "__init__.py").touch()
    before = cache_of(tmp_path, cache)
    assert before.startswith(str(cache / "scanchain" / "kernels")) and before == cache_of(tmp_path, cache)
    with (kernels / "geometry.py").open("a") as file:
        file.write("# changed\n")
    assert cache_of(tmp_path, cache) != before
    assert cache_of(tmp_path, cache, NUMBA_CACHE_DIR=str(tmp_path / "mine")) == str(tmp_path / "mine")
    (tmp_path / "file").touch()  # where no folder can be made
    assert cache_of(tmp_path, tmp_path / "file") == ""
