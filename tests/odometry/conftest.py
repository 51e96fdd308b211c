"""Drives that several tests of odometry track; their scans are only read."""

import pytest

from tests.support import made
from tests.support.drives import Drive


@pytest.fixture(scope="session")
def office_drive():
    """A minute in the simulated office."""
    return Drive.of(made.log("office", seconds=60, seed=7))


@pytest.fixture(scope="session")
def town_drive():
    """Six seconds in the simulated town, with 32 rings."""
    return Drive.of(made.log("town", seconds=6, seed=7, sensor="os1-32"))


@pytest.fixture
def drive(dimension, office_drive, town_drive):
    """The one of a dimension: a test that takes it runs in both."""
    return office_drive if dimension == 2 else town_drive
