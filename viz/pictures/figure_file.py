"""A matplotlib figure as a PNG that is there whole or not at all."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scanchain.whole_file import write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_figure(path: Path, figure: Figure, **options: Any) -> None:
    """Write it on white; ``options`` are those of savefig. Raises OSError."""
    picture = BytesIO()
    figure.savefig(picture, facecolor="white", format="png", **options)
    write_whole(path, picture.getvalue())
