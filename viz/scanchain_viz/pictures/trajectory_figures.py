"""Figures of trajectories: paths, errors, time per scan, consistency and observability."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from scipy.special import gammaincinv

from scanchain.data import BACK_END, VERIFICATION
from scanchain_viz.colors import hex_of
from scanchain_viz.pictures.axis import Axis
from scanchain_viz.pictures.figure import INK, Floats, Plot, palette_of

# Distinguishable on white and on black, also for most color-blind readers.
_COLORS = (
    "#2f7de1", "#e0532f", "#1aa179", "#c77800", "#a55bd6", "#d6457f", "#0f9bb5", "#7f8c1d", "#8a6d5b", "#8c9096",
    "#b0413e", "#5f8f57",
)  # fmt: skip

TRUTH = "#e0269e"  # dashed; on white and on black like the others, and never the color of a method
CLOSURES = {  # by whom a closure was rejected, "" where it was accepted: what it is called and its line's color
    VERIFICATION: ("rejected by verification", "#f0958d"),
    BACK_END: ("rejected by the back end", "#eb463c"),
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
    def dashes(self) -> tuple[float, ...]:
        """Of its line, in widths."""
        return (3.0, 1.5) if self.is_dashed else ()


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
_SHOWN_SHARES = (0.5, 99.5)  # per cent of the values of a distribution
_THIN, _DOTS = 0.8, (1.0, 1.5)  # width and dashes of a dotted line
_TRUTH_WIDTH, _TRUTH_DASHES = 0.9, (3.0, 3.0)
_LOWEST, _HIGHEST = 0.01, 1000.0  # range to which observability is clipped
_BAR_INCHES = 0.65  # of a color bar and its numbers
# a decade each, degenerate up to orange
_WORST_TO_BEST = ("#7a0177", "#dd1c77", "#f2a03d", "#9fb8ad", "#41a6c4", "#1f6fd0")
_MAX_DOTS = 3000


def plan(
    trajectories: Sequence[DrawnTrajectory],
    truth: Floats | None,
    low: Floats,
    high: Floats,
    *,
    is_wide: bool = False,
) -> Markup:
    """Seen from above, within corners."""
    figure = Plot.of_plan(low, high, is_wide=is_wide)
    for trajectory in _known(trajectories, "positions"):
        figure.path(_decimated(trajectory.positions), trajectory.color, dashes=trajectory.dashes)
    if truth is not None:
        figure.path(_decimated(truth), TRUTH, _TRUTH_WIDTH, _TRUTH_DASHES)
    figure.has_grid = True
    return figure.svg()


def height(trajectories: Sequence[DrawnTrajectory], truth: Floats | None, low: Floats, high: Floats) -> Markup:
    """Height over the distance traveled, within corners."""
    figure = Plot()
    for trajectory in _known(trajectories, "positions"):
        z = _decimated(trajectory.positions)[:, 2]
        figure.line(_decimated(trajectory.distance_m), z, trajectory.color, dashes=trajectory.dashes)
    if truth is not None:
        steps_m = np.linalg.norm(np.diff(truth, axis=0), axis=1)
        distance_m = np.append(0.0, np.cumsum(steps_m))
        rows = np.linspace(0, len(truth) - 1, min(len(truth), _MAX_POINTS)).astype(int)
        figure.line(distance_m[rows], truth[rows, 2], TRUTH, _TRUTH_WIDTH, _TRUTH_DASHES)
    figure.y.limit(low[2], high[2])
    longest_m = np.median([trajectory.distance_m[-1] for trajectory in trajectories if len(trajectory.distance_m)])
    figure.x.limit(0.0, 1.05 * max(float(longest_m), 1.0))
    return _labeled(figure, "distance traveled [m]", "z [m]")


def error_over_distance(trajectories: Sequence[DrawnTrajectory]) -> Markup:
    """Position error over the distance, after alignment."""
    figure = Plot(logarithmic="y")
    for trajectory in _known(trajectories, "error_m"):
        known = np.isfinite(trajectory.error_m)
        x, y = _windowed(trajectory.distance_m[known], trajectory.error_m[known])
        figure.line(x, np.maximum(y, 1e-4), trajectory.color, dashes=trajectory.dashes)
    return _labeled(figure, "distance traveled [m]", "position error [m]")


def distribution(
    trajectories: Sequence[DrawnTrajectory], key: str, unit_scale: float, label: str, *, is_wide: bool = False
) -> Markup:
    """Cumulative distribution, shown up to the 99.5th percentile of the worst trajectory."""
    figure, ends = Plot(logarithmic="x", is_wide=is_wide), []
    for trajectory in _known(trajectories, key):
        values = getattr(trajectory, key)
        values = np.maximum(np.sort(unit_scale * values[np.isfinite(values)]), 1e-6)
        _cumulative(figure, trajectory, values)
        ends.append(np.percentile(values, _SHOWN_SHARES))
    figure.x.limit(0.9 * np.min(ends), 1.1 * np.max(ends))
    figure.y.limit(0.0, 100.0)
    return _labeled(figure, label, "share below [%]")


def time_per_scan(trajectories: Sequence[DrawnTrajectory]) -> Markup:
    """Milliseconds along the log."""
    figure = Plot(logarithmic="y")
    for trajectory in _known(trajectories, "seconds"):
        x, y = _windowed(np.arange(len(trajectory.seconds), dtype=np.float64), 1e3 * trajectory.seconds)
        figure.line(x, y, trajectory.color, 0.9, trajectory.dashes)
    return _labeled(figure, "scan", "time of a scan [ms]")


def consistency(trajectories: Sequence[DrawnTrajectory], degrees_of_freedom: int) -> Markup:
    """Distribution of the NEES beside the one that exact covariances would give (dotted)."""
    figure = Plot(logarithmic="x")
    for trajectory in _known(trajectories, "nees"):
        values = np.sort(trajectory.nees[np.isfinite(trajectory.nees)])
        _cumulative(figure, trajectory, np.maximum(values, 1e-4))
    shares = np.linspace(0.001, 0.999, 200)
    ideal = 2.0 * gammaincinv(0.5 * degrees_of_freedom, shares) / degrees_of_freedom  # quantiles of χ²
    figure.line(ideal, 100.0 * shares, INK, _THIN, _DOTS)
    figure.y.limit(0.0, 100.0)
    return _labeled(figure, "squared error over covariance (1 is exact on average)", "motions below [%]")


def observability(trajectories: Sequence[DrawnTrajectory], *, is_wide: bool) -> Markup:
    """Observability scan by scan; below 1 (dotted) a scan is degenerate."""
    figure = Plot(logarithmic="y", is_wide=is_wide)
    for trajectory in _known(trajectories, "observability"):
        x = np.arange(len(trajectory.observability), dtype=np.float64)
        known = np.clip(trajectory.observability, _LOWEST, _HIGHEST)
        figure.line(*_windowed(x, known, np.min), trajectory.color, dashes=trajectory.dashes)
    figure.level(1.0, _THIN, _DOTS)
    return _labeled(figure, "scan", "observability")


def innovations(
    curves: Mapping[str, tuple[Floats, str]], stretches: Sequence[tuple[int, int, str]], *, is_wide: bool
) -> Markup:
    """Innovations (N,) over their limits scan by scan, 1 (dotted) is a finding; stretches are shaded."""
    figure = Plot(is_wide=is_wide)
    for first, last, color in stretches:
        figure.span(first - 0.5, last + 0.5, color, 0.2)
    for values, color in curves.values():
        x = np.arange(len(values), dtype=np.float64)
        shown = np.clip(np.nan_to_num(values), _LOWEST, _HIGHEST)
        figure.line(*_windowed(x, shown, np.max), color, 0.9)
    figure.level(1.0, _THIN, _DOTS)
    return _labeled(figure, "scan", "innovation / limit")


def observability_plan(trajectory: DrawnTrajectory) -> Markup:
    """Observability on the trajectory from above, the worst scans on top; of many the worst of successive ones."""
    figure = Plot.of_plan(*frame([trajectory], None), spare_inches=_BAR_INCHES)
    values = np.nan_to_num(trajectory.observability, nan=_HIGHEST)
    groups = np.array_split(np.arange(len(values)), min(len(values), _MAX_DOTS))
    worst = np.array([group[np.argmin(values[group])] for group in groups])
    order = worst[np.argsort(-values[worst])]
    axis = Axis(is_logarithmic=True)
    axis.limit(_LOWEST, _HIGHEST, (_LOWEST, 1.0, _HIGHEST))
    palette = palette_of(_WORST_TO_BEST)
    shown = np.clip(values[order], _LOWEST, _HIGHEST)
    colors = palette[np.rint(255.0 * axis.fractions(shown)).astype(int), :3]
    size = float(np.sqrt(np.clip(3000.0 / len(values), 4.0, 30.0)))
    x, y = trajectory.positions[order, :2].T
    figure.dots(x, y, list(map(hex_of, colors)), size)
    figure.color_bar(palette, axis)
    figure.has_grid = True
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


def _cumulative(figure: Plot, trajectory: DrawnTrajectory, ordered: Floats) -> None:
    """Per cent of the values below each."""
    rows = np.unique(np.linspace(0, len(ordered) - 1, min(len(ordered), _MAX_POINTS)).astype(int))
    shares = np.linspace(0.0, 100.0, len(ordered))[rows]
    figure.line(ordered[rows], shares, trajectory.color, dashes=trajectory.dashes)


def _labeled(figure: Plot, x: str, y: str) -> Markup:
    """The figure with a grid and names of its axes."""
    figure.x.label, figure.y.label, figure.has_grid = x, y, True
    return figure.svg()


def _decimated(values: Floats) -> Floats:
    return values[:: max(1, -(-len(values) // _MAX_POINTS))]


def window(count: int) -> int:
    """Number of neighboring values, of so many, that make a point of a line."""
    return max(1, -(-count // _WINDOWS))


def _windowed(x: Floats, y: Floats, combine: Callable[..., Floats] = np.median) -> tuple[Floats, Floats]:
    """Neighboring values put together so that a line of them can be read."""
    size = window(len(x))
    count = len(x) // size * size
    if not count:
        return x, y
    return x[:count].reshape(-1, size).mean(axis=1), combine(y[:count].reshape(-1, size), axis=1)
