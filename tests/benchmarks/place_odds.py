"""What keyframes show at right and wrong poses in a map.

Right poses are those of logs that enter a map (the real ones of ``places --late``), up to 5 m from its keyframes
and disturbed by 0.3 m and 0.03 rad. Wrong ones are the best that a search finds for paths of real logs in the
maps of other buildings, and the keyframes up to 12 before and after. At each a keyframe is aligned as for a loop
closure.

Prints the weights of a logistic regression over fit, no fit and contradicted free space, the two classes of
equal weight, beside those of ``loops.evidence.log_ratio``; and for both the share of pairs that they order
rightly and the mean log-odds of a keyframe.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import permutations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from scanchain import lie
from scanchain.data import Keyframe, Matrix, Pose
from scanchain.loops import LoopCloser, evidence
from scanchain.loops.place_search import completed
from scanchain.loops.planar_map_search import PlanarMapSearch
from scanchain.maps import SavedMap, open_saved_map
from scanchain.settings import load_settings
from tests.benchmarks.harness import options_of, poses_at, table, true_in_map
from tests.benchmarks.places import ENTRIES, REAL, prepared, whole_of

NEAR_M, AROUND = 5.0, 12
PATH_M, STEP_M = 8.0, 8.0  # length of the paths, and between their begins
LEAST = 0.25  # share of the highest score from which on a wrong pose is taken


class Shown:
    """Features of keyframes at poses in a map: fit, no fit, contradiction; see ``log_ratio``."""

    def __init__(self, saved: SavedMap) -> None:
        self.config = load_settings(2).config
        self.saved, self.closer = saved, LoopCloser(self.config, 2)
        self.closer.add_map(list(saved.keyframes))

    def of(self, keyframe: Keyframe, T_map_lidar: Pose) -> tuple[float, float, float] | None:
        """None where the map has nothing near."""
        saved = self.saved
        near = self._nearest(T_map_lidar)
        if lie.apart(saved.poses[near], T_map_lidar)[0] > NEAR_M:
            return None
        target = self.closer.near.submaps.anchor_of(near)
        submap = self.closer.near.submaps.around(target, saved.keyframes, len(saved.keyframes) - 1)
        T_first = lie.between(saved.poses[target], T_map_lidar)
        verified = self.closer.near.verifier.scan(keyframe, submap, T_first, in_map=True)
        T = saved.poses[target] @ verified.match.T_target_source
        placed, beside = replace(keyframe, T_odom_lidar=T), saved.keyframes[self._nearest(T)]
        counts = evidence.compared([placed], [beside]) + evidence.compared([beside], [placed])
        points = len(keyframe.points) + len(beside.points)
        return evidence.features(verified.closure(target, len(saved.keyframes)), *counts.tolist(), points)

    def _nearest(self, T: Pose) -> int:
        return int(np.linalg.norm(self.saved.poses[:, :2, 2] - T[:2, 2], axis=1).argmin())


def right(name: str, cache: Path) -> Iterator[tuple[float, float, float]]:
    """Features at right poses of a log that enters a map."""
    out, _, options, map_truth, truth = prepared(name, 0, cache)
    saved, whole = open_saved_map(out), open_saved_map(whole_of(ENTRIES[name].log, cache))
    shown, random = Shown(saved), np.random.default_rng(0)
    begin_ns = whole.keyframes[0].stamp_ns
    for keyframe in whole.keyframes[::2]:
        expected, away_m = true_in_map(saved, map_truth, poses_at(truth, np.array([keyframe.stamp_ns])))
        after_s = (keyframe.stamp_ns - begin_ns) * 1e-9
        if away_m[0] < NEAR_M and options["log__start_s"] <= after_s <= options["log__end_s"]:
            off = lie.pose_2d(*random.normal(0.0, (0.3, 0.3, 0.03)).tolist())
            found = shown.of(keyframe, lie.flatten(expected[0]) @ off)
            yield from [] if found is None else [found]


def wrong(guest: SavedMap, host: SavedMap, found: list[bool]) -> Iterator[tuple[float, float, float]]:
    """Features at the best poses of paths of a log in the map of another building; which are taken for found."""
    shown, search = Shown(host), PlanarMapSearch(host.keyframes, 0.1)
    traveled_m = np.array([each.traveled_m for each in guest.keyframes])
    for begin_m in np.arange(traveled_m[0], traveled_m[-1] - PATH_M, STEP_M).tolist():
        first, end = np.searchsorted(traveled_m, (begin_m, begin_m + PATH_M)).tolist()
        members, middle = guest.keyframes[first:end], guest.keyframes[(first + end) // 2]
        T_middle_odom = lie.inverse(middle.T_odom_lidar)
        points = np.vstack([lie.transform(T_middle_odom @ each.T_odom_lidar, each.points) for each in members])
        best = completed(search.searched(points, LEAST))
        found.append(best is not None and best.is_certain and not best.is_ambiguous)
        if best is None:
            continue
        for each in guest.keyframes[max(middle.index - AROUND, 0) : middle.index + AROUND]:
            features = shown.of(each, best.T_map_lidar @ T_middle_odom @ each.T_odom_lidar)
            yield from [] if features is None else [features]


def told(weights: NDArray[np.float64], ours: Matrix, others: Matrix) -> tuple[str, ...]:
    """Cells of some weights."""
    odds = [np.clip(part @ weights, -evidence.LARGEST_RATIO, evidence.LARGEST_RATIO) for part in (ours, others)]
    ordered = (odds[0][:, None] > odds[1]).mean() + 0.5 * (odds[0][:, None] == odds[1]).mean()
    shown = ", ".join(f"{each:.1f}" for each in weights.tolist())
    return shown, f"{100.0 * ordered:.1f} %", f"{odds[0].mean():+.2f}", f"{odds[1].mean():+.2f}"


def main() -> None:
    cache = options_of(__doc__).cache
    runs = {log: whole_of(log, cache) for log in REAL}
    maps = {log: open_saved_map(run) for log, run in runs.items()}
    ours = np.array([each for name, entry in ENTRIES.items() if entry.log in REAL for each in right(name, cache)])
    finds: list[bool] = []
    others = np.array([each for a, b in permutations(REAL, 2) for each in wrong(maps[a], maps[b], finds)])
    counts = np.array([len(ours), len(others)])
    signs, shares = np.repeat([1.0, -1.0], counts), np.repeat(0.5 / counts, counts)
    rows = np.vstack([ours, others])
    fitted = minimize(lambda w: float(shares @ np.logaddexp(0.0, -signs * (rows @ w))), np.zeros(3)).x
    print(f"{len(ours):,} keyframes at right poses, {len(others):,} at wrong ones")
    print(f"{sum(finds):,} of {len(finds):,} paths in maps of other buildings are taken for found\n")
    row = table("weights", "fit, no fit, contradiction", "ordered rightly", "right, mean", "wrong, mean")
    row("fitted", *told(fitted, ours, others))
    row("in use", *told(np.array(evidence.WEIGHTS), ours, others))


if __name__ == "__main__":
    main()
