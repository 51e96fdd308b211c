"""What a place looks like from above, whichever way one came and a few meters aside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy import fft
from numpy.typing import NDArray
from scipy.ndimage import affine_transform, gaussian_filter, map_coordinates

from scanchain import lie
from scanchain.data import Pose
from scanchain.kernels.search.descriptor import count_heights, mark_heights
from scanchain.loops.local_map import LocalMap

SIZE = 128  # cells along each side of a view
_ANGLES = 64  # steps of half a turn
_FREQUENCIES = np.arange(2.0, 34.0)  # periods in a view
_BANDS, _HARMONICS = 16, 5  # of the key
_WEIGHT_OF_MEAN = 0.3  # of the harmonic 0 in the key
_BLUR = 0.7  # cells
_STEPS = 16.0  # of an image in 8 bits, per unit


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
class Place:
    """A local map from above.

    Attributes
    ----------
    anchor : its keyframe
    T_anchor_level : the upright frame that it is seen in, from the keyframe's
    cell_m : of the image
    image : (SIZE, SIZE) uint8, how much stands in each cell, row along y
    spectrum : (F, A) magnitudes of the image's Fourier transform by frequency and direction, mean 0 in each row:
        the same wherever in the image the place lies, turned as it is turned (Reddy & Chatterji 1996)
    key : (K,) unit vector; the same however the place is turned, too
    """

    anchor: int
    T_anchor_level: Pose
    cell_m: float
    image: NDArray[np.uint8]
    spectrum: NDArray[np.float32]
    key: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Likeness:
    """How one place lies in another: pose between the anchors, and correlation of the images there, up to 1."""

    T_target_source: Pose
    score: float


def describe(surroundings: LocalMap, T_anchor_level: Pose) -> Place:
    """The place of a local map; what stands in a cell is the root of the number of heights above its lowest."""
    cell_m = 2.0 * surroundings.radius_m / SIZE
    masks, counts = np.zeros((SIZE, SIZE), np.uint64), np.empty((SIZE, SIZE), np.uint8)
    T_level_anchor = lie.inverse(T_anchor_level)
    for T_anchor_lidar, points in surroundings.views(len(surroundings.members)):
        mark_heights(points, T_level_anchor @ T_anchor_lidar, cell_m, masks)
    count_heights(masks, counts)
    image = gaussian_filter(np.sqrt(counts, dtype=np.float32), _BLUR)
    magnitude = np.abs(fft.fftshift(fft.fft2(image * _WINDOW)))
    spectrum = np.log1p(map_coordinates(magnitude, _POLAR, order=1))
    return Place(
        anchor=surroundings.anchor.index,
        T_anchor_level=T_anchor_level,
        cell_m=cell_m,
        image=np.minimum(_STEPS * image + 0.5, 255.0).astype(np.uint8),
        spectrum=spectrum - spectrum.mean(axis=1, keepdims=True),
        key=_key_of(spectrum),
    )


def compare(source: Place, target: Place, *, expected_rad: float = 0.0, within_rad: float = np.pi) -> Likeness:
    """Where the source lies in the target: heading by the spectra, which leave it open by half a turn, then shift.

    The heading is looked for within so many radians of the expected one.
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
    return Likeness(T_target_source, correlation / norm)


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
    """Turn of the source that makes its spectrum the target's, and whether the opposite one is as good.

    A parabola refines the best of the steps.
    """
    product = fft.rfft(target, axis=1) * fft.rfft(source, axis=1).conj()
    likeness = fft.irfft(product.sum(axis=0), _ANGLES)
    off_rad = np.abs(lie.wrap(_HEADINGS - expected_rad)).reshape(2, _ANGLES)
    best = int(np.where(off_rad.min(axis=0) <= within_rad, likeness, -np.inf).argmax())
    left, middle, right = likeness[best - 1], likeness[best], likeness[(best + 1) % _ANGLES]
    bend = left - 2.0 * middle + right
    offset = 0.5 * (left - right) / bend if bend < min(-abs(left - right), 0.0) else 0.0
    half = int(off_rad[:, best].argmin())
    return float((half * _ANGLES + best + offset) * np.pi / _ANGLES), bool(off_rad[:, best].max() <= within_rad)


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
