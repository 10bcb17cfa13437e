"""Robots and motion (design 4.3): state (x, y, v, theta) at the rear, explicit Euler, footprint, collision."""

import math

import numpy as np

from oracle.radar import distance, wrap


def clamp(value: float, limit: float) -> float:
    """`value` brought into [-limit, limit]."""
    return max(-limit, min(limit, value))


def ackermann(state, control, *, max_speed, max_accel, max_steer, wheelbase, dt=0.1) -> np.ndarray:
    """Next (x, y, v, theta); control = (acceleration [m/s^2], steering [rad]); x' takes v, theta of before."""
    x, y, v, theta = (float(s) for s in state)
    accel, steer = clamp(float(control[0]), max_accel), clamp(float(control[1]), max_steer)
    return np.asarray(
        [
            x + v * math.cos(theta) * dt,
            y + v * math.sin(theta) * dt,
            clamp(v + accel * dt, max_speed),
            wrap(theta + v * math.tan(steer) / wheelbase * dt),
        ]
    )


def differential(state, control, *, max_speed, max_accel, max_yaw_rate, dt=0.1) -> np.ndarray:
    """Next (x, y, v, theta); control = (acceleration [m/s^2], yaw rate [rad/s])."""
    x, y, v, theta = (float(s) for s in state)
    accel, rate = clamp(float(control[0]), max_accel), clamp(float(control[1]), max_yaw_rate)
    return np.asarray(
        [
            x + v * math.cos(theta) * dt,
            y + v * math.sin(theta) * dt,
            clamp(v + accel * dt, max_speed),
            wrap(theta + rate * dt),
        ]
    )


def center(state, length: float) -> np.ndarray:
    """Body's centre: half a length ahead of the rear point."""
    x, y, _, theta = (float(s) for s in state)
    return np.asarray([x + 0.5 * length * math.cos(theta), y + 0.5 * length * math.sin(theta)])


def corners(state, length: float, width: float) -> np.ndarray:
    """(4, 2) corners of the body, counter-clockwise from rear right."""
    x, y, _, theta = (float(s) for s in state)
    c, s = math.cos(theta), math.sin(theta)
    local = [(0.0, -0.5 * width), (length, -0.5 * width), (length, 0.5 * width), (0.0, 0.5 * width)]
    return np.asarray([[x + c * a - s * b, y + s * a + c * b] for a, b in local])


def outline(state, length: float, width: float, spacing: float) -> np.ndarray:
    """(n, 2) points on the edge of the body, corners included, at most `spacing` apart."""
    ring = corners(state, length, width)
    points = []
    for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        pieces = max(1, math.ceil(distance(a, b) / spacing - 1e-9))
        points += [a + (b - a) * k / pieces for k in range(pieces)]
    return np.asarray(points)


def to_body(point, state) -> tuple[float, float]:
    """Coordinates of a world point in the frame of the rear point."""
    dx, dy = float(point[0]) - float(state[0]), float(point[1]) - float(state[1])
    c, s = math.cos(float(state[3])), math.sin(float(state[3]))
    return c * dx + s * dy, -s * dx + c * dy


def point_to_body(point, state, length: float, width: float) -> float:
    """Distance [m] of a point to the oriented rectangle, 0 inside."""
    along, across = to_body(point, state)
    dx = max(0.0 - along, 0.0, along - length)
    dy = max(abs(across) - 0.5 * width, 0.0)
    return math.hypot(dx, dy)


def segments_cross(a, b, c, d) -> bool:
    """True when the open segments ab and cd cross properly."""

    def side(p, q, r):
        return (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])

    return side(a, b, c) * side(a, b, d) < 0.0 and side(c, d, a) * side(c, d, b) < 0.0


def body_to_body(state_a, size_a, state_b, size_b) -> float:
    """Distance [m] of two oriented rectangles, 0 when they meet; sizes = (length, width)."""
    ring_a, ring_b = corners(state_a, *size_a), corners(state_b, *size_b)
    for i in range(4):
        for j in range(4):
            if segments_cross(ring_a[i], ring_a[(i + 1) % 4], ring_b[j], ring_b[(j + 1) % 4]):
                return 0.0
    gaps = [point_to_body(p, state_b, *size_b) for p in ring_a]
    gaps += [point_to_body(p, state_a, *size_a) for p in ring_b]
    return min(gaps)


def collided(states, lengths, widths, thresholds, boundary, *, mode: str = "centre"):
    """`(hit, margin)` (N,): collides now (design 4.3); how far a distance is from the threshold at least [m].

    centre: the body's centre nearer than the robot's threshold to a boundary point or another centre.
    footprint: the oriented rectangle nearer than the threshold to a boundary point or another footprint; a
    threshold of 0 means contact.
    """
    robots = len(states)
    hit, margin = np.zeros(robots, bool), np.full(robots, np.inf)
    for i in range(robots):
        middle, size = center(states[i], lengths[i]), (lengths[i], widths[i])
        gaps = []
        for point in boundary:
            point = (float(point[0]), float(point[1]))
            footprint_gap = point_to_body(point, states[i], *size)
            gaps.append(distance(point, middle) if mode == "centre" else footprint_gap)
        for j in range(robots):
            if j != i and mode == "centre":
                gaps.append(distance(middle, center(states[j], lengths[j])))
            elif j != i:
                gaps.append(body_to_body(states[i], size, states[j], (lengths[j], widths[j])))
        for gap in gaps:
            touching = gap <= 0.0 and mode == "footprint"
            hit[i] = hit[i] or touching or gap < thresholds[i]
            margin[i] = min(margin[i], abs(gap - thresholds[i]))
    return hit, margin
