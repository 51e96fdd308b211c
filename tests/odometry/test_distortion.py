"""Distortion of scans: measured on the log itself, removed where times by azimuth clearly explain it."""

from dataclasses import replace

import numpy as np
import pytest

import scanchain
from scanchain.__main__ import main
from scanchain.logs import open_log
from scanchain.logs.messages import point_times
from scanchain.odometry.distortion import Distortion, choose_point_times, measure_distortion
from scanchain.runs.judging import judge_run
from scanchain.simulation.drive import plan, record
from tests.support import made
from tests.support.scenes import shared_data

SECONDS = 10


@pytest.fixture
def no_time_fields(monkeypatch):
    """Clouds are read as if they had no field of times."""
    monkeypatch.setattr(point_times.PointTimes, "fields", lambda self, names: [])


def at_once():
    """The town by a lidar that takes each scan at one instant."""
    drive = plan("town", sensor="os1-32", duration_s=float(SECONDS))
    rays = drive.sensor.rays(0)
    rays = replace(rays, instants_ns=np.zeros_like(rays.instants_ns))
    drive = replace(drive, sensor=replace(drive.sensor, rays=lambda index: rays))
    return made.recorded("town-at-once", lambda path: record(drive, path, force=True))


def chosen(path, **options):
    log = open_log(path, **options)
    choose_point_times(log)
    return log, next(iter(log.scans())), log.config


@pytest.mark.parametrize(("world", "sensor"), [("town", "os1-32"), ("forest", "vlp-16")])
def test_clouds_without_times_are_timed_by_the_azimuth_that_explains_them(world, sensor, no_time_fields):
    path = made.log(world, seconds=SECONDS, sensor=sensor)
    log, scan, config = chosen(path)
    assert (config.point_times, config.revolution_s) == ("clockwise", 0.1)
    assert np.isclose(abs(config.revolution_start_rad), np.pi, atol=0.02)
    assert np.isclose(np.ptp(scan.times_s), 0.1, atol=0.001) and not log.distortion
    list(log.scans())
    assert any("clockwise" in note and "residuals are" in note for note in log.notes)


def test_a_run_is_as_good_by_azimuth_as_by_the_times_that_are_missing(tmp_path, no_time_fields):
    path = made.log("town", seconds=SECONDS, sensor="vlp-16")
    ates = [
        scanchain.run(path, tmp_path / choice, recording=False, log__point_times=choice).accuracy.ate_rmse_m
        for choice in ("none", "auto")
    ]
    assert ates[1] < 0.02 < 0.1 < ates[0]


def test_scans_that_were_measured_at_once_stay_without_times(no_time_fields):
    log, scan, config = chosen(at_once())
    assert config.point_times == "auto" and not len(scan.times_s) and not log.distortion
    list(log.scans())
    assert len([note for note in log.notes if "no point times" in note]) == 1
    assert any("show no distortion" in note for note in log.notes)


@pytest.mark.parametrize("name", ["kitti_0001_first54", "kitti_0005_first60"])
def test_the_clouds_of_kitti_are_recognized_as_deskewed(name):
    log, scan, config = chosen(shared_data(f"3d/{name}.mcap"))
    assert config.point_times == "auto" and not len(scan.times_s) and not log.distortion


def test_times_that_are_ignored_are_named_with_the_distortion_and_the_flag():
    log, scan, config = chosen(made.log("town", seconds=SECONDS, sensor="os1-32"), point_times="none")
    assert config.point_times == "none" and not len(scan.times_s)
    assert "distorted by up to" in log.distortion and "--log.point_times auto" in log.distortion


def test_a_run_whose_scans_remain_distorted_is_to_be_checked_and_so_says_its_directory(tmp_path):
    log = made.log("town", seconds=SECONDS, sensor="os1-32")
    done = scanchain.run(log, tmp_path / "run", recording=False, log__point_times="none")
    assert done.metrics.verdict == "check these segments" and "distorted by up to" in done.metrics.verdict_reason
    assert judge_run(tmp_path / "run").sentence == done.metrics.sentence


def test_a_log_with_times_is_not_measured_before_a_run(monkeypatch):
    log = open_log(made.log("town", seconds=SECONDS, sensor="os1-32"))
    monkeypatch.setattr("scanchain.odometry.distortion.Odometry", None)
    choose_point_times(log)
    assert log.config.point_times == "auto"


def test_the_measured_times_of_a_log_explain_its_scans_and_reversed_ones_do_not():
    path = shared_data("3d/pandaset_002_sweeps30to55.mcap")
    found = measure_distortion(open_log(path, topic="/pandar64/points"))
    assert (
        found is not None and found.is_given and found.is_shown and found.gain > 0.01 and found.loss > found.gain
    )
    by_azimuth = measure_distortion(open_log(path, topic="/pandar64/points", point_times="none"))
    assert by_azimuth is not None and by_azimuth.is_shown and by_azimuth.config.point_times == "clockwise"
    assert np.isclose(by_azimuth.config.revolution_start_rad, -1.54, atol=0.05)


@pytest.mark.parametrize("sensor", ["lms-270", "utm-30"])
def test_scans_that_do_not_determine_their_motion_tell_nothing_of_its_times(sensor):
    """Two of these logs seemed to fit better without their times, or had no finite residual."""
    found = measure_distortion(open_log(made.log("field", seconds=40, sensor=sensor, seed=2)))
    assert found.size_m > 0.1
    assert (found.gain, found.loss, found.sigmas) == (0.0, 0.0, 0.0) and "were not compared" in found.changes


def test_a_lidar_that_does_not_spin_is_not_timed_by_azimuth(no_time_fields):
    log, _, config = chosen(made.log("town", seconds=SECONDS, sensor="rosette"))
    assert config.point_times == "auto" and "may be distorted" in log.distortion


def test_times_by_azimuth_are_not_adopted_where_opposite_ones_explain_the_scans_as_well_whether_or_not_it_spins():
    config = open_log(made.log("town", seconds=SECONDS, sensor="os1-32")).config
    for loss in (-0.1, 0.0, 0.3, 0.7):
        spinning, rosette = (
            Distortion(0.1, "at 1 m/s", config, False, gain=0.1, loss=loss, sigmas=9.0, is_spinning=spins)
            for spins in (True, False)
        )
        assert spinning.is_shown == rosette.is_shown == (loss == 0.3) and rosette.share == 1.0


@pytest.mark.parametrize(
    ("gain", "said"), [(0.1, "which point times remove"), (-0.1, "residuals do not refute them")]
)
def test_times_of_a_log_are_said_to_remove_distortion_only_if_residuals_are_smaller_with_them(gain, said):
    log = open_log(made.log("office", seconds=SECONDS))
    found = Distortion(0.1, "at 1 m/s", log.config, True, gain=gain, loss=0.2, sigmas=1.0, is_spinning=False)
    words, remedy = found.advice(log)
    assert words.endswith(said) and not remedy


@pytest.mark.parametrize(("loss", "flag"), [(-0.13, "azimuth"), (0.05, "none")])
def test_times_that_are_worse_than_none_are_replaced_by_the_azimuth_where_the_opposite_ones_are_better(loss, flag):
    log = open_log(made.log("office", seconds=SECONDS))
    found = Distortion(0.1, "at 1 m/s", log.config, True, gain=-0.15, loss=loss, sigmas=-9.0, is_spinning=False)
    assert found.advice(log)[1] == f"--log.point_times {flag}"


def test_scans_that_a_run_does_not_deskew_count_as_distorted_as_far_as_they_are():
    town = made.log("town", seconds=SECONDS, sensor="os1-32")
    shares = []
    for deskew in (True, False):
        log = open_log(town)
        choose_point_times(log, deskew=deskew)
        shares.append(log.distorted_share)
    assert shares[0] == 0.0 and 0.7 < shares[1] <= 1.0
    planar = open_log(made.log("office", seconds=SECONDS))
    choose_point_times(planar, deskew=False)
    assert planar.distorted_share == 1.0


def test_azimuth_is_taken_where_it_is_asked_for_in_the_better_sense():
    _, scan, config = chosen(made.log("office", seconds=SECONDS), point_times="azimuth")
    assert config.point_times == "counterclockwise" and len(scan.times_s)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_planar_scans_whose_beams_are_timed_the_wrong_way_round_are_to_be_checked(monkeypatch, sign):
    """RPLidar's driver mirrors the order of the beams, but not their times."""
    seconds = point_times.Beams.seconds
    monkeypatch.setattr(point_times.Beams, "seconds", lambda self, step_s: seconds(self, sign * step_s))
    log, _, _ = chosen(shared_data("reports/rplidar_turned.bag"))
    assert ("opposite of their point times" in log.distortion) == (log.distorted_share > 1.0) == (sign > 0.0)
    assert ("try --log.point_times azimuth" in log.distortion) == (sign > 0.0)


def test_a_lidar_that_stands_is_not_called_distorted(no_time_fields):
    log, _, config = chosen(made.log("hall", seconds=SECONDS, sensor="os1-32"), end_s=1.7)
    assert config.point_times == "auto" and not log.distortion


def test_the_verdict_and_the_doctor_name_distorted_scans(tmp_path, capfd):
    path = made.log("town", seconds=SECONDS, sensor="vlp-16")
    main(["run", str(path), "--out", str(tmp_path / "out"), "--rerun", "off", "--log.point_times", "none"])
    assert "scans are distorted by up to" in capfd.readouterr().out
    main(["doctor", str(path), "--log.point_times", "none"])
    said = capfd.readouterr().out
    assert "scans are distorted by up to" in said and "--log.point_times auto" in said
