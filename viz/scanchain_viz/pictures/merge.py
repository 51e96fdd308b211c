"""A merged map as a picture: sessions in their colors over the map, and the closures between them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from scanchain import lie
from scanchain.config import Config
from scanchain.data import Points
from scanchain.maps import open_saved_map
from scanchain_viz.pictures.figure import Floats, SvgFigure
from scanchain_viz.pictures.map_figures import draw_points
from scanchain_viz.pictures.trajectory_figures import color_of

_CLOSURES = "#3f9b2f"


@dataclass(frozen=True, slots=True)
class DrawnSession:
    """A session: its name, color, and the positions (K, 3) of its keyframes."""

    name: str
    color: str
    positions: Floats


@dataclass(frozen=True, slots=True)
class DrawnMerge:
    """Sessions of a merged map, ends (E, 2, 3) of the closures between them, and the spacing of its points."""

    sessions: tuple[DrawnSession, ...]
    closures: Floats
    dimension: int
    grain_m: float

    @property
    def positions(self) -> Floats:
        """(K, 3) of all keyframes."""
        return np.concatenate([session.positions for session in self.sessions])


def read_merge(directory: Path) -> DrawnMerge:
    """The sessions of a merge's directory."""
    saved = open_saved_map(directory)
    positions = lie.lift(saved.poses)[:, :3, 3]
    sessions = tuple(
        DrawnSession(each.name, color_of(number), positions[saved.session == number])
        for number, each in enumerate(saved.sessions)
    )
    ends: NDArray[np.int64] = saved.session[saved.edges.pairs]
    between = saved.edges.pairs[ends[:, 0] != ends[:, 1]]
    return DrawnMerge(sessions, positions[between], saved.dimension, Config().maps.voxel_size_m)


def picture(drawn: DrawnMerge, points: Points, low: Floats, high: Floats) -> Markup:
    """Paths and closures over the map (M, 3), seen from above, within corners."""
    figure = SvgFigure.of_plan(low, high)
    draw_points(figure, points, low, high)
    gaps = np.full((len(drawn.closures), 1, 3), np.nan)
    x, y, _ = np.concatenate([drawn.closures, gaps], axis=1).reshape(-1, 3).T
    figure.line(x, y, _CLOSURES, 0.5)
    for session in drawn.sessions:
        x, y = session.positions[:, :2].T
        figure.line(x, y, session.color)
    return figure.svg()
