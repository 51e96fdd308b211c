from dataclasses import replace

import numpy as np
import pytest

from scanchain.errors import InputError
from scanchain.landmarks.files import read_landmark_data, read_mrclam
from scanchain.landmarks.ranges import OdometryNoise, solve_range_log
from scanchain.landmarks.study import Options, accuracy_lines, study_file, study_log
from tests.support.scenes import shared_data


@pytest.fixture
def arrays():
    """A problem of three poses and two landmarks that fits its truth."""
    poses, landmarks = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 1.0]]), np.array([[1.0, 3.0], [4.0, 2.0]])
    pairs = [(0, 0), (0, 1), (1, 0), (2, 1)]
    return {
        "gt_traj": poses,
        "gt_landmarks": landmarks,
        "odom": np.diff(poses, axis=0),
        "observations": np.array([[i, j, *(landmarks[j] - poses[i])] for i, j in pairs]),
        "sigma_odom": 0.01 * np.eye(2),
        "sigma_landmark": 0.04 * np.eye(2),
    }


ALONE = Options(("schur",), 1, (1,), None, "odometry", "levenberg-marquardt")


def written(tmp_path, arrays):
    path = tmp_path / "problem.npz"
    np.savez(path, **arrays)
    return path


@pytest.mark.parametrize("missing", [(), ("gt_traj", "gt_landmarks"), ("gt_traj",), ("gt_landmarks",)])
@pytest.mark.parametrize("kind", ["linear", "bearing-range"])
def test_the_kind_of_observation_is_found_and_the_estimate_stands_with_and_without_the_truth(
    tmp_path, arrays, missing, kind
):
    true_poses, true_landmarks = arrays["gt_traj"], arrays["gt_landmarks"]
    arrays["observations"] = np.vstack([arrays["observations"], [1.0, 1.0, 3.0, 2.0]])
    x, y = arrays["observations"][:, 2:].T
    if kind == "bearing-range":
        arrays["observations"][:, 2:] = np.stack([np.arctan2(y, x), np.hypot(x, y)], axis=1)
    for name in missing:
        del arrays[name]
    data = read_landmark_data(written(tmp_path, arrays))
    study = study_file(data, ALONE)
    assert data.kind == kind and study.converged
    np.testing.assert_allclose(study.after.state.poses, true_poses, atol=1e-6)
    np.testing.assert_allclose(study.after.state.landmarks, true_landmarks, atol=1e-6)
    (_, after), _ = accuracy_lines(study)[1:]
    assert after.count("unknown") == bool(missing)
    assert np.isnan(study.after.poses_m) == ("gt_traj" in missing)


def without(*names):
    return lambda arrays: [arrays.pop(name) for name in names]


def seen_once_without_truth(arrays):
    without("gt_traj", "gt_landmarks")(arrays)
    arrays["observations"] = arrays["observations"][:2]


def setting(name, value):
    return lambda arrays: arrays.__setitem__(name, value)


def changing(name, place, value):
    return lambda arrays: arrays[name].__setitem__(place, value)


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (without("odom"), "has no array odom"),
        (setting("odom", np.zeros((5, 2))), "odom has 5 steps between 3 poses"),
        (setting("gt_traj", np.zeros((3, 3))), r"gt_traj has shape \(3, 3\)"),
        (setting("sigma_odom", np.zeros((3, 2))), r"sigma_odom has shape \(3, 2\)"),
        (setting("sigma_odom", -np.eye(2)), "sigma_odom is no covariance"),
        (setting("sigma_landmark", np.array([[1.0, 0.5], [0.0, 1.0]])), "sigma_landmark is no covariance"),
        (setting("observations", np.zeros((0, 4))), "observations is empty"),
        (setting("gt_landmarks", np.array([["a", "b"]])), "gt_landmarks holds <U1"),
        (setting("odom", np.array([[{}, {}]] * 2)), "holds pickled objects"),
        (changing("odom", (1, 0), np.nan), r"odom\[1, 0\] is nan"),
        (changing("observations", (2, 1), 7.0), r"observations\[2\] is of landmark 7; .* 0 to 1"),
        (changing("observations", (2, 0), 0.5), r"observations\[2\] is of pose 0.5"),
        (changing("observations", (3, 0), -1.0), r"observations\[3\] is of pose -1"),
        (setting("gt_landmarks", np.zeros((5, 2))), "3 of 5 landmarks are not observed, the first is 2; add obs"),
        (seen_once_without_truth, "no landmark is observed twice and there is no gt_landmarks"),
    ],
)
def test_every_damage_of_a_problem_is_one_line(tmp_path, arrays, damage, said):
    damage(arrays)
    with pytest.raises(InputError, match=said) as raised:
        read_landmark_data(written(tmp_path, arrays))
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("content", "said"),
    [(b"", "is no npz of plain arrays"), (b"\x93NUMPY", "is no npz of plain arrays"),
     (b"PK\x03\x04 broken", "is no npz of plain arrays"), (None, "cannot be read")],
)  # fmt: skip
def test_what_is_no_npz_or_cut_off_is_refused(tmp_path, arrays, content, said):
    path = written(tmp_path, arrays)
    whole = path.read_bytes()
    for share in (0.2, 0.5, 0.9):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(InputError, match=r"problem\.npz: "):
            read_landmark_data(path)
    path.unlink() if content is None else path.write_bytes(content)
    with pytest.raises(InputError, match=rf"problem\.npz: {said}"):
        read_landmark_data(path)


@pytest.fixture
def folder(tmp_path):
    """An MRCLAM folder with landmarks 6 and 7, robot 2 seen once, and a barcode that nobody has."""
    place = tmp_path / "mrclam"
    place.mkdir()
    (place / "Barcodes.dat").write_text("# subject barcode\n1 5\n2 14\n6 63\n7 81\n")
    (place / "Landmark_Groundtruth.dat").write_text("6 1.0 2.0 0.001 0.001\n7 2.0 0.5 0.001 0.001\n")
    (place / "Robot1_Odometry.dat").write_text("".join(f"{10 + 0.1 * k:.1f} 0.5 0.0\n" for k in range(50)))
    (place / "Robot1_Groundtruth.dat").write_text(
        "".join(f"{10 + 0.1 * k:.1f} {0.05 * k:.2f} 0.0 0.0\n" for k in range(51))
    )
    rows = ["9.0 63 2.0 1.0", "11.0 14 1.0 0.0", "11.5 99 1.0 0.0"]
    for time in (12.0, 11.0, 13.0, 14.0):  # not in order
        for code, (x, y) in ((63, (1.0, 2.0)), (81, (2.0, 0.5))):
            away = np.array([x - 0.5 * (time - 10.0), y])
            rows.append(f"{time} {code} {np.hypot(*away):.3f} {np.arctan2(away[1], away[0]):.3f}")
    (place / "Robot1_Measurement.dat").write_text("\n".join(rows))
    return place


def test_an_exact_drive_is_found_and_what_is_not_its_own_is_counted(folder):
    log, after = read_mrclam(folder, 1), study_log(folder, ALONE).after
    assert (log.of_robots, log.unknown, log.outside) == (1, 1, 1)
    assert len(log.seen_s) == 8 and np.all(np.diff(log.seen_s) >= 0.0)
    assert set(log.subjects.tolist()) == {6, 7}
    assert after.poses_m < 0.01 and after.landmarks_m < 0.01
    (folder / "Robot1_Groundtruth.dat").unlink()
    study = study_log(folder, ALONE)
    assert np.isnan(study.after.poses_m) and study.converged


@pytest.mark.parametrize(
    ("file", "text", "said"),
    [
        ("Robot1_Odometry.dat", "1.0 2.0\n", "does not have 3 numbers per line"),
        ("Robot1_Odometry.dat", "1.0 2.0 x\n", "is no table of 3 numbers"),
        ("Robot1_Odometry.dat", "# time forward turn\n \n", "is empty"),
        ("Robot1_Odometry.dat", None, "one of those logged there: none"),
        ("Barcodes.dat", None, "is no MRCLAM folder"),
        ("Robot1_Measurement.dat", "1.0 63 nan 0.0\n", "row 1 is not finite"),
        ("Robot1_Measurement.dat", "11.0 14 1.0 0.0\n", "robot 1 saw no landmark"),
        ("Robot1_Measurement.dat", "11.0 63 2.06 1.3\n", "too seldom"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_every_damage_of_a_folder_is_one_line(folder, file, text, said):
    (folder / file).unlink() if text is None else (folder / file).write_text(text)
    with pytest.raises(InputError, match=said) as raised:
        solve_range_log(read_mrclam(folder, 1), None)
    assert "\n" not in str(raised.value)


def test_utias_6_robot_1_is_as_accurate_as_a_batch_in_gtsam_or_better_and_noise_that_is_stated_too_small_is_told():
    folder = shared_data("landmarks/utias_mrclam6")
    study = study_log(folder, ALONE)
    assert study.before.poses_m == pytest.approx(2.06, abs=0.01)
    assert study.after.poses_m <= 0.113
    assert study.facts["left out"].startswith("407 of other robots, 1 of unknown barcodes, 0 ")
    assert study.facts["odometry noise"].endswith("fits") and study.facts["sensor noise"].endswith("fits")
    stated = study_log(folder, replace(ALONE, noise=OdometryNoise(0.003, 0.001, 0.005, 0.01)))
    assert "off by a factor" in stated.facts["odometry noise"]
