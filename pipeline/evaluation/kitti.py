"""The KITTI odometry metric: drift per meter over stretches of several lengths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.errors import InputError
from scanchain.evaluation.absolute import path_length
from scanchain.evaluation.pairing import Pairs
from scanchain.evaluation.relative import motion_errors
from scanchain.words import counted

KITTI_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
SHORT_LENGTHS_M = (10.0, 20.0, 40.0)
_LONG_PATH_M = 200.0  # from here on the published lengths leave a choice of starts


@dataclass(frozen=True, slots=True)
class LengthError:
    """Mean drift over the stretches of one length; None where none fits."""

    length_m: float
    stretches: int
    translation_share: float | None
    rotation_rad_per_m: float | None


@dataclass(frozen=True, slots=True)
class KittiError:
    """Drift, averaged over all stretches of all lengths (Geiger et al. 2012).

    Attributes
    ----------
    definition : what was computed, in words; pairing : over which poses
    translation_share : ‖t‖ / length; times 100 it is the published per cent
    rotation_rad_per_m : angle / length
    stretches : how many there were
    by_length : the same, length by length
    """

    definition: str
    pairing: str
    translation_share: float
    rotation_rad_per_m: float
    stretches: int
    by_length: tuple[LengthError, ...]

    @property
    def summary(self) -> str:
        """The figures in one line, in the units they are published in."""
        return (
            f"KITTI translation {100.0 * self.translation_share:.4f} %, rotation "
            f"{np.degrees(self.rotation_rad_per_m):.6f} deg/m over "
            f"{counted(self.stretches, 'stretch', 'stretches')}"
        )


def kitti_error(pairs: Pairs, lengths_m: Sequence[float] = KITTI_LENGTHS_M, *, every: int = 10) -> KittiError:
    """Drift over stretches that start at every ``every``-th pose.

    A stretch ends at the first pose more than its length further along the reference's path, and its error is
    divided by the nominal length, as in the benchmark's own code (step 10, lengths 100 to 800 m).
    """
    if every < 1 or not lengths_m or min(lengths_m) <= 0.0:
        raise InputError(f"lengths {list(lengths_m)} m from every {every} poses: take positive ones")
    traveled_m = path_length(pairs.reference)
    by_length, shares, turns = [], [], []
    for length_m in lengths_m:
        share, turn = _drift(pairs, traveled_m, length_m, every)
        shares.append(share)
        turns.append(turn)
        by_length.append(LengthError(length_m, len(share), _mean(share), _mean(turn)))
    share, turn = np.concatenate(shares), np.concatenate(turns)
    if not len(share):
        raise InputError(
            f"no stretch of {min(lengths_m):g} m fits into a path of {traveled_m[-1]:.1f} m; take shorter lengths"
        )
    starts = "pose" if every == 1 else f"{every}th pose"
    lengths = ", ".join(f"{length_m:g}" for length_m in lengths_m)
    return KittiError(
        definition=(
            f"KITTI: translation and angle of (P_i⁻¹ P_j)⁻¹ (R_i⁻¹ R_j) over the length, mean of {len(share)} "
            f"stretches of {lengths} m from every {starts}"
        ),
        pairing=pairs.description,
        translation_share=float(share.mean()),
        rotation_rad_per_m=float(turn.mean()),
        stretches=len(share),
        by_length=tuple(by_length),
    )


def kitti_error_on_any_course(pairs: Pairs) -> KittiError:
    """The published lengths where the path is long enough for them, else 10, 20 and 40 m from every pose."""
    if path_length(pairs.reference)[-1] >= _LONG_PATH_M:
        return kitti_error(pairs)
    return kitti_error(pairs, SHORT_LENGTHS_M, every=1)


def _drift(
    pairs: Pairs, traveled_m: NDArray[np.float64], length_m: float, every: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Translational share and rad/m of every stretch of a length."""
    start = np.arange(0, len(pairs), every)
    end = np.searchsorted(traveled_m, traveled_m[start] + length_m, side="right")
    fits = end < len(pairs)
    error = motion_errors(pairs, np.stack([start[fits], end[fits]], axis=1))
    return np.linalg.norm(error[:, :3, 3], axis=1) / length_m, lie.rotation_angle(error) / length_m


def _mean(values: NDArray[np.float64]) -> float | None:
    return float(values.mean()) if len(values) else None
