"""What is compiled is told, once for each module of kernels."""

from numba import njit

from pipeline.runs.compiling import telling_of_compilation
from pipeline.runs.progress import Unwatched


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
