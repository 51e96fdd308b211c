"""Lines of CARMEN logs, folders of sweeps as KITTI lays them out, and the headers of PCD and PLY files."""

import numpy as np

BEGIN_S = 1_000_000_000.25  # exact in binary


def flaser(k, ranges=None, *, stamp_s=None, pose=None, odometry=None):
    ranges = np.linspace(1.0, 5.0, 180).round(2) if ranges is None else ranges
    odometry = (0.1 * k, 0.02 * k, 0.01 * k) if odometry is None else odometry
    values = [*ranges, *(odometry if pose is None else pose), *odometry]
    stamp_s = BEGIN_S + 0.25 * k if stamp_s is None else stamp_s
    words = " ".join(f"{value:.6f}" for value in values)
    return f"FLASER {len(ranges)} {words} {stamp_s:.6f} nohost {0.25 * k:.6f}"


def robotlaser(k, ranges, laser, robot, *, remissions=()):
    head = [0, -1.0, 0.25 * (len(ranges) - 1), 0.25, 30.0, 0.01, 0]
    values = [*head, len(ranges), *ranges, len(remissions), *remissions, *laser, *robot, 0, 0, 0, 0, 0]
    return f"ROBOTLASER1 {' '.join(map(str, values))} {BEGIN_S + 0.25 * k:.6f} host {0.25 * k:.6f}"


def odom(k, x):
    return f"ODOM {x:.6f} 0.0 0.0 0.0 0.0 0.0 {BEGIN_S + 0.25 * k:.6f} nohost {0.25 * k:.6f}"


def save(path, *lines):
    path.write_text("# CARMEN\n" + "\n".join(lines) + "\n")
    return path


def xyzi(cloud):
    """A cloud's points without the first, which is NaN, as float32 x y z intensity."""
    rows = cloud.rows[1:]
    return np.column_stack([rows["x"], rows["y"], rows["z"], np.linspace(0, 1, len(rows))]).astype("<f4")


def oxts_line(latitude, longitude, up_m, roll, pitch, yaw):
    return " ".join(f"{value:.15f}" for value in (latitude, longitude, up_m, roll, pitch, yaw, *[0.0] * 24))


def kitti_raw(folder, said, *, calibrated=True):
    drive = folder / "2011_09_26_drive_0001_sync"
    for name in ("velodyne_points/data", "oxts/data"):
        (drive / name).mkdir(parents=True)
    times = []
    for k, cloud in enumerate(said):
        xyzi(cloud).tofile(drive / "velodyne_points/data" / f"{k:010d}.bin")
        line = oxts_line(49.0 + 1e-5 * k, 8.4 + 2e-5 * k, 110.0 + 0.5 * k, 0.01, -0.02, 0.3 * k)
        (drive / "oxts/data" / f"{k:010d}.txt").write_text(line + "\n")
        times.append(f"2011-09-26 13:02:25.{k:03d}594360\n")
    (drive / "velodyne_points/timestamps.txt").write_text("".join(times))
    (drive / "oxts/timestamps.txt").write_text("".join(times))
    if calibrated:
        numbers = "R: 0 -1 0 1 0 0 0 0 1\nT: -0.8 0.3 -0.75\ndelta_f: 0 0\n"
        (folder / "calib_imu_to_velo.txt").write_text("calib_time: 25-May-2012 16:47:16\n" + numbers)
    return drive


def kitti_odometry(folder, said, *, poses=True):
    sequence = folder / "sequences" / "07"
    (sequence / "velodyne").mkdir(parents=True)
    for k, cloud in enumerate(said):
        xyzi(cloud).tofile(sequence / "velodyne" / f"{k:06d}.bin")
    (sequence / "times.txt").write_text("".join(f"{0.103736 * k:.6e}\n" for k in range(len(said))))
    row = " ".join(map(str, np.eye(4)[:3].ravel()))
    (sequence / "calib.txt").write_text(f"P0: {row}\nTr: 0 -1 0 0.1 0 0 -1 -0.2 1 0 0 -0.3\n")
    if poses:
        (folder / "poses").mkdir()
        lines = [" ".join(map(str, camera(k)[:3].ravel())) for k in range(len(said))]
        (folder / "poses" / "07.txt").write_text("\n".join(lines) + "\n")
    return sequence


def camera(k):
    T = np.eye(4)
    T[:3, :3] = [[np.cos(0.1 * k), 0, np.sin(0.1 * k)], [0, 1, 0], [-np.sin(0.1 * k), 0, np.cos(0.1 * k)]]
    T[:3, 3] = 0.1 * k, 0.02 * k, 1.5 * k
    return T


PCD = """# .PCD v0.7
VERSION 0.7
FIELDS x y z timestamp ring
SIZE 4 4 4 8 2
TYPE F F F U U
COUNT 1 1 1 1 1
WIDTH {count}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {count}
DATA {form}
"""

PLY = """ply
format {form} 1.0
comment made by hand
element vertex {count}
property double x
property float y
property float z
property uchar ring
element face 1
property list uchar int vertex_indices
end_header
"""
