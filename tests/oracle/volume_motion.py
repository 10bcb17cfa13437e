"""What flying robots may do, in float64: limits, collisions, and whether they can stop."""

import itertools
import math

import numpy as np


def wall_distance(free, occupied, point, reach):
    """How far a point [voxels] is from the nearest occupied voxel, looked for so far; 0 where it is in none that is
    free."""
    v = tuple(math.floor(a) for a in point)
    if not all(0 <= a < n for a, n in zip(v, free.shape, strict=True)) or not free[v]:
        return 0.0
    nearest = math.inf
    span = range(-math.ceil(reach) - 1, math.ceil(reach) + 2)
    for d in itertools.product(span, repeat=3):
        u = tuple(a + b for a, b in zip(v, d, strict=True))
        if all(0 <= a < n for a, n in zip(u, free.shape, strict=True)) and occupied[u]:
            gap = [max(a - p, p - a - 1.0, 0.0) for a, p in zip(u, point, strict=True)]
            nearest = min(nearest, math.hypot(*gap))
    return nearest


def collides(free, occupied, points, i, thresholds, resolution, slack):
    """Whether robot i collides, and how far from the limit that is [m]. points: float64 [N, 3] [voxels]."""
    wall = wall_distance(free, occupied, points[i], thresholds[i] / resolution) * resolution - slack * thresholds[i]
    others = [
        math.dist(points[i], points[j]) * resolution - max(thresholds[i], thresholds[j])
        for j in range(len(points))
        if j != i
    ]
    margin = min([wall, *others])
    return margin < 0.0, abs(margin)


def stopping_points(point, velocity, accel, dt, count=40):
    """Points [m] that a robot passes that brakes from now on as hard as it can: at the mean of the old and the new
    speed in each step of dt."""
    p, v = np.array(point, dtype=np.float64), np.array(velocity, dtype=np.float64)
    found = [p.copy()]
    while (speed := float(np.linalg.norm(v))) > 1e-9:
        slower = v * max(speed - accel * dt, 0.0) / speed
        step = 0.5 * dt * (v + slower)
        found += [p + step * (k + 1) / count for k in range(count)]
        p, v = p + step, slower
    return np.array(found)


def turned(a, b):
    """How far a heading is from another [rad]."""
    return abs((b - a + math.pi) % (2.0 * math.pi) - math.pi)
