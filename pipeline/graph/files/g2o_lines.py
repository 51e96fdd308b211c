"""The lines of a g2o or TORO file by kind, as numbers, and TORO's conventions for these."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import atan2, cos, hypot, pi, sin
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from scanchain.checks import LARGEST
from scanchain.data import Matrix
from scanchain.errors import InputError, shown
from scanchain.words import counted

TORO_VERTICES = {2: "VERTEX2", 3: "VERTEX3"}
TORO_EDGES = {2: "EDGE2", 3: "EDGE3"}
_IN_THE_PLANE = [0, 1, 4, 2, 5, 3]  # TORO's xx xy yy θθ xθ yθ as the upper triangle xx xy xθ yy yθ θθ
VERTICES = {2: "VERTEX_SE2", 3: "VERTEX_SE3:QUAT"}
EDGES = {2: "EDGE_SE2", 3: "EDGE_SE3:QUAT"}
POINT, SIGHTING = "VERTEX_XY", "EDGE_SE2_XY"
POSE_NUMBERS = {2: 3, 3: 7}  # x y θ, or x y z qx qy qz qw
TRIANGLE = {2: 6, 3: 21}  # upper triangle of an information matrix
Rotation = Literal["vector", "quaternion"]  # of which Ω is in 3D
ROTATION_COMMENT: dict[Rotation, str] = {
    "vector": "# information of EDGE_SE3:QUAT is of (translation, rotation vector in radians)",
    "quaternion": "# information of EDGE_SE3:QUAT is of (translation, vector part of unit quaternion), as g2o",
}
_LARGEST_ID = 2**63 - 1  # int64
_WHOLE_TURN = 2.0 * pi + 1e-3  # rad, above which an angle is a turn too many, or degrees


def from_toro(numbers: list[float], dimension: int) -> list[float]:
    """A vertex' or an edge's numbers as g2o has them: x y z qx qy qz qw, Ω row by row."""
    if dimension == 2:
        return numbers[:3] + [numbers[3:][place] for place in _IN_THE_PLANE[: len(numbers) - 3]]
    return numbers[:3] + _quaternion(*numbers[3:6]) + numbers[6:]


def to_toro_angles(R: NDArray[np.float64]) -> list[float]:
    """Roll, pitch and yaw with R = Rz(yaw) Ry(pitch) Rx(roll); exact at a pitch of ±π/2 too, where one is free."""
    yaw = atan2(R[1, 0], R[0, 0]) if hypot(R[0, 0], R[1, 0]) > 1e-9 else 0.0
    c, s = cos(yaw), sin(yaw)
    pitch = atan2(-R[2, 0], c * R[0, 0] + s * R[1, 0])
    roll = atan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1])
    return [roll, pitch, yaw]


def to_toro_triangle(upper: list[float]) -> list[float]:
    """Ω of an edge, upper triangle row by row, in TORO's order."""
    if len(upper) != len(_IN_THE_PLANE):
        return upper
    result = [0.0] * len(upper)
    for value, place in zip(upper, _IN_THE_PLANE, strict=True):
        result[place] = value
    return result


def _quaternion(roll: float, pitch: float, yaw: float) -> list[float]:
    """Quaternion xyzw of Rz(yaw) Ry(pitch) Rx(roll)."""
    cr, sr = cos(0.5 * roll), sin(0.5 * roll)
    cp, sp = cos(0.5 * pitch), sin(0.5 * pitch)
    cy, sy = cos(0.5 * yaw), sin(0.5 * yaw)
    return [
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    ]


@dataclass(frozen=True, slots=True)
class Kind:
    """A tag's kind: destination of its lines, ids and numbers on each, True if they are written as in TORO."""

    name: Literal["vertices", "edges", "points", "sightings"]
    dimension: int
    ids: int
    numbers: int
    is_toro: bool = False


_KINDS = {
    VERTICES[2]: Kind("vertices", 2, 1, 3),
    VERTICES[3]: Kind("vertices", 3, 1, 7),
    EDGES[2]: Kind("edges", 2, 2, 9),
    EDGES[3]: Kind("edges", 3, 2, 28),
    POINT: Kind("points", 2, 1, 2),
    SIGHTING: Kind("sightings", 2, 2, 5),
    TORO_VERTICES[2]: Kind("vertices", 2, 1, 3, is_toro=True),
    TORO_VERTICES[3]: Kind("vertices", 3, 1, 6, is_toro=True),
    TORO_EDGES[2]: Kind("edges", 2, 2, 9, is_toro=True),
    TORO_EDGES[3]: Kind("edges", 3, 2, 27, is_toro=True),
}


@dataclass(slots=True)
class Rows:
    """The lines of one kind: where they stand, the vertex ids they begin with, the numbers that follow."""

    lines: list[int] = field(default_factory=list)
    ids: list[list[int]] = field(default_factory=list)
    numbers: list[list[float]] = field(default_factory=list)

    def ids_array(self, width: int) -> NDArray[np.int64]:
        """Vertex ids (n, width)."""
        return np.array(self.ids, np.int64).reshape(-1, width)

    def numbers_array(self, width: int) -> Matrix:
        """Numbers (n, width)."""
        return np.array(self.numbers, np.float64).reshape(-1, width)


@dataclass(slots=True)
class G2oLines:
    """A file's lines by kind; ``dimension`` is 2 or 3, and 0 where it holds neither poses nor edges.

    ``turns`` : line and size of angles beyond a turn, which may be degrees
    ``rotation`` : of which the information is, by the comment that ``write_g2o`` writes
    """

    dimension: int = 0
    vertices: Rows = field(default_factory=Rows)
    edges: Rows = field(default_factory=Rows)
    points: Rows = field(default_factory=Rows)
    sightings: Rows = field(default_factory=Rows)
    fixed: Rows = field(default_factory=Rows)
    others: list[str] = field(default_factory=list)
    turns: list[tuple[int, float]] = field(default_factory=list)
    rotation: Rotation = "vector"


def sort_lines(path: Path) -> G2oLines:
    """Read the file; a line that cannot be understood is an error that names it."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not text"
        raise InputError(
            f"{path}: cannot be read as g2o: {reason}; give a text file of vertices and edges"
        ) from error
    result = G2oLines()
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if words:
            _sort_line(path, number, words, line, result)
    if not result.edges.ids and not result.sightings.ids:
        raise InputError(f"{path}: holds no EDGE_SE2 and no EDGE_SE3:QUAT line; is it a g2o pose graph?")
    return result


def _sort_line(path: Path, number: int, words: list[str], line: str, result: G2oLines) -> None:
    """Sort one line in."""
    tag = words[0]
    if tag == "FIX":
        for word in words[1:]:
            _append(path, number, [tag, word], 1, 0, result.fixed)
        return
    kind = _KINDS.get(tag)
    for rotation, comment in ROTATION_COMMENT.items():
        if line == comment:
            result.rotation = rotation
            return
    if kind is None:
        result.others.append(line)
        return
    if result.dimension not in (0, kind.dimension):
        raise InputError(
            f"{path}:{number}: {tag} in an SE({result.dimension}) graph; keep to one dimension a file"
        )
    result.dimension = kind.dimension
    rows: Rows = getattr(result, kind.name)
    _append(path, number, words, kind.ids, kind.numbers, rows)
    angles = rows.numbers[-1][3:6] if kind.is_toro and kind.dimension == 3 else rows.numbers[-1][2:3]
    if (kind.is_toro or kind.dimension == 2) and kind.name in ("vertices", "edges"):
        largest = max(map(abs, angles))
        if largest > _WHOLE_TURN:
            result.turns.append((number, largest))
    if kind.is_toro:
        rows.numbers[-1] = from_toro(rows.numbers[-1], kind.dimension)


def _append(path: Path, number: int, words: list[str], ids: int, numbers: int, rows: Rows) -> None:
    """Add a line's ids and numbers, each checked."""
    if len(words) != 1 + ids + numbers:
        raise InputError(
            f"{path}:{number}: {words[0]} has {counted(len(words) - 1, 'value')}, needs {ids + numbers}"
        )
    try:
        rows.ids.append([_vertex_id(word) for word in words[1 : 1 + ids]])
        values = [float(word) for word in words[1 + ids :]]
    except ValueError as error:
        raise InputError(f"{path}:{number}: {words[0]}: {error}") from error
    if not np.isfinite(values).all():
        raise InputError(f"{path}:{number}: {words[0]} has a value that is not finite; remove or mend the line")
    for value in values:
        if abs(value) > LARGEST:
            raise InputError(
                f"{path}:{number}: {' '.join(words[: 1 + ids])} has the value {value:g}, over {LARGEST:g}; "
                "write meters and radians, and an inverse covariance of these"
            )
    rows.numbers.append(values)
    rows.lines.append(number)


def _vertex_id(word: str) -> int:
    """Raises ValueError."""
    try:
        value = int(word)
    except ValueError:
        raise ValueError(f"vertex id {shown(word)} is not a whole number; write 0, 1, 2, ...") from None
    if abs(value) > _LARGEST_ID:
        raise ValueError(f"vertex id {shown(word)} is too large; the limit is {_LARGEST_ID}")
    return value
