"""A map to be turned and zoomed in a page: points and lines packed into it, drawn by a script of its own."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from scanchain.data import Points
from scanchain.viz.pictures.trajectories import Floats, PathLine

SCRIPT = (Path(__file__).parent / "templates" / "map_viewer.js").read_text(encoding="utf-8")
_MAX_POINTS = 160_000  # 6 bytes each, 8 as text: 1.3 MB of a page
_MAX_LINE_POINTS = 4_000
_HIGHEST = 65_535.0
_BULK = (3.0, 97.0)  # percentiles of the points: what is in view at first, and the ends of the color scale
_WIDER = 1.8  # lines, on the canvas


def map_scene(
    points: Points, lines: Sequence[PathLine], low: Floats, high: Floats, *, grain_m: float, is_flat: bool
) -> Markup:
    """The canvas that ``SCRIPT`` draws a map (M, 3) and lines in; what lies outside of the corners is left out.

    grain_m : distance of neighboring points of the map, which is how large they are drawn from near by
    """
    inside = points[((points >= low) & (points <= high)).all(axis=1)]
    shown = inside[:: max(1, -(-len(inside) // _MAX_POINTS))]
    bulk = np.percentile(shown, _BULK, axis=0) if len(shown) and not is_flat else np.stack([low, high])
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
        '<canvas class="scene" tabindex="0" role="img" aria-label="Map and trajectory, to be turned and zoomed" '
        'data-scene="{}"></canvas><div class="buttons"></div>'
    )
    return template.format(json.dumps(scene, separators=(",", ":")))


def _line(line: PathLine, low: Floats, high: Floats) -> dict[str, object]:
    """As the script takes it: whole and thinned out, or, where it is broken, as pairs of points."""
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
