"""Pictures of pose graphs and landmark problems, before and after optimization, and the report of the latter."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain.data import GraphState
from scanchain.errors import InputError
from scanchain.graph.optimization import GraphChange, fit
from scanchain.landmarks.solvers import MethodResult
from scanchain.landmarks.study import Estimate, Study, accuracy_lines, file_stem, size_of, table_of
from scanchain_viz.colors import palette_of
from scanchain_viz.pictures.figure import INK, Plot, around, broken, write_png
from scanchain_viz.report import page

_CHAIN, _LOOP, _REJECTED = "#1f5fd0", "#8a8f98", "#d03030"
_SEEN_FROM = np.array([[0.80, 0.60, 0.0], [-0.30, 0.40, 0.866]])  # rows: right and up of an oblique view, in 3D
BEFORE, AFTER = "#e07b00", "#1f5fd0"
_ELLIPSE = math.sqrt(-2.0 * math.log(0.05))  # standard deviations that hold 95 % of a Gaussian in the plane
_BLUES = ("f7fbff", "deebf7", "c6dbef", "9dcae1", "6aaed6", "4191c6", "2070b4", "08509b", "08306b")
_TIMES = (
    "Times are medians; each method solves from scratch, including its analysis of the sparsity pattern (again: "
    "with that analysis reused)."
)
_DIFFERS = "Differs by: largest difference of any unknown from the first method."
_PINV = "pinv has no factor; the entries of (AᵀA)⁻¹ are shown and counted instead."


def draw_graph(change: GraphChange, path: Path) -> None:
    """Draw a graph to a PNG: from above in 2D, obliquely in 3D; before and after each in its own frame and scale.

    Raises OSError.
    """
    states = (("before", change.before), ("after", change.after))
    panels = [(f"{change.name} {when}\n{fit(state)}", _graph(state)) for when, state in states]
    write_png(path, panels, width_inches=6.0)


def _graph(state: GraphState) -> Plot:
    positions = state.poses[:, :-1, -1]
    is_flat = positions.shape[1] == 2
    seen = positions if is_flat else positions @ _SEEN_FROM.T
    low, high = around(seen)
    center, half = 0.5 * (low + high), 0.5 * (high - low).max()
    low, high = center - half, center + half  # a square, since the panels stand side by side
    figure = Plot.of_plan(low, high)
    if not is_flat:
        figure.x.label, figure.y.label = "seen obliquely from above [m]", ""
    chain, loops, rejected = state.drawn_edges
    width = float(np.clip(2000.0 / max(len(state.edges), 1), 0.25, 1.0))
    for edges, color, thickness, name in (
        (loops, _LOOP, width, "between poses that do not follow each other"),
        (chain, _CHAIN, 1.5 * width, "between successive poses"),
        (rejected, _REJECTED, width, "rejected"),
    ):
        if len(edges):
            figure.line(broken(seen[edges]), color, thickness, name=name)
    return figure


def _estimates(study: Study) -> tuple[Plot, Plot]:
    """Trajectory and landmarks before and after optimization, those after it with their 95 % ellipses."""
    before, after = _plot(study, study.before, BEFORE, "before"), _plot(study, study.after, AFTER, "after")
    axes_m, angles_rad = ellipses(study)
    around = np.linspace(0.0, 2.0 * np.pi, 37)  # every 10°
    along = axes_m[:, None] * np.stack([np.cos(around), np.sin(around)], axis=-1)
    c, s = np.cos(angles_rad), np.sin(angles_rad)
    outlines = along @ np.stack([c, s, -s, c], axis=-1).reshape(-1, 2, 2) + study.after.in_truth()[1][:, None]
    after.line(broken(outlines), f"{AFTER}80", 0.6, name="95 % ellipse of a landmark")
    return before, after


def _plot(study: Study, estimate: Estimate, color: str, when: str) -> Plot:
    """An estimate over the ground truth, in the truth's frame if there is one."""
    points = [study.true_poses, study.true_landmarks, *study.before.in_truth(), *study.after.in_truth()]
    figure = Plot.of_plan(*around(np.concatenate(points)))
    poses, landmarks = estimate.in_truth()
    if np.isfinite(study.true_poses).any():
        figure.line(_by_robot(study, study.true_poses), INK, 1.1, (4.0, 2.0), name="true trajectory")
    figure.line(_by_robot(study, poses), f"{color}d9", name=f"trajectory {when}")
    if np.isfinite(study.true_landmarks).any():
        figure.marks(study.true_landmarks, "+", INK, 7.0, line=0.9, name="true landmarks")
    figure.marks(landmarks, "o", color, 4.0, line=0.9, name=f"landmarks {when}")
    return figure


def _by_robot(study: Study, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points of all poses as one line, broken between robots."""
    return np.concatenate([np.pad(each, ((0, 1), (0, 0)), constant_values=np.nan) for each in study.paths(points)])


def ellipses(study: Study) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The 95 % ellipse of every landmark: half axes (N, 2) in meters, the longer first, and angle to x (N,)."""
    turn = study.after.T_truth_estimate[:2, :2]
    values, vectors = np.linalg.eigh(turn @ study.covariance.landmarks @ turn.T)
    axes_m = _ELLIPSE * np.sqrt(np.maximum(values[:, ::-1], 0.0))
    return axes_m, np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])


def _factor(method: MethodResult) -> Plot:
    """Nonzero entries of a method's factor, dark; a pixel of several entries is darker the denser they are."""
    matrix, size = method.factor.matrix.tocoo(), len(method.factor.order)
    there, pixels = matrix.data != 0.0, min(size, 500)
    count, _, _ = np.histogram2d(
        matrix.row[there], matrix.col[there], bins=pixels, range=[[-0.5, size - 0.5], [-0.5, size - 0.5]]
    )
    share = count / (size / pixels) ** 2
    shades = np.where(count > 0, 0.30 + 0.70 * np.sqrt(np.minimum(share, 1.0)), 0.0)
    low, high = np.zeros(2), np.full(2, float(size))
    figure = Plot.of_plan(low, high)
    figure.y.limit(size, 0.0)
    figure.x.label, figure.y.label = f"{method.factor.nnz:,} nonzero", ""
    figure.image(np.rint(255.0 * shades).astype(np.uint8), palette_of(_BLUES), low, high, rendering="auto")
    return figure


def write_report(directory: Path, studies: Sequence[Study]) -> None:
    """Write a PNG of every estimate, and report.html."""
    sections: list[page.Section] = []
    try:
        for study in studies:
            plots, panels = _estimates(study), []
            for plot, when, estimate in zip(plots, ("before", "after"), (study.before, study.after), strict=True):
                error = f": poses {estimate.poses_m:.3g} m off" if np.isfinite(estimate.poses_m) else ""
                panels.append((f"{study.name}, {when}{error}", plot))
            write_png(directory / f"{file_stem(study.name)}.png", panels, width_inches=5.5)
            sections += [_estimate_section(study, *plots), _solver_section(study)]
        title = f"Landmark problem{'s' if len(studies) > 1 else ''}"
        names = ", ".join(study.name for study in studies)
        definitions = dict.fromkeys(study.after.definition for study in studies)
        definition = page.Collapsible("Definition of the errors", "\n\n".join(definitions))
        page.write_page(directory, page.Page(title, names, sections=sections, collapsibles=[definition]))
    except OSError as error:
        raise InputError(f"{directory}: not writable ({error.strerror}); choose another --out") from error


def _estimate_section(study: Study, before: Plot, after: Plot) -> page.Section:
    (_, error_before), (_, error_after), _ = accuracy_lines(study)
    facts = [("error before, rmse", error_before), ("error after, rmse", error_after)]
    facts += study.facts.items()
    chips, marks = [page.Chip("before", BEFORE), page.Chip("after", AFTER)], "Circles: landmarks"
    if np.isfinite(study.true_poses).any() or np.isfinite(study.true_landmarks).any():
        chips.append(page.Chip("truth", INK, is_dashed=True))
        marks += "; crosses: true ones"
    drawings = (
        page.Drawing.of("Before optimization", f"{marks}.", before),
        page.Drawing.of("After optimization", f"{marks}; ellipses: 95 %.", after),
    )
    return page.Section(study.name, facts=facts, chips=chips, drawings=drawings)


def _solver_section(study: Study) -> page.Section:
    factors = [
        page.Drawing.of(f"{method.method}: {method.factor.name}", "", _factor(method)) for method in study.methods
    ]
    text = f"The Jacobian A has {size_of(study)}. The pictures show the nonzero entries of each method's factor."
    headings, *rows = table_of(study)
    split = [heading.partition(" ms") for heading in headings]
    heads = [page.Head(name, unit.strip()) for name, unit, _ in split]
    notes = [_TIMES, _DIFFERS if len(rows) > 1 else "--methods all compares the linear solvers."]
    notes += [_PINV] if any(method.method == "pinv" for method in study.methods) else []
    grid = page.Grid(heads, [page.Row(name, cells) for name, *cells in rows], notes)
    return page.Section(f"Linear solvers on {study.name}", text, grid=grid, drawings=factors, is_small=True)
