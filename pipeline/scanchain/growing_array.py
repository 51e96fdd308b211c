"""Arrays that grow at their end, with spare capacity so that appending takes constant time on average."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    """A read-only view, so that a kernel is compiled for one kind of array only."""
    view = array.view()
    view.flags.writeable = False
    return view


class GrowingArray:
    """Rows of one shape and type; the capacity doubles when it is full."""

    def __init__(self, row_shape: tuple[int, ...], dtype: DTypeLike) -> None:
        self._room = np.empty((16, *row_shape), dtype)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def append(self, row: Any) -> int:
        """Index of the row, which is appended."""
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
        return read_only(self._room[: self._count])

    def replace(self, rows: NDArray[Any]) -> None:
        """Replace all rows by these; views returned before keep the old ones."""
        self._room = np.array(rows, self._room.dtype)
        self._count = len(rows)


class Columns:
    """Records of one kind in growing columns, texts as integer codes: a fraction of the memory of objects."""

    def __init__(self) -> None:
        self._columns: dict[str, GrowingArray] = {}
        self._numbers: dict[str, int] = {}

    def __len__(self) -> int:
        return len(next(iter(self._columns.values()), ()))

    def __getitem__(self, name: str) -> NDArray[Any]:
        """View of a column, (n, ...), not to be written to."""
        return self._columns[name].rows if self._columns else np.empty(0)

    def replace(self, name: str, values: NDArray[Any]) -> None:
        """Replace the values (n, ...) of a column."""
        self._columns[name].replace(values)

    @property
    def texts(self) -> list[str]:
        """Texts by integer code."""
        return list(self._numbers)

    def append(self, record: Mapping[str, Any]) -> None:
        """Append a record: numbers, texts, and arrays that have the same shape in every record."""
        for name, value in record.items():
            if isinstance(value, str):
                value = self._numbers.setdefault(str(value), len(self._numbers))
            if name not in self._columns:
                self._columns[name] = GrowingArray(np.shape(value), np.asarray(value).dtype)
            self._columns[name].append(value)
