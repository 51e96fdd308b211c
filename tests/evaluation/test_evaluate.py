"""Trajectory metrics: equal to their slow twins and to evo on the same pairs."""

import bz2
import re

import numpy as np
import pytest

from scanchain import evaluation as ev
from scanchain import lie
from scanchain.data import Trajectory
from scanchain.errors import InputError
from scanchain.evaluation.metrics import evaluate
from scanchain.evaluation.pairing import nearest
from scanchain.logs import open_log
from scanchain.odometry import Odometry
from scanchain.settings import Override, load_settings
from scanchain.trajectory import parse_stamp_ns, read_tum, write_kitti
from tests.support import naive_evaluate as naive
from tests.support.scenes import configured, kitti_scans, shared_data


def drive(count=300, seed=1, step_m=1.0):
    """A winding course, SE(3), ten poses a second."""
    random = np.random.default_rng(seed)
    steps = lie.exp(random.normal([step_m, 0, 0, 0, 0, 0], [0.1, 0.05, 0.05, 0.01, 0.01, 0.05], (count, 6)))
    poses = np.empty((count, 4, 4))
    poses[0] = lie.exp(random.normal(size=6))
    for k in range(1, count):
        poses[k] = poses[k - 1] @ steps[k]
    return Trajectory(np.arange(count, dtype=np.int64) * 100_000_000 + 10**18, poses)


def disturbed(trajectory, seed=2, sigma_m=0.1):
    """The same course in another frame, with noise on every pose."""
    random = np.random.default_rng(seed)
    noise = lie.exp(random.normal(scale=[sigma_m] * 3 + [0.02] * 3, size=(len(trajectory), 6)))
    frame = lie.exp(np.array([3.0, -2.0, 1.0, 0.3, -0.2, 2.0]))
    return Trajectory(trajectory.stamps_ns, frame @ trajectory.poses @ noise)


@pytest.fixture(scope="module")
def pairs():
    return ev.pair(disturbed(drive()), drive())


def evo_trajectories(pairs):
    trajectory = pytest.importorskip("evo.core.trajectory")
    stamps = pairs.stamps_ns / 1e9
    return (
        trajectory.PoseTrajectory3D(poses_se3=list(pairs.reference), timestamps=stamps),
        trajectory.PoseTrajectory3D(poses_se3=list(pairs.estimate), timestamps=stamps),
    )


@pytest.fixture(scope="module")
def published():
    """A real drive: the positions of a GPS/INS and what our odometry makes of the first 30 sweeps."""
    odometry = Odometry(configured(3), np.eye(4))
    scans = kitti_scans(30)
    poses = np.array([odometry.process(scan).T_odom_lidar for scan in scans])
    estimate = Trajectory(np.array([scan.stamp_ns for scan in scans]), poses)
    return ev.pair(estimate, read_tum(shared_data("3d/kitti_0001_first54.tum")))


@pytest.fixture(params=["pairs", "published"])
def each(request):
    """Made-up pairs and those of a real drive."""
    return request.getfixturevalue(request.param)


@pytest.mark.parametrize("alignment", list(ev.Alignment))
def test_ate_equals_evo(each, alignment):
    metrics = pytest.importorskip("evo.core.metrics")
    reference, estimate = evo_trajectories(each)
    if alignment is ev.Alignment.RIGID:
        estimate.align(reference)
    if alignment is ev.Alignment.FIRST:
        estimate.align_origin(reference)
    ours = ev.absolute_error(each, alignment)
    compared = [(metrics.PoseRelation.translation_part, ours.errors_m, ours.translation_m)]
    if alignment is not ev.Alignment.RIGID:  # evo lets the positions turn the rotations as well
        compared.append((metrics.PoseRelation.rotation_angle_rad, ours.errors_rad, ours.rotation_rad))
    for relation, errors, statistics in compared:
        theirs = metrics.APE(relation)
        theirs.process_data((reference, estimate))
        np.testing.assert_allclose(errors, theirs.error, atol=1e-9)
        figures = theirs.get_all_statistics()
        names = {"minimum": "min", "maximum": "max"}
        for name in ("rmse", "mean", "median", "std", "minimum", "maximum"):
            assert getattr(statistics, name) == pytest.approx(figures[names.get(name, name)], abs=1e-9)


@pytest.mark.parametrize("frames", [1, 7])
def test_rpe_over_frames_equals_evo(each, frames):
    metrics = pytest.importorskip("evo.core.metrics")
    ours = ev.relative_error_over_frames(each, frames)
    for relation, errors in (
        (metrics.PoseRelation.translation_part, ours.errors_m),
        (metrics.PoseRelation.rotation_angle_rad, ours.errors_rad),
    ):
        theirs = metrics.RPE(relation, delta=frames, delta_unit=metrics.Unit.frames, all_pairs=True)
        theirs.process_data(evo_trajectories(each))
        np.testing.assert_allclose(errors, theirs.error, atol=1e-9)


@pytest.mark.parametrize("measure", [(ev.relative_error_over_distance, 10.0), (ev.relative_error_over_time, 1.0)])
def test_rpe_over_distance_and_time_equals_evo_on_the_same_stretches(each, measure):
    metrics, lie_algebra = (pytest.importorskip(f"evo.core.{name}") for name in ("metrics", "lie_algebra"))
    ours = measure[0](each, measure[1])
    assert len(ours.segments) > 15
    theirs = [
        metrics.RPE.rpe_base(each.reference[i], each.reference[j], each.estimate[i], each.estimate[j])
        for i, j in ours.segments
    ]
    np.testing.assert_allclose(ours.errors_m, [np.linalg.norm(error[:3, 3]) for error in theirs], atol=1e-9)
    turns = [lie_algebra.so3_log_angle(error[:3, :3]) for error in theirs]
    np.testing.assert_allclose(ours.errors_rad, turns, atol=1e-9)


def test_where_the_rest_is_straight_the_start_alone_has_no_error_of_the_rest():
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, :3, 3] = np.arange(6)[:, None] * [1.0, 0.0, 0.1]
    poses[0, :3, 3] = 0.0, 1.0, 1.0
    line = Trajectory(np.arange(6) * 10**9, poses)
    found = evaluate(line, line)
    assert found.ate.translation_m.rmse < 1e-9 and found.start_m == 0.0 and found.after_start is None


def test_stretches_end_at_the_first_pose_far_or_late_enough(pairs):
    path = naive.traveled(pairs.reference)
    segments = ev.relative_error_over_distance(pairs, 20.0).segments
    assert len(segments) > 10
    for i, j in segments:
        assert path[j] - path[i] >= 20.0 - 1e-9 > path[j - 1] - path[i] - 2e-9
    segments = ev.relative_error_over_time(pairs, 0.95).segments
    np.testing.assert_array_equal(segments[:, 1] - segments[:, 0], 10)
    assert len(segments) == len(pairs) - 10


@pytest.mark.parametrize("every", [1, 10])
def test_kitti_metric_equals_naive(each, every):
    lengths_m = (10.0, 20.0, 100.0)
    ours = ev.kitti_error(each, lengths_m, every=every)
    shares, turns = naive.kitti(each.reference, each.estimate, lengths_m, every)
    assert ours.segments == len(shares) == sum(part.segments for part in ours.by_length)
    assert ours.translation_share == pytest.approx(np.mean(shares), abs=1e-12)
    assert ours.rotation_rad_per_m == pytest.approx(np.mean(turns), abs=1e-9)


def test_the_rotation_error_of_a_straight_course_does_not_depend_on_its_roll():
    reference = np.tile(np.eye(4), (50, 1, 1))
    reference[:, 0, 3] = np.linspace(0.0, 60.0, 50)
    reference[:, 1, 3] = np.random.default_rng(1).normal(scale=0.01, size=50)
    estimate = lie.exp(np.array([0.3, -0.2, 0.1, 0.4, 0.2, -0.1])) @ reference
    estimate[:, :3, 3] += np.random.default_rng(0).normal(scale=0.02, size=(50, 3))
    stamps_ns = np.arange(50, dtype=np.int64) * 10**8
    error = ev.absolute_error(ev.pair(Trajectory(stamps_ns, estimate), Trajectory(stamps_ns, reference)))
    assert error.rotation_rad.maximum < 1e-7
    assert 0.01 < error.translation_m.rmse < 0.04


def test_short_paths_are_judged_over_short_lengths(pairs):
    short = ev.pair(disturbed(drive(65)), drive(65))
    assert ev.kitti_error_of_any_path(short) == ev.kitti_error(short, (10.0, 20.0, 40.0), every=1)
    error = ev.kitti_error_of_any_path(pairs)
    assert error == ev.kitti_error(pairs)
    assert [part.length_m for part in error.by_length] == [100.0 * k for k in range(1, 9)]
    assert [part.segments > 0 for part in error.by_length] == [True, True] + [False] * 6
    assert [part.translation_share is not None for part in error.by_length] == [True, True] + [False] * 6


def scaled(trajectory, factor):
    poses = trajectory.poses.copy()
    poses[:, :3, 3] *= factor
    return Trajectory(trajectory.stamps_ns, poses)


def test_meters_or_centimeters_same_judgment(pairs):
    meters = ev.absolute_error(pairs)
    centimeters = ev.absolute_error(ev.pair(scaled(disturbed(drive()), 100.0), scaled(drive(), 100.0)))
    assert centimeters.translation_m.rmse == pytest.approx(100.0 * meters.translation_m.rmse)
    assert centimeters.rotation_rad.rmse == pytest.approx(meters.rotation_rad.rmse)
    assert centimeters.share_of_path == pytest.approx(meters.share_of_path)


def planar(xy, yaw=None):
    yaw = np.zeros(len(xy)) if yaw is None else yaw
    poses = np.array([lie.pose_2d(x, y, a) for (x, y), a in zip(xy, yaw, strict=True)])
    return Trajectory(np.arange(len(xy), dtype=np.int64) * 10**8, poses)


def test_a_mirrored_planar_course_is_not_met_by_turning_the_plane_over():
    xy = np.array([[0.0, 0], [1, 0.2], [2, 0], [3, -0.5], [4, 0.1]])
    error = ev.absolute_error(ev.pair(planar(xy * [1, -1]), planar(xy)))
    assert error.translation_m.rmse > 0.1
    assert error.T_reference_estimate[2, 2] == 1.0


def test_a_straight_course_aligns_in_the_plane_and_is_refused_in_space():
    xy = np.linspace([0.0, 0.0], [10.0, 5.0], 20)
    assert ev.absolute_error(ev.pair(planar(xy + np.array([1.0, 2.0])), planar(xy))).translation_m.rmse < 1e-12
    rolled = planar(xy)
    rolled = Trajectory(rolled.stamps_ns, lie.lift(rolled.poses) @ lie.exp(np.array([0, 0, 0, 0.1, 0, 0])))
    with pytest.raises(InputError, match="align by the first pose"):
        ev.absolute_error(ev.pair(rolled, rolled))


def test_nearest_equals_naive_with_repeated_and_unsorted_stamps():
    random = np.random.default_rng(5)
    stamps = random.integers(0, 60, 40)
    wanted = random.integers(-10, 70, 200)
    index, difference = nearest(wanted, stamps)
    assert index.tolist() == naive.nearest(wanted.tolist(), stamps.tolist())
    np.testing.assert_array_equal(difference, np.abs(stamps[index] - wanted))


def at_rate(trajectory, every, late_ns=0):
    """Every n-th pose, with stamps that much later."""
    return Trajectory(trajectory.stamps_ns[::every] + late_ns, trajectory.poses[::every])


@pytest.mark.parametrize("is_planar", [False, True])
def test_truth_at_another_rate_is_interpolated_as_naive_does(is_planar):
    truth = drive(200)
    truth = Trajectory(truth.stamps_ns, lie.flatten(truth.poses)) if is_planar else truth
    random = np.random.default_rng(4)
    keep = np.sort(random.choice(200, 140, replace=False))
    sparse = Trajectory(truth.stamps_ns[keep], truth.poses[keep])
    stamps_ns = random.integers(truth.stamps_ns[0] - 10**9, truth.stamps_ns[-1] + 10**9, 100)
    stamps_ns[::7] = sparse.stamps_ns[random.integers(0, 140, len(stamps_ns[::7]))]
    pairs = ev.pair(Trajectory(stamps_ns, truth.poses[:100]), sparse, gap_s=0.25)
    known_poses = lie.lift(sparse.poses)
    expected = [naive.interpolated(t, sparse.stamps_ns, known_poses, 0.25e9) for t in stamps_ns.tolist()]
    assert pairs.places.tolist() == [k for k, pose in enumerate(expected) if pose is not None]
    known = np.array([pose for pose in expected if pose is not None])
    np.testing.assert_allclose(pairs.reference, known, atol=1e-9)
    assert pairs.early + pairs.late + pairs.in_gap == 100 - len(pairs)
    assert min(pairs.early, pairs.late, pairs.in_gap, pairs.interpolated) > 0


@pytest.mark.parametrize("bag", ["", "2d/mocap_room_1.bag"])
def test_interpolated_truth_and_ate_equal_those_of_evo(bag):
    """Of a made-up drive, and at the stamps of real scans by a motion capture, which has gaps of half a second."""
    core = [pytest.importorskip(f"evo.core.{name}") for name in ("trajectory", "sync", "metrics")]
    PoseTrajectory3D, sync, metrics = core[0].PoseTrajectory3D, core[1], core[2]
    truth, stamps_ns = drive(400), drive().stamps_ns[:80] * 2 - drive().stamps_ns[0] + 37_000_000
    if bag:
        log = open_log(shared_data(bag), ground_truth_topic="/vrpn_client_node/jackal/pose")
        truth, stamps_ns = log.ground_truth(), np.array([scan.stamp_ns for scan in log.scans()])
        truth = Trajectory(truth.stamps_ns, lie.lift(truth.poses))
    stamps_ns = stamps_ns[(stamps_ns > truth.stamps_ns.min()) & (stamps_ns < truth.stamps_ns.max())]
    estimate = disturbed(Trajectory(stamps_ns, drive(len(stamps_ns), step_m=0.02).poses))
    ours = ev.pair(estimate, truth, gap_s=10.0)
    both = [
        PoseTrajectory3D(poses_se3=list(each.poses), timestamps=1e-9 * (each.stamps_ns - truth.stamps_ns.min()))
        for each in (truth, estimate)
    ]
    reference, found = sync.associate_trajectories(*both, max_diff=10.0, sync_method=sync.SyncMethod.interpolation)
    assert len(ours) == len(found.timestamps) == len(stamps_ns) and 2 * ours.interpolated > len(ours)
    np.testing.assert_allclose(ours.reference, reference.poses_se3, atol=2e-6)  # stamps of evo are floats
    found.align(reference)
    ate = metrics.APE(metrics.PoseRelation.translation_part)
    ate.process_data((reference, found))
    assert ev.absolute_error(ours).translation_m.rmse == pytest.approx(ate.get_all_statistics()["rmse"], abs=1e-6)


def test_a_true_pose_of_the_same_stamp_is_taken_to_the_last_bit_in_any_order():
    truth = drive(50)
    order = np.random.default_rng(0).permutation(50)
    some = order[:20]
    shuffled = Trajectory(truth.stamps_ns[order], truth.poses[order])
    pairs = ev.pair(Trajectory(truth.stamps_ns[some], truth.poses[some]), shuffled)
    np.testing.assert_array_equal(pairs.estimate, pairs.reference)
    assert pairs.places.tolist() == list(range(20)) and pairs.interpolated == 0
    doubled = Trajectory(np.repeat(truth.stamps_ns[:5], 2), np.repeat(truth.poses[:5], 2, axis=0))
    np.testing.assert_array_equal(ev.pair(doubled, truth).reference, doubled.poses)


def test_scans_without_truth_are_counted_with_the_reason():
    truth = drive(100)
    holed = Trajectory(np.delete(truth.stamps_ns, range(40, 48)), np.delete(truth.poses, range(40, 48), axis=0))
    longer = Trajectory(truth.stamps_ns + 3_000_000 - 500_000_000, truth.poses)
    pairs = ev.pair(longer, holed)
    assert (pairs.early, pairs.late, pairs.in_gap) == (5, 0, 9)
    assert pairs.missing == ("14 without a true pose: 5 before the truth begins, 9 in gaps of it wider than 0.5 s")
    assert pairs.share == pytest.approx(0.86)
    assert pairs.missing in ev.absolute_error(pairs).pairing and "86.0 %" in ev.absolute_error(pairs).pairing
    assert len(ev.pair(longer, holed, gap_s=1.0)) == 95


def test_a_stamp_rounded_to_milliseconds_is_that_of_the_truth_at_its_ends_too():
    truth = drive(30)
    rounded = Trajectory(truth.stamps_ns + np.where(np.arange(30) < 15, 400_000, -400_000), truth.poses)
    assert len(ev.pair(rounded, truth)) == len(ev.pair(truth, rounded)) == 30


def test_truth_without_a_pose_beside_the_estimate_is_refused_with_the_reason():
    truth, late = drive(100), at_rate(drive(100), 1, late_ns=50_000_000)
    sparse, one = at_rate(truth, 20), at_rate(truth, 100)
    for estimate, reference, words in (
        (late, sparse, r"more than 0\.6 s apart.*max_gap_s"),
        (at_rate(truth, 1, late_ns=10**12), truth, "same clock"),
        (at_rate(truth, 1, late_ns=10_000_000), one, "poses at one instant alone"),
    ):
        with pytest.raises(InputError, match=words):
            ev.pair(estimate, reference)
    assert len(ev.pair(late, sparse, gap_s=2.0)) == 80 and len(ev.pair(truth, one)) == 1


def test_stamps_that_are_all_the_same_pair_nothing(pairs):
    unset = Trajectory(np.zeros(len(pairs), np.int64), pairs.estimate)
    with pytest.raises(InputError, match=r"poses that can be paired all have the stamp 0\.000 s"):
        ev.pair(unset, Trajectory(unset.stamps_ns, pairs.reference))


def test_truth_that_may_mislead_is_warned_of():
    every = at_rate(drive(100), 1, late_ns=50_000_000)
    (sparse,) = ev.pair(every, at_rate(drive(100), 20), gap_s=2.0).warnings
    assert sparse == "true poses are up to 2 s apart, and the path between them is taken as straight"
    (few,) = ev.pair(drive(100), Trajectory(drive(100).stamps_ns[:30], drive(100).poses[:30])).warnings
    assert few == "accuracy is that of 30 of 100 scans alone: 70 without a true pose: 70 after it ends"
    assert ev.pair(drive(5), drive(5)).warnings == ["accuracy is that of 5 poses alone"]
    assert ev.pair(every, drive(100)).warnings == []


@pytest.mark.parametrize("axes", ["camera", "none"])
def test_orientations_of_other_axes_or_none_are_told_and_those_of_another_world_are_not(axes):
    truth = drive()
    camera, world = np.eye(4), lie.exp(np.array([9.0, 8.0, 7.0, 0.3, 0.2, 2.0]))
    camera[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    poses = world @ truth.poses
    assert evaluate(truth, Trajectory(truth.stamps_ns, poses)).warnings == []
    poses = poses @ camera if axes == "camera" else poses.copy()
    if axes == "none":
        poses[:, :3, :3] = np.eye(3)
    (said,) = evaluate(truth, Trajectory(truth.stamps_ns, poses)).warnings
    assert "orientations are far from the ground truth" in said


def test_noise_of_a_fast_truth_does_not_lengthen_the_path_that_is_shown():
    estimate = at_rate(drive(200), 20)
    poses = drive(200).poses.copy()
    poses[:, :3, 3] += np.random.default_rng(0).normal(0.0, 0.5, (200, 3))
    noisy = Trajectory(drive(200).stamps_ns, poses)
    pairs = ev.pair(estimate, noisy)
    shown = ev.on_the_estimate(estimate, noisy)
    assert shown.stamps_ns.tolist() == estimate.stamps_ns.tolist()
    assert ev.path_length(shown.poses)[-1] == pytest.approx(ev.absolute_error(pairs).path_length_m)
    assert ev.path_length(shown.poses)[-1] < 0.9 * ev.path_length(noisy.poses)[-1]


def test_stretches_that_do_not_fit_or_cross_a_gap_are_none_of_the_size_asked_for(pairs):
    coarse = ev.pair(at_rate(drive(100), 50), at_rate(drive(100), 50))  # a pose every 5 s
    for measure in (
        lambda: ev.relative_error_over_frames(pairs, 300),
        lambda: ev.relative_error_over_distance(pairs, 1e4),
        lambda: ev.relative_error_over_time(pairs, 1e4),
        lambda: ev.kitti_error(pairs, (1e4,)),
        lambda: ev.relative_error_over_time(coarse, 1.0),
        lambda: ev.relative_error_over_distance(coarse, 0.5),
    ):
        with pytest.raises(InputError, match=r"no segment of .* fits into"):
            measure()
    holed = np.delete(np.arange(100), range(40, 80))
    pairs = ev.pair(Trajectory(drive(100).stamps_ns[holed], drive(100).poses[holed]), drive(100))
    found = ev.relative_error_over_time(pairs, 1.0)
    assert np.diff(pairs.stamps_ns[found.segments], axis=1).max() == 10**9


def test_a_kitti_file_gives_the_k_th_scan_its_k_th_row_and_must_have_as_many(tmp_path):
    truth = drive(30)
    write_kitti(tmp_path / "poses.txt", truth)
    file = ev.read_truth(tmp_path / "poses.txt")
    file.check(truth.stamps_ns, 30)
    np.testing.assert_allclose(file.at(truth.stamps_ns).poses, truth.poses, atol=1e-7)
    stopped = file.first(12).at(truth.stamps_ns[:12])
    np.testing.assert_array_equal(stopped.stamps_ns, truth.stamps_ns[:12])
    for refused in (lambda: file.check(truth.stamps_ns, 29), lambda: file.at(truth.stamps_ns[:12])):
        with pytest.raises(InputError, match="one line per scan"):
            refused()


def test_poses_without_time_pair_line_by_line():
    lines = Trajectory(np.arange(120, dtype=np.int64), drive(120).poses)
    pairs = ev.pair(lines, Trajectory(lines.stamps_ns[:100], lines.poses[:100]))
    assert (len(pairs), pairs.late, pairs.interpolated) == (100, 20, 0)


def wheel_odometry():
    """The FLASER lines of the Intel log: header stamps, and poses (x, y, yaw) of the raw wheel odometry."""
    with bz2.open(shared_data("2d/intel.clf.bz2"), "rt") as file:
        rows = [line.split() for line in file if line.startswith("FLASER")]
    return [parse_stamp_ns(row[-3], "intel.clf") for row in rows], [[float(v) for v in row[-6:-3]] for row in rows]


def test_relations_over_raw_wheel_odometry_equal_naive_and_are_big():
    stamps_ns, poses = wheel_odometry()
    relations = ev.read_relations(shared_data("2d/intel.relations"))
    trajectory = Trajectory(np.array(stamps_ns), np.array([lie.pose_2d(*pose) for pose in poses]))
    error = ev.relation_error(trajectory, relations)
    assert error.missing == 0
    assert len(error.errors_m) == 2984
    index = {stamp: k for k, stamp in reversed(list(enumerate(stamps_ns)))}
    for k in range(0, 2984, 50):
        T, (first, second) = relations.T_first_second[k], relations.stamps_ns[k].tolist()
        expected = naive.relation_2d(
            poses[index[first]], poses[index[second]], (T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0]))
        )
        assert (error.errors_m[k], error.errors_rad[k]) == pytest.approx(expected, abs=1e-9)
    assert error.translation_m.mean > 1.0
    assert error.translation_squared_m2.mean == pytest.approx(error.translation_m.rmse**2)
    assert re.search(r"translation \d+\.\d{4} ± \d+\.\d{4} m", error.summary)


def test_relations_made_of_a_trajectory_find_no_error_in_it(tmp_path):
    trajectory = planar(np.random.default_rng(1).normal(size=(20, 2)), np.linspace(-3.0, 3.0, 20))
    lines = []
    for i, j in ((0, 5), (7, 3), (19, 0)):
        T = lie.inverse(trajectory.poses[i]) @ trajectory.poses[j]
        lines.append(f"{i / 10:.6f} {j / 10:.6f} {T[0, 2]:.17g} {T[1, 2]:.17g} 0 0 0 {float(lie.yaw(T)):.17g}")
    lines.append("0.100000 55.000000 0 0 0 0 0 0")
    (tmp_path / "a.relations").write_text("\n".join(lines))
    relations = ev.read_relations(tmp_path / "a.relations")
    error = ev.relation_error(trajectory, relations)
    assert error.used.tolist() == [0, 1, 2] and error.missing == 1
    assert error.translation_m.maximum < 1e-12 and error.rotation_rad.maximum < 1e-7
    with pytest.raises(InputError, match="belong to this log"):
        ev.relation_error(Trajectory(trajectory.stamps_ns + 10**15, trajectory.poses), relations)
    (tmp_path / "a.relations").write_text("1.0 2.0 0 0 0 0 0 0\n1.0 2.0 0 0 0 0 0\n")
    with pytest.raises(InputError, match=r"a\.relations:2 has 7 fields"):
        ev.read_relations(tmp_path / "a.relations")


def test_scans_in_the_dropouts_of_a_real_motion_capture_are_named():
    """Poses every 10 ms with six dropouts of half a second."""
    config = load_settings(overrides=[Override("log.ground_truth_topic", "/vrpn_client_node/jackal/pose", "--gt")])
    log = open_log(shared_data("2d/mocap_room_1.bag"), config.config.log)
    stamps_ns = np.array([scan.stamp_ns for scan in log.scans()])
    pairs = ev.pair(Trajectory(stamps_ns, np.tile(np.eye(3), (len(stamps_ns), 1, 1))), log.ground_truth())
    assert (len(pairs), pairs.interpolated) == (383, 383)
    assert pairs.missing == "31 without a true pose: 31 in gaps of it wider than 0.1 s"


def test_stamps_in_bursts_have_the_interval_between_the_bursts():
    """Motion capture over a network: five poses arrive at once, every 50 ms."""
    truth = drive(100)
    bursts_ns = np.arange(100) // 5 * 50_000_000 + np.arange(100) % 5 * 10_000
    wanted_ns = np.arange(1, 19) * 50_000_000 + 25_000_000
    estimate = Trajectory(wanted_ns, truth.poses[: len(wanted_ns)])
    pairs = ev.pair(estimate, Trajectory(bursts_ns, truth.poses))
    assert len(pairs) == 18 and pairs.gap_s == pytest.approx(0.25, rel=0.01)


def test_an_error_is_no_share_of_a_path_that_is_too_short():
    standing = drive(step_m=0.001, count=3)
    error = ev.absolute_error(ev.pair(disturbed(standing), standing), ev.Alignment.FIRST)
    assert error.path_length_m < 1.0
    assert error.share_of_path is None and "%" not in error.summary and "max" in error.summary
    driven = ev.absolute_error(ev.pair(disturbed(drive()), drive()))
    assert f"{100.0 * driven.share_of_path:.3f} % of {driven.path_length_m:.1f} m" in driven.summary
