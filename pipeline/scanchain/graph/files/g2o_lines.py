"""Lines of g2o and TORO files as numbers and back: every tag is a choice of the numbers that g2o has."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation as Turn

from scanchain import lie
from scanchain.checks import LARGEST
from scanchain.data import Matrix
from scanchain.errors import InputError, counted, shown

Rotation = Literal["vector", "quaternion"]  # of which Ω is in 3D
ROTATION_COMMENT: dict[Rotation, str] = {
    "vector": "# information of EDGE_SE3:QUAT is of (translation, rotation vector in radians)",
    "quaternion": "# information of EDGE_SE3:QUAT is of (translation, vector part of unit quaternion), as g2o",
}
_LARGEST_ID = 2**63 - 1  # int64
_WHOLE_TURN = 2.0 * np.pi + 1e-3  # rad, above which an angle is a turn too many, or degrees


@dataclass(frozen=True, slots=True)
class Tag:
    """Kind of a line.

    Attributes
    ----------
    dimension : 2 or 3
    ids : number of vertex ids that it begins with: 1 of a vertex, 2 of an edge
    columns : which numbers of a whole line follow: a pose (x y θ, or x y z qx qy qz qw), and of an edge the upper
        triangle of Ω, row by row. TORO has roll, pitch and yaw for the quaternion
    is_point : whether it is a point, or an edge to one
    """

    dimension: int
    ids: int
    columns: tuple[int, ...]
    is_point: bool = False
    is_toro: bool = False


TAGS = {
    "VERTEX_SE2": Tag(2, 1, (0, 1, 2)),
    "EDGE_SE2": Tag(2, 2, tuple(range(9))),
    "VERTEX_XY": Tag(2, 1, (0, 1), is_point=True),
    "EDGE_SE2_XY": Tag(2, 2, (0, 1, 3, 4, 6), is_point=True),
    "VERTEX_SE3:QUAT": Tag(3, 1, tuple(range(7))),
    "EDGE_SE3:QUAT": Tag(3, 2, tuple(range(28))),
    "VERTEX2": Tag(2, 1, (0, 1, 2), is_toro=True),
    "EDGE2": Tag(2, 2, (0, 1, 2, 3, 4, 6, 8, 5, 7), is_toro=True),  # Ω as xx xy yy θθ xθ yθ
    "VERTEX3": Tag(3, 1, tuple(range(6)), is_toro=True),
    "EDGE3": Tag(3, 2, tuple(range(27)), is_toro=True),
}


def write_lines(
    dimension: int, ids: NDArray[np.int64], numbers: Matrix, is_point: NDArray[np.bool_], *, is_toro: bool
) -> list[str]:
    """Lines of vertices, ids (n, 1), or edges (n, 2), of whole lines as g2o has them (n, m).

    Every number is the shortest that reads back as the same.
    """
    if is_toro and dimension == 3:
        numbers = np.hstack([numbers[:, :3], to_angles(numbers[:, 3:7]), numbers[:, 7:]])
    tags = {
        tag.is_point: (name, tag.columns)
        for name, tag in TAGS.items()
        if (tag.dimension, tag.ids, tag.is_toro) == (dimension, ids.shape[1], is_toro)
    }
    lines = []
    for names, row, point in zip(ids.tolist(), numbers.tolist(), is_point.tolist(), strict=True):
        name, columns = tags[point]
        lines.append(" ".join([name, *map(repr, names), *(repr(row[column]) for column in columns)]))
    return lines


def from_angles(angles: Matrix) -> Matrix:
    """Quaternions xyzw (n, 4) of roll, pitch and yaw (n, 3), Rz(yaw) Ry(pitch) Rx(roll)."""
    return Turn.from_euler("ZYX", angles[:, ::-1]).as_quat()


def to_angles(quat_xyzw: Matrix) -> Matrix:
    """Roll, pitch and yaw (n, 3); exact at a pitch of ±π/2 too, where yaw is free and taken as zero."""
    R = lie.from_quaternion(quat_xyzw)
    yaw = np.where(np.hypot(R[:, 0, 0], R[:, 1, 0]) > 1e-9, np.arctan2(R[:, 1, 0], R[:, 0, 0]), 0.0)
    c, s = np.cos(yaw), np.sin(yaw)
    pitch = np.arctan2(-R[:, 2, 0], c * R[:, 0, 0] + s * R[:, 1, 0])
    roll = np.arctan2(s * R[:, 0, 2] - c * R[:, 1, 2], c * R[:, 1, 1] - s * R[:, 0, 1])
    return np.stack([roll, pitch, yaw], axis=1)


class Rows(NamedTuple):
    """Vertices or edges, those of poses before those of points, each in the order of the file.

    Attributes
    ----------
    lines : (n,) where they stand
    ids : (n, 1) or (n, 2) vertex ids
    numbers : (n, m) whole lines as g2o has them, zero where a tag has no number
    is_point : (n,) bool, points or edges to points
    """

    lines: NDArray[np.int64]
    ids: NDArray[np.int64]
    numbers: Matrix
    is_point: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class G2oLines:
    """Content of a file.

    Attributes
    ----------
    dimension : 2 or 3
    fixed : line and vertex id of every pose that is held
    others : lines of other tags
    rotation : of which the information is, by the comment that ``write_g2o`` writes
    turns : line and size of angles beyond a turn, which may be degrees
    """

    dimension: int
    vertices: Rows
    edges: Rows
    fixed: list[tuple[int, int]]
    others: list[str]
    rotation: Rotation
    turns: list[tuple[int, float]]


def sort_lines(path: Path) -> G2oLines:
    """Read the file; a line that cannot be understood is an error that names it."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not text"
        raise InputError(
            f"{path}: cannot be read as g2o: {reason}; give a text file of vertices and edges"
        ) from error
    dimension = 0
    rotation: Rotation = "vector"
    others, fixed, turns = list[str](), list[tuple[int, int]](), list[tuple[int, float]]()
    by_tag = defaultdict[str, list[tuple[int, list[int], list[float]]]](list)
    comments: dict[str, Rotation] = {comment: name for name, comment in ROTATION_COMMENT.items()}
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words:
            continue
        tag = TAGS.get(words[0])
        if words[0] == "FIX":
            fixed += [(number, _vertex_id(f"{path}:{number}: FIX", word)) for word in words[1:]]
        elif line in comments:
            rotation = comments[line]
        elif tag is None:
            others.append(line)
        elif dimension not in (0, tag.dimension):
            raise InputError(
                f"{path}:{number}: {words[0]} in an SE({dimension}) graph; keep to one dimension a file"
            )
        else:
            dimension = tag.dimension
            by_tag[words[0]].append((number, *_parsed(f"{path}:{number}: {words[0]}", tag, words)))
    rows = {name: _rows(path, name, lines, turns) for name, lines in by_tag.items()}
    vertices, edges = (_joined([rows[name] for name in rows if TAGS[name].ids == ids], ids) for ids in (1, 2))
    if not len(edges.ids):
        raise InputError(f"{path}: holds no EDGE_SE2 and no EDGE_SE3:QUAT line; is it a g2o pose graph?")
    return G2oLines(dimension, vertices, edges, fixed, others, rotation, turns)


def _joined(parts: list[Rows], ids: int) -> Rows:
    """Rows of several tags, or none."""
    if not parts:
        return Rows(np.empty(0, np.int64), np.empty((0, ids), np.int64), np.empty((0, 0)), np.empty(0, np.bool_))
    lines, is_point = (
        np.concatenate([part.lines for part in parts]),
        np.concatenate([part.is_point for part in parts]),
    )
    names, numbers = np.concatenate([part.ids for part in parts]), np.concatenate([part.numbers for part in parts])
    order = np.lexsort((lines, is_point))
    return Rows(lines[order], names[order], numbers[order], is_point[order])


def _parsed(place: str, tag: Tag, words: list[str]) -> tuple[list[int], list[float]]:
    """Vertex ids and numbers of a line; ``place`` is for messages."""
    if len(words) != 1 + tag.ids + len(tag.columns):
        count, wanted = counted(len(words) - 1, "value"), tag.ids + len(tag.columns)
        raise InputError(f"{place} has {count}, needs {wanted}")
    ids = [_vertex_id(place, word) for word in words[1 : 1 + tag.ids]]
    try:
        return ids, list(map(float, words[1 + tag.ids :]))
    except ValueError as error:
        raise InputError(f"{place}: {error}") from error


def _rows(
    path: Path, name: str, lines: list[tuple[int, list[int], list[float]]], turns: list[tuple[int, float]]
) -> Rows:
    """Lines of one tag as arrays, checked; angles beyond a turn are added to ``turns``."""
    tag = TAGS[name]
    places, ids, numbers = (np.array(column) for column in zip(*lines, strict=True))
    for row in np.flatnonzero(~np.isfinite(numbers).all(axis=1))[:1]:
        raise InputError(f"{path}:{places[row]}: {name} has a value that is not finite; remove or mend the line")
    for row, column in np.argwhere(np.abs(numbers) > LARGEST)[:1]:
        start = " ".join([name, *map(str, ids[row].tolist())])
        raise InputError(
            f"{path}:{places[row]}: {start} has the value {numbers[row, column]:g}, over {LARGEST:g}; "
            "write meters and radians, and an inverse covariance of these"
        )
    if not tag.is_point and (tag.dimension == 2 or tag.is_toro):
        largest = np.abs(numbers[:, 3:6] if tag.dimension == 3 else numbers[:, 2:3]).max(axis=1)
        beyond = largest > _WHOLE_TURN
        turns += zip(places[beyond].tolist(), largest[beyond].tolist(), strict=True)
    whole = numbers
    if tag.dimension == 2:
        whole = np.zeros((len(numbers), 3 if tag.ids == 1 else 9))
        whole[:, tag.columns] = numbers
    elif tag.is_toro:
        whole = np.hstack([numbers[:, :3], from_angles(numbers[:, 3:6]), numbers[:, 6:]])
    return Rows(places, ids, whole, np.full(len(numbers), tag.is_point))


def _vertex_id(place: str, word: str) -> int:
    try:
        value = int(word)
    except ValueError:
        raise InputError(f"{place}: vertex id {shown(word)} is not a whole number; write 0, 1, 2, ...") from None
    if abs(value) > _LARGEST_ID:
        raise InputError(f"{place}: vertex id {shown(word)} is too large; the limit is {_LARGEST_ID}")
    return value
