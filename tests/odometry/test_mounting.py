"""A lidar whose mounting the log does not state, or states wrongly: the motions of wheels and lidar tell."""

import re
from dataclasses import replace

import numpy as np
import pytest

import scanchain
from scanchain import lie
from scanchain.logs import open_log
from scanchain.runs.directory import POINTS_FILE
from scanchain.runs.resume import Checkpoints, read_checkpoint
from scanchain.simulation.drive import plan, record
from scanchain.slam import Slam
from tests.support import made
from tests.support.messages import says, unfolded
from tests.support.naive_logs import Said, decoded, write
from tests.support.scenes import configured, shared_data

ASSUMED = "as if the lidar sat at the base's origin"


def mounted(yaw_deg, x=0.0, y=0.0, *, z=0.25, roll_deg=0.0):
    T = lie.exp(np.radians([0.0, 0, 0, 0, 0, yaw_deg])) @ lie.exp(np.radians([0.0, 0, 0, roll_deg, 0, 0]))
    T[:3, 3] = x, y, z
    return T


def simulated(name, T, tmp_path, *, world="office", seconds=25.0, stated=None, wheels_scale=1.0, **options):
    """A drive with the lidar mounted as it is; /tf_static says ``stated``, or there is none."""
    drive = plan(world, duration_s=seconds, **options)
    motion = replace(drive.motion, vehicle=replace(drive.motion.vehicle, T_base_lidar=T))
    drive = replace(drive, motion=motion, T_base_lidar=T if stated is None else stated)
    path = made.recorded(f"{world}_{name}", lambda draft: record(drive, draft))
    if stated is not None:
        return path
    said = [
        Said(channel.topic, schema.name, message.log_time, message.data)
        for schema, channel, message, _ in decoded(path)
        if channel.topic != "/tf_static"
    ]
    return write(tmp_path / f"{name}.mcap", said, chunk_size=1 << 20)


def run(path, tmp_path, **options):
    done = scanchain.run(path, tmp_path / "run", recording=False, **options)
    return done, done.summary


@pytest.mark.parametrize(
    ("yaw_deg", "x", "y", "place"), [(37, 0.4, -0.2, "0.40 m ahead"), (180, -0.05, 0.0, "0.0")]
)
def test_the_wheels_say_how_a_lidar_without_transform_is_mounted(tmp_path, yaw_deg, x, y, place):
    done, text = run(simulated(f"at{yaw_deg}", mounted(yaw_deg, x, y), tmp_path), tmp_path)
    says(
        text, f"mounting estimated from the wheels: lidar turned by {yaw_deg}.", place, "the log has no transform"
    )
    assert done.accuracy.ate_rmse_m < 0.02 and done.metrics.verdict == "trustworthy", text
    assert "disagree" not in text and "against" not in text


@pytest.mark.slow
def test_in_space_they_say_it_too(tmp_path):
    path = simulated("at90", mounted(90, 0.5, z=1.7), tmp_path, world="town", seconds=15.0, sensor="vlp-16")
    done, text = run(path, tmp_path, loops__enabled=False)
    says(text, "lidar turned by 90.", "m ahead of the base")
    assert done.accuracy.ate_rmse_m < 0.03, text


@pytest.mark.slow
def test_a_transform_that_the_motions_contradict_is_named_and_one_that_they_confirm_is_not(tmp_path):
    wrong = simulated("wrong", mounted(180, 0.2), tmp_path, stated=mounted(0, 0.2))
    text = unfolded(run(wrong, tmp_path)[1])
    says(
        text,
        "lidar at x 0.20, y 0.00 m of the base",
        "contradict the assumed mounting: lidar turned by 180.",
    )
    assert re.search(r"deg, 0\.(19|20|21) m ahead of the base", text), text
    assert "disagree" not in text
    right = simulated("right", mounted(90, 0.2), tmp_path, stated=mounted(90, 0.2))
    _, text = run(right, tmp_path, force=True)
    assert "contradict the mounting" not in text and "estimated" not in text


def test_a_lidar_upside_down_is_named_with_the_flag_that_mirrors_its_scans(tmp_path):
    path = simulated("over", mounted(20, 0.2, roll_deg=180.0), tmp_path)
    _, text = run(path, tmp_path)
    says(text, "the lidar turns left where they turn right", "--log.upside_down true")
    done, text = run(path, tmp_path, log__upside_down=True, force=True)
    says(text, "lidar turned by 20.", "0.20 m ahead of the base")
    assert done.accuracy.ate_rmse_m < 0.02 and done.metrics.verdict == "trustworthy", text


def test_a_mounting_that_nothing_shows_is_called_assumed(tmp_path, capfd):
    path = simulated("at37", mounted(37, 0.4, -0.2), tmp_path)
    _, text = run(path, tmp_path, log__end_s=0.5)
    says(text, "mounting assumed", ASSUMED)
    assert scanchain.__main__.main(["info", str(path)]) == 0
    says(
        capfd.readouterr().out,
        "mounting  assumed at the robot's origin: no transform states it; a run estimates it",
    )


def test_a_drive_straight_on_leaves_the_place_open(tmp_path):
    path = simulated("ahead", mounted(90, 0.3), tmp_path, world="corridor", seconds=12.0)
    _, text = run(path, tmp_path, loops__enabled=False)
    says(text, "lidar turned by ", "its position is not observable: the log hardly turns")


def test_an_interrupted_estimate_goes_on_to_the_bit(tmp_path):
    log = open_log(simulated("at37", mounted(37, 0.4, -0.2), tmp_path))
    scans, config = list(log.scans())[:120], configured(2, {"loops.enabled": False})
    whole = Slam(config, log.stated_mounting, dimension=2)
    poses = [whole.process(scan).T_odom_lidar for scan in scans]
    slam = Slam(config, log.stated_mounting, tmp_path / POINTS_FILE, dimension=2)
    for stop in (3, 40, 77):
        for scan in scans[slam.front_end.scans : stop]:
            np.testing.assert_array_equal(slam.process(scan).T_odom_lidar, poses[scan.index])
        Checkpoints(tmp_path, 10.0).write(slam)
        slam.points.close()
        slam = read_checkpoint(tmp_path, config).slam
        slam.points.reopen(tmp_path / POINTS_FILE)
    for scan in scans[77:]:
        np.testing.assert_array_equal(slam.process(scan).T_odom_lidar, poses[scan.index])
    np.testing.assert_array_equal(slam.finish().T_base_lidar, whole.finish().T_base_lidar)


def test_wheels_of_a_real_robot_say_that_its_lidar_is_turned(tmp_path):
    path = shared_data("reports/rplidar_turned.bag")
    done, text = run(path, tmp_path, log__point_times="azimuth")
    says(text, "mounting estimated from the wheels: lidar turned by 18", "0.05 m behind the base")
    assert "mounting is wrong" not in text and "disagree" not in text
    assert done.metrics.verdict == "trustworthy"
    done, text = run(path, tmp_path, force=True)  # its driver mirrors the order of the beams, not their times
    says(text, "mounting estimated from the wheels: lidar turned by 18", "scans fit better with the opposite")
    assert done.metrics.verdict == "check these segments"
