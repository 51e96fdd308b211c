"""evalio both ways: its sequences are logs, scanchain is a pipeline of it, and its trajectory files are read."""

import importlib.util
import json
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

import scanchain as sc
from scanchain import lie
from scanchain.__main__ import main
from scanchain.errors import InputError
from scanchain.evaluation import absolute_error, pair
from scanchain.logs import open_log
from scanchain.trajectory import read_tum
from tests.support import made
from tests.support.messages import says
from tests.support.scenes import ROOT

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("evalio") is None,
    reason="evalio is not installed: pip install 'scanchain[evalio]'",
)
SEQUENCE = "evalio:sim_town/drive"


@pytest.fixture(scope="module")
def town():
    """Four seconds of a simulated car with an IMU."""
    return made.log("town", seconds=4, sensor="vlp-16", imu="mems")


@pytest.fixture
def registered(town, monkeypatch):
    """The data set of evalio over the log, in this process and in those that it starts."""
    monkeypatch.setenv("SIM_TOWN", str(town))
    monkeypatch.setenv("EVALIO_CUSTOM", "evalio_sequences")
    monkeypatch.setenv("PYTHONPATH", f"{ROOT / 'tests' / 'support'}:{ROOT}", prepend=":")
    monkeypatch.syspath_prepend(ROOT / "tests" / "support")
    from evalio.datasets import register_dataset

    register_dataset(module="evalio_sequences")


def test_a_sequence_is_a_log_with_its_imu_and_truth(town, registered):
    log, original = open_log(SEQUENCE), open_log(town)
    scans, of_original = list(log.scans()), list(original.scans())
    assert len(scans) == len(of_original) == log.scan_count
    for scan, recorded in zip(scans, of_original, strict=True):
        assert scan.stamp_ns == recorded.stamp_ns
        np.testing.assert_array_equal(scan.points, recorded.points[::8])
        np.testing.assert_allclose(scan.times_s, recorded.times_s[::8], atol=1e-7)
    T = original.imu.T_lidar_sensor
    np.testing.assert_allclose(log.imu.T_lidar_sensor, T, atol=1e-6)
    np.testing.assert_allclose(log.T_base_lidar, lie.inverse(T), atol=1e-6)
    truth, of_truth = log.ground_truth(), original.ground_truth()
    np.testing.assert_array_equal(truth.stamps_ns, of_truth.stamps_ns)
    np.testing.assert_allclose(truth.poses, of_truth.poses, atol=1e-6)


def test_a_run_of_a_sequence_names_it(registered, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    sc.run(SEQUENCE, tmp_path / "run", recording=False)
    (log,) = json.loads((tmp_path / "run" / "run.json").read_text())["logs"]
    assert log["path"].endswith(SEQUENCE) and log["sha256"]
    main(["info", SEQUENCE])
    assert "/ground_truth" in capsys.readouterr().out


def test_a_sequence_that_is_unknown_or_absent_is_refused_with_the_command_that_gets_it(registered, monkeypatch):
    with pytest.raises(InputError) as error:
        open_log("evalio:hilti_2022/basement_2")
    says(error.value.text, "evalio:hilti_2022/basement_2: is not in", "evalio dl hilti_2022/basement_2")
    with pytest.raises(InputError, match=r"no such sequence; evalio ls datasets lists them, as of sim_town/drive"):
        open_log("evalio:sim_town/drove")
    monkeypatch.setitem(sys.modules, "evalio.datasets", None)
    with pytest.raises(InputError, match=r"pip install 'scanchain\[evalio\]'"):
        open_log(SEQUENCE)


@pytest.fixture
def ran(registered, tmp_path):
    """The folder of results that evalio's command line writes with scanchain as its pipeline."""
    command = [sys.executable, "-m", "scanchain.evalio", "run", "-d", "sim_town/drive", "-p", "scanchain"]
    done = subprocess.run([*command, "-o", str(tmp_path)], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    return tmp_path / "sim_town" / "drive"


def test_evalio_runs_scanchain_and_its_files_are_read(ran, capsys):
    trajectory, truth = read_tum(ran / "scanchain.csv"), read_tum(ran / "gt.csv")
    assert len(trajectory) == len(truth) == 40
    assert absolute_error(pair(trajectory, truth)).translation_m.rmse < 0.05
    assert "local_map.voxel_size_m: 1.0" in (ran / "scanchain.csv").read_text()
    main(["evaluate", str(ran / "scanchain.csv"), str(ran / "gt.csv")])
    assert "paired 40 of 40 estimated poses" in capsys.readouterr().out


def test_a_scan_waits_for_the_imu_and_parameters_are_keys_of_the_configuration(registered):
    from evalio.datasets import get_sequence
    from evalio.types import LidarMeasurement, Stamp

    from scanchain.evalio import ScanchainPipeline

    pipeline = ScanchainPipeline()
    assert pipeline.set_params({"local_map.voxel_size_m": 0.8, "voxel_size": 1.0}) == {"voxel_size": 1.0}
    sequence = get_sequence("sim_town/drive")
    pipeline.set_lidar_params(sequence.lidar_params())
    pipeline.set_imu_T_lidar(sequence.imu_T_lidar())
    pipeline.initialize()
    assert pipeline.slam.config.local_map.voxel_size_m == 0.8
    saved = []
    measurements = list(sequence)
    measurements.sort(key=lambda each: each.stamp.to_nsec())  # samples of a sweep come after its scan
    for measurement in measurements:
        if isinstance(measurement, LidarMeasurement):
            pipeline.add_lidar(LidarMeasurement(Stamp(measurement.stamp), measurement.points))
        else:
            pipeline.add_imu(measurement)
        saved += [stamp.to_nsec() for stamp, _ in pipeline.saved_estimates()]
    scans = [each.stamp.to_nsec() for each in measurements if isinstance(each, LidarMeasurement)]
    assert saved == scans[: len(saved)] and len(saved) >= len(scans) - 1


def test_every_scan_has_its_imu_where_a_sample_falls_on_the_end_of_a_sweep(monkeypatch):
    """Scans at 10 Hz, whose last point has the stamp of the next scan, and samples at 200 Hz."""
    from evalio.types import Duration, ImuMeasurement, LidarMeasurement, Point, Stamp

    from scanchain.evalio import ScanchainPipeline

    pipeline, given = ScanchainPipeline(), []
    pipeline.initialize()

    def process(scan):
        given.append(None if scan.inertial is None else scan.inertial.stamps_ns)
        return SimpleNamespace(T_odom_lidar=np.eye(4))

    monkeypatch.setattr(pipeline.slam, "process", process)
    points = [Point(x=1.0 + k, y=1.0, z=1.0, t=Duration.from_nsec(10_000_000 * k)) for k in range(11)]
    for stamp_ns in range(0, 450_000_000, 5_000_000):
        stamp = Stamp.from_nsec(stamp_ns)
        pipeline.add_imu(ImuMeasurement(stamp, np.zeros(3), np.zeros(3)))
        if stamp_ns % 100_000_000 == 0:
            pipeline.add_lidar(LidarMeasurement(stamp, points))
    assert len(given) == 4
    np.testing.assert_array_equal(np.concatenate(given), np.arange(0, 405_000_000, 5_000_000))
    assert all(each[-1] >= 100_000_000 * (k + 1) for k, each in enumerate(given))
    before = len(pipeline.samples)
    pipeline.add_imu(ImuMeasurement(Stamp.from_nsec(5_000_000), np.zeros(3), np.zeros(3)))  # late: left out
    assert len(pipeline.samples) == before
