"""A pose graph before and after optimization, side by side."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanchain.data import GraphState
from scanchain.graph.optimization import GraphChange, fit
from scanchain_viz.pictures.figure import write_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_PANEL_INCHES = 6.0
_CHAIN, _LOOP, _REJECTED = "#1f5fd0", "#8a8f98", "#d03030"
_SEEN_FROM = np.array([[0.80, 0.60, 0.0], [-0.30, 0.40, 0.866]])  # rows: right and up of an oblique view, in 3D


def draw_graph(change: GraphChange, path: Path) -> None:
    """Draw it to a PNG: from above in 2D, obliquely in 3D; every panel in its own frame and scale.

    Raises OSError.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2.0 * _PANEL_INCHES, _PANEL_INCHES), layout="constrained")
    panels = figure.subplots(1, 2)
    for axes, state, when in zip(panels, (change.before, change.after), ("before", "after"), strict=True):
        _draw_state(axes, state)
        axes.set_title(f"{change.name} {when}\n{fit(state)}", loc="left", fontsize=11)
    handles, labels = panels[1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    write_figure(path, figure, dpi=150)


def _draw_state(axes: Axes, state: GraphState) -> None:
    rejected = state.is_rejected
    positions = state.poses[:, :-1, -1]
    is_flat = positions.shape[1] == 2
    seen = positions if is_flat else positions @ _SEEN_FROM.T
    skips = np.abs(state.edges[:, 0] - state.edges[:, 1]) != 1
    width = float(np.clip(2000.0 / max(len(state.edges), 1), 0.25, 1.0))
    _draw_edges(
        axes, seen, state.edges[skips & ~rejected], _LOOP, width, "between poses that do not follow each other"
    )
    _draw_edges(axes, seen, state.edges[~skips & ~rejected], _CHAIN, 1.5 * width, "between successive poses")
    _draw_edges(axes, seen, state.edges[rejected], _REJECTED, width, "rejected")
    axes.autoscale_view()
    axes.set_aspect("equal", adjustable="datalim")
    axes.tick_params(labelsize=9, color="#999999")
    if is_flat:
        axes.set_xlabel("x [m]")
        axes.set_ylabel("y [m]")
    else:
        axes.set_xticks([])
        axes.set_yticks([])
        axes.set_xlabel("seen obliquely from above")
    for spine in axes.spines.values():
        spine.set_color("#cccccc")


def _draw_edges(
    axes: Axes, seen: NDArray[np.float64], edges: NDArray[np.int64], color: str, width: float, name: str
) -> None:
    from matplotlib.collections import LineCollection

    if len(edges):
        axes.add_collection(LineCollection(list(seen[edges]), colors=color, linewidths=width, label=name))
