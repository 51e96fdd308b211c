"""A data set of evalio, ``sim_town/drive``: every eighth point of the simulated log that SIM_TOWN names."""

import os
from pathlib import Path

from evalio.datasets import Dataset, DatasetIterator
from evalio.types import (
    SE3,
    Duration,
    ImuMeasurement,
    ImuParams,
    LidarMeasurement,
    LidarParams,
    Point,
    Stamp,
    Trajectory,
)

from scanchain import lie
from scanchain.logs import open_log

EVERY = 8


class Drive(DatasetIterator):
    """Samples of the IMU up to the end of a scan, then the scan, as a recorder stores them."""

    def __init__(self, log):
        self.log = log

    def __iter__(self):
        for scan in self.log.scans():
            imu = scan.inertial
            for stamp_ns, rate, force in zip(imu.stamps_ns.tolist(), imu.rates, imu.accelerations, strict=True):
                yield ImuMeasurement(Stamp.from_nsec(stamp_ns), rate, force)
            rows = zip(scan.points[::EVERY].tolist(), scan.times_s[::EVERY].tolist(), strict=True)
            points = [Point(x=x, y=y, z=z, t=Duration.from_sec(time_s)) for (x, y, z), time_s in rows]
            yield LidarMeasurement(Stamp.from_nsec(scan.stamp_ns), points)

    def __len__(self):
        return len(self.log)


class SimTown(Dataset):
    drive = "drive"

    def open(self):
        return open_log(os.environ["SIM_TOWN"])

    def data_iter(self):
        return Drive(self.open())

    def imu_T_lidar(self):
        return SE3.from_mat(lie.inverse(self.open().imu.T_lidar_sensor))

    def imu_T_gt(self):
        return self.imu_T_lidar()  # the truth of a log is that of its lidar

    def imu_params(self):
        return ImuParams.down()

    def lidar_params(self):
        return LidarParams(num_rows=16, num_columns=1800, min_range=0.5, max_range=100.0)

    def files(self):
        return [Path(os.environ.get("SIM_TOWN", "absent"))]

    def ground_truth_raw(self):
        truth = self.open().ground_truth()
        stamps = [Stamp.from_nsec(stamp_ns) for stamp_ns in truth.stamps_ns.tolist()]
        return Trajectory(stamps=stamps, poses=[SE3.from_mat(pose) for pose in truth.poses])
