"""Colors, what they stand for in reports, figures and recordings, and palettes."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanchain.data import BACK_END, VERIFICATION
from scanchain.verdict import Kind

# Distinguishable from each other on white and on black, also with red-green color blindness.
SEGMENT_COLORS: dict[str, str] = {
    Kind.DEGENERATE: "#dc9a00",
    Kind.LOST: "#b3150c",
    Kind.CONTRADICTED: "#7638b8",
    Kind.WHEELS: "#c29086",
    Kind.SCANS_SLIP: "#be123c",
    Kind.WHEELS_SLIP: "#64748b",
    Kind.ACCELERATION: "#0a7d8c",
    Kind.LOOPS: "#3a35ff",
    Kind.OVERLAP: "#65aae4",
    Kind.DISCONNECTED: "#6b7280",
    Kind.COPIES: "#4d7c0f",
}
CLOSURES = {  # what rejected a closure, "" if it was accepted: its name in legends and its line's color
    VERIFICATION: ("rejected by verification", "#f0958d"),
    BACK_END: ("rejected by the back end", "#eb463c"),
    "": ("accepted", "#3f9b2f"),
}
ODOMETRY, OPTIMIZED = "#d0611d", "#2f7de1"
TRUTH = "#cf1f86"  # dashed, and never the color of a method
# Distinguishable on white and on black, also for most color-blind readers.
_COLORS = (
    "#2f7de1", "#e0532f", "#1aa179", "#c77800", "#a55bd6", "#d6457f", "#0f9bb5", "#7f8c1d", "#8a6d5b", "#8c9096",
    "#b0413e", "#5f8f57",
)  # fmt: skip


def color_of_kind(kind: str) -> str:
    """Color of a kind of finding; gray for one of a check of the user's own."""
    return SEGMENT_COLORS.get(kind, _COLORS[9])


def color_of(place: int) -> str:
    """Color of the method or session at this row of the table."""
    return _COLORS[place % len(_COLORS)]


def rgb(color: str) -> tuple[int, int, int]:
    """Red, green and blue of #rrggbb."""
    red, green, blue = bytes.fromhex(color.removeprefix("#"))
    return red, green, blue


def height_shares(z: NDArray[np.floating]) -> NDArray[np.floating]:
    """(N,) heights scaled and clipped to 0 at their 2nd percentile and 1 at their 98th."""
    low, high = np.percentile(z, (2.0, 98.0))
    return np.clip((z - low) / max(float(high - low), 1e-9), 0.0, 1.0)


def between(anchors: Sequence[tuple[int, int, int]], shares: NDArray[np.floating]) -> NDArray[np.uint8]:
    """(N, 3) colors interpolated between evenly spaced anchors, at fractions (N,) from 0 to 1."""
    places = shares * (len(anchors) - 1.0)
    channels = np.array(anchors, np.float64).T
    mixed = np.stack([np.interp(places, np.arange(len(anchors)), channel) for channel in channels], axis=1)
    return np.rint(mixed).astype(np.uint8)


def palette_of(colors: Sequence[str], count: int = 256) -> NDArray[np.uint8]:
    """(K, 4) opaque colors interpolated between evenly spaced anchors, #rrggbb."""
    mixed = between([rgb(color) for color in colors], np.linspace(0.0, 1.0, count))
    return np.pad(mixed, ((0, 0), (0, 1)), constant_values=255)
