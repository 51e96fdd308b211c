"""Folders as those of UTIAS MRCLAM, with robots that drive between random points of an arena among landmarks.

The wheels are logged at 50 Hz with systematic errors and noise. A camera with a field of view of 1.1 rad sees
barcodes up to 6 m away, and its errors are half white and half correlated over 5 s for each landmark. The truth is
by motion capture at 50 Hz.
"""

from dataclasses import dataclass

import numpy as np

RATE_HZ, IMAGES_HZ = 50, 2.0
ARENA_M = np.array([10.0, 6.0])
FIELD_RAD, REACH_M = 0.55, 6.0
BODY_M = 0.12  # radius of a robot, on which its barcodes are
CORRELATED_S = 5.0
WHEELS = np.array([0.02, 0.01, 0.03, 0.05])  # white noise: forward, sideways, turning per m, turning per rad


@dataclass(frozen=True)
class World:
    """What is to be simulated; systematic errors are drawn from normal distributions with these deviations."""

    seed: int
    robots: tuple[int, ...] = (1,)
    landmarks: int = 15
    duration_s: float = 900.0
    noise: float = 1.0  # factor of all noise
    correlated: float = 0.5  # share of the correlated errors' variance
    range_m: float = 0.01
    range_share: float = 0.006
    bearing_rad: float = 0.01
    depth: float = 1.0
    systematic: float = 1.0  # factor of all systematic errors
    wheels_sigma: tuple[float, ...] = (0.05, 0.05, 0.05, 0.03)
    sensor_sigma: tuple[float, ...] = (0.02, 0.03, 0.01, 0.01, 0.03)
    delay_s: float = 0.15
    wrong: float = 0.0  # share of the sightings with a barcode read wrong


def wrapped(angle):
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def driven(rng, world, steps):
    """Poses, logged velocities and their errors c of a robot that drives between random points.

    With v and ω as logged it drives (1 + c₀) v + c₁ |ω| and (1 + c₂) ω + c₃ v, and noise per meter and radian.
    """
    c = world.systematic * rng.normal(size=4) * world.wheels_sigma
    dt, pose = 1.0 / RATE_HZ, np.append(rng.uniform(0.1, 0.9, 2) * ARENA_M, rng.uniform(-np.pi, np.pi))
    poses, logged = np.empty((steps, 3)), np.empty((steps, 2))
    v, w, plan = 0.0, 0.0, list[tuple[float, float]]()
    for k in range(steps):
        poses[k] = pose
        if not plan:  # turn to a random point and drive there, unseeing
            away = rng.uniform(0.1, 0.9, 2) * ARENA_M - pose[:2]
            turn, turning = wrapped(np.arctan2(away[1], away[0]) - pose[2]), rng.choice([0.2, 0.4])
            plan = round(abs(turn) / turning / dt) * [(rng.choice([0.0, 0.05]), np.sign(turn) * turning)]
            plan += round(np.hypot(*away) / 0.12 / dt) * [(0.12, 0.0)] + int(rng.choice([0, 50])) * [(0.0, 0.0)]
            plan = plan[::-1]
        wanted = plan.pop()
        v, w = v + 0.1 * (wanted[0] - v), w + 0.1 * (wanted[1] - w)
        logged[k] = v, w
        noise = world.noise * WHEELS * np.sqrt(np.abs([v, v, v, w]) * dt) * rng.normal(size=4)
        forward, turned = ((1.0 + c[0]) * v + c[1] * abs(w)) * dt + noise[0], ((1.0 + c[2]) * w + c[3] * v) * dt
        turned += noise[2] + noise[3]
        x, y = np.cos(pose[2] + 0.5 * turned), np.sin(pose[2] + 0.5 * turned)
        pose = pose + np.array([x * forward - y * noise[1], y * forward + x * noise[1], turned])
        pose[2] = wrapped(pose[2])
    return poses, logged, c


class Camera:
    """Sees barcodes with systematic, white and correlated errors."""

    def __init__(self, rng, world):
        self.rng, self.world = rng, world
        self.errors = world.systematic * rng.normal(size=5) * world.sensor_sigma
        self.last = {}

    def error(self, subject, time_s):
        """White and correlated error of unit variance, (2,)."""
        share, fresh = self.world.correlated, self.rng.normal(size=2)
        before, then_s = self.last.get(subject, (fresh, -np.inf))
        decay = np.exp(-(time_s - then_s) / CORRELATED_S)
        slow = decay * before + np.sqrt(1.0 - decay**2) * self.rng.normal(size=2)
        self.last[subject] = slow, time_s
        return self.world.noise * (np.sqrt(share) * slow + np.sqrt(1.0 - share) * self.rng.normal(size=2))

    def see(self, pose, point, subject, time_s, radius_m=0.0):
        """Range and bearing, or None where it is out of sight."""
        scale, offset, turned, stretch, ahead = self.errors
        away = point - pose[:2]
        c, s = np.cos(pose[2]), np.sin(pose[2])
        x, y = c * away[0] + s * away[1] - ahead, -s * away[0] + c * away[1]
        reach, bearing = np.hypot(x, y) - radius_m, np.arctan2(y, x)
        if abs(bearing) > FIELD_RAD or not 0.4 < reach < REACH_M or self.rng.random() > 0.7:
            return None
        e = self.error(subject, time_s)
        sigma = np.hypot(self.world.range_m, self.world.range_share * reach)
        measured = (1.0 + scale) * reach * (1.0 - self.world.depth * (1.0 - np.cos(bearing))) + offset
        return measured + sigma * e[0], bearing * (1.0 + stretch) + turned + self.world.bearing_rad * e[1]


def write_mrclam(folder, world):
    """The folder, and the true systematic errors by robot."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(world.seed)
    steps, begin = int(world.duration_s * RATE_HZ), 1_000_000.0
    times = begin + np.arange(steps) / RATE_HZ
    landmarks = rng.uniform(0.0, 1.0, (world.landmarks, 2)) * ARENA_M
    subjects = 6 + np.arange(world.landmarks)
    codes = {k: 10 + 3 * k for k in [1, 2, 3, 4, 5, *subjects.tolist()]}
    drives = {robot: driven(rng, world, steps) for robot in world.robots}
    own = {}

    def table(name, rows, form):
        np.savetxt(folder / name, rows, form, header="made by tests.support.mrclam")

    table("Barcodes.dat", [[k, code] for k, code in codes.items()], "%d")
    table("Landmark_Groundtruth.dat", np.column_stack([subjects, landmarks, np.full((len(landmarks), 2), 1e-4)]),
          "%d %.6f %.6f %.6f %.6f")  # fmt: skip
    for robot, (poses, wheels, c) in drives.items():
        camera = Camera(rng, world)
        own[robot] = c, camera.errors
        table(f"Robot{robot}_Odometry.dat", np.column_stack([times - world.delay_s, wheels]), "%.3f %.4f %.4f")
        noise = rng.normal(size=poses.shape) * [0.001, 0.001, 0.005]
        table(f"Robot{robot}_Groundtruth.dat", np.column_stack([times, poses + noise]), "%.3f %.5f %.5f %.5f")
        rows = []
        for k in range(RATE_HZ * 2, steps - RATE_HZ, int(RATE_HZ / IMAGES_HZ)):
            others = [(other, at[k, :2], BODY_M) for other, (at, *_) in drives.items() if other != robot]
            for subject, point, radius in [
                *((*each, 0.0) for each in zip(subjects.tolist(), landmarks, strict=True)),
                *others,
            ]:
                seen = camera.see(poses[k], point, subject, times[k], radius)
                if seen is not None:
                    code = codes[subject]
                    if rng.random() < world.wrong:
                        code = codes[int(rng.choice(subjects))]
                    rows.append([times[k], code, *seen])
        table(f"Robot{robot}_Measurement.dat", np.array(rows), "%.3f %d %.4f %.4f")
    return own
