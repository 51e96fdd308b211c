"""Points as a file lists them behind its header."""

from __future__ import annotations

from itertools import islice
from typing import IO

import numpy as np
from numpy.typing import NDArray


class CloudFileError(Exception):
    """A file that does not hold what its header says; the message says what is wrong."""


def ascii_rows(file: IO[bytes], point: np.dtype[np.void], count: int) -> NDArray[np.void]:
    """``count`` lines of numbers."""
    lines = list(islice((line for line in file if line.strip()), count))
    try:
        rows = np.loadtxt(lines, point, comments=None, ndmin=1) if lines else np.empty(0, point)
    except ValueError as error:
        raise CloudFileError(f"is no list of {count} points ({error})") from error
    return _all_of(rows, count)


def binary_rows(file: IO[bytes], point: np.dtype[np.void], count: int) -> NDArray[np.void]:
    """``count`` points, one after the other."""
    data = file.read(count * point.itemsize)
    return _all_of(np.frombuffer(data, point, len(data) // max(point.itemsize, 1)), count)


def _all_of(rows: NDArray[np.void], count: int) -> NDArray[np.void]:
    if len(rows) < count:
        raise CloudFileError(f"ends after {len(rows)} of its {count} points")
    return rows
