"""The worlds that can be driven through, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from scanchain.data import Matrix
from scanchain.errors import InputError
from scanchain.simulation.motion import Motion, Vehicle
from scanchain.simulation.routes import Laps, Pivot, Pivots, begun_at
from scanchain.simulation.solids import Solids
from scanchain.simulation.worlds import corridor, forest, highway, identical, office, sparse, staircase, town


@dataclass(frozen=True, slots=True)
class World:
    """A world, the route through it, the vehicle, and the default lidar and duration.

    Attributes
    ----------
    build : draws the place
    route : the closed route driven, (W, 2) along the ground or (W, 3) at heights of its own, or turns and moves
    sight_m : how far any lidar sees there
    dropouts : places (x, y) in meters; for 1 s around the moment they are first passed, the log lacks its scans
    """

    build: Callable[[np.random.Generator], Solids]
    route: Matrix | tuple[Pivot, ...]
    vehicle: Vehicle
    sensor: str
    duration_s: float
    sight_m: float = np.inf
    dropouts: tuple[tuple[float, float], ...] = ()

    def motion(
        self,
        solids: Solids,
        *,
        duration_s: float,
        rng: np.random.Generator,
        reverse: bool = False,
        start_m: float = 0.0,
    ) -> Motion:
        """The drive; ``rng`` draws its deviations and its sway.

        reverse : drive the route the other way round; start_m : begin so far along it
        """
        if isinstance(self.route, tuple):
            return Pivots(self.route, self.vehicle, solids, duration_s=duration_s, rng=rng)
        route = begun_at(self.route[::-1] if reverse else self.route, start_m)
        return Laps(route, self.vehicle, solids, duration_s=duration_s, rng=rng)


_GAPS = ((0.0, 40.0), (25.0, 0.0))  # a crossing that is turned at, the middle of a street

WORLDS: dict[str, World] = {
    "office": World(office.office, office.ROUTE, office.ROBOT, "lms-270", 240.0),
    "town": World(town.town, town.ROUTE, town.CAR, "hdl-64", 60.0),
    "rounds": World(town.rounds, town.ROUNDS_ROUTE, town.ROUNDS_CAR, "hdl-64", 160.0),
    "identical": World(identical.identical, identical.ROUTE, office.ROBOT, "lms-270", 300.0),
    "highway": World(highway.highway, highway.ROUTE, highway.CAR, "hdl-64", 30.0),
    "corridor": World(corridor.corridor, corridor.ROUTE, corridor.ROBOT, "os1-32", 40.0, corridor.SIGHT_M),
    "field": World(sparse.field, sparse.FIELD_ROUTE, sparse.TRACTOR, "hdl-64", 40.0, sparse.FIELD_SIGHT_M),
    "forest": World(forest.forest, forest.ROUTE, forest.MULE, "os1-32", 30.0),
    "staircase": World(staircase.staircase, staircase.ROUTE, staircase.WALKER, "os1-32", 40.0),
    "hall": World(sparse.hall, sparse.HALL_ROUTE, sparse.TRUCK, "vlp-16", 25.0),
    "turns": World(sparse.yard, sparse.YARD_STEPS, sparse.YARD_ROBOT, "os1-32", 40.0),
    "gap": World(town.town, town.ROUTE, town.CAR, "hdl-64", 30.0, dropouts=_GAPS),
}


def find_world(name: str) -> World:
    """The world of that name."""
    if name not in WORLDS:
        raise InputError(f"world {name!r} does not exist; choose one of {', '.join(WORLDS)}")
    return WORLDS[name]
