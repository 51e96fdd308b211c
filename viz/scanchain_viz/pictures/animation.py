"""The growing map of a run, seen from above, as an animated GIF."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from scanchain import lie
from scanchain.errors import InputError
from scanchain.files import write_whole
from scanchain.maps import open_saved_map
from scanchain_viz.colors import height_shares, palette_of, rgb
from scanchain_viz.pictures.maps import VIRIDIS, map_points, surroundings

_MOST_BYTES = 3_000_000  # a larger file is drawn again with half the frames
_HEIGHTS = 48  # colors of 3D points, from low to high; points of a plane have one
_BACKGROUND, _POINTS, _PATH, _HEAD = "#12161b", "#e7eaee", "#ff8a3d", "#ffffff"
_SHADES = VIRIDIS[4:]  # without those that are as dark as the background


def draw_growing_map(directory: Path, picture: Path) -> None:
    """Draw the points of the keyframes as they are added, and the path up to each, at their final poses.

    directory : of a run or a merge
    Raises InputError where it holds no map, or the picture cannot be written.
    """
    saved = open_saved_map(directory)
    clouds = map_points(saved)
    positions = lie.lift(saved.poses)[:, :3, 3]
    low, high = surroundings(positions, [np.vstack(clouds)])
    scale = min(side / max(size, 1e-6) for side, size in zip((720, 540), (high - low)[:2], strict=True))
    width, height = np.maximum(np.ceil(scale * (high - low)[:2]), 1.0).astype(int).tolist()

    def pixels(points: np.ndarray) -> np.ndarray:
        """Columns and rows (N, 2) of positions."""
        return np.stack([scale * (points[:, 0] - low[0]), scale * (high[1] - points[:, 1])], axis=1)

    points, of_keyframe = np.vstack(clouds), np.repeat(np.arange(len(clouds)), list(map(len, clouds)))
    column, row = pixels(points).astype(int).T
    seen = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    is_planar, shades = saved.dimension == 2, np.ones(len(points), np.uint8)
    if not is_planar:
        shades += np.rint((_HEIGHTS - 1) * height_shares(points[:, 2])).astype(np.uint8)
    colors = [rgb(_POINTS)] if is_planar else palette_of(_SHADES, _HEIGHTS)[:, :3].tolist()
    palette = [rgb(_BACKGROUND), *colors, rgb(_PATH), rgb(_HEAD)]
    path, head = len(palette) - 2, len(palette) - 1
    way = pixels(positions)

    def frames(count: int) -> list[Image.Image]:
        canvas, drawn, found = np.zeros((height, width), np.uint8), 0, []
        for last in np.unique(np.linspace(1, len(clouds), count).astype(int)).tolist():
            new = seen & (of_keyframe >= drawn) & (of_keyframe < last)
            np.maximum.at(canvas, (row[new], column[new]), shades[new])
            drawn = last
            image = Image.fromarray(canvas)
            image.putpalette(np.array(palette, np.uint8).tobytes())
            pen, (x, y) = ImageDraw.Draw(image), way[last - 1].tolist()
            pen.line([tuple(each) for each in way[:last].tolist()], fill=path, width=2)
            pen.ellipse([x - 4.0, y - 4.0, x + 4.0, y + 4.0], fill=head, outline=path)
            found.append(image)
        return found

    count = min(72, len(clouds))
    data = _gif(frames(count))
    while len(data) > _MOST_BYTES and count > 1:
        count //= 2
        data = _gif(frames(count))
    try:
        write_whole(picture, data)
    except OSError as error:
        raise InputError(f"{picture}: not writable ({error.strerror}); choose another path") from error


def _gif(frames: list[Image.Image]) -> bytes:
    """The frames one after the other, endlessly, the last one for longer."""
    file, first = BytesIO(), frames[0]
    times_ms = [70] * (len(frames) - 1) + [2500]
    first.save(file, "GIF", save_all=True, append_images=frames[1:], duration=times_ms, loop=0, disposal=1)
    return file.getvalue()
