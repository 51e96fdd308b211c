"""Odometries that a comparison must survive, and one that is as good as it is told to be."""

import os
import signal
import subprocess
import time
from pathlib import Path

import numpy as np

from scanchain import lie

AT_ONCE = ("dies-early", "is-spatial", "is-unsteady")


class Bad:
    """Stands still for ten scans, then shows its nature, some of it by a file."""

    def __init__(self, nature="stands", file=""):
        self.nature, self.file = nature, Path(file)
        self.scans, self.hoard = 0, []

    def register(self, points, stamp_s, times_s):
        self.scans += 1
        pose = np.eye(points.shape[1] + 1)
        if self.scans <= 10 and self.nature not in AT_ONCE:
            return pose
        match self.nature:
            case "raises":
                raise ValueError("no more <b>patience</b>")
            case "hangs":  # and says so, so that a test need not wait
                self.file.touch()
                time.sleep(600.0)
            case "eats":
                while True:
                    self.hoard.append(np.ones(1 << 20))
                    time.sleep(0.005)
            case "dies" | "dies-early":
                os.kill(os.getpid(), signal.SIGSEGV)
            case "spawns" | "spawns-away" | "spawns-and-dies" if self.scans == 11:
                self._spawn()
        if self.nature == "is-unsteady":  # never twice the same
            pose[:-1, -1] = np.random.default_rng().normal(scale=0.1, size=points.shape[1]) + 0.1 * self.scans
        return {"is-spatial": np.eye(4), "is-lost": np.nan * pose}.get(self.nature, pose)

    def _spawn(self):
        """Start a process and forget it."""
        child = subprocess.Popen(["sleep", "600"], start_new_session=self.nature == "spawns-away")
        with self.file.open("a") as file:
            print(child.pid, file=file)
        time.sleep(0.5)
        if self.nature == "spawns-and-dies":
            os.kill(os.getpid(), signal.SIGSEGV)


class Doubled:
    """Ten centimeters forward a scan, and twice as much after the last one."""

    def __init__(self):
        self.poses = []

    def register(self, points, stamp_s, times_s):
        pose = np.eye(points.shape[1] + 1)
        pose[0, -1] = 0.1 * len(self.poses)
        self.poses.append(pose)
        return pose

    def final_poses(self):
        return np.array([pose @ pose for pose in self.poses])


class Shifted:
    """Ten centimeters forward a scan, or whatever it is told."""

    def __init__(self, step_m=0.1):
        self.scans, self.step_m = 0, step_m
        self.description = f"moves {step_m} m a scan"

    def register(self, points, stamp_s, times_s):
        pose = np.eye(points.shape[1] + 1)
        pose[0, -1] = self.step_m * self.scans
        self.scans += 1
        return pose


class Turned:
    """Integrates the rates of an IMU, and does not move."""

    def __init__(self):
        self.T_odom_lidar, self.last_ns = np.eye(4), 0

    def add_inertial(self, inertial):
        rates = inertial.rates @ inertial.T_lidar_imu[:3, :3].T
        for stamp_ns, rate in zip(inertial.stamps_ns.tolist(), rates, strict=True):
            lasted_s = 1e-9 * (stamp_ns - self.last_ns) if self.last_ns else 0.0
            self.T_odom_lidar = self.T_odom_lidar @ lie.exp(np.concatenate([np.zeros(3), lasted_s * rate]))
            self.last_ns = stamp_ns

    def register(self, points, stamp_s, times_s):
        return self.T_odom_lidar
