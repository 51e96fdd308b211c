"""The figures of a method: one field each, with its unit; None where there is none."""

from __future__ import annotations

from msgspec import Struct


class Figures(Struct, frozen=True):
    """What a row of the table holds; errors are None without ground truth or relations, or after a failure."""

    ate_m: float | None = None
    ate_share: float | None = None
    ate_rotation_rad: float | None = None
    rpe_1_s_m: float | None = None
    rpe_10_m_m: float | None = None
    rpe_100_m_m: float | None = None
    kitti_share: float | None = None
    kitti_rad_per_m: float | None = None
    paired_share: float | None = None
    relations_m: float | None = None
    relations_rad: float | None = None
    nees: float | None = None
    thickness_m: float | None = None
    entropy: float | None = None
    disagreement_m: float | None = None
    median_s: float | None = None
    p95_s: float | None = None
    cpu_s: float | None = None
    first_s: float | None = None
    scans_per_s: float | None = None
    preprocess_s: float | None = None
    match_s: float | None = None
    map_s: float | None = None
    loops_s: float | None = None
    start_s: float | None = None
    finish_s: float | None = None
    peak_mib: float | None = None
    repeats_apart_m: float | None = None
