"""The map that each method makes of the same points, how sharp it is, and a thinned one for pictures."""

from __future__ import annotations

from collections.abc import Mapping

from scanchain import lie
from scanchain.comparison.judging import Judged, representative
from scanchain.comparison.outcome import Outcome
from scanchain.comparison.scan_store import StoredScans
from scanchain.data import Points
from scanchain.evaluation import Sharpness, sampled_map, sampling_step, sharpness

_PICTURE_POINTS = 150_000


def maps_of(scans: StoredScans, outcomes: Mapping[str, list[Outcome]]) -> dict[str, Points]:
    """Sampled maps (M, d) of the methods that came to their end."""
    step = sampling_step(int(scans.points.sum()))
    whole = {name: representative(runs) for name, runs in outcomes.items()}
    return {
        name: sampled_map(scans.scans(), outcome.trajectory, step)
        for name, outcome in whole.items()
        if outcome.is_whole
    }


def sharpness_of(maps: Mapping[str, Points]) -> dict[str, Sharpness]:
    """Of the maps that hold together."""
    answers = sharpness(list(maps.values())) if maps else []
    return {name: answer for name, answer in zip(maps, answers, strict=True) if answer is not None}


def picture_points(points: Points, judged: Judged) -> Points:
    """Some of a map's points (M, 3), in the frame of the ground truth where there is one."""
    thinned = points[:: max(1, -(-len(points) // _PICTURE_POINTS))]
    T = judged.T_reference_estimate
    if points.shape[1] == 2:
        T = lie.flatten(T)
    return lie.transform(T, thinned)
