"""Trajectory and map in the report of a run: states of the scans, closures by verdict, truth; flat and in 3D."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from markupsafe import Markup
from numpy.typing import NDArray

from scanchain.data import BACK_END, Points, State
from scanchain.errors import counted
from scanchain.verdict import Kind, Stretch
from scanchain_viz.colors import STRETCH_COLORS
from scanchain_viz.pictures import trajectory_figures as figures
from scanchain_viz.pictures.figure import broken
from scanchain_viz.pictures.map_figures import map_picture, path_over_map, surroundings
from scanchain_viz.pictures.trajectory_figures import CLOSURES, TRUTH, DrawnTrajectory, Floats, PathLine
from scanchain_viz.report.page import Chip, Drawing, Section

_DISPUTED = "at closures rejected by the back end"
_OVER_ALL = (
    Kind.OVERLAP,
    Kind.WHEELS,
    Kind.ACCELERATION,
    Kind.DISCONNECTED,
    Kind.COPIES,
)  # drawn over the states of single scans
_COLORS = {
    _DISPUTED: STRETCH_COLORS[Kind.LOOPS],
    State.DEGENERATE: STRETCH_COLORS[Kind.DEGENERATE],
    State.LOST: STRETCH_COLORS[Kind.LOST],
    State.CONTRADICTED: STRETCH_COLORS[Kind.CONTRADICTED],
} | {kind: STRETCH_COLORS[kind] for kind in _OVER_ALL}  # a scan may have several; the later are drawn on top
_MAX_SEGMENTS = 3000  # largest number of segments of a path; of longer ones the worst state of successive scans
_MAX_CLOSURES = 1500  # largest number of closures of a verdict


@dataclass(frozen=True, slots=True)
class Tables:
    """Tables of a run: a row a scan, a row a closure tried (None without loop closing), suspicious stretches."""

    steps: pa.Table
    closures: pa.Table | None
    stretches: Sequence[Stretch] = ()

    @classmethod
    def read(cls, steps: pa.Table, closures_file: Path, stretches: Sequence[Stretch]) -> Tables:
        """With the closures, where their file is."""
        return cls(steps, pq.ParquetFile(closures_file).read() if closures_file.exists() else None, stretches)


def trajectory_section(
    trajectory: DrawnTrajectory, tables: Tables, truth: Floats | None, points: Points, grain_m: float
) -> Section:
    """The optimized path and the map (M, 3), in one frame; ``truth`` (K, 3) likewise, None where there is none.

    grain_m : of the map
    """
    is_flat = not np.ptp(points[:, 2]) if len(points) else True
    lines, chips = zip(*_lines(trajectory.positions, tables, truth), strict=True)
    low, high = surroundings(*figures.frame([trajectory], truth), [points])
    above = "seen from above; dark is low, bright is high."
    over_map = path_over_map(points, trajectory.positions, lines, low, high)
    drawings = (
        Drawing("Trajectory over the map", "Seen from above; circle: start, square: end.", over_map),
        *(() if is_flat else (Drawing("Map", f"map.ply, {above}", map_picture(points, low, high)),)),
        interactive_map(points, lines, low, high, grain_m=grain_m, is_flat=is_flat, is_wide=not is_flat),
    )
    return Section("Trajectory and map", chips=chips, drawings=drawings)


def _lines(path: Floats, tables: Tables, truth: Floats | None) -> Iterator[tuple[PathLine, Chip]]:
    """Lines with their legends, the path first; empty ones are omitted."""
    yield PathLine(path, "#2f7de1", 1.2), Chip("trajectory", "#2f7de1")
    yield from _closure_lines(path, tables.closures)
    states = np.array(tables.steps["state"].to_pylist())
    for mark, color in _COLORS.items():
        is_marked = states == mark if isinstance(mark, State) else _is_marked(tables, mark)
        if is_marked.any():
            name = f"{mark}: {counted(int(is_marked.sum()), 'scan')}"
            yield PathLine(_marked_parts(path, is_marked), color, 2.6), Chip(name, color)
    if truth is not None:
        yield PathLine(truth, TRUTH, 0.9, is_dashed=True), Chip("ground truth", TRUTH, is_dashed=True)


def _closure_lines(path: Floats, closures: pa.Table | None) -> Iterator[tuple[PathLine, Chip]]:
    if closures is None or not closures.num_rows:
        return
    ends = np.stack([closures["target_scan"].to_numpy(), closures["source_scan"].to_numpy()], axis=1)
    rejected_by = np.array(closures["rejected_by"].to_pylist())
    for by, (name, color) in CLOSURES.items():
        chosen = rejected_by == by
        count = int(chosen.sum())
        if count:
            pairs = path[ends[chosen][:: max(1, -(-count // _MAX_CLOSURES))]]
            yield PathLine(broken(pairs), color, 0.9), Chip(f"closures {name}: {count:,}", color)


def _is_marked(tables: Tables, mark: Kind | str) -> NDArray[np.bool_]:
    """(N,) scans of stretches of a kind, or at closures that the back end rejected."""
    is_marked = np.zeros(len(tables.steps), bool)
    if mark == _DISPUTED:
        parts = _disputed(tables)
    else:
        parts = [slice(each.first, each.last + 1) for each in tables.stretches if each.kind == mark]
    for part in parts:
        is_marked[part] = True
    return is_marked


def _disputed(tables: Tables) -> list[slice]:
    """Scans from each keyframe of a closure that the back end rejected to the next keyframe."""
    if tables.closures is None or not tables.closures.num_rows:
        return []
    keyframes = np.append(np.flatnonzero(tables.steps["keyframe"].to_numpy() >= 0), len(tables.steps))
    is_rejected = np.array(tables.closures["rejected_by"].to_pylist()) == BACK_END
    ends = np.stack([tables.closures[name].to_numpy() for name in ("target_scan", "source_scan")])
    firsts = np.unique(ends[:, is_rejected])
    lasts = keyframes[np.searchsorted(keyframes, firsts, side="right")]
    return [slice(first, last) for first, last in zip(firsts.tolist(), lasts.tolist(), strict=True)]


def _marked_parts(path: Floats, is_marked: NDArray[np.bool_]) -> Floats:
    """The segments of the path that lead to a marked scan, NaN elsewhere."""
    size = max(1, -(-len(path) // _MAX_SEGMENTS))
    groups = [slice(k, k + size) for k in range(0, len(path), size)]
    has_marked = np.array([bool(is_marked[group].any()) for group in groups])
    positions = path[[min(group.stop, len(path)) - 1 for group in groups]].copy()
    shown = has_marked | np.append(has_marked[1:], False)
    positions[~shown] = np.nan
    return positions


SCRIPT = (Path(__file__).parent / "templates" / "map_viewer.js").read_text(encoding="utf-8")
_MAX_POINTS = 160_000  # 6 bytes each, 8 as text: 1.3 MB of a page
_MAX_LINE_POINTS = 4_000
_HIGHEST = 65_535.0
_BULK = (3.0, 97.0)  # percentiles of the points: what is in view at first, and the ends of the color scale
_BULK_2D, _MARGIN = (0.5, 99.5), 0.03  # the same of a flat map, and its share that is added on each side
_WIDEST = 3.0  # greatest width of a flat map's canvas over its height
_WIDER = 1.8  # lines, on the canvas


def interactive_map(
    points: Points, lines: Sequence[PathLine], low: Floats, high: Floats, *, grain_m: float, is_flat: bool,
    is_wide: bool = False,
) -> Drawing:  # fmt: skip
    """A map and lines to move and turn, as ``map_scene`` makes it."""
    drag = "Drag to move" if is_flat else "Drag to rotate, Shift-drag to move"
    text = f"{drag}, click it and scroll to zoom, double-click to reset; two fingers zoom and move."
    scene = map_scene(points, lines, low, high, grain_m=grain_m, is_flat=is_flat)
    return Drawing("Interactive map", text, scene, is_wide=is_wide)


def map_scene(
    points: Points, lines: Sequence[PathLine], low: Floats, high: Floats, *, grain_m: float, is_flat: bool
) -> Markup:
    """The canvas in which ``SCRIPT`` draws a map (M, 3) and lines; points outside of the corners are left out.

    grain_m : distance of neighboring points of the map, which is how large they are drawn from near by
    """
    inside = points[((points >= low) & (points <= high)).all(axis=1)]
    shown = inside[:: max(1, -(-len(inside) // _MAX_POINTS))]
    if is_flat:
        bulk = _flat_view(shown, lines, low, high)
    else:
        bulk = np.percentile(shown, _BULK, axis=0) if len(shown) else np.stack([low, high])
    width, height = (bulk[1] - bulk[0])[:2]
    scene = {
        "box": [low.tolist(), high.tolist()],
        "view": bulk.tolist(),
        "heights": bulk[:, 2].tolist(),
        "grain": grain_m * np.sqrt(max(len(inside), 1) / max(len(shown), 1)),
        "flat": is_flat,
        "points": _packed(shown, low, high),
        "lines": [_line(line, low, high) for line in lines if len(line.positions)],
    }
    template = Markup(
        '<canvas class="scene"{} tabindex="0" role="img" aria-label="Map and trajectory, to rotate and zoom" '
        'data-scene="{}"></canvas><div class="buttons"></div>'
    )
    style = Markup(' style="height: auto; aspect-ratio: {:.3f}"').format(min(width / height, _WIDEST))
    return template.format(style if is_flat else "", json.dumps(scene, separators=(",", ":")))


def _flat_view(points: Points, lines: Sequence[PathLine], low: Floats, high: Floats) -> Floats:
    """Corners (2, 3) of what is in view at first: all lines and most points, with a margin."""
    bulk = np.percentile(points, _BULK_2D, axis=0) if len(points) else np.empty((0, 3))
    seen = np.vstack([bulk, *(line.positions for line in lines)])
    first, last = np.nanmin(seen, axis=0), np.nanmax(seen, axis=0)
    margin = _MARGIN * (last - first)
    return np.stack([np.maximum(first - margin, low), np.minimum(last + margin, high)])


def _line(line: PathLine, low: Floats, high: Floats) -> dict[str, object]:
    """A line for the script: whole and downsampled, or, where it is broken, as pairs of points."""
    positions, is_known = line.positions, np.isfinite(line.positions[:, 0])
    if is_broken := not is_known.all():
        starts = np.flatnonzero(is_known[:-1] & is_known[1:])
        positions = positions[np.stack([starts, starts + 1], axis=1).ravel()]
    elif len(positions) > _MAX_LINE_POINTS:
        positions = positions[np.linspace(0, len(positions) - 1, _MAX_LINE_POINTS).astype(int)]
    return {
        "points": _packed(positions, low, high),
        "color": line.color,
        "width": _WIDER * line.width,
        "dashed": line.is_dashed,
        "pairs": is_broken,
    }


def _packed(positions: NDArray[np.floating], low: Floats, high: Floats) -> str:
    """As 16-bit fractions of the box, least significant byte first, in base64."""
    size = np.maximum(high - low, 1e-9)
    fractions = np.clip(np.rint(_HIGHEST * (positions - low) / size), 0.0, _HIGHEST)
    return b64encode(fractions.astype("<u2").tobytes()).decode("ascii")
