"""Steps gathered into batches, one call a column instead of one a scan, and the keyframe graph as it grows."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from time import perf_counter

import msgspec
import numpy as np
import rerun as rr

from scanchain import lie
from scanchain.data import Closure, ClosureVerdict, GraphState, Match, Matrix, State, Step
from scanchain.runs.closures import final_verdicts
from scanchain.runs.step_table import StepTable
from scanchain_viz.recording import drawing, entities
from scanchain_viz.recording.drawing import Floats, Message, Times

_MAX_SCANS = 256
_MAX_BYTES = 4_000_000
_MAX_WAIT_S = 0.25
_LEAST_DRAWN = 1e-3  # least observability that is drawn
WARNING, _INFORMATION = "WARN", "INFO"  # rerun's words
_GROWTH = 1.05  # factor of growth between two drawings: the recording stays linear in the length of the log
_DOWNWEIGHTED = 0.5  # robust weight below which an accepted closure is drawn amber


class Verdicts(msgspec.Struct, frozen=True):
    """Events of a step, one per closure with a new verdict, and the numbers accepted and rejected since."""

    events: Sequence[str]
    accepted: int
    rejected: int


class KeyframeGraph:
    """Takes in every step; returns the verdicts on closures, and draws the graph when it has grown enough."""

    def __init__(self) -> None:
        self.positions: list[Floats] = []
        self.tried: list[Closure] = []  # with the verdicts of the matcher alone
        self.closures: list[Closure] = []
        self.graph: GraphState | None = None
        self.counts = (0, 0)
        self.drawn = 0
        self.is_current = True

    def add(self, step: Step) -> Verdicts:
        """Take in a step; the verdicts on its closures are those of the matcher, then of the back end for all."""
        if step.keyframe >= 0:
            self.positions.append(drawing.positions(step.T_world_lidar[None])[0])
            self.is_current = False
        events: list[str] = []
        if step.closures:
            self.tried += step.closures
            events += self._update([*self.closures, *(replace(each, weight=1.0) for each in step.closures)])
        if step.graph is not None:
            self.graph = step.graph
            events += self._update(final_verdicts(self.tried, step.graph))
        return Verdicts(events, *self.counts)

    def settle(self, closures: Sequence[Closure], graph: GraphState) -> Verdicts:
        """Take in the final graph with every closure tried."""
        self.graph = graph
        self.is_current = False
        return Verdicts(self._update(closures), *self.counts)

    def restore(self, steps: StepTable, closures: Sequence[Closure], graph: GraphState) -> Verdicts:
        """Restore the state after these steps from the closures and the graph at that time."""
        self.graph, self.tried = graph, list(closures)
        self._update(final_verdicts(closures, graph))
        for position in drawing.positions(steps.columns["T_world_lidar"][steps.columns["keyframe"] >= 0]):
            self.positions.append(position)
            self.drawn = len(self.positions) if self.has_grown else self.drawn
        self.is_current = self.drawn == len(self.positions)
        return Verdicts((), *self.counts)

    @property
    def has_grown(self) -> bool:
        """True if it is time to draw it."""
        return len(self.positions) > _GROWTH * self.drawn

    def draw(self, times: Times) -> list[Message]:
        """Messages of the present graph, unless it is drawn already."""
        if self.is_current or not self.positions:
            return []
        self.drawn, self.is_current = len(self.positions), True
        nodes = np.array(self.positions)
        if self.graph is not None:
            nodes[: len(self.graph.poses)] = drawing.positions(self.graph.poses)
        accepted = [item for item in self.closures if item.verdict is ClosureVerdict.ACCEPTED]
        rejected = [item for item in self.closures if item.verdict is ClosureVerdict.REJECTED]
        colors = [entities.ORANGE if item.weight < _DOWNWEIGHTED else entities.GREEN for item in accepted]
        return [
            Message(entities.KEYFRAMES, drawing.dots(nodes), times),
            Message(entities.ODOMETRY_EDGES, drawing.lines([nodes]), times),
            Message(entities.ACCEPTED, drawing.lines(_edges(nodes, accepted), colors or None), times),
            Message(entities.REJECTED, drawing.lines(_edges(nodes, rejected)), times),
        ]

    def _update(self, closures: Sequence[Closure]) -> list[str]:
        """Store the verdicts; a line for each new one, the number being the closure's row in loops.parquet."""
        before = [item.verdict for item in self.closures]
        self.closures = list(closures)
        counts = Counter(item.verdict for item in closures)
        self.counts = (counts[ClosureVerdict.ACCEPTED], counts[ClosureVerdict.REJECTED])
        return [
            f"closure {number} ({item.target} to {item.source}) {item.verdict}: {item.reason}"
            for number, item in enumerate(closures)
            if number >= len(before) or item.verdict is not before[number]
        ]


def _edges(nodes: Floats, closures: list[Closure]) -> Floats:
    """Line strips (E, 2, 3) between the keyframes of closures."""
    pairs = np.array([(item.target, item.source) for item in closures], np.int64).reshape(-1, 2)
    return nodes[pairs]


class Batcher:
    """Holds the steps since the last batch; every batch turns them into messages."""

    def __init__(self, dimension: int) -> None:
        self.graph = KeyframeGraph()
        self.steps: list[Step] = []
        self.verdicts: list[Verdicts] = []  # of each step
        self.bytes = 0
        self.scans = 0
        self.points = 0
        self.box: Floats | None = None
        self.started_s = perf_counter()
        self.T_odom_before: Matrix | None = None
        self.T_world_odom: Matrix = lie.identity(dimension)
        self.has_odom = False
        self.state: State | None = None
        self.closures: tuple[int, int] | None = None

    def restore(self, steps: StepTable, closures: Sequence[Closure], graph: GraphState) -> None:
        """Restore the state after these steps from the closures and the graph at that time."""
        verdicts = self.graph.restore(steps, closures, graph)
        odom, world = steps.columns["T_odom_lidar"], steps.columns["T_world_lidar"]
        self.scans, self.points = len(steps), int(steps.columns["points"].sum())
        self._frame(drawing.positions(world))
        self.T_odom_before = odom[-1]
        self.has_odom, self.T_world_odom = True, world[-1] @ lie.inverse(odom[-1])
        self.state, self.closures = steps.last_state, (verdicts.accepted, verdicts.rejected)

    def add(self, step: Step) -> None:
        """Take in one step, and the verdicts of that moment."""
        verdicts = self.graph.add(step)
        if not self.steps:
            self.started_s = perf_counter()
        self.steps.append(step)
        self.verdicts.append(verdicts)
        self.bytes += 12 * len(step.points)
        self.points += len(step.points)
        self.scans += 1

    @property
    def is_due(self) -> bool:
        """True if the batch is large or old enough."""
        return (
            len(self.steps) >= _MAX_SCANS
            or self.bytes >= _MAX_BYTES
            or perf_counter() - self.started_s >= _MAX_WAIT_S
        )

    def messages(self) -> list[Message]:
        """Messages of the gathered steps, scan by scan; the batch is empty afterwards."""
        steps, self.steps, self.bytes = self.steps, [], 0
        verdicts, self.verdicts = self.verdicts, []
        if not steps:
            return []
        times = Times(
            np.array([step.scan.index for step in steps], np.int64),
            np.array([step.scan.stamp_ns for step in steps], np.int64),
        )
        odom = np.array([step.T_odom_lidar for step in steps])
        world = np.array([step.T_world_lidar for step in steps])
        self._frame(drawing.positions(world))
        return [
            Message(entities.LIDAR, drawing.transforms(world), times),
            Message(entities.SCAN, _scans(steps), times),
            *self._trails(times, odom, world),
            *_matches([step.match for step in steps], times),
            Message(entities.TIME, _times_by_stage(steps), times),
            *self._states(steps, verdicts, times),
        ]

    def settled(self, closures: Sequence[Closure], graph: GraphState, times: Times) -> list[Message]:
        """All that is left, and the final verdicts at ``times``, of the last step; their numbers in any case."""
        messages, verdicts, self.closures = self.messages(), self.graph.settle(closures, graph), None
        told = events([[(_INFORMATION, text) for text in verdicts.events]], times)
        return [*messages, *told, *self._counts([verdicts], times), *self.graph.draw(times)]

    def _frame(self, positions: Floats) -> None:
        """Widen the box around everything that was passed, (2, 3)."""
        known = positions if self.box is None else np.concatenate([self.box, positions])
        self.box = np.stack([known.min(axis=0), known.max(axis=0)])

    def _trails(self, times: Times, odom: Matrix, world: Matrix) -> list[Message]:
        """Each scan's segment of the trajectory, before and after correction, and the correction where it changed.

        A segment of the corrected trajectory starts where the scan before stands under the same correction, so
        that a closure does not draw a jump.
        """
        first = odom[:1] if self.T_odom_before is None else self.T_odom_before[None]
        before = np.concatenate([first, odom[:-1]])
        self.T_odom_before = odom[-1]
        corrections = world @ lie.inverse(odom)
        steps = np.abs(np.diff(np.concatenate([self.T_world_odom[None], corrections]), axis=0)).max(axis=(1, 2))
        changed = steps > 1e-6
        changed[0] |= not self.has_odom
        self.has_odom, self.T_world_odom = True, corrections[-1]
        odometry = drawing.segments(drawing.positions(before), drawing.positions(odom))
        trajectory = drawing.segments(drawing.positions(corrections @ before), drawing.positions(world))
        messages = [
            Message(entities.ODOMETRY, rr.LineStrips3D.columns(strips=odometry), times),
            Message(entities.TRAJECTORY, rr.LineStrips3D.columns(strips=trajectory), times),
        ]
        if changed.any():
            messages.append(Message(entities.ODOM, drawing.transforms(corrections[changed]), times[changed]))
        return messages

    def _states(self, steps: list[Step], verdicts: list[Verdicts], times: Times) -> list[Message]:
        """The state where it changes, with the reason as an event, and the verdicts on loop closures."""
        before = [self.state, *(step.state for step in steps[:-1])]
        changed = np.array([step.state is not state for step, state in zip(steps, before, strict=True)])
        self.state = steps[-1].state
        told: list[list[tuple[str, str]]] = []
        for step, is_new, verdict in zip(steps, changed, verdicts, strict=True):
            why = [(WARNING, f"{step.state}: {step.reason}")] if is_new and step.state is not State.OK else []
            told.append([*why, *((_INFORMATION, text) for text in verdict.events)])
        messages = [*events(told, times), *self._counts(verdicts, times)]
        if changed.any():
            states = [str(step.state) for step, new in zip(steps, changed, strict=True) if new]
            messages.append(Message(entities.STATE, rr.StateChange.columns(state=states), times[changed]))
        return messages

    def _counts(self, verdicts: list[Verdicts], times: Times) -> list[Message]:
        """Numbers of accepted and rejected closures, where they change."""
        counts = [(verdict.accepted, verdict.rejected) for verdict in verdicts]
        before = [self.closures, *counts[:-1]]
        changed = np.array([now != then for now, then in zip(counts, before, strict=True)])
        self.closures = counts[-1]
        if not changed.any():
            return []
        columns = rr.Scalars.columns(scalars=np.array(counts, np.float64)[changed].reshape(-1))
        return [Message(entities.LOOPS, columns.partition([2] * int(changed.sum())), times[changed])]


def events(events: Sequence[Sequence[tuple[str, str]]], times: Times) -> list[Message]:
    """The events of each row of ``times``, level and text."""
    rows = [row for row, of_row in enumerate(events) for _ in of_row]
    if not rows:
        return []
    levels, texts = zip(*(event for of_row in events for event in of_row), strict=True)
    columns = rr.TextLog.columns(text=list(texts), level=list(levels))
    return [Message(entities.EVENTS, columns, times[np.array(rows)])]


def _scans(steps: list[Step]) -> rr.ComponentColumnList:
    points = drawing.in_space(np.concatenate([step.points for step in steps]))
    return rr.Points3D.columns(positions=points).partition([len(step.points) for step in steps])


def _matches(matches: list[Match], times: Times) -> list[Message]:
    """Plots and covariance of the registrations; what is infinite is a gap."""
    numbers = np.array(
        [
            (
                match.inliers,
                match.inlier_share,
                match.residual_m,
                math.log10(max(match.observability, _LEAST_DRAWN)),
                match.iterations,
            )
            for match in matches
        ],
        np.float64,
    )
    numbers[~np.isfinite(numbers)] = np.nan
    series = (
        entities.INLIERS, entities.INLIER_SHARE, entities.RESIDUAL, entities.OBSERVABILITY, entities.ITERATIONS,
    )  # fmt: skip
    informations = np.array([match.information for match in matches])
    return [
        *(
            Message(entity, rr.Scalars.columns(scalars=np.ascontiguousarray(column)), times)
            for entity, column in zip(series, numbers.T, strict=True)
        ),
        Message(entities.COVARIANCE, drawing.ellipsoids(informations, entities.COVARIANCE_SCALE), times),
    ]


def _times_by_stage(steps: list[Step]) -> rr.ComponentColumnList:
    """Milliseconds of every stage, one series each, in the order of ``entities.STAGES``."""
    seconds = [(t.read_s, t.preprocess_s, t.match_s, t.map_s, t.loops_s) for t in (step.timing for step in steps)]
    milliseconds = 1e3 * np.array(seconds).reshape(-1)
    return rr.Scalars.columns(scalars=milliseconds).partition([len(entities.STAGES)] * len(steps))
