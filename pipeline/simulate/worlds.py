"""The worlds that can be driven through, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.data import Matrix
from pipeline.errors import InputError
from pipeline.simulate import office, town
from pipeline.simulate.motion import Vehicle
from pipeline.simulate.solids import Solids


@dataclass(frozen=True, slots=True)
class World:
    """A place, the closed route driven in it, by whom, and with which lidar and for how long by default."""

    build: Callable[[np.random.Generator], Solids]
    route: Matrix
    vehicle: Vehicle
    sensor: str
    duration_s: float


WORLDS: dict[str, World] = {
    "office": World(office.office, office.ROUTE, office.ROBOT, sensor="lms-270", duration_s=240.0),
    "town": World(town.town, town.ROUTE, town.CAR, sensor="hdl-64", duration_s=60.0),
}


def find_world(name: str) -> World:
    """The world of that name."""
    if name not in WORLDS:
        raise InputError(f"world {name!r} does not exist; choose one of {', '.join(WORLDS)}")
    return WORLDS[name]
