"""The map of a report to move and turn: a canvas with points and lines for templates/map_viewer.js."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from scanchain.data import Points
from scanchain_viz.pictures.figure import Floats, Line
from scanchain_viz.report.page import Drawing

SCRIPT = (Path(__file__).parent / "templates" / "map_viewer.js").read_text(encoding="utf-8")
_MAX_POINTS = 160_000  # 6 bytes each, 8 as text: 1.3 MB of a page
_MAX_LINE_POINTS = 4_000
_HIGHEST = 65_535.0
_BULK = (3.0, 97.0)  # percentiles of the points: what is in view at first, and the ends of the color scale
_BULK_2D, _MARGIN = (0.5, 99.5), 0.03  # the same of a flat map, and its share that is added on each side
_WIDEST = 3.0  # greatest width of a flat map's canvas over its height
_WIDER = 1.8  # lines, on the canvas


def interactive_map(
    points: Points, lines: Sequence[Line], low: Floats, high: Floats, *, grain_m: float, is_flat: bool,
    is_wide: bool = False,
) -> Drawing:  # fmt: skip
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
    canvas = Markup(
        '<canvas class="scene"{} tabindex="0" role="img" aria-label="Map and trajectory, to rotate and zoom" '
        'data-scene="{}"></canvas><div class="buttons"></div>'
    )
    style = Markup(' style="height: auto; aspect-ratio: {:.3f}"').format(min(width / height, _WIDEST))
    drag = "Drag to move" if is_flat else "Drag to rotate, Shift-drag to move"
    text = f"{drag}, click it and scroll to zoom, double-click to reset; two fingers zoom and move."
    svg = canvas.format(style if is_flat else "", json.dumps(scene, separators=(",", ":")))
    return Drawing("Interactive map", text, svg, is_wide=is_wide)


def _flat_view(points: Points, lines: Sequence[Line], low: Floats, high: Floats) -> Floats:
    """Corners (2, 3) of what is in view at first: all lines and most points, with a margin."""
    bulk = np.percentile(points, _BULK_2D, axis=0) if len(points) else np.empty((0, 3))
    seen = np.vstack([bulk, *(line.positions for line in lines)])
    first, last = np.nanmin(seen, axis=0), np.nanmax(seen, axis=0)
    margin = _MARGIN * (last - first)
    return np.stack([np.maximum(first - margin, low), np.minimum(last + margin, high)])


def _line(line: Line, low: Floats, high: Floats) -> dict[str, object]:
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
