"""Trajectory files: what is written is read back, exactly in time."""

import sys
from xml.etree import ElementTree

import numpy as np
import pytest

from scanchain import lie
from scanchain.data import Trajectory
from scanchain.errors import InputError
from scanchain.trajectory import read_kitti, read_tum, write_kitti, write_tum
from tests.support.scenes import shared_data

STAMPS_NS = [1317042145963999987, 1317042145963999986, 976052857337529984, 0, 1, -1, -2500000001]


def wandering(count=7, seed=3):
    """Random SE(3) poses stamped with awkward nanoseconds that step back in time."""
    random = np.random.default_rng(seed)
    twists = random.normal(scale=[5, 5, 5, 1, 1, 1], size=(count, 6))
    return Trajectory(np.array(STAMPS_NS[:count], np.int64), lie.exp(twists))


def test_stamps_survive_to_the_nanosecond_and_in_order_and_poses_to_nine_digits(tmp_path):
    trajectory = wandering()
    write_tum(tmp_path / "a.tum", trajectory)
    back = read_tum(tmp_path / "a.tum")
    assert back.stamps_ns.tolist() == STAMPS_NS
    np.testing.assert_allclose(back.poses, trajectory.poses, atol=1e-8)
    with pytest.raises(InputError, match=r"a\.tum: exists; choose another name or pass force=True"):
        write_tum(tmp_path / "a.tum", trajectory)
    pose = lie.pose_2d(1.5, -2.0, 0.7)
    write_tum(tmp_path / "a.tum", Trajectory(np.array([5], np.int64), pose[None]), force=True)
    np.testing.assert_allclose(read_tum(tmp_path / "a.tum").poses[0], lie.lift(pose), atol=1e-8)
    write_kitti(tmp_path / "a.txt", trajectory)
    back = read_kitti(tmp_path / "a.txt")
    np.testing.assert_allclose(back.poses, trajectory.poses, atol=1e-8)
    assert back.stamps_ns.tolist() == list(range(7))


@pytest.mark.parametrize("d", [2, 3])
def test_a_trajectory_becomes_positions_a_data_frame_and_a_picture(d, monkeypatch):
    poses = lie.pose_2d(1.5, -2.0, 0.7)[None] if d == 2 else wandering().poses
    trajectory = Trajectory(np.array(STAMPS_NS[: len(poses)]), poses)
    np.testing.assert_array_equal(trajectory.positions, poses[:, :d, d])
    frame = trajectory.to_dataframe()
    assert list(frame.stamp_ns) == STAMPS_NS[: len(poses)]
    np.testing.assert_array_equal(frame[["x_m", "y_m", "z_m"][:d]], trajectory.positions)
    if d == 2:
        assert frame.yaw_rad.tolist() == pytest.approx([0.7])
    else:
        quaternions = frame[["qx", "qy", "qz", "qw"]]
        np.testing.assert_allclose(quaternions, lie.to_quaternion(poses[:, :3, :3]), atol=1e-12)
    axes = trajectory.plot()
    assert trajectory.plot(axes) is axes and len(axes.lines) == 2
    np.testing.assert_array_equal(axes.lines[0].get_xydata(), trajectory.positions[:, :2])
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(InputError, match="pandas is not installed; install it with: pip install pandas"):
        trajectory.to_dataframe()


def test_evo_reads_what_we_write(tmp_path):
    files = pytest.importorskip("evo.tools.file_interface")
    trajectory = wandering()
    write_tum(tmp_path / "a.tum", trajectory)
    write_kitti(tmp_path / "a.txt", trajectory)
    from_tum = files.read_tum_trajectory_file(str(tmp_path / "a.tum"))
    from_kitti = files.read_kitti_poses_file(str(tmp_path / "a.txt"))
    for read in (from_tum, from_kitti):
        np.testing.assert_allclose(np.array(read.poses_se3), trajectory.poses, atol=1e-7)


def test_a_published_ground_truth_is_read_with_its_exact_stamps():
    trajectory = read_tum(shared_data("3d/kitti_0001_first54.tum"))
    assert len(trajectory) == 54
    assert trajectory.stamps_ns[0] == 1317042145963999987
    np.testing.assert_allclose(trajectory.poses[1, :3, 3], [1.440872, 0.008673, 0.018271])


@pytest.mark.parametrize("mark", [" ", ",", ", ", ";", " ; "])
def test_comments_and_empty_lines_are_passed_over_and_words_separated(tmp_path, mark):
    path = tmp_path / "a.csv"
    rows = [mark.join([stamp, *["1", "2", "3", "0", "0", "0", "1"]]) for stamp in ("1.5", "2.5")]
    path.write_text("\n".join(["# stamp,x,y,z", "", rows[0], "   ", rows[1], ""]))
    trajectory = read_tum(path)
    assert trajectory.stamps_ns.tolist() == [1500000000, 2500000000]
    np.testing.assert_array_equal(trajectory.poses[1, :3], [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3]])


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("1.0 1 2 3 0 0 0", "7 fields"),
        ("timestamp,tx,ty,tz,qx,qy,qz,qw", "begin a line of column names with #"),
        ("1317042145963999987 1 2 3 0 0 0 1", "give it in seconds"),
        ("noon 1 2 3 0 0 0 1", "'noon'"),
        ("nan 1 2 3 0 0 0 1", "nan"),
        ("1.0 1 2 x 0 0 0 1", "'x'"),
        ("1.0 1 2 inf 0 0 0 1", "finite"),
        ("1.0 1 2 3 0 0 0 3", "has a quaternion of length 3, not 1"),
        ("976052905.167 976052911.885 -0.1 -0.1 0 0 0 -1.7", "evaluate --relations"),
    ],
)
def test_a_bad_tum_line_is_named_with_its_number(tmp_path, line, says):
    path = tmp_path / "bad.tum"
    path.write_text(f"0.5 1 2 3 0 0 0 1\n{line}\n")
    with pytest.raises(InputError) as caught:
        read_tum(path)
    assert f"{path}:2" in str(caught.value)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_files_that_are_none_and_kitti_lines_that_are_no_pose_are_one_line_errors(tmp_path):
    (tmp_path / "empty.tum").write_text("# nothing\n")
    (tmp_path / "binary.tum").write_bytes(bytes(range(256)))
    for name in ("absent.tum", "empty.tum", "binary.tum", "."):
        with pytest.raises(InputError, match=r"^[^\n]+$"):
            read_tum(tmp_path / name)
    for line in ("1 0 0 0 0 1 0 0 0 0 1", "2 0 0 0 0 2 0 0 0 0 2 0", "1 0 0 0 0 1 0 0 0 0 -1 0"):
        (tmp_path / "bad.txt").write_text(f"{line}\n")
        with pytest.raises(InputError, match=r"bad\.txt:1"):
            read_kitti(tmp_path / "bad.txt")


def test_a_notebook_shows_the_path_as_svg():
    trajectory = Trajectory(np.arange(3), np.stack([lie.pose_2d(k, 0.5 * k, 0.0) for k in range(3)]))
    shown = ElementTree.fromstring(trajectory._repr_html_())
    assert shown.tag.endswith("svg")
    texts = " ".join(trajectory._repr_html_().split())
    assert "Trajectory(3 poses of SE(2) over 0.0 s)" in texts and "x [m]" in texts
