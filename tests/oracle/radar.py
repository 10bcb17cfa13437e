"""Ray-masked point filtering (docs/paper.md, masking): which points of a cloud a radar sees from where it stands.

Every verdict is given with its certainty: `visible` is the definition in float64, `clear` is False where a
threshold lies within `tolerance` of the compared value, so that float32 may fall on either side of it.
"""

import math

import numpy as np


def distance(a, b) -> float:
    """Euclidean distance [m] of two points of any dimension."""
    return math.sqrt(sum((float(p) - float(q)) ** 2 for p, q in zip(a, b, strict=True)))


def wrap(angle: float) -> float:
    """`angle` [rad] brought to [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def masks(free, obstacle, alpha1: float, alpha2: float, rho: float, slack: float = 0.0) -> bool:
    """True when the obstacle vector masks the free vector; `slack` > 0 loosens every compare."""
    range_free, range_obstacle = math.sqrt(sum(c * c for c in free)), math.sqrt(sum(c * c for c in obstacle))
    if range_free == 0.0 or range_obstacle == 0.0:
        return False  # where the sensor itself stands: seen, and no wall
    if not range_obstacle - range_free < alpha2 + slack:
        return False
    cosine = sum(f * o for f, o in zip(free, obstacle, strict=True)) / (range_free * range_obstacle)
    cosine = min(1.0, max(-1.0, cosine))
    if cosine > 1.0 - alpha1 - slack:
        return True
    return rho > 0.0 and math.acos(cosine) < math.asin(min(1.0, rho / range_obstacle)) + slack


def in_view(vector, heading: float, fov: float, slack: float = 0.0) -> bool:
    """True when the angle between `vector` and the heading [rad, in the plane] stays within half `fov`."""
    length = math.sqrt(sum(c * c for c in vector))
    if fov >= 2.0 * math.pi or length == 0.0:
        return True
    cosine = (vector[0] * math.cos(heading) + vector[1] * math.sin(heading)) / length
    return math.acos(min(1.0, max(-1.0, cosine))) <= 0.5 * fov + slack


def visible_points(
    free,
    obstacles,
    origin,
    radar_range: float,
    alpha1: float = 1e-3,
    alpha2: float = 1e-6,
    obstacle_radius=0.0,
    *,
    heading: float = 0.0,
    fov: float = 2.0 * math.pi,
    tolerance: float = 1e-5,
) -> tuple[np.ndarray, np.ndarray]:
    """`(visible, clear)`, bool (n_free,): seen from `origin` [m], and no threshold within `tolerance`."""
    free, obstacles = np.asarray(free, np.float64), np.asarray(obstacles, np.float64)
    origin = np.asarray(origin, np.float64)
    radius = np.broadcast_to(np.asarray(obstacle_radius, np.float64), (len(obstacles),))
    walls = [
        ([float(c) for c in point - origin], float(rho))
        for point, rho in zip(obstacles, radius, strict=True)
        if distance(point, origin) <= radar_range + tolerance
    ]
    visible, clear = np.zeros(len(free), bool), np.ones(len(free), bool)
    for index, point in enumerate(free):
        vector = [float(c) for c in point - origin]
        length = math.sqrt(sum(c * c for c in vector))
        if length > radar_range + tolerance:
            continue
        exact, surely, maybe = True, True, True  # seen: by the definition, at the worst, at the best
        exact &= length <= radar_range and in_view(vector, heading, fov)
        surely &= length <= radar_range - tolerance and in_view(vector, heading, fov, -tolerance)
        maybe &= in_view(vector, heading, fov, tolerance)
        for wall, rho in walls:
            if exact and math.sqrt(sum(c * c for c in wall)) <= radar_range:
                exact = not masks(vector, wall, alpha1, alpha2, rho)
            surely = surely and not masks(vector, wall, alpha1, alpha2, rho, tolerance)
            if maybe and math.sqrt(sum(c * c for c in wall)) <= radar_range - tolerance:
                maybe = not masks(vector, wall, alpha1, alpha2, rho, -tolerance)
            if not maybe:
                break
        visible[index], clear[index] = exact and maybe, surely == maybe
    return visible, clear


def seen_boundary(boundary, free, visible, origin, radar_range: float, reach):
    """`(seen, clear)`, bool (n_boundary,): in range and within `reach` [m] of a visible free point."""
    reach = np.broadcast_to(np.asarray(reach, np.float64), (len(boundary),))
    seen, clear = np.zeros(len(boundary), bool), np.ones(len(boundary), bool)
    for index, point in enumerate(boundary):
        clear[index] = abs(distance(point, origin) - radar_range) > 1e-5
        if distance(point, origin) <= radar_range:
            for near, flag in zip(free, visible, strict=True):
                if flag and distance(point, near) <= reach[index]:
                    seen[index] = True
                    break
    return seen, clear


def behind_wall(free, origin, cells, resolution: float, *, step: float = 0.01) -> np.ndarray:
    """Bool (n_free,): the segment from `origin` to the point enters a wall cell, in steps of `step` cells.

    `cells`: set of integer (ix, iy) of obstacle points on a lattice of `resolution` [m]; a cell is the square
    around its point. The march ends half a step before the free point itself.
    """
    hidden = np.zeros(len(free), bool)
    for index, point in enumerate(free):
        dx, dy = float(point[0]) - float(origin[0]), float(point[1]) - float(origin[1])
        count = max(1, math.ceil(math.hypot(dx, dy) / (step * resolution)))
        for k in range(count):
            t = (k + 0.5) / count
            ix = math.floor((float(origin[0]) + t * dx) / resolution + 0.5)
            iy = math.floor((float(origin[1]) + t * dy) / resolution + 0.5)
            if (ix, iy) in cells:
                hidden[index] = True
                break
    return hidden
