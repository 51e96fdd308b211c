"""Loop closures of places recognized: described once complete, compared with all older ones, measured, judged."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.config import Config
from scanchain.data import Closure, Keyframe, Matrix, Pose, Proposal, Verdict
from scanchain.loops.local_map import FUTURE, PAST, LocalMap, local_map
from scanchain.loops.pieces import Pieces
from scanchain.loops.place import describe
from scanchain.loops.recognition import Candidate, Recognition
from scanchain.loops.upright import level_frame
from scanchain.loops.verification import Measurement, Verifier

_SPACING = 1.0 / 3.0  # radii of the way between two places


class PlaceCloser:
    """Asks of every few keyframes whether their surroundings were seen before.

    The surroundings are complete once the lidar has gone on by the radius of a view.
    """

    def __init__(self, config: Config, pieces: Pieces) -> None:
        self.config = config.loops
        self.pieces = pieces
        self.map_config = config.local_map
        self.recognition = Recognition(config.loops)
        self.verifier = Verifier(config)
        self.examined = 0
        self.next_m = 0.0
        self.last: Closure | None = None

    def close(
        self,
        keyframes: Sequence[Keyframe],
        T_world_keyframes: Matrix,
        joined: NDArray[np.bool_],
        *,
        finish: bool = False,
    ) -> tuple[Closure, ...]:
        """Closures of the places that are complete by now, accepted or not; with ``finish``, of all that are left.

        keyframes : all so far; T_world_keyframes : (K, 4, 4) their best known poses
        joined : (K,) those that lie as the graph says as seen from the newest, and among themselves
        """
        closures: list[Closure] = []
        for anchor in self._anchors(keyframes, finish):
            closures += self._closures(anchor, keyframes, T_world_keyframes, joined)
        return tuple(closures)

    def _anchors(self, keyframes: Sequence[Keyframe], finish: bool) -> Iterator[Keyframe]:
        """Keyframes that places are made of, each once."""
        while self.examined < len(keyframes):
            keyframe = keyframes[self.examined]
            radius_m = self._radius_m(keyframe)
            if keyframes[-1].traveled_m < keyframe.traveled_m + FUTURE * radius_m and not finish:
                return
            self.examined += 1
            if keyframe.traveled_m >= self.next_m:
                self.next_m = keyframe.traveled_m + _SPACING * radius_m
                yield keyframe

    def _closures(
        self, anchor: Keyframe, keyframes: Sequence[Keyframe], T_world: Matrix, joined: NDArray[np.bool_]
    ) -> Iterator[Closure]:
        """The first that is accepted, after those that are not."""
        radius_m = self._radius_m(anchor)
        surroundings = local_map(keyframes, anchor.index, radius_m, self.pieces)
        place = describe(surroundings, level_frame(anchor, self.map_config))
        apart_m = max((PAST + FUTURE) * radius_m, self.config.min_travel_m)  # no scan belongs to both
        candidates = self.recognition.candidates(
            place,
            self._expected(anchor, keyframes, T_world),
            before_m=anchor.traveled_m - apart_m,
            radius_m=radius_m,
            keyframes=keyframes,
            T_world=T_world,
        )
        for candidate in candidates:
            is_known = bool(joined[candidate.target] == joined[anchor.index])
            if not is_known and candidate.proposed_by is Proposal.POSITION:
                continue
            target = local_map(keyframes, candidate.target, radius_m, self.pieces)
            measured = self.verifier.measure(surroundings, target, candidate.likeness.T_target_source)
            closure = self._judge(candidate, surroundings, target, measured, T_world if is_known else None)
            yield closure
            if closure.verdict is Verdict.ACCEPTED:
                self.last = closure
                return

    def _expected(self, anchor: Keyframe, keyframes: Sequence[Keyframe], T_world: Matrix) -> Pose:
        """T_world_lidar by odometry since the last closure; that one may not have moved the map yet."""
        if self.last is None:
            return T_world[anchor.index]
        T_last_anchor = lie.between(keyframes[self.last.source].T_odom_lidar, anchor.T_odom_lidar)
        return T_world[self.last.target] @ self.last.match.T_target_source @ T_last_anchor

    def _radius_m(self, anchor: Keyframe) -> float:
        return self.config.place_radius_m * anchor.scale

    def _judge(
        self,
        candidate: Candidate,
        source: LocalMap,
        target: LocalMap,
        measured: Measurement,
        T_world: Matrix | None,
    ) -> Closure:
        """A closure and its verdict; without poses of the world the way between the two says nothing."""
        i, j = target.anchor.index, source.anchor.index
        moved_m = 0.0
        if T_world is not None:
            moved = lie.inverse(T_world[j]) @ T_world[i] @ measured.match.T_target_source
            moved_m = float(np.linalg.norm(moved[:3, 3]))
        traveled_m = source.anchor.traveled_m - target.anchor.traveled_m
        problem = self._problem(candidate, measured, moved_m, traveled_m)
        return Closure(
            target=i,
            source=j,
            match=measured.match,
            overlap=measured.overlap,
            verdict=Verdict.REJECTED if problem else Verdict.ACCEPTED,
            reason=problem or "verified by matching",
            proposed_by=candidate.proposed_by,
        )

    def _problem(self, candidate: Candidate, measured: Measurement, moved_m: float, traveled_m: float) -> str:
        """Why a measurement is no closure, empty if it is one."""
        limits, match = self.config, measured.match
        plausible_m = max(limits.place_drift * traveled_m, limits.min_radius_m)
        if not match.is_fit:
            return match.reason
        if measured.overlap < limits.min_place_overlap:
            return f"overlap {measured.overlap:.2f} < loops.min_place_overlap ({limits.min_place_overlap:g})"
        if match.degeneracy_eigenvalue < limits.min_place_information:
            return (
                f"information {match.degeneracy_eigenvalue:.1e} < "
                f"loops.min_place_information ({limits.min_place_information:g})"
            )
        if measured.agreement < limits.min_agreement:
            return f"agreement {measured.agreement:.2f} < loops.min_agreement ({limits.min_agreement:g})"
        if candidate.rival >= 0:
            return f"keyframe {candidate.rival} looks as much alike"
        if moved_m > plausible_m:
            return f"{moved_m:.1f} m from the prediction > loops.place_drift ({limits.place_drift:g}) of the way"
        return ""
