"""Pictures of landmark problems: before and after against the truth, and the sparsity of every factor."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix
from scanchain.landmarks.compare import MethodResult
from scanchain.landmarks.study import Estimate, Study
from scanchain_viz.pictures.figure import INK, SvgFigure, palette_of, write_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BEFORE, AFTER, _TRUTH = "#e07b00", "#1f5fd0", "#1a1a1a"
_FRAME = "#cccccc"
_ACROSS = 4  # panels of factors in a row
_PIXELS = 500  # largest width in pixels of a picture of a factor
_ELLIPSE = 2.4477  # standard deviations that hold 95 % of a Gaussian in the plane
_ELLIPSE_WIDTH, _ELLIPSE_OPACITY = 0.6, 0.5
_BLUES = ("f7fbff", "deebf7", "c6dbef", "9dcae1", "6aaed6", "4191c6", "2070b4", "08509b", "08306b")
_TITLE = {"loc": "left", "fontsize": 11}


def draw_estimate(path: Path, study: Study) -> None:
    """Draw trajectory and landmarks before and after optimization, side by side, over the truth, to a PNG.

    Landmarks after it carry their 95 % ellipses. All is in the frame of the truth where there is one.
    """
    from matplotlib.figure import Figure

    low, high = _frame(study)
    width, height = high - low
    figure = Figure(figsize=(11.0, float(np.clip(5.2 * height / width, 3.0, 9.0)) + 1.0), layout="constrained")
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    for axes, estimate, color, title in (
        (panels[0], study.before, BEFORE, "before"),
        (panels[1], study.after, AFTER, "after"),
    ):
        _draw_truth(axes, study)
        _draw_state(axes, estimate, color, title)
        accuracy = estimate.accuracy.poses_m
        error = f": poses {accuracy:.3g} m off" if np.isfinite(accuracy) else ""
        axes.set_title(f"{study.name}, {title}{error}", **_TITLE)
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
    _draw_ellipses(panels[1], study)
    panels[0].set_ylabel("y [m]", fontsize=9)
    _legend(figure)
    write_figure(path, figure, dpi=150, bbox_inches="tight")


def svg_before(study: Study) -> Markup:
    """Trajectory and landmarks before optimization, for a page."""
    return _svg(study, study.before, BEFORE).svg()


def svg_after(study: Study) -> Markup:
    """The same after it."""
    figure = _svg(study, study.after, AFTER)
    x, y = _in_truth(study.after)[1].T
    figure.ellipses(x, y, *ellipses(study), AFTER, _ELLIPSE_WIDTH, _ELLIPSE_OPACITY)
    return figure.svg()


def _svg(study: Study, estimate: Estimate, color: str) -> SvgFigure:
    figure = SvgFigure.of_plan(*_frame(study))
    (poses_x, poses_y), (x, y) = (each.T for each in _in_truth(estimate))
    (true_x, true_y), (there_x, there_y) = study.true_poses.T, study.true_landmarks.T
    figure.line(true_x, true_y, INK, 1.1, (4.0, 2.0))
    figure.line(poses_x, poses_y, color, opacity=0.85)
    figure.marks(there_x, there_y, "+", INK, 7.0, line=0.9)
    figure.marks(x, y, "o", color, 4.0, line=0.9)
    return figure


def svg_factor(method: MethodResult) -> Markup:
    """Sparsity of a method's factor."""
    size = len(method.factor.order)
    low, high = np.zeros(2), np.full(2, float(size))
    figure = SvgFigure.of_plan(low, high)
    figure.x.limit(0.0, size, ticks=(0, size))
    figure.y.limit(size, 0.0, ticks=(0, size))
    figure.x.label, figure.y.label = f"{method.factor.nnz:,} nonzero", ""
    figure.image(
        np.rint(255.0 * _shades(method)).astype(np.uint8), palette_of(_BLUES), low, high, rendering="auto"
    )
    return figure.svg()


def draw_factors(path: Path, studies: Sequence[Study]) -> None:
    """Draw the nonzero entries of every method's factor to a PNG; several problems stand side by side.

    The place of a method that a problem was not solved by stays empty.
    """
    from matplotlib.figure import Figure

    solved = [{method.method: method for method in study.methods} for study in studies]
    names = dict.fromkeys(name for methods in solved for name in methods)
    cells = [(study, methods.get(name)) for name in names for study, methods in zip(studies, solved, strict=True)]
    columns = len(studies) * max(1, min(_ACROSS, len(cells)) // len(studies))
    rows = -(-len(cells) // columns)
    figure = Figure(figsize=(2.9 * columns, (3.25 if len(studies) > 1 else 3.05) * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, (study, method) in zip(panels, cells, strict=False):
        if method is None:
            axes.set_axis_off()
        else:
            _draw_factor(axes, method, study.name if len(studies) > 1 else "")
    for axes in panels[len(cells) :]:
        axes.set_axis_off()
    write_figure(path, figure, dpi=130, bbox_inches="tight")


def _frame(study: Study) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners of the required view, with a margin."""
    parts = [study.true_poses, study.true_landmarks]
    for estimate in (study.before, study.after):
        parts += list(_in_truth(estimate))
    points = np.concatenate(parts)
    points = points[np.isfinite(points).all(axis=1)]
    low, high = points.min(axis=0), points.max(axis=0)
    margin = max(0.05 * float((high - low).max()), 1e-3)
    return low - margin, high + margin


def _in_truth(estimate: Estimate) -> tuple[Matrix, Matrix]:
    """Positions of poses and landmarks in the truth's frame."""
    state, T = estimate.state, estimate.T_truth_estimate
    return lie.transform(T, state.poses[:, :2]), lie.transform(T, state.landmarks)


def _draw_truth(axes: Axes, study: Study) -> None:
    axes.set_aspect("equal")
    axes.tick_params(labelsize=9, color=_FRAME)
    axes.set_xlabel("x [m]", fontsize=9)
    for spine in axes.spines.values():
        spine.set_color(_FRAME)
    if len(study.true_poses):
        axes.plot(*study.true_poses.T, color=_TRUTH, linewidth=1.1, linestyle=(0, (4, 2)), label="true trajectory")
    if np.isfinite(study.true_landmarks).any():
        axes.plot(
            *study.true_landmarks.T, color=_TRUTH, linestyle="none", marker="+", markersize=7,
            markeredgewidth=0.9, label="true landmarks", zorder=4,
        )  # fmt: skip


def _draw_state(axes: Axes, estimate: Estimate, color: str, when: str) -> None:
    poses, landmarks = _in_truth(estimate)
    axes.plot(*poses.T, color=color, linewidth=1.2, alpha=0.85, label=f"trajectory {when}", zorder=3)
    axes.plot(
        *landmarks.T, color=color, linestyle="none", marker="o", markersize=4, markeredgewidth=0.9,
        markerfacecolor="none", label=f"landmarks {when}", zorder=5,
    )  # fmt: skip


def ellipses(study: Study) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The 95 % ellipse of every landmark: half axes (N, 2) in meters, the longer first, and angle to x (N,)."""
    turn = study.after.T_truth_estimate[:2, :2]
    values, vectors = np.linalg.eigh(turn @ study.landmark_covariance @ turn.T)
    axes_m = _ELLIPSE * np.sqrt(np.maximum(values[:, ::-1], 0.0))
    return axes_m, np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])


def _draw_ellipses(axes: Axes, study: Study) -> None:
    from matplotlib.collections import EllipseCollection

    axes_m, angles_rad = ellipses(study)
    drawn = EllipseCollection(
        2.0 * axes_m[:, 0], 2.0 * axes_m[:, 1], np.degrees(angles_rad), units="xy",
        offsets=_in_truth(study.after)[1], offset_transform=axes.transData, facecolors="none", edgecolors=AFTER,
        linewidths=_ELLIPSE_WIDTH, alpha=_ELLIPSE_OPACITY, zorder=2,
    )  # fmt: skip
    axes.add_collection(drawn)


def _legend(figure: Figure) -> None:
    """One legend for both panels, each kind once."""
    from matplotlib.lines import Line2D

    found = {}
    for axes in figure.axes:
        found |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    found["95 % ellipse of a landmark"] = Line2D(
        [], [], color=AFTER, linewidth=_ELLIPSE_WIDTH, alpha=_ELLIPSE_OPACITY
    )
    figure.legend(
        list(found.values()), list(found), loc="outside lower center", ncols=4, frameon=False, fontsize=9
    )


def _shades(method: MethodResult) -> NDArray[np.float64]:
    """Nonzero entries dark, up to 1; a pixel that stands for many of them is as dark as they are dense."""
    matrix = method.factor.matrix.tocoo()
    there = matrix.data != 0.0
    size = len(method.factor.order)
    pixels = min(size, _PIXELS)
    count, _, _ = np.histogram2d(
        matrix.row[there], matrix.col[there], bins=pixels, range=[[-0.5, size - 0.5], [-0.5, size - 0.5]]
    )
    share = count / (size / pixels) ** 2
    return np.where(count > 0, 0.30 + 0.70 * np.sqrt(np.minimum(share, 1.0)), 0.0)


def _draw_factor(axes: Axes, method: MethodResult, problem: str) -> None:
    size = len(method.factor.order)
    shades = _shades(method)
    axes.imshow(shades, cmap="Blues", vmin=0.0, vmax=1.0, extent=(0, size, size, 0), interpolation="antialiased")
    axes.set_xticks([0, size])
    axes.set_yticks([0, size])
    axes.tick_params(labelsize=7, color=_FRAME, length=2)
    for spine in axes.spines.values():
        spine.set_color(_FRAME)
    title = f"{method.method}: {method.factor.name}"
    axes.set_title(f"{problem}\n{title}" if problem else title, fontsize=9, loc="left")
    axes.set_xlabel(f"{method.factor.nnz:,} nonzero", fontsize=8, labelpad=1)
