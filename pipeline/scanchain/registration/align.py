"""Two clouds, aligned in one call: any unit, any origin, no configuration."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace

import msgspec
import numpy as np

from scanchain import checks, lie
from scanchain.config import Config
from scanchain.data import LEAST_FIT, AnyPoints, Match, Points, Pose
from scanchain.errors import InputError
from scanchain.kernels.registration.observability import WEAK
from scanchain.preprocess import downsample
from scanchain.registration.matcher import create_matcher
from scanchain.registration.search import SearchGrid, Wanted, Window, evenly, find, thinned
from scanchain.registration.voxel_map import VoxelMap
from scanchain.settings import Override, load_settings

_RANGE_VOXELS = {2: 40.0, 3: 14.0}  # largest number of voxels that the median distance from the centroid spans
_WINDOW = (0.5, 1.0)  # half the window searched in the plane: share of that distance, and rad
_SEEDS = Wanted(apart_m=1.0, rival=0.6, answers=6)  # initial poses in the plane
_SEEN_FROM = 3.0  # largest distance of a sensor, in the origin, from the centroid, in such median distances
_ELSEWHERE = (0.1, 0.05)  # m, in space voxels, and rad: distance above which two matches are distinct
AMBIGUOUS = 1.4  # times the cost of the best match, below which a distinct one is a rival: 25 surfaces, odds 150
_MOST = 3  # times the number of points to match, above which more points only cost time
_GAIN = 12.5  # least decrease of cost, in variances of a range, to leave the guess along a weak direction: 5 σ
_APART = 10.0  # times that distance between the centroids, above which the clouds cannot overlap


def align(
    target: AnyPoints,
    source: AnyPoints,
    T_guess: Pose | None = None,
    *,
    voxel_size_m: float | None = None,
    matcher: str = "plicp",
) -> Match:
    """Match of a cloud to another one, whose frame the pose refers to.

    Both clouds are moved to their centroids and scaled so that a voxel has the preset's size; the other lengths
    (search radius, kernel scale, tolerance) are the preset's, too. The clouds may therefore be in any unit, which
    replaces meters below.

    target, source : (N, d) and (M, d), d = 2 or 3, meters; rows that are not finite are left out
    T_guess : (d+1, d+1), the identity where left out; motions of about three voxels are found from there; in the
        plane, shifts by half the target's median range and turns of 1 rad about the origin of the source, or about
        its centroid where the origin is far away (branch and bound; Olson 2009, Hess et al. 2016)
    voxel_size_m : of the map made of the target; where left out, a fraction of the target's extent such that each
        voxel on a surface holds about one point or more
    matcher : "plicp" or "svd"
    Returns the match: ``T_target_source``, ``information`` (k, k) of a right perturbation of it, ``inliers``,
    ``residual_m``, ``observability``, ``converged`` and ``reason``.
    Raises InputError naming an argument that is not a valid cloud, pose, size or matcher.
    """
    d = checks.dimension_of(target, "target")
    target, source = _valid(target, "target", d), _valid(source, "source", d)
    T_guess = lie.identity(d) if T_guess is None else checks.pose(T_guess, "T_guess", d)
    config = load_settings(d, overrides=(Override("matching.matcher", matcher, "matcher"),)).config
    at_target, at_source = _translation(target.mean(axis=0)), _translation(source.mean(axis=0))
    target = lie.transform(lie.inverse(at_target), target)
    range_m = float(np.median(np.linalg.norm(target, axis=1)))
    if not range_m > 0.0:
        raise InputError(f"target: its {len(target):,} points lie on one point; wanted a cloud with an extent")
    around = 2.0 * (d - 1) * math.pi  # of a circle or a sphere of radius 1: few points span few voxels
    finest_m = range_m * (len(target) / around) ** (-1.0 / (d - 1))
    size_m = max(finest_m, range_m / _RANGE_VOXELS[d]) if voxel_size_m is None else voxel_size_m
    checks.positive(size_m, "voxel_size_m")
    source = lie.transform(lie.inverse(at_source), source)
    T_first = lie.inverse(at_target) @ T_guess @ at_source
    apart_m = float(np.linalg.norm(T_first[:-1, -1]))
    if apart_m > _APART * (range_m + float(np.linalg.norm(source, axis=1).max())):
        raise InputError(
            f"T_guess puts the centroid of the source {apart_m:.3g} m from that of the target, which spans about "
            f"{range_m:.3g} m; wanted clouds in one unit that overlap"
        )
    is_near = np.linalg.norm(at_source[:-1, -1]) < _SEEN_FROM * range_m

    def matched(voxel_m: float, T_first: Pose) -> Match:
        """The match of the centered clouds, in their unit, with voxels of this size."""
        unit_m = voxel_m / config.local_map.voxel_size_m
        clouds, pivot = (target / unit_m, source / unit_m), _scaled(at_source, is_near / unit_m)
        match = _matched(*clouds, _scaled(T_first, 1.0 / unit_m), pivot, range_m / unit_m, config)
        return _restored(match, unit_m)

    match = matched(size_m, T_first)
    if d == 3 and voxel_size_m is None:
        match = _at_another_scale(match, matched, size_m, finest_m)
    return with_source_frame(replace(match, T_target_source=at_target @ match.T_target_source), at_source)


def _at_another_scale(
    match: Match, matched: Callable[[float, Pose], Match], size_m: float, finest_m: float
) -> Match:
    """The match with other voxels, where these are too coarse for an object or too fine for rough surfaces.

    Voxels that hold both sides of a plank leave its pose undetermined: halved ones are tried, as fine as the point
    density allows. Surfaces rougher than the width of the kernel contradict any pose: doubled ones are tried.
    """
    for _ in range(2):
        if match.observability >= 1.0 or size_m <= finest_m:
            break
        size_m = max(0.5 * size_m, finest_m)
        finer = matched(size_m, match.T_target_source)
        if finer.fit >= LEAST_FIT and finer.observability > match.observability:
            is_clear = finer.observability >= WEAK or not finer.converged  # a weak one may be due to the sampling
            match = finer if is_clear else replace(finer, converged=False, reason=match.reason, cause=match.cause)
    if match.fit < LEAST_FIT and match.observability >= 1.0:
        coarser = matched(2.0 * size_m, match.T_target_source)
        if coarser.converged:  # found at one scale, confirmed at the other
            again = matched(size_m, coarser.T_target_source)
            same = again.T_target_source, coarser.T_target_source, _ELSEWHERE[0] * size_m, _ELSEWHERE[1]
            if again.converged or lie.agree(*same):
                match = again if again.converged else coarser
    return match


def _valid(cloud: AnyPoints, name: str, d: int) -> Points:
    """The finite points of a cloud. Raises InputError where there are none."""
    points, _ = checks.valid_points(cloud, name, d)
    if not len(points):
        raise InputError(f"{name} has no points that are finite; wanted (N, {d}) with N of at least a few hundred")
    return points


def _matched(
    target: Points, source: Points, T_first: Pose, T_pivot_source: Pose, range_m: float, config: Config
) -> Match:
    """The match of two clouds in the configured scale; in the plane the best of several turns about a pivot."""
    local_map, sizes = VoxelMap(target.shape[1], config.local_map), config.preprocess
    local_map.insert(downsample(target, sizes.map_voxel_m), lie.identity(target.shape[1]))
    sparse = downsample(source, sizes.match_voxel_m)
    finer = math.sqrt(len(sparse) / sizes.match_points)
    if finer < 1.0:  # of voxels, so that about as many points as configured remain
        sparse = downsample(source, max(finer * sizes.match_voxel_m, sizes.map_voxel_m))
    sparse = evenly(sparse, _MOST * sizes.match_points)
    matcher = create_matcher(config.matching)
    match = matcher.align(sparse, local_map, T_first, wide=True)
    if match.observability < WEAK and not match.converged:
        unheld = create_matcher(msgspec.structs.replace(config.matching, min_information=0.0, min_signal=0.0))
        free = unheld.align(sparse, local_map, T_first, wide=True)
        if free.cost + _GAIN * config.matching.sensor_noise_m**2 < match.cost / AMBIGUOUS:
            match = matcher.align(sparse, local_map, free.T_target_source)
    if local_map.dimension == 3:
        return match
    grid = SearchGrid.of_voxels(local_map, T_first)
    turned = thinned(lie.transform(T_pivot_source, sparse), grid.resolution_m)
    window = Window(T_first @ lie.inverse(T_pivot_source), _WINDOW[0] * range_m, _WINDOW[1])
    found = (seed.T_target_source @ T_pivot_source for seed in find(turned, grid, window, _SEEDS))
    return _unambiguous([match, *(matcher.align(sparse, local_map, T_seed) for T_seed in found)])


def _unambiguous(matches: Sequence[Match]) -> Match:
    """The match of lowest cost, not converged where a distinct one fits nearly as well."""
    best = min(matches, key=lambda match: match.cost)
    for other in matches:
        T, T_other = best.T_target_source, other.T_target_source
        is_rival = other.cost < AMBIGUOUS * best.cost and not lie.agree(T, T_other, *_ELSEWHERE)
        if best.converged and is_rival:
            best = as_ambiguous(best, *lie.apart(T, T_other))
    return best


def as_ambiguous(match: Match, apart_m: float, apart_rad: float) -> Match:
    """The same match, not converged because a pose at this distance fits nearly as well."""
    reason = f"ambiguous: a pose {apart_m:.2g} m away, turned by {apart_rad:.2f} rad, fits nearly as well"
    return replace(match, converged=False, reason=reason, cause="ambiguous: another pose fits nearly as well")


def _restored(match: Match, unit_m: float) -> Match:
    """A match of scaled clouds, converted to the unit of the given clouds."""
    units = lie.by_component(len(match.information), unit_m, 1.0)
    return replace(
        match,
        reason=match.reason if match.converged else _in_units_of(match.reason, unit_m),
        cause=_in_units_of(match.cause, unit_m),
        T_target_source=_scaled(match.T_target_source, unit_m),
        information=match.information / np.outer(units, units),
        cost=match.cost * unit_m**2,
        residual_m=match.residual_m * unit_m,
        degeneracy_direction=units * match.degeneracy_direction,
    )


def _in_units_of(reason: str, unit_m: float) -> str:
    """A reason with lengths in the unit of the given clouds, without configuration keys, which ``align`` lacks."""
    named = re.sub(r"matching\.kernel_scale_m \((\S+)\)", r"the kernel scale of \1 m", reason)
    named = re.sub(r"local_map\.voxel_size_m \((\S+)\)", r"voxel_size_m (\1 m)", named)
    named = named.replace("matching.", "").replace("local_map.", "")
    return re.sub(r"([\d.e+-]*\d) m\b", lambda length: f"{float(length[1]) * unit_m:.3g}", named)


def with_source_frame(match: Match, T_new_old: Pose) -> Match:
    """The same match with another frame fixed to the source: ξ of T becomes Ad(T_new_old) ξ."""
    T_old_new = lie.inverse(T_new_old)
    direction = lie.adjoint(T_new_old) @ match.degeneracy_direction
    Ad_inverse = lie.adjoint(T_old_new)
    return replace(
        match,
        T_target_source=match.T_target_source @ T_old_new,
        information=Ad_inverse.T @ match.information @ Ad_inverse,
        degeneracy_direction=direction / np.linalg.norm(direction),
    )


def _translation(shift: Points) -> Pose:
    T = lie.identity(len(shift))
    T[:-1, -1] = shift
    return T


def _scaled(T: Pose, factor: float) -> Pose:
    scaled = T.copy()
    scaled[:-1, -1] *= factor
    return scaled
