"""What is compiled is told, once for each module of kernels, and counts as no work."""

import json
import subprocess
from time import perf_counter

import pytest
from numba import njit

from scanchain.api import open_recorder
from scanchain.clock import announcing_compilation, compiled_s, working_s
from scanchain.registration import VoxelMap
from scanchain.runs import results
from scanchain.runs.job import Job, Unwatched
from scanchain.runs.run import run
from scanchain.runs.warm_up import warm_up
from scanchain.simulation import simulate


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


def test_beside_what_is_compiled_a_process_begins_once_and_is_over_in_the_end(monkeypatch):
    begun, start = [], subprocess.Popen

    def remembered(*words, **options):
        begun.append(start(*words, **options))
        return begun[-1]

    monkeypatch.setattr(subprocess, "Popen", remembered)
    with announcing_compilation(Told().say, ("http.server", "0")):
        assert not begun
        for module in ("scanchain.kernels.voxels.voxel_shapes", "scanchain.kernels.geometry.eigen"):
            kernel(module)(2)
        assert len(begun) == 1 and begun[0].poll() is None
    assert begun[0].poll() is not None


def test_nothing_begins_where_nothing_is_compiled(monkeypatch):
    monkeypatch.setattr(subprocess, "Popen", None)
    with announcing_compilation(Told().say, ("http.server", "0")):
        pass


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_warm_up_optimizes_a_graph_of_all_its_scans_and_draws_both_maps(monkeypatch, dimension):
    made = {}
    for name in ("cloud_of", "grid_of"):
        monkeypatch.setattr(f"scanchain.runs.warm_up.{name}", _remembering(made, name))
    warm_up(dimension)
    assert list(made) == ["cloud_of", "grid_of"]
    (result, _), cloud = made["cloud_of"]
    assert len(result.keyframes) == len(result.trajectory) == 3 and len(result.state.edges) >= 2
    assert len(cloud.points) > 0 and made["grid_of"][1].log_odds.max() > 0.0


def _remembering(made, name):
    function = getattr(results, name)

    def remembered(*given):
        made[name] = (given, function(*given))
        return made[name][1]

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
    assert " s (and 1 s compiling, once after an installation), " in cold.summary
    assert metrics["run_s"] < figures["run_s"] + 0.5
    assert metrics["times_real_time"] == pytest.approx(metrics["log_span_s"] / metrics["run_s"])
    assert max(metrics["p95_ms"].values()) < 300.0
