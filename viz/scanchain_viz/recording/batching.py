"""Batches of steps, logged with one call per column instead of one per scan, and the growing keyframe graph."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from time import perf_counter

import numpy as np
import rerun as rr

from scanchain import lie
from scanchain.config import RecordingConfig
from scanchain.data import DOWNWEIGHTED, Closure, ClosureVerdict, GraphState, Matrix, State, Step
from scanchain.runs.closures import final_verdicts
from scanchain.steps import STAGES, Steps
from scanchain_viz.recording import drawing, entities
from scanchain_viz.recording.drawing import Floats, Message, Times

WARNING, _INFORMATION = "WARN", "INFO"  # rerun's log levels


class KeyframeGraph:
    """Keyframe graph of the steps so far: reports new verdicts on closures, is drawn when it has grown enough."""

    def __init__(self) -> None:
        self.positions: list[Floats] = []
        self.tried: list[Closure] = []  # with the verdicts of the matcher alone
        self.closures: list[Closure] = []
        self.graph: GraphState | None = None
        self.counts = (0, 0)  # of closures accepted and rejected
        self.drawn = 0  # number of keyframes when it was last drawn

    def add(self, step: Step) -> list[str]:
        """Add a step; returns new verdicts on closures: the matcher's on its own, then the back end's on all."""
        if step.keyframe >= 0:
            self.positions.append(drawing.positions(step.T_world_lidar[None])[0])
        news: list[str] = []
        if step.closures:
            self.tried += step.closures
            news += self._update([*self.closures, *(replace(each, weight=1.0) for each in step.closures)])
        if step.graph is not None:
            self.graph = step.graph
            news += self._update(final_verdicts(self.tried, step.graph))
        return news

    def settle(self, closures: Sequence[Closure], graph: GraphState) -> list[str]:
        """Set the final graph and all closures tried; returns the verdicts that changed."""
        self.graph, self.drawn = graph, 0
        return self._update(closures)

    def restore(self, positions: Floats, closures: Sequence[Closure], graph: GraphState) -> None:
        """Restore the state after keyframes at these positions from the closures and the graph at that time."""
        self.graph, self.tried = graph, list(closures)
        self._update(final_verdicts(closures, graph))
        for position in positions:
            self.positions.append(position)
            self.drawn = len(self.positions) if self.has_grown else self.drawn

    @property
    def has_grown(self) -> bool:
        """True if it is time to draw it."""
        return len(self.positions) > 1.05 * self.drawn  # so that the size stays linear in the log's length

    def draw(self, times: Times) -> list[Message]:
        """Messages that draw the current graph; none if it is already drawn."""
        if self.drawn == len(self.positions):
            return []
        self.drawn = len(self.positions)
        nodes = np.array(self.positions)
        if self.graph is not None:
            nodes[: len(self.graph.poses)] = drawing.positions(self.graph.poses)

        def edges(closures: list[Closure]) -> Floats:
            pairs = [(item.target, item.source) for item in closures]
            return nodes[np.array(pairs, np.int64).reshape(-1, 2)]

        accepted = self._of(ClosureVerdict.ACCEPTED)
        colors = [
            entities.Color.PALE_GREEN if item.weight < DOWNWEIGHTED else entities.Color.GREEN for item in accepted
        ]
        return [
            Message(entities.KEYFRAMES, drawing.dots(nodes), times),
            Message(entities.ODOMETRY_EDGES, drawing.lines([nodes]), times),
            Message(entities.ACCEPTED, drawing.lines(edges(accepted), colors or None), times),
            Message(entities.REJECTED, drawing.lines(edges(self._of(ClosureVerdict.REJECTED))), times),
        ]

    def _of(self, verdict: ClosureVerdict) -> list[Closure]:
        return [item for item in self.closures if item.verdict is verdict]

    def _update(self, closures: Sequence[Closure]) -> list[str]:
        """Store the verdicts; returns a line for each new one, numbered by the closure's row in loops.parquet."""
        before = [item.verdict for item in self.closures]
        self.closures = list(closures)
        self.counts = len(self._of(ClosureVerdict.ACCEPTED)), len(self._of(ClosureVerdict.REJECTED))
        return [
            f"closure {number} ({item.target} to {item.source}) {item.verdict}: {item.reason}"
            for number, item in enumerate(closures)
            if number >= len(before) or item.verdict is not before[number]
        ]


class Batcher:
    """Collects steps, and turns each batch of them into messages."""

    def __init__(self, config: RecordingConfig) -> None:
        self.config = config
        self.graph = KeyframeGraph()
        self.gathered: list[tuple[Step, list[str], tuple[int, int]]] = []  # with the news and counts of closures
        self.bytes = 0
        self.points = 0
        self.box: Floats | None = None
        self.started_s = perf_counter()
        self.now = Times.at(0, 0)  # of the last step
        self.last: Matrix | None = None  # (1, d+1, d+1) T_odom_lidar of the previous scan
        self.state: State | None = None

    def restore(self, steps: Steps, closures: Sequence[Closure], graph: GraphState) -> None:
        """Restore the state after these steps from the closures and the graph at that time."""
        odom, world = steps.columns["T_odom_lidar"], steps.columns["T_world_lidar"]
        positions = drawing.positions(world)
        self.graph.restore(positions[steps.columns["keyframe"] >= 0], closures, graph)
        self.points = int(steps.columns["points"].sum())
        self._frame(positions)
        self.now = Times(steps.columns["index"][-1:], steps.columns["stamp_ns"][-1:])
        self.last = odom[-1:]
        self.state = State(steps.texts("state")[-1])

    def add(self, step: Step) -> list[Message]:
        """Add a step with the verdicts at that time; returns the messages that are due."""
        self.now = Times.at(step.scan.index, step.scan.stamp_ns)
        news = self.graph.add(step)
        if not self.gathered:
            self.started_s = perf_counter()
        self.gathered.append((step, news, self.graph.counts))
        self.bytes += 12 * len(step.points)
        self.points += len(step.points)
        messages = self.graph.draw(self.now) if self.graph.has_grown else []
        if step.keyframe >= 0 and step.keyframe % self.config.local_map_every == 0 and len(step.local_map):
            points = drawing.at_most(step.local_map, self.config.max_map_points)
            messages.append(Message(entities.LOCAL_MAP, drawing.dots(points), self.now))
        is_large = len(self.gathered) >= 256 or self.bytes >= 4_000_000
        is_due = is_large or perf_counter() - self.started_s >= 0.25  # so that a viewer follows
        return [*messages, *self.messages()] if is_due else messages

    def messages(self) -> list[Message]:
        """Messages of the gathered steps, scan by scan; the batch is empty afterwards."""
        if not self.gathered:
            return []
        steps, news, counts = zip(*self.gathered, strict=True)
        self.gathered, self.bytes = [], 0
        times = Times(
            np.array([step.scan.index for step in steps], np.int64),
            np.array([step.scan.stamp_ns for step in steps], np.int64),
        )
        odom = np.array([step.T_odom_lidar for step in steps])
        world = np.array([step.T_world_lidar for step in steps])
        self._frame(drawing.positions(world))
        points = drawing.in_space(np.concatenate([step.points for step in steps]))
        scans = rr.Points3D.columns(positions=points).partition([len(step.points) for step in steps])
        return [
            Message(entities.LIDAR, drawing.transforms(world), times),
            Message(entities.SCAN, scans, times),
            *self._trails(times, odom, world),
            *_plots(steps, times),
            *self._states(steps, news, times),
            _counts(counts, times),
        ]

    def settled(self, closures: Sequence[Closure], graph: GraphState) -> list[Message]:
        """Messages of the remaining steps, and of the final verdicts at the last step."""
        messages, news = self.messages(), self.graph.settle(closures, graph)
        reported = events([[(_INFORMATION, text) for text in news]], self.now)
        return [*messages, *reported, _counts([self.graph.counts], self.now), *self.graph.draw(self.now)]

    def _frame(self, positions: Floats) -> None:
        """Widen the bounding box (2, 3) of the trajectory."""
        known = positions if self.box is None else np.concatenate([self.box, positions])
        self.box = np.stack([known.min(axis=0), known.max(axis=0)])

    def _trails(self, times: Times, odom: Matrix, world: Matrix) -> Iterator[Message]:
        """Each scan's segment of the trajectory, before and after correction, and the correction.

        A segment of the corrected trajectory starts at the previous scan's pose under the same correction,
        so that a closure does not draw a jump.
        """
        before = np.concatenate([odom[:1] if self.last is None else self.last, odom[:-1]])
        self.last, corrections = odom[-1:], world @ lie.inverse(odom)
        yield Message(entities.ODOM, drawing.transforms(corrections), times)
        for entity, *ends in (
            (entities.ODOMETRY, before, odom),
            (entities.TRAJECTORY, corrections @ before, world),
        ):
            strips = np.stack([drawing.positions(poses) for poses in ends], axis=1)
            yield Message(entity, rr.LineStrips3D.columns(strips=strips), times)

    def _states(self, steps: Sequence[Step], news: Sequence[list[str]], times: Times) -> Iterator[Message]:
        """The state where it changes, with the reason as an event, and new verdicts on loop closures as events."""
        before = [self.state, *(step.state for step in steps[:-1])]
        changed = np.array([step.state is not state for step, state in zip(steps, before, strict=True)])
        self.state = steps[-1].state
        reported: list[list[tuple[str, str]]] = []
        for step, is_new, texts in zip(steps, changed, news, strict=True):
            why = [(WARNING, f"{step.state}: {step.reason}")] if is_new and step.state is not State.OK else []
            reported.append([*why, *((_INFORMATION, text) for text in texts)])
        yield from events(reported, times)
        if changed.any():
            states = [str(step.state) for step, new in zip(steps, changed, strict=True) if new]
            yield Message(entities.STATE, rr.StateChange.columns(state=states), times[changed])


def events(events: Sequence[Sequence[tuple[str, str]]], times: Times) -> Iterator[Message]:
    """The events of each row of ``times``, level and text."""
    flat = [(row, *event) for row, of_row in enumerate(events) for event in of_row]
    if flat:
        rows, levels, texts = map(list, zip(*flat, strict=True))
        yield Message(entities.EVENTS, rr.TextLog.columns(text=texts, level=levels), times[np.array(rows)])


def _counts(counts: Sequence[tuple[int, int]], times: Times) -> Message:
    """Numbers of accepted and rejected closures after each scan."""
    columns = rr.Scalars.columns(scalars=np.array(counts, np.float64).reshape(-1))
    return Message(entities.LOOPS, columns.partition([2] * len(counts)), times)


def _plots(steps: Sequence[Step], times: Times) -> Iterator[Message]:
    """Values of the registrations, with gaps where one is infinite, their covariances, and times of the stages."""
    matches = [step.match for step in steps]
    figures = {
        entities.INLIERS: [match.inliers for match in matches],
        entities.INLIER_SHARE: [match.inlier_share for match in matches],
        entities.RESIDUAL: [match.residual_m for match in matches],
        entities.OBSERVABILITY: [math.log10(max(match.observability, 1e-3)) for match in matches],
        entities.ITERATIONS: [match.iterations for match in matches],
    }
    for entity, values in figures.items():
        known = np.where(np.isfinite(values), values, np.nan)
        yield Message(entity, rr.Scalars.columns(scalars=known), times)
    informations = np.array([match.information for match in matches])
    yield Message(entities.COVARIANCE, drawing.ellipsoids(informations, entities.COVARIANCE_SCALE), times)
    timings = [[getattr(step.timing, f"{stage}_s") for stage in STAGES] for step in steps]
    stages = rr.Scalars.columns(scalars=1e3 * np.array(timings).reshape(-1))
    yield Message(entities.TIME, stages.partition([len(STAGES)] * len(steps)), times)
