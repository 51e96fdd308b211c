"""Which older place the present one may be: by its looks alone, or by its looks near where odometry has it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scanchain import lie
from scanchain.config import LoopsConfig
from scanchain.data import Keyframe, Matrix, Pose, Proposal
from scanchain.loops.gallery import Gallery
from scanchain.loops.place import Likeness, Place, compare

_CANDIDATES = 10  # compared in full, of the places whose keys are alike
_NEAREST = 3  # compared in full, of those near to where odometry has the place
_HEADING_RAD = 0.5  # how far odometry's heading may be off
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
        self,
        place: Place,
        T_world_place: Pose,
        *,
        before_m: float,
        radius_m: float,
        keyframes: Sequence[Keyframe],
        T_world: Matrix,
    ) -> list[Candidate]:
        """At most two older places: the most alike, and the nearest to where the new one should be; it is kept.

        T_world_place : where the new one should be; T_world : (K, 4, 4) best known poses of the keyframes
        before_m : way until which places count as old
        """
        anchor = keyframes[place.anchor]
        gallery = self.galleries.setdefault(anchor.scale, Gallery())
        alike = gallery.alike(place, _CANDIDATES, before_m)
        gallery.add(place, anchor.traveled_m)
        if not alike:
            return []
        best = self._most_alike(place, alike, radius_m, keyframes, T_world)
        found = [best] if best.likeness.score >= self.config.min_likeness else []
        near = gallery.nearest(T_world, T_world_place[:3, 3], _NEAREST)
        return found + self._most_alike_here(place, near, T_world_place, keyframes, T_world)

    def _most_alike(
        self, place: Place, alike: Sequence[Place], radius_m: float, keyframes: Sequence[Keyframe], T_world: Matrix
    ) -> Candidate:
        """The most similar of several places, and whether another one contradicts it.

        Two that are the same place, but for what the map may have drifted between them, do not contradict.
        """
        ranked = sorted(
            ((compare(place, other), other.anchor) for other in alike), key=lambda each: -each[0].score
        )
        best, target = ranked[0]
        here = _position(T_world, target, best)
        for likeness, other in ranked[1:]:
            if likeness.score < _RIVAL * best.score:
                break
            between_m = abs(keyframes[other].traveled_m - keyframes[target].traveled_m)
            apart_m = float(np.linalg.norm(_position(T_world, other, likeness) - here))
            if apart_m > max(_APART * radius_m, self.config.drift * between_m):
                return Candidate(target, best, Proposal.PLACE, rival=other)
        return Candidate(target, best, Proposal.PLACE)

    def _most_alike_here(
        self,
        place: Place,
        near: Sequence[Place],
        T_world_place: Pose,
        keyframes: Sequence[Keyframe],
        T_world: Matrix,
    ) -> list[Candidate]:
        """The most similar of the nearest places that leave the new one about where it should be, if any does."""
        found: list[Candidate] = []
        for other in near:
            T_expected = (
                lie.inverse(T_world[other.anchor] @ other.T_anchor_level) @ T_world_place @ place.T_anchor_level
            )
            likeness = compare(place, other, expected_rad=_yaw(T_expected), within_rad=_HEADING_RAD)
            moved_m = np.linalg.norm(_position(T_world, other.anchor, likeness) - T_world_place[:3, 3])
            traveled_m = keyframes[place.anchor].traveled_m - keyframes[other.anchor].traveled_m
            if moved_m <= search_radius_m(self.config, traveled_m):
                found.append(Candidate(other.anchor, likeness, Proposal.POSITION))
        return sorted(found, key=lambda each: -each.likeness.score)[:1]


def search_radius_m(config: LoopsConfig, traveled_m: float) -> float:
    """How far from where odometry says a place is looked for, so many meters of the way later."""
    return float(np.clip(config.drift * traveled_m, config.min_radius_m, config.max_radius_m))


def _position(T_world: Matrix, target: int, likeness: Likeness) -> Matrix:
    """Where the source would be in the world, (3,)."""
    return (T_world[target] @ likeness.T_target_source)[:3, 3]


def _yaw(T: Pose) -> float:
    return float(np.arctan2(T[1, 0], T[0, 0]))
