"""Robots and motion: state (x, y, v, theta) at the rear, explicit Euler, footprint, collision."""

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


def omnidirectional(state, slip: float, control, *, max_speed, max_accel, dt=0.1) -> tuple[np.ndarray, float]:
    """Next (x, y, v, theta) and sideways speed; control = accelerations ahead and to the left [m/s^2].

    The heading stays; the speed vector is shortened to the limit.
    """
    x, y, v, theta = (float(s) for s in state)
    slip = float(slip)
    c, s = math.cos(theta), math.sin(theta)
    ahead = v + clamp(float(control[0]), max_accel) * dt
    left = slip + clamp(float(control[1]), max_accel) * dt
    share = min(1.0, max_speed / max(math.hypot(ahead, left), 1e-30))
    moved = [x + (v * c - slip * s) * dt, y + (v * s + slip * c) * dt, ahead * share, theta]
    return np.asarray(moved), left * share


def rear_state(state, length: float, kind: str) -> np.ndarray:
    """State of the rear point: where the others than cars keep their body's centre, half a length back."""
    x, y, v, theta = (float(s) for s in state)
    back = 0.0 if kind == "ackermann" else 0.5 * length
    return np.asarray([x - back * math.cos(theta), y - back * math.sin(theta), v, theta])


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


def outline(state, length: float, width: float, spacing: float) -> tuple[np.ndarray, float]:
    """`(points (n, 2), step)`: the edge of the body, corners included, cut at `spacing` or finer (two at least).

    step: the widest gap between neighbours [m].
    """
    ring = corners(state, length, width)
    points, widest = [], 0.0
    for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        pieces = max(2, math.ceil(distance(a, b) / spacing - 1e-6))
        points += [a + (b - a) * k / pieces for k in range(pieces)]
        widest = max(widest, distance(a, b) / pieces)
    return np.asarray(points), widest


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


def depth_in_body(point, state, length: float, width: float) -> float:
    """How deep [m] a point lies in the rectangle, negative outside of a side."""
    along, across = to_body(point, state)
    return min(along, length - along, 0.5 * width - abs(across))


def body_separation(state_a, size_a, state_b, size_b) -> float:
    """Widest gap [m] of two rectangles along the normal of a side; negative exactly where they overlap."""
    ring_a, ring_b = corners(state_a, *size_a), corners(state_b, *size_b)
    widest = -math.inf
    for theta in (float(state_a[3]), float(state_b[3])):
        for axis in ((math.cos(theta), math.sin(theta)), (-math.sin(theta), math.cos(theta))):
            a = [float(p[0] * axis[0] + p[1] * axis[1]) for p in ring_a]
            b = [float(p[0] * axis[0] + p[1] * axis[1]) for p in ring_b]
            widest = max(widest, min(b) - max(a), min(a) - max(b))
    return widest


def body_to_body(state_a, size_a, state_b, size_b) -> float:
    """Distance [m] of two oriented rectangles, 0 when they meet; sizes = (length, width)."""
    if body_separation(state_a, size_a, state_b, size_b) <= 0.0:
        return 0.0
    gaps = [point_to_body(p, state_b, *size_b) for p in corners(state_a, *size_a)]
    gaps += [point_to_body(p, state_a, *size_a) for p in corners(state_b, *size_b)]
    return min(gaps)


def collided(states, lengths, widths, thresholds, boundary, *, mode: str = "centre"):
    """`(hit, margin)` (N,): collides now; how far from undecided at least [m].

    states: of the rear points. centre: the body's centre nearer than the robot's threshold to a boundary point
    or another centre. footprint: the rectangle meets a boundary point or another rectangle, or, with a threshold
    above 0, comes nearer than that.
    """
    robots = len(states)
    hit, margin = np.zeros(robots, bool), np.full(robots, np.inf)
    for i in range(robots):
        middle, size = center(states[i], lengths[i]), (lengths[i], widths[i])
        gaps = []  # signed: below 0 is inside
        for point in boundary:
            point = (float(point[0]), float(point[1]))
            if mode == "centre":
                gaps.append(distance(point, middle))
            else:
                gaps.append(point_to_body(point, states[i], *size) or -depth_in_body(point, states[i], *size))
        for j in range(robots):
            other = (lengths[j], widths[j])
            if j != i and mode == "centre":
                gaps.append(distance(middle, center(states[j], lengths[j])))
            elif j != i:
                gap = body_to_body(states[i], size, states[j], other)
                gaps.append(gap or body_separation(states[i], size, states[j], other))
        for gap in gaps:
            hit[i] = hit[i] or gap < thresholds[i]
            margin[i] = min(margin[i], abs(gap - thresholds[i]))
    return hit, margin
