"""Factors of your own in a pose graph: distances to beacons, and the heading of a compass."""

import numpy as np

import scanchain
from scanchain import lie
from scanchain.graph.factors import Factor


class Range(Factor):
    name = "range to a beacon"

    def __init__(self, beacon, range_m):
        self.beacon, self.range_m = beacon, range_m

    def error(self, T_ij, Z):
        return np.linalg.norm(self.beacon - T_ij[:, :2, 2], axis=1)[:, None] - self.range_m


class Heading(Factor):
    name = "heading of a compass"
    is_robust = True

    def error(self, T_ij, Z):
        return lie.wrap(lie.yaw(T_ij) - lie.yaw(Z))[:, None]


graph = scanchain.PoseGraph(2)
for k in range(4):
    graph.add_pose(lie.pose_2d(1.1 * k, 0.0, 0.0), stamp_ns=k)
for k in range(3):
    graph.add_edge(k, k + 1, lie.pose_2d(1.1, 0.0, 0.0), np.diag([100.0, 100.0, 1000.0]))
graph.fix(0)
graph.add_factor(Range([3.0, 4.0], 4.0), 3, information=[[1e4]])
graph.add_factor(Range([6.0, 0.0], 3.0), 3, information=[[1e4]])
graph.add_factor(Heading(), 3, information=[[1e4]], Z=lie.pose_2d(0.0, 0.0, 0.1))
scanchain.optimize(graph)
print(graph.poses[3][:2, 2].round(2), lie.yaw(graph.poses[3]).round(2))  # -> [3. 0.] 0.1
