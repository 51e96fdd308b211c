"""The recognizer for 3D logs: descriptors of submaps seen from above, by similarity and near the expected pose.

A descriptor is the same for either heading and from a few meters aside.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy import fft
from numpy.typing import NDArray
from scipy.ndimage import affine_transform, gaussian_filter, map_coordinates
from scipy.spatial import KDTree

from scanchain import lie
from scanchain.config import Config, LoopsConfig
from scanchain.data import Matrix, Points, Pose, Proposal
from scanchain.errors import InputError
from scanchain.loops.recognizer import Candidate, Query
from scanchain.loops.submaps import Submap, level_frame

SIZE = 128  # cells along each side of the image
_HEIGHTS = 64  # cells in height
_ANGLES = 64  # directions of the spectrum over half a turn
_FREQUENCIES = np.arange(2.0, 34.0)  # periods in an image
_BANDS, _HARMONICS = 16, 5  # size of the key: bands of frequencies, harmonics over the direction
_WEIGHT_OF_MEAN = 0.3  # weight of harmonic 0 in the key
_BLUR = 0.7  # standard deviation, cells, of the filter that blurs the image
_STEPS = 16.0  # steps of an 8-bit image for each unit of a cell

_MAX_COMPARED = 10  # number of descriptors with the most similar keys that are compared in full
_MAX_NEAREST = 3  # number of descriptors nearest to the expected pose that are compared in full
_MAX_HEADING_ERROR_RAD = 0.5  # largest error of odometry's heading in the search near the expected pose
_MIN_SIMILARITY = 0.45  # least similarity of a candidate that is verified by matching
_RIVAL = 0.9  # share of the best similarity, from which on a candidate elsewhere makes it ambiguous
_MIN_APART = 0.25  # least distance in radii of a submap between two poses that are not the same
_GROWTH = 1.25  # factor by which the database grows between two builds of its tree
_SLACK = 16  # number of descriptors that may lie outside the tree however small it is


def _polar_grid() -> NDArray[np.float64]:
    angles = np.arange(_ANGLES) * (np.pi / _ANGLES)
    return np.stack([np.outer(_FREQUENCIES, np.sin(angles)), np.outer(_FREQUENCIES, np.cos(angles))]) + SIZE // 2


def _disc() -> NDArray[np.float32]:
    offset = np.arange(SIZE) - 0.5 * (SIZE - 1)
    return np.minimum(np.hypot(*np.meshgrid(offset, offset)) / (0.5 * SIZE), 1.0).astype(np.float32)


_POLAR = _polar_grid()
_HEADINGS: NDArray[np.float64] = np.linspace(0.0, 2.0 * np.pi, 2 * _ANGLES, endpoint=False)
_RADIUS = _disc()  # of every cell, 1 at the rim and beyond
_WINDOW = np.cos(0.5 * np.pi * _RADIUS)
_INSIDE = (_RADIUS < 1.0).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Descriptor:
    """A submap from above.

    Attributes
    ----------
    anchor : index of its keyframe
    T_anchor_level : pose of the level frame that it is seen in, in the keyframe's
    cell_m : of the image
    image : (SIZE, SIZE) uint8, root of the number of occupied heights in each cell, row along y
    spectrum : (F, A) magnitudes of the image's Fourier transform by frequency and direction, mean 0 in each row:
        invariant to a shift of the image, turned as it is turned (Reddy & Chatterji 1996)
    key : (K,) unit vector; invariant to a turn of the image, too
    """

    anchor: int
    T_anchor_level: Pose
    cell_m: float
    image: NDArray[np.uint8]
    spectrum: NDArray[np.float32]
    key: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Alignment:
    """Relative pose of two descriptors' anchors, and the correlation of the images there, up to 1."""

    T_target_source: Pose
    similarity: float


class DescriptorRecognizer:
    """Proposes the most similar submap, and the most similar of those near the expected pose.

    Submaps are compared with those of the same voxel scale only.
    """

    def __init__(self, config: Config, dimension: int) -> None:
        if dimension != 3:
            raise InputError("loops.recognizer descriptor is for 3D logs; leave it at auto in a 2D log")
        self.config = config
        self.databases: dict[float, DescriptorDatabase] = {}
        self.newest: Descriptor | None = None

    def add(self, submap: Submap) -> None:
        """Describe a submap and keep its descriptor."""
        self.newest = describe(submap, level_frame(submap.anchor, self.config.local_map))
        database = self.databases.setdefault(submap.anchor.scale, DescriptorDatabase())
        database.add(self.newest, submap.anchor.traveled_m)

    def query(self, query: Query) -> list[Candidate]:
        """At most two candidates: the most similar submap, and the most similar one near the expected pose."""
        descriptor, database = self.newest, self.databases[query.submap.anchor.scale]
        assert descriptor is not None and descriptor.anchor == query.submap.anchor.index
        similar = database.most_similar(descriptor, _MAX_COMPARED, query.max_traveled_m)
        if not similar:
            return []
        best = self._best(descriptor, similar, query)
        candidates = [best] if best.score >= _MIN_SIMILARITY else []
        near = database.nearest(query.T_world, query.T_world_anchor[:3, 3], _MAX_NEAREST)
        return candidates + self._best_nearby(descriptor, near, query)

    def _best(self, descriptor: Descriptor, similar: Sequence[Descriptor], query: Query) -> Candidate:
        """The most similar of several descriptors, ambiguous where another one contradicts it.

        Two at the same position, up to the possible drift of the map between them, do not contradict.
        """
        ranked = sorted(
            ((compare(descriptor, other), other.anchor) for other in similar), key=lambda each: -each[0].similarity
        )
        best, target = ranked[0]
        position = _position(query.T_world, target, best)
        rival = -1
        for alignment, other in ranked[1:]:
            if alignment.similarity < _RIVAL * best.similarity:
                break
            between_m = abs(query.keyframes[other].traveled_m - query.keyframes[target].traveled_m)
            apart_m = float(np.linalg.norm(_position(query.T_world, other, alignment) - position))
            if apart_m > max(_MIN_APART * query.submap.radius_m, self.config.loops.drift * between_m):
                rival = other
                break
        return Candidate(target, best.T_target_source, best.similarity, Proposal.PLACE, rival)

    def _best_nearby(self, descriptor: Descriptor, near: Sequence[Descriptor], query: Query) -> list[Candidate]:
        """The most similar of the nearest descriptors that align close to the expected pose, if any does."""
        found: list[Candidate] = []
        for other in near:
            T_expected = (
                lie.inverse(query.T_world[other.anchor] @ other.T_anchor_level)
                @ query.T_world_anchor
                @ descriptor.T_anchor_level
            )
            alignment = compare(
                descriptor, other, expected_rad=_yaw(T_expected), within_rad=_MAX_HEADING_ERROR_RAD
            )
            position = _position(query.T_world, other.anchor, alignment)
            moved_m = np.linalg.norm(position - query.T_world_anchor[:3, 3])
            traveled_m = query.submap.anchor.traveled_m - query.keyframes[other.anchor].traveled_m
            if moved_m <= search_radius_m(self.config.loops, traveled_m):
                found.append(
                    Candidate(other.anchor, alignment.T_target_source, alignment.similarity, Proposal.POSITION)
                )
        return sorted(found, key=lambda each: -each.score)[:1]


class DescriptorDatabase:
    """Descriptors by their keys, in a k-d tree that is rebuilt as they become more; the rest is searched linearly.

    All rebuilds together take but a few times as long as the last one.
    """

    def __init__(self) -> None:
        self.descriptors: list[Descriptor] = []
        self.waiting: deque[tuple[float, Descriptor]] = deque()
        self.tree: KDTree | None = None
        self.in_tree = 0

    def add(self, descriptor: Descriptor, traveled_m: float) -> None:
        """Keep a descriptor for later; its anchor was passed after so many meters."""
        self.waiting.append((traveled_m, descriptor))

    def most_similar(self, descriptor: Descriptor, count: int, max_traveled_m: float) -> list[Descriptor]:
        """Those with the most similar keys, passed after at most so many meters; that limit may only grow."""
        while self.waiting and self.waiting[0][0] <= max_traveled_m:
            self.descriptors.append(self.waiting.popleft()[1])
        if len(self.descriptors) > _GROWTH * self.in_tree + _SLACK:
            self.tree = KDTree([each.key for each in self.descriptors])
            self.in_tree = len(self.descriptors)
        found = list(range(self.in_tree, len(self.descriptors)))
        if self.tree is not None:
            found += np.atleast_1d(self.tree.query(descriptor.key, min(count, self.in_tree))[1]).tolist()
        distance = [_square(self.descriptors[index].key - descriptor.key) for index in found]
        return [self.descriptors[found[rank]] for rank in np.argsort(distance, kind="stable")[:count]]

    def nearest(self, T_world: Matrix, position: NDArray[np.float64], count: int) -> list[Descriptor]:
        """Those nearest to a position (3,) in the world, of those that ``most_similar`` last searched."""
        anchors = [descriptor.anchor for descriptor in self.descriptors]
        distance_m = np.linalg.norm(T_world[anchors, :3, 3] - position, axis=1)
        return [self.descriptors[index] for index in np.argsort(distance_m, kind="stable")[:count]]


def describe(submap: Submap, T_anchor_level: Pose) -> Descriptor:
    """The descriptor of a submap; a cell holds the root of the number of heights above its lowest."""
    cell_m = 2.0 * submap.radius_m / SIZE
    T_level_anchor = lie.inverse(T_anchor_level)
    views = [lie.transform(T_level_anchor @ T, points) for T, points in submap.views(len(submap.members))]
    image = gaussian_filter(np.sqrt(heights_of(np.vstack(views), cell_m), dtype=np.float32), _BLUR)
    magnitude = np.abs(fft.fftshift(fft.fft2(image * _WINDOW)))
    spectrum = np.log1p(map_coordinates(magnitude, _POLAR, order=1))
    return Descriptor(
        anchor=submap.anchor.index,
        T_anchor_level=T_anchor_level,
        cell_m=cell_m,
        image=np.minimum(_STEPS * image + 0.5, 255.0).astype(np.uint8),
        spectrum=spectrum - spectrum.mean(axis=1, keepdims=True),
        key=_key_of(spectrum),
    )


def heights_of(points: Points, cell_m: float) -> NDArray[np.int64]:
    """Number of occupied heights above the lowest one, of each cell (SIZE, SIZE) around the origin, row along y.

    points : (N, 3) meters, level frame; those outside of the square and of _HEIGHTS cells in height are left out
    """
    size = np.array([SIZE, SIZE, _HEIGHTS])
    cells = np.floor(points / cell_m).astype(np.int64) + size // 2
    column, row, height = cells[((cells >= 0) & (cells < size)).all(axis=1)].T
    is_occupied = np.zeros((SIZE, SIZE, _HEIGHTS), np.bool_)
    is_occupied[row, column, height] = True
    return np.maximum(is_occupied.sum(axis=2) - 1, 0)


def compare(
    source: Descriptor, target: Descriptor, *, expected_rad: float = 0.0, within_rad: float = np.pi
) -> Alignment:
    """The source aligned to the target: heading by the spectra, which leave it open by half a turn, then shift.

    The heading is searched within so many radians of the expected one.
    """
    heading, is_open = _heading(source.spectrum, target.spectrum, expected_rad, within_rad)
    fixed = target.image * _INSIDE
    turned = _turned(source.image.astype(np.float32), heading) * _INSIDE
    norm = max(float(np.sqrt(np.square(fixed).sum() * np.square(turned).sum())), 1e-9)
    fixed_spectrum, turned_spectrum = fft.rfft2(fixed), fft.rfft2(turned)
    correlation, x, y = _shift(fft.irfft2(fixed_spectrum * turned_spectrum.conj(), (SIZE, SIZE)), 0)
    if is_open:  # the other half turn reverses both axes, which is conjugation and a shift by one cell
        back = _shift(fft.irfft2(fixed_spectrum * turned_spectrum, (SIZE, SIZE)), 1 - SIZE)
        if back[0] > correlation:
            (correlation, x, y), heading = back, heading + np.pi
    T_level = lie.lift(lie.pose_2d(x * target.cell_m, y * target.cell_m, heading))
    T_target_source = target.T_anchor_level @ T_level @ lie.inverse(source.T_anchor_level)
    return Alignment(T_target_source, correlation / norm)


def _key_of(spectrum: NDArray[np.float32]) -> NDArray[np.float32]:
    """Strength of the first harmonics over the direction, in bands of frequencies."""
    bands = spectrum.reshape(_BANDS, -1, _ANGLES).mean(axis=1)
    strength = np.abs(fft.rfft(bands, axis=1))[:, :_HARMONICS]
    strength[:, 0] = _WEIGHT_OF_MEAN * (strength[:, 0] - strength[:, 0].mean())
    key = strength.ravel()
    return (key / max(float(np.linalg.norm(key)), 1e-9)).astype(np.float32)


def _heading(
    source: NDArray[np.float32], target: NDArray[np.float32], expected_rad: float, within_rad: float
) -> tuple[float, bool]:
    """Heading of the source that makes its spectrum the target's; True if the opposite one fits as well.

    A parabola refines the best of the steps.
    """
    product = fft.rfft(target, axis=1) * fft.rfft(source, axis=1).conj()
    correlation = fft.irfft(product.sum(axis=0), _ANGLES)
    error_rad = np.abs(lie.wrap(_HEADINGS - expected_rad)).reshape(2, _ANGLES)
    best = int(np.where(error_rad.min(axis=0) <= within_rad, correlation, -np.inf).argmax())
    left, middle, right = correlation[best - 1], correlation[best], correlation[(best + 1) % _ANGLES]
    bend = left - 2.0 * middle + right
    offset = 0.5 * (left - right) / bend if bend < min(-abs(left - right), 0.0) else 0.0
    half = int(error_rad[:, best].argmin())
    return float((half * _ANGLES + best + offset) * np.pi / _ANGLES), bool(error_rad[:, best].max() <= within_rad)


def _turned(image: NDArray[np.float32], angle_rad: float) -> NDArray[np.float32]:
    """The image turned about its middle, from x to y."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    back = np.array([[c, -s], [s, c]])  # from (row, column) of the result to that of the image
    middle = np.full(2, 0.5 * (SIZE - 1))
    offset = middle - back @ middle
    return np.asarray(affine_transform(image, back, offset, order=1), np.float32)  # pyright: ignore[reportArgumentType]


def _shift(correlation: NDArray[np.float64], offset: int) -> tuple[float, float, float]:
    """Greatest correlation within half the radius, and the shift there in cells along x and y."""
    reach = SIZE // 4
    near = np.arange(-reach, reach + 1)
    window = correlation[np.ix_((near - offset) % SIZE, (near - offset) % SIZE)]
    row, column = np.unravel_index(int(window.argmax()), window.shape)
    return float(window[row, column]), float(near[column]), float(near[row])


def search_radius_m(config: LoopsConfig, traveled_m: float) -> float:
    """Radius of the search around the expected pose, for a loop of so many meters."""
    return float(np.clip(config.drift * traveled_m, config.min_radius_m, config.max_radius_m))


def _position(T_world: Matrix, target: int, alignment: Alignment) -> Matrix:
    """Position (3,) of the source in the world."""
    return (T_world[target] @ alignment.T_target_source)[:3, 3]


def _yaw(T: Pose) -> float:
    return float(np.arctan2(T[1, 0], T[0, 0]))


def _square(v: NDArray[np.float32]) -> float:
    return float(v @ v)
