"""The worlds that can be driven through, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from scanchain.data import Matrix
from scanchain.simulation.motion import Pivot, Vehicle
from scanchain.simulation.solids import Solids
from scanchain.simulation.worlds import indoor, outdoor


@dataclass(frozen=True, slots=True)
class World:
    """A world, the route through it, the vehicle, and the default lidar and duration.

    build : builds the solids with random numbers
    route : the closed route driven, (W, 2) along the ground or (W, 3) with given heights, or turns and moves
    sight_m : visibility in dust or haze, an upper limit of any lidar's range
    dropouts : positions (x, y) in meters; for 1 s around the first pass of each, no scans are recorded
    """

    build: Callable[[np.random.Generator], Solids]
    route: Matrix | tuple[Pivot, ...]
    vehicle: Vehicle
    sensor: str
    duration_s: float
    sight_m: float = np.inf
    dropouts: tuple[tuple[float, float], ...] = ()


WORLDS: dict[str, World] = {
    "office": World(indoor.office, indoor.OFFICE_ROUTE, indoor.OFFICE_ROBOT, "lms-270", 240.0),
    "town": World(outdoor.town, outdoor.TOWN_ROUTE, outdoor.TOWN_CAR, "hdl-64", 60.0),
    "rounds": World(outdoor.rounds, outdoor.ROUNDS_ROUTE, outdoor.ROUNDS_CAR, "hdl-64", 160.0),
    "identical": World(indoor.identical, indoor.IDENTICAL_ROUTE, indoor.OFFICE_ROBOT, "lms-270", 300.0),
    "highway": World(outdoor.highway, outdoor.HIGHWAY_ROUTE, outdoor.HIGHWAY_CAR, "hdl-64", 30.0),
    "corridor": World(  # in the dust, neither end can be seen from the middle
        indoor.corridor, indoor.CORRIDOR_ROUTE, indoor.CORRIDOR_ROBOT, "os1-32", 40.0, sight_m=20.0
    ),
    "field": World(outdoor.field, outdoor.FIELD_ROUTE, outdoor.TRACTOR, "hdl-64", 40.0, sight_m=60.0),
    "forest": World(outdoor.forest, outdoor.FOREST_ROUTE, outdoor.MULE, "os1-32", 30.0),
    "staircase": World(indoor.staircase, indoor.STAIRCASE_ROUTE, indoor.WALKER, "os1-32", 40.0),
    "hall": World(indoor.hall, indoor.HALL_ROUTE, indoor.TRUCK, "vlp-16", 25.0),
    "garage": World(indoor.garage, indoor.GARAGE_ROUTE, indoor.GARAGE_CAR, "vlp-16", 90.0),
    "turns": World(outdoor.yard, outdoor.YARD_STEPS, outdoor.YARD_ROBOT, "os1-32", 40.0),
    "gap": World(  # at a crossing where the car turns, and in the middle of a street
        outdoor.town, outdoor.TOWN_ROUTE, outdoor.TOWN_CAR, "hdl-64", 30.0, dropouts=((0.0, 40.0), (25.0, 0.0))
    ),
}
