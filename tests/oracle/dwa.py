"""Dynamic window approach (design 4.4): score every candidate control a few steps ahead, take the best."""

import math

import numpy as np

from oracle.motion import ackermann, center
from oracle.radar import distance

UNLIMITED = {"max_speed": math.inf, "max_accel": math.inf, "max_steer": math.inf}


def candidates(max_accel: float, max_steer: float, num_steering: int, num_accel: int = 3) -> np.ndarray:
    """(num_accel * num_steering, 2): accelerations outer, steering angles inner, both ascending."""
    accels = np.linspace(-max_accel, max_accel, num_accel)
    steers = np.linspace(-max_steer, max_steer, num_steering)
    return np.asarray([[a, s] for a in accels for s in steers])


def score(nearest: float, to_goal: float, clearance: float, weight: float = 100.0) -> float:
    """-distance(goal) + weight * ln(d / clearance) where d < clearance [m]; -inf on top of an obstacle."""
    if nearest >= clearance:
        return -to_goal
    return -math.inf if nearest <= 0.0 else -to_goal + weight * math.log(nearest / clearance)


def scores(
    state,
    goal,
    obstacles,
    controls,
    *,
    length: float,
    wheelbase: float,
    clearance: float,
    horizon: int = 3,
    weight: float = 100.0,
    dt: float = 0.1,
) -> tuple[np.ndarray, np.ndarray]:
    """`(scores, nearest)` per control: the body's centre after `horizon` steps, without the speed limit.

    obstacles (n, 2): what counts as near: known obstacle points and the other robots' bodies, in range [m].
    """
    values, gaps = np.zeros(len(controls)), np.full(len(controls), np.inf)
    for index, control in enumerate(controls):
        ahead = np.asarray(state, np.float64)
        for _ in range(horizon):
            ahead = ackermann(ahead, control, wheelbase=wheelbase, dt=dt, **UNLIMITED)
        middle = center(ahead, length)
        for point in obstacles:
            gaps[index] = min(gaps[index], distance(point[:2], middle))
        values[index] = score(gaps[index], distance(goal, middle), clearance, weight)
    return values, gaps


def first_best(values) -> int:
    """Index of the first maximum."""
    best = 0
    for index in range(1, len(values)):
        if values[index] > values[best]:
            best = index
    return best
