"""An array that grows at its end, with room kept in reserve so that appending costs little on average."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


class GrowingArray:
    """Rows of one shape and type; the room doubles when it is full."""

    def __init__(self, row_shape: tuple[int, ...], dtype: type) -> None:
        self._room = np.empty((16, *row_shape), dtype)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def append(self, row: Any) -> int:
        """Index of the row, now the last."""
        if self._count == len(self._room):
            self._make_room(self._count + 1)
        self._room[self._count] = row
        self._count += 1
        return self._count - 1

    def extend(self, rows: NDArray[Any]) -> None:
        """Append rows (n, ...)."""
        end = self._count + len(rows)
        if end > len(self._room):
            self._make_room(end)
        self._room[self._count : end] = rows
        self._count = end

    def _make_room(self, count: int) -> None:
        room = np.empty((max(2 * len(self._room), count), *self._room.shape[1:]), self._room.dtype)
        room[: self._count] = self._room[: self._count]
        self._room = room

    @property
    def rows(self) -> NDArray[Any]:
        """View of the rows, (n, ...), not to be written to."""
        view = self._room[: self._count]
        view.flags.writeable = False
        return view

    def replace(self, rows: NDArray[Any]) -> None:
        """Put these in place of all rows; views handed out before keep the old ones."""
        self._room = np.array(rows, self._room.dtype)
        self._count = len(rows)
