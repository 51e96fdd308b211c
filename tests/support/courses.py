"""Made-up trajectories around a block, right or with a slip, and evidence on them for the verdict."""

import numpy as np

from scanchain import lie
from scanchain.verdict import Closures, Evidence

N, STEP_M, INTERVAL_S = 1200, 0.1, 0.2


def course(dimension=2, slip=(0, 0), seed=0):
    """True poses around a block, twice, and those of a matching that stands still over the scans of ``slip``."""
    rng = np.random.default_rng(seed)
    k = 3 if dimension == 2 else 6
    motions = np.zeros((N - 1, k))
    motions[:, 0] = STEP_M
    motions[np.arange(N - 1) % 150 >= 140, k - 1] = np.pi / 20.0
    slipped = motions.copy()
    slipped[slice(*slip), 0] *= 0.1
    return chained(motions, rng, 0.002), chained(slipped, rng, 0.002)


def chained(motions, rng, noise_m=0.0):
    poses = [lie.identity(2 if motions.shape[1] == 3 else 3)]
    noise = rng.normal(0.0, noise_m, motions.shape) * (np.arange(motions.shape[1]) < 2)
    for motion in motions + noise:
        poses.append(poses[-1] @ lie.exp(motion))
    return np.array(poses)


POSES = course()[0]


def wheels_of(poses, seed=1, *, scale=1.0, drift_rad_m=0.0, share=0.02):
    """Wheel odometry with errors of scale and heading, and noise."""
    rng = np.random.default_rng(seed)
    motions = lie.log(lie.between(poses[:-1], poses[1:])) * scale
    motions[:, -1] += drift_rad_m * STEP_M
    return chained(motions * rng.normal(1.0, share, motions.shape), rng)


def evidence(poses=POSES, *, wheels=None, closures=(), **changes):
    n = len(poses)
    seconds = changes.pop("seconds", INTERVAL_S * np.arange(n))
    stamps_ns = (1e9 * seconds).astype(np.int64)
    ends = np.array([pair for pair, _ in closures], np.int64).reshape(-1, 2)
    T = np.array([T for _, T in closures]).reshape(-1, *poses.shape[1:])
    known = {
        "is_lost": np.zeros(n, bool),
        "is_degenerate": np.zeros(n, bool),
        "fit": np.full(n, 0.9),
        "starts_segment": np.zeros(n, bool),
        "is_copy": np.zeros(n, bool),
        "points": np.full(n, 500),
        "inlier_share": np.ones(n),
        "bound_m": 0.02,
        "sources": {} if wheels is None else {"wheel": wheels},
    }
    return Evidence(
        stamps_ns=stamps_ns,
        log_times_ns=stamps_ns,
        poses=poses,
        closures=Closures(ends[:, 0], ends[:, 1], T, np.zeros(len(ends), bool)),
        **known | changes,
    )


def marked(first, last):
    return (np.arange(N) >= first) & (np.arange(N) <= last)


def closed(poses, *, by_m=0.01):
    """Six accepted closures around the middle of a course, as measured at these poses."""
    pairs = np.array([(10 + 5 * k, 610 + 5 * k) for k in range(6)])
    off = [lie.pose_2d(*each) for each in np.random.default_rng(3).normal(0.0, [by_m, by_m, 0.001], (6, 3))]
    T = lie.between(poses[pairs[:, 0]], poses[pairs[:, 1]]) @ np.array(off)
    return Closures(pairs[:, 0], pairs[:, 1], T, np.ones(6, bool))
