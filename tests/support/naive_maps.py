"""Slow, clear twins of the map kernels."""

import math
from itertools import pairwise

import numpy as np
from PIL import Image
from ruamel.yaml import YAML

from tests.support.naive import bin_of


def crossed_cells(start, end, resolution):
    """Cells (column, row) that a segment runs through, its last one left out: cut it at every grid line."""
    cuts = {0.0, 1.0}
    for axis in range(2):
        a, b = start[axis] / resolution, end[axis] / resolution
        for line in range(math.ceil(min(a, b)), math.floor(max(a, b)) + 1):
            if a != b:
                cuts.add((line - a) / (b - a))
    cuts = sorted(cut for cut in cuts if 0.0 <= cut <= 1.0)
    cells = []
    for low, high in pairwise(cuts):
        middle = np.asarray(start) + 0.5 * (low + high) * (np.asarray(end) - np.asarray(start))
        cells.append(tuple(np.floor(middle / resolution).astype(int).tolist()))
    last = tuple(np.floor(np.asarray(end) / resolution).astype(int).tolist())
    return [cell for cell in cells if cell != last]


def draw(scans, resolution, hit, miss, low, high):
    """Log-odds by cell of scans of (start, end) beams: each counts once a cell, ends before crossings."""
    log_odds = {}
    for beams in scans:
        ends = {tuple(np.floor(np.asarray(end) / resolution).astype(int).tolist()) for _, end in beams}
        crossed = {cell for start, end in beams for cell in crossed_cells(start, end, resolution)} - ends
        for cell in ends:
            log_odds[cell] = min(log_odds.get(cell, 0.0) + hit, high)
        for cell in crossed:
            log_odds[cell] = max(log_odds.get(cell, 0.0) + miss, low)
    return log_odds


def voxel_means(points, size):
    """Mean of the points of each voxel, in the order of first sight."""
    groups = {}
    for point in points:
        groups.setdefault(tuple(np.floor(point / size).astype(int).tolist()), []).append(point)
    return np.array([np.mean(members, axis=0) for members in groups.values()])


def served_map(folder):
    """Cells of −1, 0 or 100, row 0 at the bottom, origin and resolution of map.yaml, as map_server loads it.

    By libraries for YAML and images; trinary mode alone (nav2's map_io.cpp): p = (255 − pixel) / 255.
    """
    told = YAML(typ="safe").load((folder / "map.yaml").read_text())
    assert (told["mode"], told["negate"]) == ("trinary", 0)
    with Image.open(folder / told["image"]) as image:
        p = (255.0 - np.array(image.convert("L"), float)) / 255.0
    cells = np.full(p.shape, -1)
    cells[p < told["free_thresh"]] = 0
    cells[p > told["occupied_thresh"]] = 100
    return cells[::-1], np.array(told["origin"]), told["resolution"]


def sight(point, ranges_m, limits):
    """1 where a scan with these nearest ranges saw a surface at a point, −1 where it looked through, else 0."""
    reach, window, margin, margin_share, level, level_share = limits
    rows, columns = ranges_m.shape
    (row, column), range_m = bin_of(point, ranges_m.shape)
    if not window < range_m <= reach:
        return 0
    step = 2 * math.pi / columns
    half = max(math.ceil(0.5 * window / (range_m * step)), 1)
    around = {
        (r, c % columns): ranges_m[r, c % columns]
        for r in range(max(row - 1, 0), min(row + half + 1, rows))
        for c in range(column - half, column + half + 1)
    }
    slack = margin + margin_share * range_m
    place = min(around, key=around.get)
    if around[place] < range_m - slack:
        place = (row, column)
    nearest = around[place]
    if nearest >= 1e9 or nearest < range_m - slack:
        return 0
    if nearest <= range_m + slack:
        return 1
    height = nearest * math.sin((place[0] + 0.5) * step - math.pi / 2)
    if rows > 1 and abs(height - point[2]) <= level + level_share * nearest:
        return 0
    by_the_point = [r for (i, j), r in around.items() if abs(i - row) <= 1 and (j - column + 1) % columns <= 2]
    return -1 if min(by_the_point) < 1e9 else 0
