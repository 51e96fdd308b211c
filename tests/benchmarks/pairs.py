"""``align`` on pairs of clouds: right or wrong, and whether it says so.

    python -m tests.benchmarks.pairs [--kinds KIND ...] [--every N] [--out FILE.csv]

real: pairs of scans of KITTI, PandaSet, CSAIL, Intel and ACES up to 20 scans apart, by odometry, guessed at the
identity and turned by 10 to 180 degrees; elsewhere: scans of different logs; gicp: the pair of small_gicp,
guesses near the truth and far off; bodies: planks, boxes and bunches of boxes, in several densities, noises,
turns and units; overlap: the same seen in part, 30 to 100 %; flat: planes, channels, spheres and tubes, of which
a direction is free. A pose is right within 2.5 % of the target's median range and 2
degrees. "said" counts converged poses.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from itertools import islice
from typing import NamedTuple

import numpy as np

import scanchain
from scanchain import lie
from scanchain.data import Points, Pose
from scanchain.logs import Log, open_log
from scanchain.odometry import Odometry
from tests.benchmarks.harness import options_of, table
from tests.support.scenes import DATA, configured

LOGS = (
    "3d/kitti_0005_first60.mcap", "3d/kitti_0001_first54.mcap", "3d/pandaset_002_sweeps30to55.mcap",
    "2d/mit_csail.mcap", "2d/intel.mcap", "2d/aces.mcap",
)  # fmt: skip
APART, FIRST = (1, 2, 4, 8, 14, 20), (0, 6, 17, 29)
TURNS_DEG = (0, 10, 25, 45, 60, 90, 180)
RIGHT_SHARE, RIGHT_DEG = 0.025, 2.0  # of the target's median range, and of the turn


class Pair(NamedTuple):
    """Two clouds, the guess, and the true pose; no pose is right where that is None."""

    kind: str
    name: str
    target: Points
    source: Points
    guess: Pose
    truth: Pose | None


def turned(rng: np.random.Generator, degrees: float, d: int, shift: float = 0.0) -> Pose:
    """A turn by so much about a random axis (mostly upright), and a shift."""
    twist = np.zeros(d * (d + 1) // 2)
    direction = rng.normal(size=d)
    twist[:d] = shift * direction / np.linalg.norm(direction)
    if d == 2:
        twist[2] = np.radians(degrees) * rng.choice([-1.0, 1.0])
    else:
        axis = rng.normal(size=3) * [0.3, 0.3, 1.0]
        twist[3:] = np.radians(degrees) * axis / np.linalg.norm(axis)
    return lie.exp(twist)


def opened(name: str) -> Log:
    """A log; of two lidars the one that spins."""
    return open_log(DATA / name, **({"log__topic": "/pandar64/points"} if "pandaset" in name else {}))


def real() -> Iterator[Pair]:
    """Scans of one log, by its odometry."""
    rng = np.random.default_rng(1)
    for name in LOGS:
        log = opened(name)
        odometry = Odometry(configured(log.dimension), np.eye(log.dimension + 1))
        skip = 60 if log.dimension == 2 else 0
        tracked = [odometry.process(scan) for scan in islice(log.scans(), skip + FIRST[-1] + APART[-1] + 1)][skip:]
        for first in FIRST:
            for apart in APART:
                if first + apart >= len(tracked):
                    continue
                a, b = tracked[first], tracked[first + apart]
                truth = lie.between(a.T_odom_lidar, b.T_odom_lidar)
                clouds = a.scan.points.astype(float), b.scan.points.astype(float)
                for deg in TURNS_DEG if apart in (2, 8) else TURNS_DEG[:1]:
                    guess = truth @ turned(rng, deg, log.dimension) if deg else np.eye(log.dimension + 1)
                    yield Pair("real", f"{name[3:10]} {first}+{apart} {deg}", *clouds, guess, truth)


def elsewhere() -> Iterator[Pair]:
    """Scans of different logs, and of one log far apart."""
    rng = np.random.default_rng(2)
    for d, names in ((3, LOGS[:3]), (2, LOGS[3:])):
        scans = {
            name: [s.points.astype(float) for s in islice(opened(name).scans(), 0, None, 25 if d == 3 else 400)]
            for name in names
        }
        for a in names:
            for b in names:
                for i, j in zip(range(5), (1, 0, 3, 2, 4), strict=True):
                    if a == b and d == 3:
                        continue
                    x, y = scans[a][i % len(scans[a])], scans[b][j % len(scans[b])]
                    if x is not y:
                        yield Pair(
                            "elsewhere", f"{a[3:10]} {i} {b[3:10]} {j}", x, y, turned(rng, 20.0 * i, d), None
                        )


def gicp() -> Iterator[Pair]:
    """The pair of small_gicp."""
    folder = DATA / "3d/small_gicp_pair"
    from scanchain.logs.formats.clouds import read_cloud_file

    rows = [read_cloud_file(folder / f"{name}.ply") for name in ("target", "source")]
    target, source = (np.column_stack([each[axis] for axis in "xyz"]).astype(float) for each in rows)
    truth, rng = np.loadtxt(folder / "T_target_source.txt"), np.random.default_rng(3)
    yield Pair("gicp", "identity", target, source, np.eye(4), truth)
    yield Pair("gicp", "cm", 100 * target, 100 * source, np.eye(4), scaled(truth, 100.0))
    for share in (2, 5, 20):
        yield Pair("gicp", f"1/{share}", target[::share], source[::share], np.eye(4), truth)
    for deg in (5, 10, 20, 30, 45, 60, 90, 135, 180):
        for shift in (0.0, 0.5, 2.0, 5.0):
            guess = truth @ turned(rng, deg, 3, shift)
            yield Pair("gicp", f"{deg} deg {shift} m", target, source, guess, truth)
    for shift in (3.0, 10.0, 20.0):
        yield Pair(
            "gicp", f"part {shift}", target[target[:, 0] < shift], source[source[:, 0] > -shift], np.eye(4), truth
        )


def scaled(T: Pose, unit: float) -> Pose:
    """The same in another unit."""
    T = T.copy()
    T[:-1, -1] *= unit
    return T


def box(rng: np.random.Generator, count: int, size: tuple[float, float, float], noise: float) -> Points:
    """Points on the faces of a box about the origin."""
    a = np.array(size)
    areas = np.array([a[1] * a[2], a[0] * a[2], a[0] * a[1]])
    face = rng.choice(3, count, p=areas / areas.sum())
    points = (rng.random((count, 3)) - 0.5) * a
    points[np.arange(count), face] = rng.choice([-0.5, 0.5], count) * a[face]
    return points + rng.normal(scale=noise, size=points.shape)


def grid_box(count: int, size: tuple[float, float, float]) -> Points:
    """About so many points on the faces of a box, on a grid."""
    a = np.array(size)
    step = np.sqrt(2 * (a[0] * a[1] + a[1] * a[2] + a[0] * a[2]) / count)
    axes = [np.linspace(-w / 2, w / 2, max(round(w / step) + 1, 2)) for w in a]
    faces = []
    for k in range(3):
        u, v = (axis.ravel() for axis in np.meshgrid(*(axes[i] for i in range(3) if i != k)))
        for side in (-0.5, 0.5):
            faces.append(np.insert(np.column_stack([u, v]), k, side * a[k], axis=1))
    return np.vstack(faces)


SIZES = {
    "plank": (1.2, 0.2, 0.05), "lath": (2.0, 0.06, 0.03), "board": (1.0, 0.7, 0.018), "brick": (0.24, 0.115, 0.07),
    "crate": (0.8, 0.6, 0.5), "beam": (3.0, 0.15, 0.15),
}  # fmt: skip


def bunch(rng: np.random.Generator, count: int, noise: float, seed: int) -> Points:
    """Points of seven boxes that stick out of each other: a body without a symmetry."""
    shape = np.random.default_rng(seed)
    parts = []
    for _ in range(7):
        size = tuple(shape.uniform(0.1, 0.5, 3))
        T = lie.exp(np.append(shape.uniform(-0.25, 0.25, 3), shape.uniform(-1, 1, 3)))
        parts.append(lie.transform(T, box(rng, count // 7, size, noise)))
    return np.vstack(parts)


def bodies() -> Iterator[Pair]:
    """Bodies in two samplings of their surface, turned from the identity."""
    rng = np.random.default_rng(4)
    for name, size in SIZES.items():
        for count in (700, 2000, 7000, 30000, 100000):
            for k, deg in enumerate((2, 5, 10)):
                unit, noise = (1.0, 1000.0, 0.01)[k], 0.01 * size[2] * (1 + k)
                truth = turned(rng, deg, 3, 0.02 * size[0])
                if k != 1:
                    truth = lie.exp(np.insert(np.zeros(5), 3 + (count // 100 + k) % 3, np.radians(deg)))
                a, b = box(rng, count, size, noise), box(rng, count, size, noise)
                if k == 0:
                    a, b = grid_box(count, size), grid_box(count, size)
                b = lie.transform(lie.inverse(truth), b)
                yield Pair("bodies", f"{name} {count} {deg}", unit * a, unit * b, np.eye(4), scaled(truth, unit))
    for seed in range(12):
        for deg in (5, 15, 30, 45, 60, 90, 150):
            count = (2000, 8000, 40000)[seed % 3]
            truth = turned(rng, deg, 3, 0.05)
            a, b = (bunch(rng, count, 0.002 * (1 + seed % 4), seed) for _ in range(2))
            b = lie.transform(lie.inverse(truth), b)
            yield Pair("bodies", f"bunch {seed} {deg}", a, b, np.eye(4), truth)


def overlap() -> Iterator[Pair]:
    """Bodies of which each cloud has a part."""
    rng = np.random.default_rng(5)
    for seed in range(8):
        for share in (0.3, 0.5, 0.7, 0.85, 1.0):
            for deg in (2, 5, 10, 20):
                truth = turned(rng, deg, 3, 0.02)
                a, b = (bunch(rng, 20000, 0.002, 100 + seed) for _ in range(2))
                low, high = np.quantile(a[:, 0], [0.5 - share / 2, 0.5 + share / 2])
                a, b = a[a[:, 0] < high], b[b[:, 0] > low]
                b = lie.transform(lie.inverse(truth), b)
                yield Pair("overlap", f"{seed} {share} {deg}", a, b, np.eye(4), truth)


def flat() -> Iterator[Pair]:
    """Bodies whose pose is not observable, moved along what is free: nothing may be said to be right."""
    rng = np.random.default_rng(6)
    for count in (2000, 10000, 50000):
        for noise in (0.0, 0.001, 0.005, 0.02):
            for shift in (0.0, 0.03, 0.1):
                x = rng.random((2, count)) * [[1.0], [0.7]] - [[0.5], [0.35]]

                def plane(x=x, noise=noise):
                    return np.vstack(
                        [rng.random(x.shape) - 0.5, rng.normal(scale=noise + 1e-9, size=x.shape[1])]
                    ).T

                def tube(x=x, noise=noise):
                    angle = rng.random(x.shape[1]) * 2 * np.pi
                    r = 0.1 + rng.normal(scale=noise, size=len(angle))
                    return np.column_stack(
                        [rng.random(len(angle)) * 2.0 - 1.0, r * np.cos(angle), r * np.sin(angle)]
                    )

                def channel(x=x, noise=noise):
                    out = np.vstack([plane(x, noise) * [2.0, 0.4, 1.0] + [0, 0, side] for side in (0.0, 0.3)])
                    wall = plane(x, noise)[:, [0, 2, 1]] * [2.0, 1.0, 0.3] + [0, 0.2, 0.15]
                    return np.vstack([out, wall, wall * [1, -1, 1]])

                def ball(x=x, noise=noise):
                    p = rng.normal(size=(x.shape[1], 3))
                    return (
                        p
                        / np.linalg.norm(p, axis=1)[:, None]
                        * (0.3 + rng.normal(scale=noise, size=len(p)))[:, None]
                    )

                makes = {"plane": plane, "tube": tube, "channel": channel, "ball": ball}
                axes = {"plane": (0, 1, 5), "tube": (0, 3), "channel": (0,), "ball": (3, 4, 5)}
                for name, make in makes.items():
                    twist = np.zeros(6)
                    twist[list(axes[name])] = shift
                    a, b = make(), lie.transform(lie.exp(-twist), make())
                    yield Pair("flat", f"{name} {count} {noise} {shift}", a, b, np.eye(4), lie.exp(twist))


KINDS = {each.__name__: each for each in (real, elsewhere, gicp, bodies, overlap, flat)}


def main() -> None:
    """Print the table."""
    options = options_of(__doc__, cache=False, kinds=KINDS, every=1, out="")
    rows, counts = [], defaultdict(lambda: np.zeros(5))
    for kind in options.kinds:
        for pair in islice(KINDS[kind](), 0, None, options.every):
            begin = time.perf_counter()
            match = scanchain.align(pair.target, pair.source, pair.guess)
            spent = time.perf_counter() - begin
            range_m = np.median(np.linalg.norm(pair.target - pair.target.mean(axis=0), axis=1))
            is_right, off_m, off_rad = False, np.inf, np.inf
            if pair.truth is not None:
                centroid = pair.source.mean(axis=0)
                off_m = np.linalg.norm(
                    lie.transform(pair.truth, centroid[None])
                    - lie.transform(match.T_target_source, centroid[None])
                )
                off_rad = lie.apart(match.T_target_source, pair.truth)[1]
                is_right = off_m < RIGHT_SHARE * range_m and np.degrees(off_rad) < RIGHT_DEG
            said = match.converged
            counts[kind] += [is_right, is_right and said, not is_right, not is_right and said, spent]
            rows.append(
                f"{kind},{pair.name},{int(is_right)},{int(said)},{off_m / range_m:.4f},{np.degrees(off_rad):.3f},"
                f"{match.fit:.3f},{match.observability:.3g},{match.inliers / match.points:.3f},{match.cost:.4g},"
                f"{match.residual_m / range_m:.5f},{match.iterations},{spent:.3f},{match.cause.replace(',', ';')}"
            )
    row = table("kind", "right", "of these said", "wrong", "of these said", "seconds")
    for kind, (right, right_said, wrong, wrong_said, spent) in counts.items():
        row(kind, int(right), int(right_said), int(wrong), int(wrong_said), f"{spent:.1f}")
    if options.out:
        from pathlib import Path

        Path(options.out).write_text("\n".join(rows) + "\n")


if __name__ == "__main__":
    main()
