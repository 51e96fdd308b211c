"""ICP by hand: two clouds aligned by closest points and rigid transforms, then by scanchain.align."""

import numpy as np
from scipy.spatial import KDTree

import scanchain

scanchain.simulate("office", "office.mcap", duration_s=8.0)
log = scanchain.open_log("office.mcap")
target, source = log[60].points, log[70].points

T_target_source, tree, iteration = np.eye(3), KDTree(target), 0
for iteration in range(100):
    moved = source @ T_target_source[:2, :2].T + T_target_source[:2, 2]
    distance_m, nearest = map(np.asarray, tree.query(moved))
    is_close = distance_m < 0.5
    change = scanchain.rigid_transform(moved[is_close], target[nearest[is_close]])
    T_target_source = change @ T_target_source
    if np.abs(change - np.eye(3)).max() < 1e-6:
        break
print(iteration, T_target_source[:2, 2].round(3))  # -> 32 [ 1.029 -0.005]

match = scanchain.align(target, source)  # point-to-line: fewer iterations, and nearer to the truth
print(match.iterations, match.T_target_source[:2, 2].round(3))  # -> 8 [ 0.98  -0.023]

truth = scanchain.read_tum("office.tum").poses[[60, 70]]
print((np.linalg.inv(truth[0]) @ truth[1])[:2, 3].round(3))  # -> [ 0.982 -0.031]
