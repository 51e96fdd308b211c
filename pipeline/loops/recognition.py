"""Which older place the present one may be: by its looks alone, or by its looks near where odometry has it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline import lie
from pipeline.config import LoopsConfig
from pipeline.data import Keyframe, Matrix, Pose, Proposal
from pipeline.loops.gallery import Gallery
from pipeline.loops.place import Likeness, Place, compare

_CANDIDATES = 10  # compared in full, of the places whose keys are alike
_RIVAL = 0.9  # of the best likeness, from which on another place is as good
_APART = 0.25  # radii between two answers that are not the same


@dataclass(frozen=True, slots=True)
class Candidate:
    """An older place and how the present one lies in it; ``rival`` is another that looks as much alike, or −1."""

    target: int
    likeness: Likeness
    proposed_by: Proposal
    rival: int = -1


class Recognition:
    """Remembers places and finds those that a new one resembles, by scale of the voxels they were seen with."""

    def __init__(self, config: LoopsConfig) -> None:
        self.config = config
        self.galleries: dict[float, Gallery] = {}

    def candidates(
        self, place: Place, radius_m: float, keyframes: Sequence[Keyframe], T_world: Matrix, before_m: float
    ) -> list[Candidate]:
        """At most two older places, passed before so many metres; the most likely first. The new one is kept.

        T_world : (K, 4, 4) best known poses of the keyframes
        """
        anchor = keyframes[place.anchor]
        gallery = self.galleries.setdefault(anchor.scale, Gallery())
        alike = gallery.alike(place, _CANDIDATES, before_m)
        gallery.add(place, anchor.travelled_m)
        if not alike:
            return []
        found = [self._by_looks(place, alike, radius_m, keyframes, T_world)]
        near = gallery.places[int(np.argmin(_distances_m(gallery, place, T_world)))]
        found.append(Candidate(near.anchor, compare(place, near), Proposal.POSITION))
        return [each for each in found if self._is_likely(each, place.anchor, keyframes, T_world)]

    def _by_looks(
        self, place: Place, alike: Sequence[Place], radius_m: float, keyframes: Sequence[Keyframe], T_world: Matrix
    ) -> Candidate:
        """The most similar of several places, and whether another one contradicts it.

        Two that are the same place, but for what the map may have drifted between them, do not contradict.
        """
        ranked = sorted(((compare(place, other), other.anchor) for other in alike), key=lambda each: -each[0].score)
        best, target = ranked[0]
        here = _position(T_world, target, best)
        for likeness, other in ranked[1:]:
            if likeness.score < _RIVAL * best.score:
                break
            between_m = abs(keyframes[other].travelled_m - keyframes[target].travelled_m)
            apart_m = float(np.linalg.norm(_position(T_world, other, likeness) - here))
            if apart_m > max(_APART * radius_m, self.config.drift * between_m):
                return Candidate(target, best, Proposal.PLACE, rival=other)
        return Candidate(target, best, Proposal.PLACE)

    def _is_likely(self, candidate: Candidate, source: int, keyframes: Sequence[Keyframe], T_world: Matrix) -> bool:
        """Whether a candidate is worth a closer look."""
        if candidate.proposed_by is Proposal.PLACE:
            return candidate.likeness.score >= self.config.min_likeness
        moved_m = np.linalg.norm(_position(T_world, candidate.target, candidate.likeness) - T_world[source, :3, 3])
        travelled_m = keyframes[source].travelled_m - keyframes[candidate.target].travelled_m
        limits = self.config
        return bool(moved_m <= np.clip(limits.drift * travelled_m, limits.min_radius_m, limits.max_radius_m))


def _distances_m(gallery: Gallery, place: Place, T_world: Matrix) -> Matrix:
    anchors = [other.anchor for other in gallery.places]
    return np.linalg.norm(T_world[anchors, :3, 3] - T_world[place.anchor, :3, 3], axis=1)


def _position(T_world: Matrix, target: int, likeness: Likeness) -> Matrix:
    """Where the source would be in the world, (3,)."""
    return (T_world[target] @ likeness.T_target_source)[:3, 3]
