"""Figures of trajectories: where they went, their errors, time per scan, consistency and observability."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray
from scipy.special import gammaincinv

from scanchain.runs.closures import BACK_END, VERIFICATION
from scanchain.viz.pictures.figure import INK, Sheet

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]

# Told apart on white and on black, also by most who see colors differently.
_COLORS = (
    "#2f7de1", "#e0532f", "#1aa179", "#c77800", "#a55bd6", "#d6457f", "#0f9bb5", "#7f8c1d", "#8a6d5b", "#8c9096",
    "#b0413e", "#5f8f57",
)  # fmt: skip

TRUTH = "#e0269e"  # dashed; on white and on black like the others, and never one of theirs
CLOSURES = {  # by whom a closure was rejected, "" where it was accepted: what it is called and its line's color
    VERIFICATION: ("rejected by verification", "#8a6d5b"),
    BACK_END: ("rejected by the back end", "#0f9bb5"),
    "": ("accepted", "#3f9b2f"),
}


@dataclass(frozen=True, slots=True)
class Course:
    """A way and its scans, N of them; numbers that are not known are NaN, all or some.

    Attributes
    ----------
    name : for legends outside the drawings
    color, is_dashed : how its line is drawn
    positions : (N, 3) meters, in one frame with the other courses
    distance_m : (N,) traveled
    error_m : (N,) distance from where it was
    relation_error_m : (K,) the same of K relations, none where there are no relations
    seconds : (N,) what each scan took
    nees : (N,) squared error over covariance, 1 on average if exact
    observability : (N,) how many times the least that must be known is known of the worst direction
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
    """Of the method at this place of the table."""
    return _COLORS[place % len(_COLORS)]


_MAX_POINTS = 1500  # of a line
_WINDOWS = 250  # that a value a scan is averaged over
_MARGIN = 0.25
_FEW_DECADES = 60.0
_SHOWN_SHARES = (0.5, 99.5)  # per cent of the values of a distribution
_DOTTED: dict[str, Any] = {"color": INK, "linewidth": 0.8, "linestyle": (0, (1, 1.5))}
_TRUTH: dict[str, Any] = {"color": TRUTH, "linewidth": 0.9, "linestyle": (0, (3, 3))}
_BLIND, _PLAIN = 0.01, 1000.0  # times the least that must be known; less and more are drawn as that
_BAR_INCHES = 0.65  # of a color bar and its numbers


def plan(name: str, courses: Sequence[Course], truth: Floats | None, low: Floats, high: Floats) -> Markup:
    """Seen from above, within corners."""
    with Sheet.of_plan(name, low, high) as sheet:
        _each(sheet.axes, courses, lambda course: (course.positions[:, 0], course.positions[:, 1]))
        if truth is not None:
            sheet.axes.plot(*_thinned(truth)[:, :2].T, **_TRUTH)
        sheet.axes.grid(visible=True)
        return sheet.svg()


def height(name: str, courses: Sequence[Course], truth: Floats | None, low: Floats, high: Floats) -> Markup:
    """Height over the distance traveled, within corners."""
    with Sheet(name) as sheet:
        _each(sheet.axes, courses, lambda course: (course.distance_m, course.positions[:, 2]))
        if truth is not None:
            steps_m = np.linalg.norm(np.diff(truth, axis=0), axis=1)
            way_m = np.append(0.0, np.cumsum(steps_m))
            rows = np.linspace(0, len(truth) - 1, min(len(truth), _MAX_POINTS)).astype(int)
            sheet.axes.plot(way_m[rows], truth[rows, 2], **_TRUTH)
        sheet.axes.set_ylim(low[2], high[2])
        longest_m = np.median([course.distance_m[-1] for course in courses if len(course.distance_m)])
        sheet.axes.set_xlim(0.0, 1.05 * max(float(longest_m), 1.0))
        _label(sheet.axes, "distance traveled [m]", "z [m]")
        return sheet.svg()


def error_over_distance(name: str, courses: Sequence[Course]) -> Markup:
    """Position error along the way, after alignment."""
    with Sheet(name) as sheet:
        for course in _known(courses, "error_m"):
            known = np.isfinite(course.error_m)
            x, y = _windowed(course.distance_m[known], course.error_m[known])
            sheet.axes.plot(x, np.maximum(y, 1e-4), **course.style)
        _logarithmic(sheet.axes, "y")
        _label(sheet.axes, "distance traveled [m]", "position error [m]")
        return sheet.svg()


def distribution(name: str, courses: Sequence[Course], key: str, unit_scale: float, label: str) -> Markup:
    """Share below a value, which is shown up to the 99.5th percentile of the worst course."""
    with Sheet(name) as sheet:
        ends = []
        for course in _known(courses, key):
            values = getattr(course, key)
            values = np.maximum(np.sort(unit_scale * values[np.isfinite(values)]), 1e-6)
            _cumulative(sheet.axes, course, values)
            ends.append(np.percentile(values, _SHOWN_SHARES))
        sheet.axes.set_xlim(0.9 * np.min(ends), 1.1 * np.max(ends))
        _logarithmic(sheet.axes, "x")
        sheet.axes.set_ylim(0.0, 100.0)
        _label(sheet.axes, label, "share below [%]")
        return sheet.svg()


def time_per_scan(name: str, courses: Sequence[Course]) -> Markup:
    """Milliseconds along the log."""
    with Sheet(name) as sheet:
        for course in _known(courses, "seconds"):
            x, y = _windowed(np.arange(len(course.seconds), dtype=np.float64), 1e3 * course.seconds)
            sheet.axes.plot(x, y, **{**course.style, "linewidth": 0.9})
        _logarithmic(sheet.axes, "y")
        _label(sheet.axes, "scan", "time of a scan [ms]")
        return sheet.svg()


def consistency(name: str, courses: Sequence[Course], degrees_of_freedom: int) -> Markup:
    """Distribution of the NEES beside the one that exact covariances would give (dotted)."""
    with Sheet(name) as sheet:
        for course in _known(courses, "nees"):
            values = np.sort(course.nees[np.isfinite(course.nees)])
            _cumulative(sheet.axes, course, np.maximum(values, 1e-4))
        shares = np.linspace(0.001, 0.999, 200)
        ideal = 2.0 * gammaincinv(0.5 * degrees_of_freedom, shares) / degrees_of_freedom  # quantiles of χ²
        sheet.axes.plot(ideal, 100.0 * shares, **_DOTTED)
        _logarithmic(sheet.axes, "x")
        sheet.axes.set_ylim(0.0, 100.0)
        _label(sheet.axes, "squared error over covariance (1 is exact on average)", "motions below [%]")
        return sheet.svg()


def observability(name: str, courses: Sequence[Course]) -> Markup:
    """What is known of the worst direction, scan by scan; below 1 (dotted) a scan is degenerate."""
    with Sheet(name) as sheet:
        for course in _known(courses, "observability"):
            x = np.arange(len(course.observability), dtype=np.float64)
            known = np.clip(course.observability, _BLIND, _PLAIN)
            sheet.axes.plot(*_windowed(x, known, np.min), **course.style)
        sheet.axes.axhline(1.0, **_DOTTED)
        _logarithmic(sheet.axes, "y")
        _label(sheet.axes, "scan", "times the least")
        return sheet.svg()


def observability_plan(name: str, course: Course) -> Markup:
    """The same on the way itself, the worst scans on top."""
    from matplotlib.colors import LogNorm

    low, high = frame([course], None)
    order = np.argsort(-course.observability)
    with Sheet.of_plan(name, low, high, spare=_BAR_INCHES) as sheet:
        x, y = course.positions[order, :2].T
        size = float(np.clip(3000.0 / len(order), 4.0, 30.0))
        dots = sheet.axes.scatter(
            x, y, c=np.clip(course.observability[order], 1.0, _PLAIN), s=size, cmap="cool_r", linewidths=0,
            norm=LogNorm(1.0, _PLAIN), rasterized=True,
        )  # fmt: skip
        bar = sheet.figure.colorbar(dots, ax=sheet.axes, pad=0.02, aspect=15, format=_plain)
        bar.ax.minorticks_off()
        bar.outline.set_visible(False)
        sheet.axes.grid(visible=True)
        return sheet.svg()


def frame(courses: Sequence[Course], truth: Floats | None) -> tuple[Floats, Floats]:
    """Corners (3,) of what is shown: the truth's where there is one, else those of the courses, and a margin."""
    ways = [truth] if truth is not None else [course.positions for course in courses]
    low = np.min([way.min(axis=0) for way in ways], axis=0)
    high = np.max([way.max(axis=0) for way in ways], axis=0)
    size = high - low
    margin = np.array([max(0.08 * size[:2].max(), 1.0)] * 2 + [max(_MARGIN * size[2], 0.1)])
    return low - margin, high + margin


def _known(courses: Sequence[Course], key: str) -> list[Course]:
    """Those of which anything is known, the first of them drawn last and so on top."""
    return [course for course in reversed(courses) if np.isfinite(getattr(course, key)).any()]


def _each(axes: Axes, courses: Sequence[Course], line: Callable[[Course], tuple[Floats, Floats]]) -> None:
    for course in reversed(courses):
        if len(course.positions):
            axes.plot(*(_thinned(values) for values in line(course)), **course.style)


def _cumulative(axes: Axes, course: Course, ordered: Floats) -> None:
    """Per cent of the values below each."""
    rows = np.unique(np.linspace(0, len(ordered) - 1, min(len(ordered), _MAX_POINTS)).astype(int))
    axes.plot(ordered[rows], np.linspace(0.0, 100.0, len(ordered))[rows], **course.style)


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


def _thinned(values: Floats) -> Floats:
    return values[:: max(1, -(-len(values) // _MAX_POINTS))]


def _windowed(x: Floats, y: Floats, combine: Callable[..., Floats] = np.median) -> tuple[Floats, Floats]:
    """Neighboring values put together so that a line of them can be read."""
    size = max(1, -(-len(x) // _WINDOWS))
    count = len(x) // size * size
    if not count:
        return x, y
    return x[:count].reshape(-1, size).mean(axis=1), combine(y[:count].reshape(-1, size), axis=1)
