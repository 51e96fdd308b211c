"""What is compiled is told, once for each module of kernels, and counts as no work."""

import json
import os
import pickle
import re
import subprocess
import sys
from contextlib import nullcontext
from itertools import count
from time import perf_counter

import numba
import numpy as np
import pytest
from numba import config, njit
from numba.core.codegen import CPUCodeLibrary
from numba.core.compiler import Flags
from numba.core.types.functions import BaseFunction

from scanchain.__main__ import main
from scanchain.api import open_recorder
from scanchain.clock import announcing_compilation, compiled_s, working_s
from scanchain.kernels import compiler_shortcuts, compiling
from scanchain.kernels.graph.cholesky import factorize
from scanchain.kernels.registration.icp import align, fit_at
from scanchain.kernels.registration.observability import agreement, signal_along
from scanchain.kernels.registration.residuals import gradient_spread
from scanchain.kernels.registration.weights import weigh
from scanchain.registration import VoxelMap
from scanchain.runs import processing, results, warm_up
from scanchain.runs.job import Job, Unwatched
from scanchain.runs.run import run
from scanchain.settings import load_settings
from scanchain.simulation import simulate
from scanchain.slam import Slam
from scanchain.viz.recording.recording import Recording


class Told(Unwatched):
    def __init__(self):
        self.lines = []

    def say(self, line):
        self.lines.append(line)


def kernel(module):
    def double(x):
        return 2 * x

    double.__module__ = module
    return njit(double)


def test_each_module_of_kernels_is_named_once_and_others_are_not():
    told = Told()
    with announcing_compilation(told.say):
        for module in (
            "scanchain.kernels.voxels.voxel_shapes",
            "scanchain.kernels.voxels.voxel_shapes",
            "numba.np.arrayobj",
        ):
            assert kernel(module)(2) == 4
    kernel("scanchain.kernels.geometry.eigen")(2)
    assert told.lines == ["compiling, once after the installation:", "  kernels.voxels.voxel_shapes"]


def test_what_is_compiled_already_is_not_told():
    told = Told()
    compiled = kernel("scanchain.kernels.voxels.voxel_shapes")
    compiled(2)
    with announcing_compilation(told.say):
        compiled(3)
    assert told.lines == []


def test_beside_what_is_compiled_processes_begin_once_and_are_over_in_the_end(monkeypatch):
    begun, start = [], subprocess.Popen

    def remembered(*words, **options):
        begun.append(start(*words, **options))
        return begun[-1]

    monkeypatch.setattr(subprocess, "Popen", remembered)
    with announcing_compilation(Told().say, [("http.server", "0")] * 2):
        assert not begun
        for module in ("scanchain.kernels.voxels.voxel_shapes", "scanchain.kernels.geometry.eigen"):
            kernel(module)(2)
        assert [each.poll() for each in begun] == [None, None]
    assert None not in [each.poll() for each in begun]


def test_nothing_begins_where_nothing_is_compiled(monkeypatch):
    begun, told = [], Told()
    monkeypatch.setattr(subprocess, "Popen", lambda *words, **options: begun.append(words))
    with announcing_compilation(told.say, [("http.server", "0")]):
        kernel("numba.np.arrayobj")(2)
    assert begun == told.lines == []


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_warm_up_optimizes_a_graph_of_all_its_scans_and_draws_both_maps(monkeypatch, dimension):
    made = {}
    for module, name in ((results, "cloud_of"), (results, "grid_of"), (Slam, "finish")):
        monkeypatch.setattr(module, name, _remembering(made, module, name))
    warm_up.maps(dimension)
    assert list(made) == ["cloud_of", "grid_of"]
    assert len(made["cloud_of"].points) > 0 and made["grid_of"].log_odds.max() > 0.0
    warm_up.graph(dimension)
    assert len(made["finish"].trajectory) == 3 and len(made["finish"].state.edges) >= 2


@pytest.mark.parametrize("cores", [1, 2, 3, 16])
def test_the_processes_beside_a_run_share_out_all_parts(cores):
    parts = [part for words in warm_up.beside(3, cores) for part in words[2:]]
    assert sorted(parts) == ["fit", "graph", "judge", "maps"]
    assert len(warm_up.beside(3, cores)) == min(cores, 4)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_run_uses_the_types_that_were_compiled_ahead(office, tmp_path, dimension):
    log = office if dimension == 2 else tmp_path / "town.mcap"
    if dimension == 3:
        simulate("town", log, duration_s=0.5, sensor="vlp-16")
    warm_up.fit(dimension)
    warm_up.judge(dimension)
    warm_up.graph(dimension)
    kernels = *(each.inner for each in (align, fit_at, gradient_spread, agreement, signal_along)), factorize
    ahead = [list(kernel.signatures) for kernel in kernels]  # tests before may have used other types
    run(Job(logs=(log,), out=tmp_path / "run", sinks=frozenset()), open_recorder, Unwatched())
    assert all(ahead) and [list(kernel.signatures) for kernel in kernels] == ahead


_COMPILES = """
import sys, time
from numba.core import event
from scanchain.kernels.compiling import njit
class Slow(event.Listener):
    def on_start(self, event): print("compiled", flush=True); time.sleep(0.5)
    def on_end(self, event): pass
event.register("numba:compile", Slow())
from kernel_of_a_test import double
assert double(float(sys.argv[1])) == 2 * float(sys.argv[1])
"""


def test_of_processes_that_need_a_kernel_one_compiles_it_and_the_others_wait(tmp_path):
    (tmp_path / "kernel_of_a_test.py").write_text(
        "from scanchain.kernels.compiling import njit\n@njit()\ndef double(x):\n    return 2 * x\n"
    )
    place = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(tmp_path)}
    words = [sys.executable, "-c", _COMPILES]
    both = [subprocess.Popen([*words, x], env=place, stdout=subprocess.PIPE, text=True) for x in ("3", "4")]
    told = [each.communicate(timeout=60)[0] for each in both]
    assert [each.returncode for each in both] == [0, 0]
    assert sorted(told) == ["", 2 * "compiled\n"]  # as kernels call it, and as Python does


def test_a_kernel_that_another_process_compiles_for_too_long_is_compiled_here(tmp_path, monkeypatch):
    monkeypatch.setattr(compiling, "_PATIENCE_S", 0.1)
    monkeypatch.setattr(compiling, "_took", lambda file: False)
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))
    double = compiling.njit()(lambda x: 2 * x)
    assert double(2) == 4


def test_the_command_goes_through_what_needs_kernels_and_names_what_failed(monkeypatch, capsys):
    called, code = [], {"run": 1}

    def remembered(words, **options):
        called.append(words[4:])
        return subprocess.CompletedProcess(words, code.get(words[4], 0), "", "error: no disk\n")

    monkeypatch.setattr(subprocess, "run", remembered)
    assert main(["warm-up", "3d"]) == 0
    assert [words[0] for words in called] == ["simulate", "run", "simulate", "localize", "run", "merge"]
    assert capsys.readouterr().out.splitlines()[0].startswith("compiling what 3D logs need")
    code["localize"] = 2
    assert main(["warm-up", "2d"]) == 1
    error = capsys.readouterr().err
    assert error.startswith("error: scanchain localize ") and error.endswith(": no disk\n")


def _remembering(made, module, name):
    function = getattr(module, name)

    def remembered(*given):
        made[name] = function(*given)
        return made[name]

    return remembered


def test_the_clock_stands_still_while_a_kernel_and_those_it_calls_are_compiled():
    inner = kernel("scanchain.kernels.voxels.voxel_shapes")

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


@pytest.fixture(scope="module")
def office(tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "office.mcap"
    simulate("office", path, duration_s=3.0)
    return path


def test_a_run_tells_compilation_apart_from_work(office, tmp_path, monkeypatch):
    def finished(name):
        done = run(Job(logs=(office,), out=tmp_path / name, sinks=frozenset()), open_recorder, Unwatched())
        return done, json.loads((done.path / "metrics.json").read_text())

    finished("to compile what the cache on disk lacks")
    insert, compiled = VoxelMap.insert, []

    def compiling(self, *words):
        if not compiled:
            before_s = compiled_s()
            while compiled_s() - before_s < 0.6:
                kernel("scanchain.kernels.voxels.voxel_shapes")(2)
            compiled.append(compiled_s() - before_s)
        return insert(self, *words)

    warm, figures = finished("warm")
    assert figures["compile_s"] == 0.0 and "compiling" not in warm.summary
    monkeypatch.setattr(VoxelMap, "insert", compiling)
    cold, metrics = finished("cold")
    assert metrics["compile_s"] == pytest.approx(compiled[0]) and compiled[0] > 0.6
    assert f" s (and {compiled[0]:.0f} s compiling, once after an installation) " in cold.summary
    assert metrics["run_s"] < figures["run_s"] + 0.5
    assert metrics["times_real_time"] == pytest.approx(metrics["log_span_s"] / metrics["run_s"])
    assert max(metrics["p95_ms"].values()) < 300.0


@pytest.mark.parametrize("compiles", [True, False])
def test_the_first_scan_is_shown_ahead_where_kernels_are_compiled(office, tmp_path, monkeypatch, compiles):
    seconds, shown, steps = count(), [], []
    monkeypatch.setattr(processing, "compiled_s", lambda: next(seconds) if compiles else 0.0)
    monkeypatch.setattr(Recording, "preview", lambda self, scan: shown.append(scan))
    monkeypatch.setattr(Recording, "log", lambda self, step: steps.append(step))
    run(Job(logs=(office,), out=tmp_path / "run", sinks=frozenset()), open_recorder, Unwatched())
    assert [scan.index for scan in shown] == [steps[0].scan.index] * compiles
    np.testing.assert_array_equal(steps[0].T_world_lidar, np.eye(3))  # as the viewer draws a scan without a pose


def body(kernel):
    """LLVM code of a compiled kernel without its wrapper."""
    code = kernel.inspect_llvm(kernel.signatures[0])
    begin = code.index("define linkonce_odr i32")
    return code[begin : code.index("\n}", begin)]


def test_functions_of_numpy_are_optimized_in_the_kernels_alone_and_numba_stays_as_it_is(tmp_path, monkeypatch):
    optimized, optimize = [], CPUCodeLibrary._optimize_final_module

    def remembered(library):
        optimized.append(library.name)
        optimize(library)

    monkeypatch.setattr(CPUCodeLibrary, "_optimize_final_module", remembered)
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))
    zeros = compiling.njit()(lambda n: np.zeros((n, n), np.int16))
    assert zeros(2).tolist() == [[0, 0], [0, 0]] and not any("np_zeros" in name for name in optimized)
    assert njit(lambda n: np.zeros((n, n, n), np.int16))(1).shape == (1, 1, 1)
    assert any("np_zeros" in name for name in optimized)


def test_shortcuts_of_the_compiler_lead_to_the_same_code(tmp_path, monkeypatch):
    voxels = VoxelMap(3, load_settings(3).config.local_map).voxels
    arguments = voxels, np.empty((0, 3)), np.eye(4), np.empty(0, np.int32), 1.0, np.empty(0)

    def instructions(name):
        monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path / name))
        compiled = compiling.njit()(weigh.py_func)
        compiled.compile(tuple(map(numba.typeof, arguments)))
        return re.sub(r'[%@]("[^"]*"|[\w.$-]+)|^[\w.$-]+:|;.*', "", body(compiled), flags=re.MULTILINE)

    with_shortcuts = instructions("with")
    monkeypatch.setattr(compiling, "shortcuts", nullcontext)
    assert instructions("without") == with_shortcuts and with_shortcuts.count("fmul") > 50


def test_a_signature_is_resolved_once_and_numba_stays_as_it_is(tmp_path, monkeypatch):
    resolved, resolve = [], BaseFunction.get_call_type

    def remembered(function, context, arguments, names):
        resolved.append((function, arguments))
        return resolve(function, context, arguments, names)

    monkeypatch.setattr(BaseFunction, "get_call_type", remembered)
    monkeypatch.setattr(compiler_shortcuts, "_resolve", remembered)
    monkeypatch.setattr(compiler_shortcuts, "_signatures", {})
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))
    assert compiling.njit()(lambda x, y: x * y + y * x + x * x)(2.0, 3.0) == 16.0
    assert len(resolved) == len(set(resolved)) >= 2
    assert BaseFunction.get_call_type is remembered


def test_options_of_a_compilation_are_those_of_numba():
    plain = Flags()
    plain.release_gil = True
    ours = compiling._Flags(plain)
    assert ours == plain and plain == ours.copy() and hash(ours) == hash(plain) and ours != Flags()


def test_a_kernel_is_pickled_by_its_name():
    assert pickle.loads(pickle.dumps(align)) is align
    assert len(pickle.dumps(align)) < 100


def test_what_was_compiled_for_kernels_becomes_a_kernel_for_python(tmp_path):
    """Another process compiled the inner function, with and without which the wrapper is made and read again."""
    place = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    called = "import numpy as np; from scanchain.kernels.geometry.poses import inverse as f; "
    inner, outer = called + "f.compile_inner(np.eye(3))", called + "assert (f(np.eye(3)) == np.eye(3)).all()"
    for code in (inner, outer, outer):
        subprocess.run([sys.executable, "-c", code], env=place, check=True)
    assert len(list(tmp_path.rglob("*.nbc"))) == 2
