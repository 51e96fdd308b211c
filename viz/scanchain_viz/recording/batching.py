"""Steps gathered into batches: one call a column instead of one a scan, which is what makes recording cheap."""

from __future__ import annotations

import math
from collections.abc import Sequence
from time import perf_counter

import numpy as np
import rerun as rr

from scanchain import lie
from scanchain.data import Match, Matrix, State, Step
from scanchain.runs.step_table import StepRow
from scanchain_viz.recording import entities, shapes
from scanchain_viz.recording.keyframe_graph import Verdicts
from scanchain_viz.recording.messages import Message, Times

_MAX_SCANS = 256
_MAX_BYTES = 4_000_000
_MAX_WAIT_S = 0.25
_LEAST_DRAWN = 1e-3  # least observability that is drawn
WARNING, _INFORMATION = "WARN", "INFO"  # rerun's words


class Batcher:
    """Holds the steps since the last batch; every batch turns them into messages."""

    def __init__(self, dimension: int) -> None:
        self.steps: list[Step] = []
        self.verdicts: list[Verdicts] = []  # of each step
        self.bytes = 0
        self.scans = 0
        self.points = 0
        self.box: shapes.Floats | None = None
        self.started_s = perf_counter()
        self.T_odom_before: Matrix | None = None
        self.T_world_odom: Matrix = lie.identity(dimension)
        self.has_odom = False
        self.state: State | None = None
        self.closures: tuple[int, int] | None = None

    def restore(self, rows: Sequence[StepRow], verdicts: Verdicts) -> None:
        """Restore the state after the steps of ``rows`` from the verdicts at that time."""
        last = rows[-1]
        self.scans, self.points = len(rows), sum(row.match.points for row in rows)
        self._frame(shapes.positions(np.array([row.T_world_lidar for row in rows])))
        self.T_odom_before = last.T_odom_lidar
        self.has_odom, self.T_world_odom = True, last.T_world_lidar @ lie.inverse(last.T_odom_lidar)
        self.state, self.closures = last.state, (verdicts.accepted, verdicts.rejected)

    def add(self, step: Step, verdicts: Verdicts) -> None:
        """Take in one step with the verdicts of that moment."""
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
        self._frame(shapes.positions(world))
        return [
            Message(entities.LIDAR, shapes.transforms(world), times),
            Message(entities.SCAN, _scans(steps), times),
            *self._trails(times, odom, world),
            *_matches([step.match for step in steps], times),
            Message(entities.TIME, _times_by_stage(steps), times),
            *self._states(steps, verdicts, times),
        ]

    def settled(self, verdicts: Verdicts, times: Times) -> list[Message]:
        """The verdicts after the last step, at its ``times``; their numbers in any case."""
        self.closures = None
        return [
            *events([[(_INFORMATION, text) for text in verdicts.events]], times),
            *self._counts([verdicts], times),
        ]

    def _frame(self, positions: shapes.Floats) -> None:
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
        odometry = shapes.segments(shapes.positions(before), shapes.positions(odom))
        trajectory = shapes.segments(shapes.positions(corrections @ before), shapes.positions(world))
        messages = [
            Message(entities.ODOMETRY, rr.LineStrips3D.columns(strips=odometry), times),
            Message(entities.TRAJECTORY, rr.LineStrips3D.columns(strips=trajectory), times),
        ]
        if changed.any():
            messages.append(Message(entities.ODOM, shapes.transforms(corrections[changed]), times[changed]))
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
    points = shapes.in_space(np.concatenate([step.points for step in steps]))
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
        Message(entities.COVARIANCE, shapes.ellipsoids(informations, entities.COVARIANCE_SCALE), times),
    ]


def _times_by_stage(steps: list[Step]) -> rr.ComponentColumnList:
    """Milliseconds of every stage, one series each, in the order of ``entities.STAGES``."""
    seconds = [(t.read_s, t.preprocess_s, t.match_s, t.map_s, t.loops_s) for t in (step.timing for step in steps)]
    milliseconds = 1e3 * np.array(seconds).reshape(-1)
    return rr.Scalars.columns(scalars=milliseconds).partition([len(entities.STAGES)] * len(steps))
