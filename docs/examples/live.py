"""Live SLAM: a pose after every scan, of arrays as any driver delivers them."""

import scanchain


def driver():
    """Points (N, 2) in meters and stamp in seconds; here from a simulated log, elsewhere from your sensor."""
    scanchain.simulate("office", "office.mcap", duration_s=10.0)
    for scan in scanchain.open_log("office.mcap"):
        yield scan.points, scan.stamp_ns * 1e-9


slam, poses = scanchain.Slam(dimension=2, is_live=True), []
for points, stamp_s in driver():
    scan = scanchain.Scan.of(points, stamp_s)  # add T_odom_base=… for wheels, times_s=… for the time of each point
    step = slam.process(scan)
    if step.state != "ok":
        print(step.state, step.match.reason)
    poses.append(step.T_world_lidar)  # (3, 3); jumps at loop closures, step.T_odom_lidar never does
print(len(poses), poses[-1][:2, 2].round(2))  # -> 100 [ 4.36 -3.09]

result = slam.finish()  # closes the last loops and corrects every scan
scanchain.write_tum("trajectory.tum", result.trajectory)
print(result.trajectory)  # -> Trajectory(100 poses of SE(2) over 9.9 s)
print(scanchain.judge(result).verdict, scanchain.cloud(result).shape[1])  # -> trustworthy 2
