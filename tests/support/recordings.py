"""Recordings of a made-up drive, and what any of them holds, read by rerun."""

import socket

import numpy as np
from rerun.chunk import RrdReader

from scanchain import lie
from scanchain.config import RecordingConfig
from scanchain.data import Closure, ClosureVerdict, GraphState, Match, Scan, State, Step, Timing, Trajectory
from scanchain.runs.closures import final_verdicts
from scanchain_viz.recording import entities
from scanchain_viz.recording.recording import Recording

START_NS = 976_052_857_000_000_000
EVERY_SCAN = (
    entities.LIDAR, entities.SCAN, entities.COVARIANCE, entities.ODOMETRY, entities.TRAJECTORY,
    entities.TIME, entities.INLIERS, entities.INLIER_SHARE, entities.RESIDUAL, entities.OBSERVABILITY,
    entities.ITERATIONS, entities.OPTIMIZED_LIDAR, entities.ODOM,
)  # fmt: skip
NOW_AND_THEN = (
    entities.LOCAL_MAP, entities.KEYFRAMES, entities.ODOMETRY_EDGES, entities.ACCEPTED,
    entities.REJECTED, entities.STATE, entities.EVENTS,
)  # fmt: skip
FOR_EVER = (entities.WORLD, entities.OPTIMIZED, entities.LEGEND)


def drive(count, dimension, points=180, seed=1):
    """Steps round a circle: closures, a correction half way, a blind and a lost scan."""
    rng = np.random.default_rng(seed)
    k = 3 if dimension == 2 else 6
    steps = []
    for i in range(count):
        twist = np.zeros(k)
        twist[-1] = 2.0 * np.pi * i / count
        offset = np.eye(dimension + 1)
        offset[0, -1] = 20.0
        T_odom_lidar = lie.exp(twist) @ offset
        T_world_odom = np.eye(dimension + 1)
        T_world_odom[1, -1] = 0.5 if i >= count // 2 else 0.0
        T_world_lidar = T_world_odom @ T_odom_lidar
        state = {count // 3: State.DEGENERATE, count // 3 + 1: State.LOST}.get(i, State.OK)
        match = Match(
            T_target_source=T_odom_lidar,
            information=np.diag([1e6] * dimension + [1e8] * (k - dimension)), cost=0.5,
            inliers=points - 7, points=points, iterations=4, residual_m=np.inf if state is State.LOST else 0.02,
            fit=0.9, at_minimum=True, converged=True, reason="converged", degeneracy_eigenvalue=0.3,
            observability=9.0,
            degeneracy_direction=np.eye(k)[0],
        )  # fmt: skip
        keyframe = i // 5 if i % 5 == 0 else -1
        closures, graph = (), None
        if keyframe >= 2 and keyframe % 2 == 0:
            verdict = ClosureVerdict.ACCEPTED if keyframe % 4 == 0 else ClosureVerdict.REJECTED
            closures = (Closure(0, keyframe, match, 0.8, verdict, "looked alike"),)
        if keyframe >= 4 and keyframe % 4 == 0:
            graph = graph_of([*steps, (keyframe, T_world_lidar)], keyframe)
        stamp_ns = START_NS + 100_000_000 * i - (250_000_000 if i % 20 == 19 else 0)  # steps back, as Intel's do
        cloud = rng.normal(scale=8.0, size=(points, dimension))
        scan = Scan(i, stamp_ns, stamp_ns, cloud.astype(np.float32), np.empty(0, np.float32), 0, None)
        local_map = rng.normal(scale=30.0, size=(30_000, dimension)) if keyframe >= 0 else np.empty((0, dimension))
        timing = Timing(0.001, 0.002, 0.003, 0.001, 0.0)
        steps.append(
            Step(scan, cloud, T_odom_lidar, T_world_lidar, match, state, "a reason", keyframe, local_map, closures,
                 graph, timing)
        )  # fmt: skip
    return steps


def graph_of(steps, last_keyframe):
    poses = np.array([step.T_world_lidar for step in steps[:-1] if step.keyframe >= 0] + [steps[-1][1]])
    loops = [(0, k) for k in range(4, last_keyframe + 1, 4)]
    edges = np.array([(i, i + 1) for i in range(last_keyframe)] + loops)
    is_loop = np.arange(len(edges)) >= last_keyframe
    weight = np.where(is_loop, 0.3, 1.0)
    weight[-1] = 0.9
    return GraphState(poses, np.zeros(len(poses), np.int64), edges, is_loop, weight, 1.0, np.zeros(len(edges)))


def opened(path, dimension=2, sinks=("save",), config=None):
    """A recording before it begins."""
    config = config or RecordingConfig()
    return Recording(path, dimension=dimension, name="test", sinks=frozenset(sinks), config=config)


def record(path, steps, dimension, final=None, **options):
    """The recording after its end, with results of every kind; the last graph of the steps is the final one."""
    recording = opened(path, dimension, **options)
    with recording:
        for step in steps:
            recording.log(step)
        poses = np.array([step.T_world_lidar for step in steps])
        stamps_ns = np.array([step.scan.stamp_ns for step in steps])
        recording.log_trajectory(Trajectory(stamps_ns, poses))
        graphs = [*(step.graph for step in steps if step.graph is not None), *([final] if final else [])]
        closures = [closure for step in steps for closure in step.closures]
        recording.log_closures(final_verdicts(closures, graphs[-1]), graphs[-1])
        if dimension == 2:
            recording.log_grid(np.full((30, 40), -1, np.int8), resolution_m=0.05, origin_m=(-1.0, -0.75))
        recording.log_map(np.concatenate([lie.transform(step.T_world_lidar, step.points) for step in steps]))
    return recording


def rows_of(path):
    """Rows and timelines of every entity in a recording."""
    rows, timelines = {}, {}
    for chunk in RrdReader(str(path)).stream():
        entity = chunk.entity_path.lstrip("/")
        rows[entity] = rows.get(entity, 0) + chunk.num_rows
        timelines.setdefault(entity, set()).update(chunk.timeline_names)
    return rows, timelines


def column(path, entity, name, *, is_static=False):
    """All values of one component of an entity, or of a timeline, row by row."""
    values = []
    for chunk in RrdReader(str(path)).stream():
        batch = chunk.to_record_batch()
        is_of_it = chunk.entity_path.lstrip("/") == entity and chunk.is_static == is_static
        if is_of_it and name in batch.schema.names:
            values.extend(batch.column(name).to_pylist())
    return values


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def static_entities(path):
    return {chunk.entity_path.lstrip("/") for chunk in RrdReader(str(path)).stream() if chunk.is_static}
