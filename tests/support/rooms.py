"""Made-up maps of views along a room, in the plane."""

from pathlib import Path

import numpy as np

from scanchain import lie
from scanchain.data import Keyframe
from scanchain.maps import Edges, SavedMap, SavedPoints, Session, write_saved_map
from scanchain.sessions.changes import Part
from scanchain.simulation.solids import Scenery, Solids

BOX, HIDDEN = (5.0, 3.0), (8.0, 6.5)  # the first stands free, the second behind a wall
CORNER = SavedPoints(np.random.default_rng(0).uniform(-0.3, 0.3, (200, 2)), 1.0)  # of what stands there


def room(*boxes: tuple[float, float], edge_m: float = 0.6) -> Solids:
    """12 x 8 m, with a wall that hides its far corner, a cupboard, and boxes."""
    scenery = Scenery()
    for center, size in (((6, 0), (12, 0.2)), ((6, 8), (12, 0.2)), ((0, 4), (0.2, 8)), ((12, 4), (0.2, 8))):
        scenery.box(center, size, (0.0, 2.5))
    scenery.box((8.5, 5.0), (7.0, 0.2), (0.0, 2.5))
    scenery.box((2.0, 6.0), (1.2, 0.7), (0.0, 2.5))
    for center in boxes:
        scenery.box(center, (edge_m, edge_m), (0.0, 2.5))
    return scenery.finish()


def hall() -> Solids:
    """Another place: 20 x 4 m with three pillars."""
    scenery = Scenery()
    for center, size in (((6, 0), (20, 0.2)), ((6, 4), (20, 0.2)), ((-4, 2), (0.2, 4)), ((16, 2), (0.2, 4))):
        scenery.box(center, size, (0.0, 2.5))
    for x in (-1.0, 5.0, 12.5):
        scenery.box((x, 2.8), (0.8, 0.8), (0.0, 2.5))
    return scenery.finish()


def part(name: str, solids: Solids, T_map_room=None, count: int = 8) -> Part:
    """A map of views along the room, in the plane."""
    angle = np.linspace(-np.pi, np.pi, 720, endpoint=False)
    directions = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(720)])
    T_map_room = lie.identity(2) if T_map_room is None else T_map_room
    keyframes, poses = [], []
    for k, x in enumerate(np.linspace(1.5, 10.0, count)):
        lidar = np.eye(4)
        lidar[:3, 3] = x, 1.5, 0.3
        ranges_m = solids.cast(lidar[None], np.zeros(720, np.int32), directions, 30.0)
        pose = T_map_room @ lie.pose_2d(float(x), 1.5, 0.0)
        keyframes.append(Keyframe(k, k, k, SavedPoints(directions[:, :2] * ranges_m[:, None], 1.0), pose, 1.2 * k))
        poses.append(pose)
    return Part(name, keyframes, np.array(poses))


def corridor(x_m, index, depths_m):
    """A keyframe in a corridor, one wall of which is as far away as said for every meter along it."""
    angles = np.arange(-np.pi, np.pi, 0.01)
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    ranges_m = np.arange(0.0, 10.0, 0.02)
    along, across = x_m + ranges_m * directions[:, :1], ranges_m * directions[:, 1:]
    is_wall = (across < -1.0) | (across > depths_m[np.clip(along, 0.0, 59.9).astype(int)])
    seen = is_wall.any(axis=1)
    points = ranges_m[is_wall.argmax(axis=1)][seen, None] * directions[seen]
    return Keyframe(index, index, index, SavedPoints(points, 1.0), lie.pose_2d(x_m, 0.0, 0.0), x_m)


def map_of(folder: Path, *parts: Part) -> SavedMap:
    """A map of one or several sessions, with an edge from each keyframe to the next of its session."""
    keyframes = tuple(keyframe for each in parts for keyframe in each.keyframes)
    numbers = np.repeat(np.arange(len(parts)), [len(each.keyframes) for each in parts])
    sessions = tuple(Session(each.name, 0, 9, len(each.keyframes)) for each in parts)
    starts = np.flatnonzero(numbers[:-1] == numbers[1:])
    poses = np.array([keyframe.T_odom_lidar for keyframe in keyframes]) if keyframes else np.empty((0, 3, 3))
    dimension = poses.shape[-1] - 1
    information = np.tile(np.diag(lie.by_component(3 * dimension - 3, 1e4, 1e5)), (len(starts), 1, 1))
    motions, count = lie.between(poses[starts], poses[starts + 1]), len(starts)
    pairs = np.column_stack([starts, starts + 1])
    edges = Edges(pairs, motions, information, np.zeros(count, np.bool_), np.ones(count))
    return SavedMap(folder, dimension, keyframes, numbers, sessions, edges)


def saved(folder: Path, *parts: Part) -> Path:
    """The folder of a run that holds such a map."""
    write_saved_map(map_of(folder / "map", *parts))
    return folder
