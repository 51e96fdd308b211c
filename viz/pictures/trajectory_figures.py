"""Figures of trajectories: paths, errors, time per scan, consistency and observability."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray
from scipy.special import gammaincinv

from scanchain.runs.closures import BACK_END, VERIFICATION
from scanchain.viz.pictures.figure import INK, SvgFigure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]

# Distinguishable on white and on black, also for most color-blind readers.
_COLORS = (
    "#2f7de1", "#e0532f", "#1aa179", "#c77800", "#a55bd6", "#d6457f", "#0f9bb5", "#7f8c1d", "#8a6d5b", "#8c9096",
    "#b0413e", "#5f8f57",
)  # fmt: skip

TRUTH = "#e0269e"  # dashed; on white and on black like the others, and never the color of a method
CLOSURES = {  # by whom a closure was rejected, "" where it was accepted: what it is called and its line's color
    VERIFICATION: ("rejected by verification", "#8a6d5b"),
    BACK_END: ("rejected by the back end", "#0f9bb5"),
    "": ("accepted", "#3f9b2f"),
}


@dataclass(frozen=True, slots=True)
class DrawnTrajectory:
    """A trajectory to draw, with figures of its N scans; unknown ones are NaN.

    Attributes
    ----------
    name : for legends outside the drawings
    color, is_dashed : how its line is drawn
    positions : (N, 3) meters, in one frame with the other trajectories
    distance_m : (N,) traveled
    error_m : (N,) distance from the true position
    relation_error_m : (K,) the same of K relations, none where there are no relations
    seconds : (N,) what each scan took
    nees : (N,) squared error over covariance, 1 on average if exact
    observability : (N,) information along the least constrained direction over the required minimum
    """

    name: str
    color: str
    is_dashed: bool
    positions: Floats
    distance_m: Floats
    error_m: Floats
    relation_error_m: Floats
    seconds: Floats
    nees: Floats
    observability: Floats

    @property
    def style(self) -> dict[str, Any]:
        """For matplotlib."""
        return {"color": self.color, "linestyle": (0, (3, 1.5)) if self.is_dashed else "-"}


@dataclass(frozen=True, slots=True)
class PathLine:
    """A line through positions (N, 3), broken where they are NaN."""

    positions: Floats
    color: str
    width: float
    is_dashed: bool = False


def color_of(place: int) -> str:
    """Color of the method at this row of the table."""
    return _COLORS[place % len(_COLORS)]


_MAX_POINTS = 1500  # largest number of points of a line
_WINDOWS = 250  # number of windows over which a value of each scan is averaged
_MARGIN = 0.25
_FEW_DECADES = 60.0
_SHOWN_SHARES = (0.5, 99.5)  # per cent of the values of a distribution
_DOTTED: dict[str, Any] = {"color": INK, "linewidth": 0.8, "linestyle": (0, (1, 1.5))}
_TRUTH: dict[str, Any] = {"color": TRUTH, "linewidth": 0.9, "linestyle": (0, (3, 3))}
_LOWEST, _HIGHEST = 0.01, 1000.0  # range to which observability is clipped
_BAR_INCHES = 0.65  # of a color bar and its numbers


def plan(
    name: str, trajectories: Sequence[DrawnTrajectory], truth: Floats | None, low: Floats, high: Floats
) -> Markup:
    """Seen from above, within corners."""
    with SvgFigure.of_plan(name, low, high) as figure:
        _each(
            figure.axes, trajectories, lambda trajectory: (trajectory.positions[:, 0], trajectory.positions[:, 1])
        )
        if truth is not None:
            figure.axes.plot(*_decimated(truth)[:, :2].T, **_TRUTH)
        figure.axes.grid(visible=True)
        return figure.svg()


def height(
    name: str, trajectories: Sequence[DrawnTrajectory], truth: Floats | None, low: Floats, high: Floats
) -> Markup:
    """Height over the distance traveled, within corners."""
    with SvgFigure(name) as figure:
        _each(figure.axes, trajectories, lambda trajectory: (trajectory.distance_m, trajectory.positions[:, 2]))
        if truth is not None:
            steps_m = np.linalg.norm(np.diff(truth, axis=0), axis=1)
            distance_m = np.append(0.0, np.cumsum(steps_m))
            rows = np.linspace(0, len(truth) - 1, min(len(truth), _MAX_POINTS)).astype(int)
            figure.axes.plot(distance_m[rows], truth[rows, 2], **_TRUTH)
        figure.axes.set_ylim(low[2], high[2])
        longest_m = np.median(
            [trajectory.distance_m[-1] for trajectory in trajectories if len(trajectory.distance_m)]
        )
        figure.axes.set_xlim(0.0, 1.05 * max(float(longest_m), 1.0))
        _label(figure.axes, "distance traveled [m]", "z [m]")
        return figure.svg()


def error_over_distance(name: str, trajectories: Sequence[DrawnTrajectory]) -> Markup:
    """Position error over the distance, after alignment."""
    with SvgFigure(name) as figure:
        for trajectory in _known(trajectories, "error_m"):
            known = np.isfinite(trajectory.error_m)
            x, y = _windowed(trajectory.distance_m[known], trajectory.error_m[known])
            figure.axes.plot(x, np.maximum(y, 1e-4), **trajectory.style)
        _logarithmic(figure.axes, "y")
        _label(figure.axes, "distance traveled [m]", "position error [m]")
        return figure.svg()


def distribution(
    name: str, trajectories: Sequence[DrawnTrajectory], key: str, unit_scale: float, label: str
) -> Markup:
    """Cumulative distribution, shown up to the 99.5th percentile of the worst trajectory."""
    with SvgFigure(name) as figure:
        ends = []
        for trajectory in _known(trajectories, key):
            values = getattr(trajectory, key)
            values = np.maximum(np.sort(unit_scale * values[np.isfinite(values)]), 1e-6)
            _cumulative(figure.axes, trajectory, values)
            ends.append(np.percentile(values, _SHOWN_SHARES))
        figure.axes.set_xlim(0.9 * np.min(ends), 1.1 * np.max(ends))
        _logarithmic(figure.axes, "x")
        figure.axes.set_ylim(0.0, 100.0)
        _label(figure.axes, label, "share below [%]")
        return figure.svg()


def time_per_scan(name: str, trajectories: Sequence[DrawnTrajectory]) -> Markup:
    """Milliseconds along the log."""
    with SvgFigure(name) as figure:
        for trajectory in _known(trajectories, "seconds"):
            x, y = _windowed(np.arange(len(trajectory.seconds), dtype=np.float64), 1e3 * trajectory.seconds)
            figure.axes.plot(x, y, **{**trajectory.style, "linewidth": 0.9})
        _logarithmic(figure.axes, "y")
        _label(figure.axes, "scan", "time of a scan [ms]")
        return figure.svg()


def consistency(name: str, trajectories: Sequence[DrawnTrajectory], degrees_of_freedom: int) -> Markup:
    """Distribution of the NEES beside the one that exact covariances would give (dotted)."""
    with SvgFigure(name) as figure:
        for trajectory in _known(trajectories, "nees"):
            values = np.sort(trajectory.nees[np.isfinite(trajectory.nees)])
            _cumulative(figure.axes, trajectory, np.maximum(values, 1e-4))
        shares = np.linspace(0.001, 0.999, 200)
        ideal = 2.0 * gammaincinv(0.5 * degrees_of_freedom, shares) / degrees_of_freedom  # quantiles of χ²
        figure.axes.plot(ideal, 100.0 * shares, **_DOTTED)
        _logarithmic(figure.axes, "x")
        figure.axes.set_ylim(0.0, 100.0)
        _label(figure.axes, "squared error over covariance (1 is exact on average)", "motions below [%]")
        return figure.svg()


def observability(name: str, trajectories: Sequence[DrawnTrajectory]) -> Markup:
    """Observability scan by scan; below 1 (dotted) a scan is degenerate."""
    with SvgFigure(name) as figure:
        for trajectory in _known(trajectories, "observability"):
            x = np.arange(len(trajectory.observability), dtype=np.float64)
            known = np.clip(trajectory.observability, _LOWEST, _HIGHEST)
            figure.axes.plot(*_windowed(x, known, np.min), **trajectory.style)
        figure.axes.axhline(1.0, **_DOTTED)
        _logarithmic(figure.axes, "y")
        _label(figure.axes, "scan", "observability")
        return figure.svg()


def innovations(
    name: str, curves: Mapping[str, tuple[Floats, str]], stretches: Sequence[tuple[int, int, str]]
) -> Markup:
    """Innovations (N,) over their limits scan by scan, 1 (dotted) is a finding; stretches are shaded."""
    with SvgFigure(name) as figure:
        for first, last, color in stretches:
            figure.axes.axvspan(first - 0.5, last + 0.5, color=color, alpha=0.2, linewidth=0.0)
        for values, color in curves.values():
            x = np.arange(len(values), dtype=np.float64)
            shown = np.clip(np.nan_to_num(values), _LOWEST, _HIGHEST)
            figure.axes.plot(*_windowed(x, shown, np.max), color=color, linewidth=0.9)
        figure.axes.axhline(1.0, **_DOTTED)
        _label(figure.axes, "scan", "innovation / limit")
        return figure.svg()


def observability_plan(name: str, trajectory: DrawnTrajectory) -> Markup:
    """Observability on the trajectory from above, the worst scans on top."""
    from matplotlib.colors import LogNorm

    low, high = frame([trajectory], None)
    order = np.argsort(-trajectory.observability)
    with SvgFigure.of_plan(name, low, high, spare=_BAR_INCHES) as figure:
        x, y = trajectory.positions[order, :2].T
        size = float(np.clip(3000.0 / len(order), 4.0, 30.0))
        dots = figure.axes.scatter(
            x, y, c=np.clip(trajectory.observability[order], 1.0, _HIGHEST), s=size, cmap="cool_r", linewidths=0,
            norm=LogNorm(1.0, _HIGHEST), rasterized=True,
        )  # fmt: skip
        bar = figure.figure.colorbar(dots, ax=figure.axes, pad=0.02, aspect=15, format=_plain)
        bar.ax.minorticks_off()
        bar.outline.set_visible(False)
        figure.axes.grid(visible=True)
        return figure.svg()


def frame(trajectories: Sequence[DrawnTrajectory], truth: Floats | None) -> tuple[Floats, Floats]:
    """Corners (3,) of the axes: the ground truth if there is one, else the trajectories, with a margin."""
    paths = [truth] if truth is not None else [trajectory.positions for trajectory in trajectories]
    low = np.min([path.min(axis=0) for path in paths], axis=0)
    high = np.max([path.max(axis=0) for path in paths], axis=0)
    size = high - low
    margin = np.array([max(0.08 * size[:2].max(), 1.0)] * 2 + [max(_MARGIN * size[2], 0.1)])
    return low - margin, high + margin


def _known(trajectories: Sequence[DrawnTrajectory], key: str) -> list[DrawnTrajectory]:
    """Trajectories with known values, the first drawn last and so on top."""
    return [trajectory for trajectory in reversed(trajectories) if np.isfinite(getattr(trajectory, key)).any()]


def _each(
    axes: Axes, trajectories: Sequence[DrawnTrajectory], line: Callable[[DrawnTrajectory], tuple[Floats, Floats]]
) -> None:
    for trajectory in reversed(trajectories):
        if len(trajectory.positions):
            axes.plot(*(_decimated(values) for values in line(trajectory)), **trajectory.style)


def _cumulative(axes: Axes, trajectory: DrawnTrajectory, ordered: Floats) -> None:
    """Per cent of the values below each."""
    rows = np.unique(np.linspace(0, len(ordered) - 1, min(len(ordered), _MAX_POINTS)).astype(int))
    axes.plot(ordered[rows], np.linspace(0.0, 100.0, len(ordered))[rows], **trajectory.style)


def _label(axes: Axes, x: str, y: str) -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(visible=True)


def _logarithmic(axes: Axes, which: Literal["x", "y"]) -> None:
    """Plain numbers at 1, or at 1, 2 and 5 where there are few decades; so that labels have room."""
    from matplotlib.ticker import LogLocator, NullLocator

    (axes.set_xscale if which == "x" else axes.set_yscale)("log")
    axis = axes.xaxis if which == "x" else axes.yaxis
    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < _FEW_DECADES * low else (1.0,)))
    axis.set_major_formatter(_plain)
    axis.set_minor_locator(NullLocator())


def _plain(value: float, _: float | None = None) -> str:
    """A number of an axis without powers of ten."""
    return f"{value:g}"


def _decimated(values: Floats) -> Floats:
    return values[:: max(1, -(-len(values) // _MAX_POINTS))]


def _windowed(x: Floats, y: Floats, combine: Callable[..., Floats] = np.median) -> tuple[Floats, Floats]:
    """Neighboring values put together so that a line of them can be read."""
    size = max(1, -(-len(x) // _WINDOWS))
    count = len(x) // size * size
    if not count:
        return x, y
    return x[:count].reshape(-1, size).mean(axis=1), combine(y[:count].reshape(-1, size), axis=1)
