"""Pose graphs in g2o and TORO files, read and written, and in text files of GTSAM and iSAM, read."""

from __future__ import annotations

import itertools
import warnings
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np
from scipy.spatial.transform import Rotation as Turn

from scanchain import checks, lie
from scanchain.checks import LARGEST
from scanchain.data import Integers, Mask, Matrix, brief
from scanchain.errors import InputError, counted, shown
from scanchain.files import write_whole
from scanchain.graph.edge_checks import (
    first_of_unjoined,
    listed,
    nearest_semidefinite,
    positive_semidefinite,
    skip_poses,
)
from scanchain.graph.edge_noise import (
    BY_ROWS,
    TORO,
    Noise,
    is_invertible,
    order_of,
    positions,
    squared,
    symmetric,
)
from scanchain.graph.factors import Position, Prior
from scanchain.graph.initialize import follow_odometry
from scanchain.graph.pose_graph import PoseGraph

_NO_CONSTRAINT = ("#", "VERTEX", "PARAMS", "FIX")  # beginnings of lines that constrain nothing
_NOT_UNIT = 0.01  # difference of a quaternion's length from 1 above which it is no rounding of the digits
_WHOLE_TURN = 2.0 * np.pi + 1e-3  # rad, above which an angle is more than a full turn, or in degrees
Rotation = Literal["vector", "quaternion"]  # rotation parametrization of Ω in 3D
ROTATION_COMMENT: dict[Rotation, str] = {
    "vector": "# information of EDGE_SE3:QUAT is of (translation, rotation vector in radians)",
    "quaternion": "# information of EDGE_SE3:QUAT is of (translation, vector part of unit quaternion), as g2o",
}
_TRIANGLES = (3, 6, 21)  # numbers of entries of the information of edges to points, in the plane, and in space
_LIBRSF = {"odom2", "odom2diff", "odom3", "range2", "range3", "point2", "point3", "loop"}


class Tag(NamedTuple):
    """Kind of a line.

    dimension : 2 or 3
    ids : number of vertex ids that it begins with: 1 for a vertex, 2 for an edge
    columns : indices of its other numbers in a complete line: a pose (x y θ, or x y z qx qy qz qw), and for an
        edge the upper triangle of Ω, row by row. TORO has roll, pitch and yaw instead of the quaternion
    is_point : whether it is a point, or an edge to one
    is_covariance : whether the upper triangle is that of Ω⁻¹
    is_landmark : whether it is to a point without a vertex, whose id may be that of a pose too
    """

    dimension: int
    ids: int
    columns: tuple[int, ...]
    is_point: bool = False
    is_toro: bool = False
    is_covariance: bool = False
    is_landmark: bool = False


TAGS = {
    "ODOMETRY": Tag(2, 2, tuple(range(9)), is_covariance=True),  # of GTSAM and iSAM, as LANDMARK and BR
    "LANDMARK": Tag(2, 2, (0, 1, 3, 4, 6), is_point=True, is_covariance=True, is_landmark=True),
    "LANDMARK2": Tag(2, 2, (0, 1, 3, 4, 6), is_point=True, is_landmark=True),
    "BR": Tag(2, 2, (0, 1, 3, 6), is_point=True, is_covariance=True, is_landmark=True),  # bearing, range, σ, σ
    "VERTEX_SE2": Tag(2, 1, (0, 1, 2)),
    "EDGE_SE2": Tag(2, 2, tuple(range(9))),
    "VERTEX_XY": Tag(2, 1, (0, 1), is_point=True),
    "EDGE_SE2_XY": Tag(2, 2, (0, 1, 3, 4, 6), is_point=True),
    "VERTEX_SE3:QUAT": Tag(3, 1, tuple(range(7))),
    "EDGE_SE3:QUAT": Tag(3, 2, tuple(range(28))),
    "VERTEX2": Tag(2, 1, (0, 1, 2), is_toro=True),
    "EDGE2": Tag(2, 2, (0, 1, 2, 3, 4, 6, 8, 5, 7), is_toro=True),  # Ω as xx xy yy θθ xθ yθ
    "VERTEX3": Tag(3, 1, tuple(range(6)), is_toro=True),
    "EDGE3": Tag(3, 2, (*range(6), *range(7, 28)), is_toro=True),
}
PRIOR_TAGS = {  # of unary edges; in 3D the vertex id is followed by the id of a sensor offset
    "EDGE_PRIOR_SE2_XY": Tag(2, 1, (0, 1, 3, 4, 6)),  # read only: also EDGE_PRIOR_SE2 without information on θ
    "EDGE_PRIOR_SE2": Tag(2, 1, tuple(range(9))),
    "EDGE_PRIOR_XY": Tag(2, 1, (0, 1, 3, 4, 6), is_point=True),
    "EDGE_SE3_PRIOR": Tag(3, 2, tuple(range(28))),
}
_OFFSET = "PARAMS_SE3OFFSET"
_TAGS = TAGS | PRIOR_TAGS | {_OFFSET: Tag(3, 1, tuple(range(7)))}
_WIDTHS = {(2, 1): 3, (2, 2): 9, (3, 1): 7, (3, 2): 28}  # numbers of a complete line, by dimension and ids


def write_lines(
    dimension: int, ids: Integers, numbers: Matrix, is_point: Mask, of: dict[str, Tag], *, is_toro: bool = False
) -> list[str]:
    """Lines of vertices, ids (n, 1), or edges (n, 2), from the numbers (n, m) of complete g2o lines.

    of : the tags to choose from; the last that fits
    Every number is written with the fewest digits that read back as the same value.
    """
    if is_toro and dimension == 3:
        numbers = np.hstack([numbers[:, :3], to_angles(numbers[:, 3:7]), numbers[:, 6:]])
    tags = {
        tag.is_point: (name, tag.columns)
        for name, tag in of.items()
        if (tag.dimension, tag.ids, tag.is_toro) == (dimension, ids.shape[1], is_toro)
    }
    lines = []
    for names, row, point in zip(ids.tolist(), numbers.tolist(), is_point.tolist(), strict=True):
        name, columns = tags[point]
        lines.append(" ".join([name, *map(repr, names), *(repr(row[column]) for column in columns)]))
    return lines


def to_angles(quat_xyzw: Matrix) -> Matrix:
    """Roll, pitch and yaw (n, 3); exact at a pitch of ±π/2 too, where yaw is arbitrary and set to zero."""
    R = lie.from_quaternion(quat_xyzw)
    yaw = np.where(np.hypot(R[:, 0, 0], R[:, 1, 0]) > 1e-9, np.arctan2(R[:, 1, 0], R[:, 0, 0]), 0.0)
    c, s = np.cos(yaw), np.sin(yaw)
    pitch = np.arctan2(-R[:, 2, 0], c * R[:, 0, 0] + s * R[:, 1, 0])
    roll = np.arctan2(s * R[:, 0, 2] - c * R[:, 1, 2], c * R[:, 1, 1] - s * R[:, 0, 1])
    return np.stack([roll, pitch, yaw], axis=1)


class Rows(NamedTuple):
    """Vertices or edges, those of poses before those of points, each in the order of the file.

    lines : (n,) line numbers in the file
    ids : (n, 1) or (n, 2) vertex ids
    numbers : (n, m) of complete g2o lines, zero where a tag has no number
    is_point, is_covariance, is_landmark : (n,) bool; is_point also of edges to points
    """

    lines: Integers
    ids: Integers
    numbers: Matrix
    is_point: Mask
    is_covariance: Mask
    is_landmark: Mask


class Lines:
    """Content of a file; an invalid line raises an error with its line number.

    dimension : 2 or 3
    vertices, edges : their lines, the edges followed by priors, which have their vertex twice
    between : number of edges without the priors
    fixed : line and vertex id (n, 2) of every fixed pose
    others : lines of other tags
    notes : as in ``G2oFile``
    rotation : rotation parametrization of the information, from the comment that ``write_g2o`` writes
    """

    def __init__(self, path: Path, noise: Noise) -> None:
        self.path, self.noise, self.dimension = path, noise, 0
        self.rotation: Rotation = "vector"
        self.others, self.notes = list[str](), list[str]()
        comments: dict[str, Rotation] = {comment: name for name, comment in ROTATION_COMMENT.items()}
        fixed, rows, priors = list[tuple[int, int]](), list[_Row](), list[_Row]()
        offsets, sensors = list[tuple[int, list[str]]](), list[tuple[int, int]]()
        for number, line in enumerate(self._text().splitlines(), start=1):
            words = line.split()
            if words[:1] == ["FIX"]:
                fixed += [(number, self._vertex_id(number, "FIX", word)) for word in words[1:]]
            elif line in comments:
                self.rotation = comments[line]
            elif words and words[0] in TAGS:
                rows.append((number, TAGS[words[0]], *self._parsed(number, words)))
            elif words and words[0] in PRIOR_TAGS:
                (vertex, *sensor), numbers = self._parsed(number, words)
                sensors += [(number, each) for each in sensor]
                priors.append((number, PRIOR_TAGS[words[0]], [vertex, vertex], numbers))
            elif words:
                self.others.append(line)
                offsets += [(number, words)] if words[0] == _OFFSET else []
        self._check_sensors(sensors, offsets)
        self.fixed = np.array(fixed, np.int64).reshape(-1, 2)
        rows.sort(key=lambda row: row[1].is_point)
        vertices, edges = ([row for row in rows if row[1].ids == n] for n in (1, 2))
        self.vertices, self.edges = self._whole(vertices, 1), self._whole(edges + priors, 2)
        self.between = len(edges)
        if again := len(edges) - len({(tag, *names, *numbers) for _, tag, names, numbers in edges}):
            self.notes.append(f"{path}: {counted(again, 'edge')} repeated to the digit; each counts in full")
        self._separate_landmarks()
        if not edges and not (priors and vertices):
            what = f"its first line is {self.others[0][:40]!r}; " if self.others else ""
            what += "is it a g2o pose graph?"
            if any(line.split(maxsplit=1)[0] in _LIBRSF for line in self.others):
                what = "its lines are libRSF's measurements over time, not between poses; solve them with libRSF"
            raise InputError(f"{path}: holds no EDGE_SE2 and no EDGE_SE3:QUAT line; {what}")

    def _separate_landmarks(self) -> None:
        """Give landmarks ids of their own if some of theirs are also ids of poses."""
        edges, of_points = self.edges, self.edges.is_landmark
        names, which = np.unique(edges.ids[of_points, 1], return_inverse=True)
        poses = np.append(self.vertices.ids[~self.vertices.is_point], edges.ids[~edges.is_point])
        poses = np.append(poses, edges.ids[of_points, 0])
        if np.isin(names, poses).any() and (first := int(poses.max()) + 1) < np.iinfo(np.int64).max - len(names):
            edges.ids[of_points, 1] = first + which
            text = f"landmarks have ids of poses; they are numbered from {first} on"
            self.notes.append(f"{self.path}: {len(names):,} {text}")

    def error(self, line: object, text: str) -> InputError:
        """An error with this line number."""
        return InputError(f"{self.path}:{line}: {text}")

    def indices(self, lines: Integers, names: Integers, ids: Integers) -> Integers:
        """Integers (n, w) in ``ids`` (K,) of the vertices that lines (n,) name."""
        order = np.argsort(ids)
        indices = order[np.minimum(np.searchsorted(ids, names, sorter=order), len(ids) - 1)]
        self.check_known(lines, names, ids[indices] == names)
        return indices

    def check_known(self, lines: Integers, names: Integers, is_known: Mask) -> None:
        """Raise InputError for lines (n,) that name vertices (n, w) missing in the file."""
        without = ", or remove all VERTEX lines to start from odometry" if len(self.vertices.lines) else ""
        for row, column in np.argwhere(~is_known)[:1]:
            text = f"vertex {names[row, column]} is not in the file; add its VERTEX line"
            raise self.error(lines[row], text + without)

    def poses(self, rows: Rows) -> Matrix:
        """Poses (n, d+1, d+1) that rows x y θ, or x y z qx qy qz qw, begin with; quaternions are normalized."""
        d, numbers = self.dimension, rows.numbers
        result = np.tile(lie.identity(d), (len(numbers), 1, 1))
        result[:, :d, d] = numbers[:, :d]
        if d == 2:
            result[:, 0, 0] = result[:, 1, 1] = np.cos(numbers[:, 2])
            result[:, 1, 0] = np.sin(numbers[:, 2])
            result[:, 0, 1] = -result[:, 1, 0]
            return result
        length = np.linalg.norm(numbers[:, 3:7], axis=1)
        for bad in np.flatnonzero(length < 1e-6)[:1]:
            raise self.error(rows.lines[bad], "quaternion of length 0; write qx qy qz qw, 0 0 0 1 for none")
        off = np.flatnonzero(np.abs(length - 1.0) > _NOT_UNIT)
        for first in off[:1]:
            text = f"quaternion of length {length[first]:.3g}, the first of {len(off):,} to be normalized"
            self.notes.append(f"{self.path}:{rows.lines[first]}: {text}")
        result[:, :3, :3] = lie.from_quaternion(numbers[:, 3:7])
        return result

    def _text(self) -> str:
        try:
            return self.path.read_text(encoding="utf-8-sig")
        except (OSError, UnicodeDecodeError) as error:
            reason = getattr(error, "strerror", None) or "not UTF-8 text"
            raise InputError(
                f"{self.path}: cannot be read as g2o: {reason}; give a text file of vertices and edges"
            ) from error

    def _parsed(self, line: int, words: list[str]) -> tuple[list[int], list[float]]:
        """Vertex ids and numbers of a line."""
        name, tag = words[0], _TAGS[words[0]]
        if self.dimension not in (0, tag.dimension):
            raise self.error(line, f"{name} in an SE({self.dimension}) graph; use one dimension per file")
        self.dimension = tag.dimension
        if len(words) != 1 + tag.ids + len(tag.columns):
            count, wanted = counted(len(words) - 1, "value"), tag.ids + len(tag.columns)
            is_bare = tag.ids == 2 and wanted - len(words) + 1 in _TRIANGLES
            raise self.error(line, f"{name} has {count}, needs {wanted}{'; it has no information' * is_bare}")
        ids = [self._vertex_id(line, name, word) for word in words[1 : 1 + tag.ids]]
        try:
            numbers = list(map(float, words[1 + tag.ids :]))
        except ValueError as error:
            raise self.error(line, f"{name}: {error}") from error
        if not all(abs(number) <= LARGEST for number in numbers):
            edge = " ".join(words[: 1 + tag.ids])
            fault = f"{edge} has a value that is not finite or over {LARGEST:g}"
            raise self.error(line, f"{fault}; write meters and radians, and an inverse covariance of these")
        return ids, numbers

    def _check_sensors(self, sensors: list[tuple[int, int]], offsets: list[tuple[int, list[str]]]) -> None:
        """Raise InputError for a prior (line, id) of a sensor with an offset from the vertex (line, words)."""
        parsed = [self._parsed(line, words) for line, words in offsets] if sensors else []
        moved = {sensor for (sensor,), offset in parsed if any(offset[:6])}
        for line in [line for line, sensor in sensors if sensor in moved][:1]:
            raise self.error(line, "EDGE_SE3_PRIOR with an offset of the sensor; give it for the vertex itself")

    def _vertex_id(self, line: int, tag: str, word: str) -> int:
        try:
            return int(np.int64(word))
        except (ValueError, OverflowError):
            text = f"{tag}: vertex id {shown(word)} is not a 64-bit integer; write 0, 1, 2, ..."
            raise self.error(line, text) from None

    def _whole(self, rows: list[_Row], ids: int) -> Rows:
        """Vertices or edges as complete g2o lines."""
        numbers = np.zeros((len(rows), _WIDTHS.get((self.dimension, ids), 0)))
        is_covariance = np.zeros(len(rows), np.bool_)
        is_landmark = np.array([tag.is_landmark for _, tag, *_ in rows], np.bool_)
        for tag in {row[1] for row in rows}:
            of_tag = [place for place, row in enumerate(rows) if row[1] == tag]
            of_file, columns = np.array([rows[place][3] for place in of_tag]), tag.columns
            is_covariance[of_tag] = tag.is_covariance
            if tag == TAGS["BR"]:
                of_file, columns = positions(of_file), TAGS["LANDMARK"].columns
            elif tag in (TAGS["EDGE2"], TAGS["ODOMETRY"]):
                is_root = self.noise == "square-root"  # as in iSAM, whose lines are all by rows
                order = BY_ROWS if is_root else order_of(of_file[:, 3:], TORO if tag.is_toro else BY_ROWS)
                columns = (0, 1, 2, *(3 + entry for entry in order))
                is_covariance[of_tag] |= order == BY_ROWS
            numbers[np.ix_(of_tag, columns)] = of_file
        lines = np.array([line for line, *_ in rows], np.int64)
        is_point = np.array([tag.is_point for _, tag, *_ in rows], np.bool_)
        is_toro = np.array([tag.is_toro for _, tag, *_ in rows], np.bool_)
        angles, has_angles = (numbers[:, 2:3], ~is_point) if self.dimension == 2 else (numbers[:, 3:6], is_toro)
        largest = np.abs(angles).max(axis=1, initial=0.0) * has_angles
        if len(rows) and largest.max() > _WHOLE_TURN:
            line = lines[largest.argmax()]
            note = f"{self.path}:{line}: an angle of {largest.max():.6g}; degrees? angles are taken as radians"
            self.notes += [] if self.notes else [note]
        if self.dimension == 3 and is_toro.any():  # Rz(yaw) Ry(pitch) Rx(roll)
            numbers[is_toro, 3:7] = Turn.from_euler("ZYX", numbers[is_toro, 5:2:-1]).as_quat()
        names = np.array([row[2] for row in rows], np.int64).reshape(-1, ids)
        return Rows(lines, names, numbers, is_point, is_covariance, is_landmark)


_Row = tuple[int, Tag, list[int], list[float]]  # line, tag, vertex ids, numbers
TORO_SUFFIXES = (".graph", ".toro")
GRAPH_SUFFIXES = (".g2o", *TORO_SUFFIXES)

Chosen = Literal["in force", "rejected"]


def rejected_path(path: Path) -> Path:
    """The file with the rejected edges of a graph, next to its file: graph_rejected.g2o for graph.g2o."""
    return path.with_name(f"{path.stem}_rejected{path.suffix}")


def write_g2o(
    path: Path | str,
    graph: PoseGraph,
    *,
    ids: Integers | None = None,
    other_lines: Iterable[str] = (),
    edges: Chosen = "in force",
    rotation: Rotation = "vector",
    force: bool = False,
) -> None:
    """Write poses, points and edges with full information matrices; .graph and .toro files in the TORO format.

    ids : (K,) the vertex ids, by default 0, 1, …; FIX is written for poses that were fixed by ``PoseGraph.fix``
    edges : those "in force" with their robust weight in Ω, so that the poses are the minimum of the file's own χ²
    rotation : rotation parametrization of Ω in 3D, stated in the first line of the file: "vector" for a rotation
        vector, as in this package, GTSAM and published graphs, or "quaternion" for the vector part of the unit
        quaternion, half as long, as in g2o itself
    force : whether to replace an existing file; else InputError, as for a graph with points in TORO
    Warns of edges of custom factors, which the format lacks.
    """
    checks.instance(graph, PoseGraph, "graph", "read_g2o(path).graph")
    checks.one_of(rotation, get_args(Rotation), "rotation")
    path, d = checks.path(path, "path"), graph.dimension
    is_toro = path.suffix in TORO_SUFFIXES
    if is_toro and graph.is_point.any():
        raise InputError(f"{path}: TORO has no points, and the graph has {graph.is_point.sum()}; write .g2o")
    if is_toro and graph.is_of_origin.any():
        raise InputError(f"{path}: TORO has no priors, and the graph has {graph.is_of_origin.sum()}; write .g2o")
    names = np.arange(len(graph)) if ids is None else ids
    has_quaternions = d == 3 and not is_toro
    chosen = graph.is_rejected if edges == "rejected" else ~graph.is_rejected
    chosen = _written(path, graph, chosen)
    pairs, is_prior = graph.edges[chosen], graph.is_of_origin[chosen]
    units = lie.by_component(graph.freedom, 1.0, 2.0 if has_quaternions and rotation == "quaternion" else 1.0)
    weight = np.ones(len(pairs)) if edges == "rejected" else graph.weight[chosen]
    information = weight[:, None, None] * (graph.information[chosen] * np.outer(units, units))
    triangles = information[:, *np.triu_indices(graph.freedom)]
    of_edges = np.hstack([_numbers(graph.measurements[chosen]), triangles])
    lines = [ROTATION_COMMENT[rotation]] if has_quaternions else []
    lines += write_lines(d, names[:, None], _numbers(graph.poses), graph.is_point, TAGS, is_toro=is_toro)
    lines += [f"FIX {names[index]}" for index in graph.held]
    to_point, others, seen = graph.is_point[pairs[:, 1]], list(other_lines), names[pairs[is_prior, 1], None]
    between = names[pairs[~is_prior]], of_edges[~is_prior], to_point[~is_prior]
    lines += write_lines(d, *between, TAGS, is_toro=is_toro)
    if d == 3 and len(seen):
        sensor, line = _sensor(others)
        lines += [line] if line not in others else []
        seen = np.insert(seen, 1, sensor, axis=1)
    lines += write_lines(d, seen, of_edges[is_prior], to_point[is_prior], PRIOR_TAGS)
    with checks.writing(path, force=force):
        write_whole(path, "\n".join([*lines, *others, ""]).encode())


def _written(path: Path, graph: PoseGraph, chosen: Mask) -> Mask:
    """The chosen edges (E,) that the format can represent."""
    left_out = chosen & graph.is_custom
    if left_out.any():
        text = f"{path}: g2o has no tag for {counted(int(left_out.sum()), 'edge')} of custom factors; left out"
        warnings.warn(text, stacklevel=3)
    return chosen & ~graph.is_custom


def _sensor(others: list[str]) -> tuple[int, str]:
    """Id and line of a sensor without an offset: one of these lines, or a new one whose id none of them has."""
    parameters = (words for words in map(str.split, others) if len(words) > 1 and words[0].startswith("PARAMS"))
    used = {words[1] for words in parameters}
    sensors = ((number, f"{_OFFSET} {number} 0 0 0 0 0 0 1") for number in itertools.count())
    return next((number, line) for number, line in sensors if line in others or str(number) not in used)


def _numbers(poses: Matrix) -> Matrix:
    """Poses as rows x y θ, or x y z qx qy qz qw."""
    d = poses.shape[-1] - 1
    if d == 2:
        return np.column_stack([poses[:, :2, 2], lie.yaw(poses)])
    return np.hstack([poses[:, :3, 3], lie.to_quaternion(poses[:, :3, :3])])


Indefinite = Literal["project", "refuse"]


@dataclass(frozen=True, slots=True)
class Projection:
    """Edges and priors of a file with an indefinite information matrix, and the change by projecting it.

    edges, of : number of these, and of all
    median, most : median and largest ‖Ω − Ω₊‖ / ‖Ω‖ of these, Frobenius norm
    first : the first of them, by its vertices and its line
    """

    edges: int
    of: int
    median: float
    most: float
    first: str

    @property
    def text(self) -> str:
        """The projection as one line of text."""
        return (
            f"{self.edges:,} of {self.of:,} edges have an indefinite information matrix, which is no inverse "
            "covariance; each was projected to the nearest positive semidefinite one, which changed it by "
            f"{100.0 * self.median:.3g} % of its norm (median), {100.0 * self.most:.3g} % at most; "
            f"first {self.first}"
        )


@dataclass(frozen=True, slots=True)
class G2oFile:
    """A pose graph as read.

    graph : the poses, then the points, each in the order of their ids; the stamp of each is its id
    ids : (K,) the file's vertex ids
    other_lines : lines about neither poses nor edges, retained to be written again
    has_guess : whether the file holds vertices; else the graph's poses are chained along its odometry
    projection : of the indefinite information matrices; None without any
    notes : warnings of what in the file may be meant otherwise than read, such as angles in degrees
    """

    __repr__ = brief
    graph: PoseGraph
    ids: Integers
    other_lines: tuple[str, ...]
    has_guess: bool
    projection: Projection | None
    notes: tuple[str, ...] = ()

    @property
    def other_tags(self) -> tuple[tuple[str, int], ...]:
        """Tags that are not supported, with the number of lines of each."""
        return _tags(self.other_lines)


def _tags(lines: Iterable[str]) -> tuple[tuple[str, int], ...]:
    return tuple(Counter(line.split(maxsplit=1)[0] for line in lines).items())


def read_g2o(
    path: Path | str,
    *,
    loops: Literal["quadratic", "robust"] = "quadratic",
    indefinite: Indefinite = "project",
    rotation: Rotation | None = None,
    noise: Noise = "auto",
) -> G2oFile:
    """Read a graph.

    loops : "robust" gives edges between non-consecutive poses the robust loss
    indefinite : what to do about indefinite information matrices: "project" each to the nearest positive
        semidefinite one and warn, or "refuse" the file
    rotation : rotation parametrization of the information in 3D, as in ``write_g2o``; by default the one stated in
        the file, else "vector"
    noise : what the upper triangles of the edges and priors are: "information" Ω, "covariance" Ω⁻¹, or
        "square-root", the upper triangular R with Ω = RᵀR, as in iSAM. By default Ω⁻¹, as in GTSAM, in lines
        ODOMETRY and LANDMARK, and in EDGE2 lines of which one is indefinite in TORO's order; else Ω
    Of every component that nothing joins to a fixed pose, the first pose is fixed, with a warning.
    """
    path = checks.path(path, "path")
    checks.one_of(noise, get_args(Noise), "noise")
    lines = Lines(path, noise)
    edges, dimension, between = lines.edges, lines.dimension, slice(lines.between)
    ids, is_point, poses = _vertices(lines)
    pairs = _pairs(lines, ids, is_point)
    fixed = lines.indices(lines.fixed[:, 0], lines.fixed[:, 1:], ids)[:, 0]
    is_quaternion = dimension == 3 and (rotation or lines.rotation) == "quaternion"
    measurements, information = lines.poses(edges), _information(lines, is_quaternion=is_quaternion)
    is_whole = np.asarray(information[:, dimension:].any(axis=(1, 2)))
    projection = _project(lines, information, indefinite)
    fixed, held = _gauges(lines, ids, pairs, fixed)
    has_guess = bool(len(lines.vertices.lines))
    chain, to_points = (np.flatnonzero(edges.is_point[between] == point) for point in (False, True))
    if not has_guess:
        poses = follow_odometry(poses, held, pairs[chain], measurements[chain])
    if not lines.vertices.is_point.any():  # of landmarks, or without any vertex
        i, j = pairs[to_points].T
        poses[j, :-1, -1] = (poses[i] @ measurements[to_points])[:, :-1, -1]
    constraints = [line for line in lines.others if not line.lstrip().startswith(_NO_CONSTRAINT)]
    left_out = " and ".join(f"{counted(count, 'line')} {tag}" for tag, count in _tags(constraints))
    graph = PoseGraph(dimension, ids, left_out)
    for pose, point, stamp in zip(poses, is_point.tolist(), ids.tolist(), strict=True):
        graph.add_point(pose[:-1, -1], stamp) if point else graph.add_pose(pose, stamp)
    is_robust = (loops == "robust") & skip_poses(pairs[between], is_point)
    graph.add_edges(pairs[between], measurements[between], information[between], is_robust)
    for prior in range(lines.between, len(pairs)):
        factor, m = (Prior(), graph.freedom) if is_whole[prior] else (Position(), dimension)
        graph.add_factor(factor, int(pairs[prior, 1]), information[prior, :m, :m], measurements[prior])
    for index in fixed.tolist():
        graph.fix(index)
    note = f"{path}: {left_out} not understood: in neither χ² nor certificate nor covariances" if left_out else ""
    for text in filter(None, (*lines.notes, note)):
        warnings.warn(text, stacklevel=2)
    return G2oFile(graph, ids, tuple(lines.others), has_guess, projection, tuple(lines.notes))


def _gauges(lines: Lines, ids: Integers, pairs: Integers, fixed: Integers) -> tuple[Integers, Mask]:
    """Poses to fix: those of FIX lines, and the first of every component joined to none of them and no prior.

    Also whether each pose (K,) begins where it is: these and, without any FIX line, pose 0.
    """
    index, priors = np.arange(len(ids)), pairs[lines.between :, 1]
    start = fixed if len(fixed) else index[:1]
    chosen = fixed if len(priors) else start
    apart = first_of_unjoined(pairs, np.isin(index, np.append(chosen, priors)))
    if len(apart):
        fixed, text = (
            np.append(chosen, apart),
            f"with {listed(ids[apart])} fixed; poses of different parts do not compare",
        )
        lines.notes.append(f"{lines.path}: parts that no edge joins to the rest have a gauge of their own, {text}")
    return fixed, np.isin(index, np.append(start, apart))


def _pairs(lines: Lines, ids: Integers, is_point: Mask) -> Integers:
    """Integers (E, 2) of the poses and points of all edges, which are of the kind that the tags say."""
    edges, between = lines.edges, slice(lines.between)
    pairs = lines.indices(edges.lines, edges.ids, ids)
    is_right = is_point[pairs[:, 1]] == edges.is_point
    is_known = np.stack([~is_point[pairs[between, 0]], is_right[between]], axis=1)
    lines.check_known(edges.lines[between], edges.ids[between], is_known)
    for bad in np.flatnonzero(pairs[between, 0] == pairs[between, 1])[:1]:
        i, j = edges.ids[bad]
        raise lines.error(edges.lines[bad], f"edge {i}-{j} joins a vertex to itself; remove it")
    for bad in np.flatnonzero(~is_right)[:1]:
        what, other = ("point", "pose") if edges.is_point[bad] else ("pose", "point")
        text = f"the prior is of a {what}, and vertex {edges.ids[bad, 0]} is a {other}; EDGE_PRIOR_XY is of points"
        raise lines.error(edges.lines[bad], text)
    return pairs


def _information(lines: Lines, *, is_quaternion: bool) -> Matrix:
    """Information (n, k, k) from the upper triangles at the end of the rows of edges."""
    edges, d, noise = lines.edges, lines.dimension, lines.noise
    information = symmetric(edges.numbers[:, -6 if d == 2 else -21 :])
    is_covariance = edges.is_covariance if noise == "auto" else np.full(len(information), noise == "covariance")
    is_position = ~information[:, d:].any(axis=(1, 2))
    for chosen, m in ((is_covariance & ~is_position, information.shape[1]), (is_covariance & is_position, d)):
        rows, C = np.flatnonzero(chosen), information[chosen, :m, :m]
        for line in edges.lines[rows[~is_invertible(C)]][:1]:
            raise lines.error(
                line, "covariance is not positive definite; correct it, or say with --noise what it is"
            )
        inverse = np.linalg.inv(C)
        information[chosen, :m, :m] = 0.5 * (inverse + np.swapaxes(inverse, 1, 2))
    if noise == "square-root":
        information = squared(information)
    elif noise == "auto" and is_covariance.any():
        rows, order = np.flatnonzero(is_covariance), "covariances (xx xy xθ yy yθ θθ), as GTSAM has them"
        text = f"noise of {counted(len(rows), 'edge')} read as {order}; --noise information or square-root if not"
        lines.notes.append(f"{lines.path}:{edges.lines[rows[0]]}: {text}")
    if is_quaternion:
        units = lie.by_component(6, 1.0, 0.5)
        information *= np.outer(units, units)
    return information


def _project(lines: Lines, information: Matrix, indefinite: Indefinite) -> Projection | None:
    """Replace indefinite matrices (E, k, k) by the nearest semidefinite ones, and warn of the change."""
    bad = np.flatnonzero(~positive_semidefinite(information))
    if not len(bad):
        return None
    (i, j), line = lines.edges.ids[bad[0]], lines.edges.lines[bad[0]]
    noun, name = ("edge", f"{i}-{j}") if bad[0] < lines.between else ("prior", str(j))
    if indefinite == "refuse":
        raise lines.error(
            line,
            f"information matrix of {noun} {name} is not positive semidefinite, the first of "
            f"{len(bad):,}; give the upper triangle of an inverse covariance, or have it projected",
        )
    before, nearest = information[bad], nearest_semidefinite(information[bad])
    information[bad] = nearest
    off = np.linalg.norm(nearest - before, axis=(1, 2)) / np.linalg.norm(before, axis=(1, 2))
    first = f"{name} in line {line}"
    projection = Projection(len(bad), len(information), float(np.median(off)), float(off.max()), first)
    warnings.warn(projection.text, stacklevel=3)
    return projection


def _vertices(lines: Lines) -> tuple[Integers, Mask, Matrix]:
    """Ids (K,), of poses and then of points, each ascending; is_point (K,); and poses (K, d+1, d+1).

    Without vertex lines the ids are those in the edges, and the poses are the identity; so are the points of
    LANDMARK and BR lines, whose format has no vertices of points.
    """
    vertices = lines.vertices
    if not len(vertices.lines):
        pairs, to_point = lines.edges.ids[: lines.between], lines.edges.is_point[: lines.between]
        of_poses = np.unique(np.append(pairs[~to_point], pairs[to_point, 0]))
        of_points = np.unique(pairs[to_point, 1])
        ids, is_point = np.append(of_poses, of_points), np.arange(len(of_poses) + len(of_points)) >= len(of_poses)
        poses = np.tile(lie.identity(lines.dimension), (len(ids), 1, 1))
    else:
        order = np.lexsort((vertices.ids[:, 0], vertices.is_point))
        ids, is_point, poses = vertices.ids[order, 0], vertices.is_point[order], lines.poses(vertices)[order]
        edges, of_file = lines.edges, vertices.ids[vertices.is_point]
        seen = np.setdiff1d(edges.ids[edges.is_landmark, 1], of_file)
        again = order[1:][(ids[1:] == ids[:-1]) & (is_point[1:] == is_point[:-1])]
        for row in np.sort(again)[:1]:
            name = vertices.ids[row, 0]
            raise lines.error(vertices.lines[row], f"vertex {name} is in the file twice; remove one")
        ids, is_point = np.append(ids, seen), np.append(is_point, np.ones(len(seen), np.bool_))
        poses = np.concatenate([poses, np.tile(lie.identity(lines.dimension), (len(seen), 1, 1))])
    for name in np.intersect1d(ids[is_point], ids[~is_point])[:1]:
        raise InputError(f"{lines.path}: vertex {name} is a pose and a point; give each an id of its own")
    return ids, is_point, poses
