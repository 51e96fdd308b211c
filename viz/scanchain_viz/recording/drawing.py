"""Messages to the sinks of a recording, and conversions of arrays to what rerun draws.

The pipeline has SE(2) or SE(3) in float64; rerun draws float32 in 3D, a 2D log in the plane z = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix

Floats = NDArray[np.float32]
Color = tuple[int, int, int]
Colors = Color | Sequence[Color] | NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Times:
    """Times of the rows of a message, on the timelines ``scan`` and ``sensor_time``.

    Header stamps may step back in time, so the rows need not be in order of ``stamps_ns``.
    """

    scans: NDArray[np.int64]
    stamps_ns: NDArray[np.int64]

    @staticmethod
    def at(scan: int, stamp_ns: int) -> Times:
        """One instant."""
        return Times(np.array([scan], np.int64), np.array([stamp_ns], np.int64))

    def __getitem__(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Times:
        return Times(self.scans[rows], self.stamps_ns[rows])

    def columns(self) -> tuple[rr.TimeColumn, rr.TimeColumn]:
        """The two time columns."""
        return (
            rr.TimeColumn("scan", sequence=self.scans),
            rr.TimeColumn("sensor_time", timestamp=self.stamps_ns.view("datetime64[ns]")),
        )


@dataclass(frozen=True, slots=True)
class Message:
    """Columns of an entity over ``times``, or an archetype at one instant; without times it is static."""

    entity: str
    content: rr.AsComponents | rr.ComponentColumnList
    times: Times | None = None

    def send(self, stream: rr.RecordingStream) -> None:
        """Write it to a stream; raises if rerun rejects it."""
        if self.times is None:
            assert isinstance(self.content, rr.AsComponents)
            stream.log(self.entity, self.content, static=True, strict=True)
        else:
            columns = self.content
            if not isinstance(columns, rr.ComponentColumnList):
                parts = columns.as_component_batches()
                columns = [part.partition([len(part.as_arrow_array())]) for part in parts]
            stream.send_columns(self.entity, self.times.columns(), columns, strict=True)


def pixels(radius: float | None) -> float | None:
    """A radius in UI points, which rerun encodes as a negative number."""
    return None if radius is None else -radius


def dots(positions: Floats | None = None, color: Colors | None = None, radius: float | None = None) -> rr.Points3D:
    """Points (N, 3) of one radius in UI points, in one color or one each; None keeps the static value."""
    return rr.Points3D.from_fields(positions=positions, colors=color, radii=pixels(radius))


def lines(
    strips: Sequence[Floats] | Floats | None = None, color: Colors | None = None, radius: float | None = None
) -> rr.LineStrips3D:
    """Line strips, (N, 3) each, of one radius in UI points, in one color or one each; None as in ``dots``."""
    return rr.LineStrips3D.from_fields(strips=strips, colors=color, radii=pixels(radius))


def in_space(points: NDArray[np.floating]) -> Floats:
    """Points (N, 2 or 3) as (N, 3); a point in the plane lies at z = 0."""
    return lie.lift_points(points).astype(np.float32)


def positions(poses: Matrix) -> Floats:
    """Positions (N, 3) of poses (N, d+1, d+1)."""
    return in_space(poses[:, :-1, -1])


def transforms(poses: Matrix) -> rr.ComponentColumnList:
    """Transform columns of poses (N, d+1, d+1)."""
    quat_xyzw = lie.to_quaternion(lie.lift(poses)[:, :3, :3]).astype(np.float32)
    return rr.Transform3D.columns(translation=positions(poses), quaternion=quat_xyzw)


def ellipsoids(informations: Matrix, scale: float) -> rr.ComponentColumnList:
    """Ellipsoid columns of the position's covariance, axes ``scale`` standard deviations long.

    informations : (N, k, k) of twists in the lidar's frame, so that the translation block of the inverse is the
        covariance of the position along the lidar's axes. Unobservable directions are drawn at the cap.
    """
    k = informations.shape[-1]
    d = 2 if k == 3 else 3
    values, vectors = np.linalg.eigh(np.nan_to_num(informations, posinf=0.0, neginf=0.0))
    scaled = vectors[:, :d, :] / np.sqrt(np.maximum(values, 1e-9))[:, None, :]
    variances, axes = np.linalg.eigh(scaled @ np.swapaxes(scaled, -1, -2))
    half_sizes = in_space(scale * np.sqrt(np.minimum(variances, 0.04)))  # 0.2 m at most, also where infinite
    if d == 2:
        half_sizes[:, 2] = 0.1 * half_sizes.min(axis=1, initial=np.inf, where=[True, True, False])
    rotation = np.tile(np.eye(3), (len(axes), 1, 1))
    rotation[:, :d, :d] = axes
    rotation[:, :, 0] *= np.linalg.det(rotation)[:, None]
    return rr.Ellipsoids3D.columns(
        half_sizes=half_sizes, quaternions=lie.to_quaternion(rotation).astype(np.float32)
    )


def at_most(points: NDArray[np.floating], limit: int) -> Floats:
    """Every n-th point (N, 2 or 3) in space, so that at most ``limit`` remain."""
    return in_space(points[:: max(1, -(-len(points) // limit))])
