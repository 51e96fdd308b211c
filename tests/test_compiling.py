"""What is compiled is told, once for each module of kernels."""

import subprocess

import pytest
from numba import njit

from pipeline.runs.compiling import telling_of_compilation
from pipeline.runs.progress import Unwatched
from pipeline.runs.rehearsal import rehearse


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
    with telling_of_compilation(told):
        for module in ("pipeline.kernels.voxels", "pipeline.kernels.voxels", "numba.np.arrayobj"):
            assert kernel(module)(2) == 4
    kernel("pipeline.kernels.eigen")(2)
    assert told.lines == ["compiling, once after the installation:", "  kernels.voxels"]


def test_what_is_compiled_already_is_not_told():
    told = Told()
    compiled = kernel("pipeline.kernels.voxels")
    compiled(2)
    with telling_of_compilation(told):
        compiled(3)
    assert told.lines == []


def test_beside_what_is_compiled_a_process_begins_once_and_is_over_in_the_end(monkeypatch):
    begun, start = [], subprocess.Popen

    def remembered(*words, **options):
        begun.append(start(*words, **options))
        return begun[-1]

    monkeypatch.setattr(subprocess, "Popen", remembered)
    with telling_of_compilation(Told(), ("http.server", "0")):
        assert not begun
        for module in ("pipeline.kernels.voxels", "pipeline.kernels.eigen"):
            kernel(module)(2)
        assert len(begun) == 1 and begun[0].poll() is None
    assert begun[0].poll() is not None


def test_nothing_begins_where_nothing_is_compiled(monkeypatch):
    monkeypatch.setattr(subprocess, "Popen", None)
    with telling_of_compilation(Told(), ("http.server", "0")):
        pass


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_rehearsal_reaches_the_end(dimension):
    rehearse(dimension)
