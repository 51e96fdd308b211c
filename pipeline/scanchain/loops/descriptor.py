"""Descriptor of a submap seen from above, the same for either heading and from a few meters aside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy import fft
from numpy.typing import NDArray
from scipy.ndimage import affine_transform, gaussian_filter, map_coordinates

from scanchain import lie
from scanchain.config import LocalMapConfig
from scanchain.data import Keyframe, Pose
from scanchain.kernels.search.descriptor import count_heights, mark_heights
from scanchain.kernels.voxels.voxel_shapes import DIRECTION, PLANE, SHAPE
from scanchain.loops.submaps import Submap
from scanchain.registration import VoxelMap

SIZE = 128  # cells along each side of the image
_ANGLES = 64  # directions of the spectrum over half a turn
_FREQUENCIES = np.arange(2.0, 34.0)  # periods in an image
_BANDS, _HARMONICS = 16, 5  # size of the key: bands of frequencies, harmonics over the direction
_WEIGHT_OF_MEAN = 0.3  # weight of harmonic 0 in the key
_BLUR = 0.7  # standard deviation, cells, of the filter that blurs the image
_STEPS = 16.0  # steps of an 8-bit image for each unit of a cell
_CONES = (0.85, 0.97)  # cosines: normals nearer to the axis than this are the ground's, roughly and finally
_MIN_GROUND_VOXELS = 10  # least number of voxels with such a normal; with fewer the lidar is assumed upright


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


def describe(submap: Submap, T_anchor_level: Pose) -> Descriptor:
    """The descriptor of a submap; a cell holds the root of the number of heights above its lowest."""
    cell_m = 2.0 * submap.radius_m / SIZE
    masks, counts = np.zeros((SIZE, SIZE), np.uint64), np.empty((SIZE, SIZE), np.uint8)
    T_level_anchor = lie.inverse(T_anchor_level)
    for T_anchor_lidar, points in submap.views(len(submap.members)):
        mark_heights(points, T_level_anchor @ T_anchor_lidar, cell_m, masks)
    count_heights(masks, counts)
    image = gaussian_filter(np.sqrt(counts, dtype=np.float32), _BLUR)
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


def level_frame(keyframe: Keyframe, config: LocalMapConfig) -> Pose:
    """T_keyframe_level (4, 4), the frame with the same origin whose z axis is normal to the ground.

    The ground is what is planar and lies at less than 32° to the lidar's own horizon; where there is too little
    of it, the lidar is assumed upright. The x axis is as near to the lidar's as it can be.
    """
    voxels = VoxelMap(3, config, keyframe.scale)
    voxels.insert(keyframe.points, lie.identity(3))
    cells = voxels.voxels.cells[: len(voxels)]
    normals = cells[cells[:, SHAPE] == PLANE, DIRECTION : DIRECTION + 3]
    up = np.array([0.0, 0.0, 1.0])
    for cosine in _CONES:
        along = normals @ up
        chosen = np.abs(along) > cosine
        if chosen.sum() < _MIN_GROUND_VOXELS:
            break
        up = _unit((normals[chosen] * np.sign(along[chosen])[:, None]).sum(axis=0))
    return upright_frame(up)


def upright_frame(up: NDArray[np.float64], ahead: NDArray[np.float64] | None = None) -> Pose:
    """The frame (4, 4) at the origin with its z axis along the unit vector ``up``, x near ``ahead``, or x."""
    T = lie.identity(3)
    ahead = np.array([1.0, 0.0, 0.0]) if ahead is None else ahead
    forward = _unit(ahead - (ahead @ up) * up)
    T[:3, 0], T[:3, 1], T[:3, 2] = forward, np.cross(up, forward), up
    return T


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


def _unit(v: NDArray[np.float64]) -> NDArray[np.float64]:
    return v / np.linalg.norm(v)
