"""Odometries that a comparison must survive: each stands still for ten scans, then shows its nature."""

import os
import signal
import subprocess
import time
from pathlib import Path

import numpy as np


class StandsStill:
    def __init__(self):
        self.scans = 0

    def track(self, points, times_s, stamp_ns):
        self.scans += 1
        if self.scans > 10:
            self.misbehave()
        return np.eye(points.shape[1] + 1)

    def misbehave(self):
        pass


class Raises(StandsStill):
    def misbehave(self):
        raise ValueError("no more <b>patience</b>")


class Hangs(StandsStill):
    """Says that it hangs by a file, so that a test need not wait."""

    def misbehave(self):
        Path(os.environ["HANGS_FILE"]).touch()
        time.sleep(600.0)


class Eats(StandsStill):
    def __init__(self):
        super().__init__()
        self.hoard = []

    def misbehave(self):
        while True:
            self.hoard.append(np.ones(1 << 20))
            time.sleep(0.005)


class Dies(StandsStill):
    def misbehave(self):
        os.kill(os.getpid(), signal.SIGSEGV)


class Spawns(StandsStill):
    """Starts a process of its own and forgets it."""

    is_away = False

    def misbehave(self):
        if self.scans == 11:
            child = subprocess.Popen(["sleep", "600"], start_new_session=self.is_away)
            with Path(os.environ["SPAWNED_FILE"]).open("a") as file:
                print(child.pid, file=file)
            time.sleep(0.5)


class SpawnsAway(Spawns):
    is_away = True


class SpawnsAndDies(Spawns):
    def misbehave(self):
        super().misbehave()
        os.kill(os.getpid(), signal.SIGSEGV)


class Spatial(StandsStill):
    """A 3D pose of a 2D log."""

    def track(self, points, times_s, stamp_ns):
        return np.eye(4)


class LosesItself(StandsStill):
    def track(self, points, times_s, stamp_ns):
        pose = super().track(points, times_s, stamp_ns)
        return np.nan * pose if self.scans > 10 else pose


class DiesEarly(Dies):
    def track(self, points, times_s, stamp_ns):
        self.misbehave()


class Unsteady(StandsStill):
    """Never twice the same."""

    def track(self, points, times_s, stamp_ns):
        self.scans += 1
        pose = np.eye(points.shape[1] + 1)
        pose[:-1, -1] = np.random.default_rng().normal(scale=0.1, size=points.shape[1]) + 0.1 * self.scans
        return pose


class Shifted(StandsStill):
    """Ten centimeters forward a scan, or whatever it is told."""

    def __init__(self, step_m=0.1):
        super().__init__()
        self.step_m = step_m
        self.description = f"moves {step_m} m a scan"

    def track(self, points, times_s, stamp_ns):
        pose = np.eye(points.shape[1] + 1)
        pose[0, -1] = self.step_m * self.scans
        self.scans += 1
        return pose
