"""What every test may use. Kernels compile when first called, which is no reason for a property test to fail."""

import os
from collections import Counter

import pytest
from hypothesis import settings

from scanchain.__main__ import main
from scanchain.ahead import KINDS, compile_ahead
from scanchain.odometry import jackknife
from tests.support import made
from tests.support.scenes import SHORT_WINDOWS

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as in a comparison: threads of baselines spin otherwise
settings.register_profile("compiling", deadline=None)
settings.load_profile("compiling")


def pytest_sessionstart(session):
    """Several processes would compile the same kernels; they are compiled before, each once."""
    if session.config.getoption("numprocesses", None):
        compile_ahead(KINDS, lambda done, total: None)


def pytest_collection_modifyitems(items):
    """Begin with the files that have most slow tests, so that no process is left with one of them in the end."""
    slow = Counter(item.path for item in items if item.get_closest_marker("slow"))
    items.sort(key=lambda item: -slow[item.path])


@pytest.fixture(scope="session")
def office():
    """Six seconds in the simulated office, 60 scans, with the truth beside it; shared, so it is only read."""
    return made.log("office", seconds=6)


@pytest.fixture(scope="session", autouse=True)
def wide_terminal():
    """Lines are not folded where nothing is tested of that."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", "1000")
        yield


@pytest.fixture(scope="module", autouse=True)
def short_windows(request):
    """Error bars by a few scans, where nothing is tested of them: a thousand runs would be twice as long."""
    with pytest.MonkeyPatch.context() as patch:
        if not request.node.get_closest_marker("error_bars"):
            patch.setattr(jackknife, "LONGEST", SHORT_WINDOWS)
        yield


@pytest.fixture(params=[2, 3])
def dimension(request):
    """A test that takes it runs in the plane and in space."""
    return request.param


@pytest.fixture
def call(capfd):
    """Run a command; its exit code, its output, and what it said on stderr, libraries included."""

    def run(*words):
        code = main([str(word) for word in words])
        return code, *capfd.readouterr()

    return run
