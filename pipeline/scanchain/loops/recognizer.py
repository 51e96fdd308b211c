"""The interface of place recognition: query and candidate, the protocol of recognizers, and the built-in ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from scanchain import plugins
from scanchain.config import Config
from scanchain.data import Keyframe, Matrix, Pose, Proposal
from scanchain.errors import InputError
from scanchain.loops.submaps import Submap

RECOGNIZERS = {
    "descriptor": "scanchain.loops.descriptor_recognizer:DescriptorRecognizer",
}


@dataclass(frozen=True, slots=True)
class Query:
    """The keyframe to recognize, with its submap and its expected pose.

    Attributes
    ----------
    submap : around the keyframe, its ``anchor``; the one that was added last
    max_traveled_m : candidates have at most this ``traveled_m``, so that no scan belongs to both submaps
    T_world_anchor : (d+1, d+1) expected pose of the anchor
    keyframes : all so far, by index
    T_world : (K, d+1, d+1) their best known poses
    """

    submap: Submap
    max_traveled_m: float
    T_world_anchor: Pose
    keyframes: Sequence[Keyframe]
    T_world: Matrix


@dataclass(frozen=True, slots=True)
class Candidate:
    """An older keyframe whose surroundings the queried one may revisit.

    Attributes
    ----------
    target : index of the older keyframe
    T_target_source : (d+1, d+1) initial pose of the queried keyframe in the target's frame, which verification
        refines; it converges from a few voxels and about 20° off
    score : similarity, comparable between candidates of one recognizer; the larger the better
    proposed_by : appearance alone (``PLACE``) or together with the expected pose (``POSITION``); the latter is not
        tried where the target lies in another segment than the queried keyframe
    rival : another keyframe as similar elsewhere, which makes the candidate ambiguous, or −1
    """

    target: int
    T_target_source: Pose
    score: float
    proposed_by: Proposal = Proposal.PLACE
    rival: int = -1


class Recognizer(Protocol):
    """Database of submaps that proposes which of them a new one revisits.

    A checkpoint does not hold it: a resumed run makes a new one from its name and adds the same submaps again, in
    the same order. It goes on to the same result if ``query`` changes nothing that a later result depends on.
    """

    def __init__(self, config: Config, dimension: int) -> None:
        """``dimension`` is 2 or 3."""
        ...

    def add(self, submap: Submap) -> None:
        """Store a submap by its anchor; called once each, in the order of the log."""
        ...

    def query(self, query: Query) -> Sequence[Candidate]:
        """Candidates for the submap added last, verified in this order until one is accepted."""
        ...


def create_recognizer(config: Config, dimension: int) -> Recognizer | None:
    """The recognizer that ``loops.recognizer`` names; None where place recognition is off.

    Raises InputError for a name that is neither in the registry nor a class that can be loaded.
    """
    name = config.loops.recognizer
    if name == "auto":
        name = "descriptor" if dimension == 3 else "none"
    if name == "none" or not config.loops.enabled:
        return None
    if name not in RECOGNIZERS and ":" not in name:
        known = ", ".join(("auto", "none", *RECOGNIZERS))
        raise InputError(f"loops.recognizer is {name!r}; it must be one of {known}, or module:Class for your own")
    return plugins.load(RECOGNIZERS.get(name, name), "add", "query")(config, dimension)
