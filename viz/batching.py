"""Steps gathered into batches: one call a column instead of one a scan, which is what makes recording cheap."""

from __future__ import annotations

import math
from time import perf_counter

import numpy as np
import rerun as rr

from pipeline import lie
from pipeline.data import Match, Matrix, State, Step
from viz import entities, shapes
from viz.messages import Message, Times

_MAX_SCANS = 256
_MAX_BYTES = 4_000_000
_MAX_WAIT_S = 0.25
_BLIND = 1e-3  # observability; less is drawn as that
_WARNING, _INFORMATION = "WARN", "INFO"  # rerun's words


class Batcher:
    """Holds the steps since the last batch; every batch turns them into messages."""

    def __init__(self, dimension: int) -> None:
        self.steps: list[Step] = []
        self.bytes = 0
        self.scans = 0
        self.points = 0
        self.box: shapes.Floats | None = None
        self.started_s = perf_counter()
        self.T_odom_before: Matrix | None = None
        self.T_world_odom: Matrix = lie.identity(dimension)
        self.has_odom = False
        self.state: State | None = None

    def add(self, step: Step) -> None:
        """Take in one step."""
        if not self.steps:
            self.started_s = perf_counter()
        self.steps.append(step)
        self.bytes += 12 * len(step.points)
        self.points += len(step.points)
        self.scans += 1

    @property
    def is_due(self) -> bool:
        """Whether the batch is large or old enough."""
        return (
            len(self.steps) >= _MAX_SCANS
            or self.bytes >= _MAX_BYTES
            or perf_counter() - self.started_s >= _MAX_WAIT_S
        )

    def messages(self) -> list[Message]:
        """Everything the gathered steps say, scan by scan; the batch is empty afterwards."""
        steps, self.steps, self.bytes = self.steps, [], 0
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
            *self._states(steps, times),
        ]

    def _frame(self, positions: shapes.Floats) -> None:
        """Widen the box around everything that was passed, (2, 3)."""
        known = positions if self.box is None else np.concatenate([self.box, positions])
        self.box = np.stack([known.min(axis=0), known.max(axis=0)])

    def _trails(self, times: Times, odom: Matrix, world: Matrix) -> list[Message]:
        """Each scan's piece of the way, before and after correction, and the correction where it changed.

        A piece of the corrected way starts where the scan before stands under the same correction, so that a
        closure does not draw a jump.
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

    def _states(self, steps: list[Step], times: Times) -> list[Message]:
        """The state where it changes, and as events why, with what became of the loop closures."""
        before = [self.state, *(step.state for step in steps[:-1])]
        changed = np.array([step.state is not state for step, state in zip(steps, before, strict=True)])
        self.state = steps[-1].state
        rows: list[int] = []
        texts: list[str] = []
        levels: list[str] = []
        for row, step in enumerate(steps):
            if changed[row] and step.state is not State.OK:
                rows.append(row)
                texts.append(f"{step.state}: {step.reason}")
                levels.append(_WARNING)
            for closure in step.closures:
                rows.append(row)
                texts.append(f"closure {closure.target} to {closure.source} {closure.verdict}: {closure.reason}")
                levels.append(_INFORMATION)
        messages = []
        if changed.any():
            states = [str(step.state) for step, new in zip(steps, changed, strict=True) if new]
            messages.append(Message(entities.STATE, rr.StateChange.columns(state=states), times[changed]))
        if rows:
            columns = rr.TextLog.columns(text=texts, level=levels)
            messages.append(Message(entities.EVENTS, columns, times[np.array(rows)]))
        return messages


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
                math.log10(max(match.observability, _BLIND)),
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
