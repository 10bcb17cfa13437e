"""Dynamic window approach (docs/planners.md): score every candidate control a few steps ahead, take the best."""

import math

import numpy as np

from oracle.radar import distance


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


def scores(state, goal, controls, *, move, middle, gap, clearance, horizon=3, weight=100.0) -> np.ndarray:
    """Score of every control held for `horizon` steps.

    move(state, control) -> next state, without the speed limit; middle(state) -> centre of the body;
    gap(state) -> distance [m] of the body there to the nearest thing known to be in the way.
    """
    values = np.zeros(len(controls))
    for index, control in enumerate(controls):
        ahead = state
        for _ in range(horizon):
            ahead = move(ahead, control)
        values[index] = score(gap(ahead), distance(goal, middle(ahead)), clearance, weight)
    return values


def first_best(values) -> int:
    """Index of the first maximum."""
    best = 0
    for index in range(1, len(values)):
        if values[index] > values[best]:
            best = index
    return best
