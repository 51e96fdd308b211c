"""Slow and clear twins of the landmark kernels, by the definitions."""

import numpy as np


def wrapped(angle):
    return np.arctan2(np.sin(angle), np.cos(angle))


def bearing_range(pose, landmark, bearing, reach, own=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)):
    """Predicted minus measured bearing and range of a landmark from a pose (x, y) or (x, y, heading).

    own : the sensor's range scale, depth share, range offset, bearing offset, bearing scale, and lever arm
    """
    heading = pose[2] if len(pose) == 3 else 0.0
    scale, depth, offset, turned, stretched, ahead = own
    dx, dy = landmark - pose[:2]
    q = np.hypot(dx, dy)
    true = bearing + wrapped(np.arctan2(dy, dx) - heading - bearing)  # of the turns that are equal, the nearest
    along = (1.0 - depth) * q + depth * q * np.cos(true) + scale * q + offset - ahead * np.cos(true)
    return np.array([true + turned + stretched * true + ahead * np.sin(true) / q - bearing, along - reach])


def odometry(first, second, moved):
    c, s = np.cos(first[2]), np.sin(first[2])
    x, y = np.array([[c, s], [-s, c]]) @ (second[:2] - first[:2])
    return np.array([x - moved[0], y - moved[1], wrapped(second[2] - first[2] - moved[2])])


def numeric_jacobian(function, x, step=1e-6):
    columns = []
    for k in range(len(x)):
        away = np.zeros(len(x))
        away[k] = step
        columns.append((function(x + away) - function(x - away)) / (2.0 * step))
    return np.stack(columns, axis=1)


def dead_reckoned(times, velocities, begin, end, steps=20_000):
    """The motion from ``begin`` to ``end`` by many short Euler steps."""
    x = y = heading = 0.0
    lasting = (end - begin) / steps
    for k in range(steps):
        now = begin + (k + 0.5) * lasting
        at = np.searchsorted(times, now, side="right") - 1
        v, turning = velocities[at] if at >= 0 else (0.0, 0.0)
        middle = heading + 0.5 * turning * lasting
        x, y, heading = (
            x + v * lasting * np.cos(middle),
            y + v * lasting * np.sin(middle),
            heading + turning * lasting,
        )
    return np.array([x, y, heading])


def fill_in(A, order):
    """Entries of R, structurally, when the columns of A are eliminated in this order, rows joined by each."""
    rows = [set(np.flatnonzero(row)) for row in A]
    entries = 0
    for column in order:
        holding = [row for row in rows if column in row]
        joined = set().union(*holding) if holding else {column}
        entries += len(joined)
        rows = [row for row in rows if column not in row]
        rows.append(joined - {column})
    return entries
