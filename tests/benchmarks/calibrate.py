"""Calibration of simulated logs with errors of every sensor: how often the truth is within two sigma.

A spinning lidar with wrong elevations and ranges, a second one whose transform is off by 10 cm and 3 degrees, an
IMU of MEMS grade at any angle and late, late wheels of wrong scales. The lidar's own transform is right.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np

import scanchain
from scanchain import lie
from scanchain.calibration import Parameter, calibrate
from scanchain.logs.messages.lidar import with_offsets
from scanchain.logs.messages.poses import StampedPose
from scanchain.logs.mounting import angles_rad
from scanchain.logs.stream import decoded_messages
from scanchain.logs.writer import Link, LogWriter, pack_odometry, pack_transforms, place
from scanchain.runs.job import Progress
from scanchain.settings import load_settings
from scanchain.simulation.drive import _WHEELS, Drive, _random, plan
from scanchain.simulation.imu import IMUS
from scanchain.simulation.sensors import SENSORS
from tests.benchmarks.harness import options_of, recorded, table
from tests.support.several_lidars import recorded as messages_of

WORLDS = ("town", "rounds", "turns", "forest", "hall")
OTHERS = ("rosette", "vlp-16")


def turned(rng: np.random.Generator, degrees: float, meters: float) -> np.ndarray:
    """A pose of this angle about a random axis, and of this distance in a random direction."""
    axis, ahead = (each / np.linalg.norm(each) for each in rng.normal(size=(2, 3)))
    T = lie.exp(np.concatenate([np.zeros(3), np.radians(degrees) * axis]))
    T[:3, 3] = meters * ahead
    return T


def made(seed: int, world: str, sensor: str, seconds: float, cache: Path) -> tuple[Path, dict[str, float]]:
    """A log, and its true parameters in the units of the table."""
    rng = np.random.default_rng(1000 + seed)
    elevation_deg, range_m, imu_s, wheels_s = rng.uniform(-1, 1, 4) * [0.3, 0.03, 0.1, 0.2]
    other, T_lidar_other = OTHERS[seed % 2], turned(rng, 15.0, 0.5)
    T_base_imu = turned(rng, 40.0, 0.2)
    imu = replace(IMUS["mems"], T_base_imu=T_base_imu, delay_ns=round(1e9 * imu_s))
    first = replace(plan(world, seed=seed, sensor=sensor, duration_s=seconds), imu=imu)
    T_base_lidar = first.T_base_lidar

    def of_other() -> Drive:
        vehicle = replace(first.motion.vehicle, T_base_lidar=T_base_lidar @ T_lidar_other)
        return replace(
            first,
            motion=replace(first.motion, vehicle=vehicle),
            T_base_lidar=vehicle.T_base_lidar,
            sensor=replace(SENSORS[other], max_range_m=first.sensor.max_range_m),
            imu=None,
        )

    name = f"{world}_{sensor}_{seconds}_{seed}"
    sources = recorded(f"calibrate_{name}", first, cache), recorded(f"calibrate_other_{name}", of_other(), cache)
    path = cache / f"calibrate_{name}.mcap"
    T_stated = T_base_lidar @ T_lidar_other @ turned(rng, 3.0, 0.1)
    with LogWriter(path, force=True) as writer:
        begin_ns = int(first.truth().stamps_ns[0])
        links = Link("base_link", "lidar", place(T_base_lidar)), Link("base_link", "other", place(T_stated))
        writer.append("/tf_static", "tf2_msgs/msg/TFMessage", pack_transforms(begin_ns, *links), begin_ns)
        log = scanchain.open_log(sources[0])
        for message in messages_of(log):
            if message.channel.topic == "/imu/data":
                writer.copy(message.channel, message.log_time_ns, message.value)
        for message in decoded_messages(log.indexes, {"/odom": log.sample_decoders["/odom"]}, log.span, damage=[]):
            for pose in message.value if isinstance(message.value, list) else [message.value]:
                if isinstance(pose, StampedPose):
                    stamp_ns = pose.stamp_ns + round(1e9 * wheels_s)
                    data = pack_odometry(stamp_ns, "odom", "base_link", place(pose.T_parent_child))
                    writer.append("/odom", "nav_msgs/msg/Odometry", data, stamp_ns, message.log_time_ns)
        offsets = (-np.radians(elevation_deg), -range_m), (0.0, 0.0)
        for source, topic, frame, off in zip(
            sources, ("/points", "/other"), ("lidar", "other"), offsets, strict=True
        ):
            for scan in scanchain.open_log(source):
                points = with_offsets(scan.points.astype(float), *off).astype(np.float32)
                times = {"t": np.rint(1e9 * scan.times_s).astype(np.uint32)}
                writer.point_cloud(topic, scan.stamp_ns, frame, points, times, scan.stamp_ns + 100_000_000)
    wheels = _random(seed, _WHEELS)
    scale, turn, _ = wheels.choice([-1.0, 1.0], 3) * wheels.uniform(0.5, 1.5, 3)
    true = {
        "elevation offset": elevation_deg,
        "range offset": range_m,
        "IMU delay": imu_s,
        "wheels delay": wheels_s,
    }
    true |= {"scale of distances": 1.0 + 0.01 * scale, "scale of turns": 1.0 + 0.02 * turn}
    poses = {"other": T_lidar_other, "base": T_base_lidar, "IMU": lie.inverse(T_base_lidar) @ T_base_imu}
    for key, T in poses.items():
        values = [*T[:3, 3], *np.degrees(angles_rad(T))]
        true |= {
            f"{key} {name}": value
            for name, value in zip(("x", "y", "z", "roll", "pitch", "yaw"), values, strict=True)
        }
    return path, true


def name_of(parameter: Parameter) -> str:
    """Its name among the true ones."""
    sensor = parameter.sensor
    key = "base " if "on the base" in sensor else "other " if "/other" in sensor else ""
    key = key or ("IMU " if sensor == "IMU" else "wheels " if parameter.name == "delay" else "")
    return key + parameter.name


def main() -> None:
    options = options_of(__doc__, seeds=40, first=0, seconds=15.0, sensors=["os1-32", "vlp-16"])
    row = table("log", "parameter", "true", "found", "sigma", "unit", "error in sigmas")
    errors, unknown = defaultdict(list), defaultdict(int)
    for seed in range(options.first, options.first + options.seeds):
        world, sensor = WORLDS[seed % len(WORLDS)], options.sensors[seed % len(options.sensors)]
        path, true = made(seed, world, sensor, options.seconds, options.cache)
        log = scanchain.open_log(path, topic=("/points", "/other"))
        found = calibrate(log, load_settings(3).config, Progress())
        for each in found.parameters:
            name = name_of(each)
            if name not in true:
                continue
            if each.why:
                unknown[name] += 1
                continue
            error = (each.value - true[name]) / each.sigma
            errors[name].append(error)
            row(
                f"{seed} {world}, {sensor}",
                name,
                f"{true[name]:.4f}",
                f"{each.value:.4f}",
                f"{each.sigma:.4f}",
                each.unit,
                f"{error:.1f}",
            )
        path.unlink()
    row = table("parameter", "observable in", "not in", "within 2 sigma", "root mean square of error / sigma")
    for name, values in errors.items():
        within = f"{np.mean(np.abs(values) < 2.0):.0%}"
        row(name, len(values), unknown[name], within, f"{np.sqrt(np.mean(np.square(values))):.2f}")
    every = np.concatenate(list(map(np.array, errors.values())))
    row(
        "all",
        len(every),
        sum(unknown.values()),
        f"{np.mean(np.abs(every) < 2.0):.0%}",
        f"{np.sqrt(np.mean(every**2)):.2f}",
    )


if __name__ == "__main__":
    main()
