"""How a team takes targets in turn: `maexp.kernels.teamwork` in NumPy."""

from __future__ import annotations

import numpy as np


def plan_in_turn(gain: np.ndarray, value: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Robots choose one after the other, the one with the most to win first; a target taken lowers the gain of others
    that can be seen from there (Burgard et al. 2005).

    Args:
        gain: float32 [n, M], what is to be seen from a candidate.
        value: float32 [n, M], what it is worth as long as nobody has claimed any of that; -inf: there is none.
        point: float [n, M, 2], where they are [radar ranges].

    Returns:
        each candidate's value when it is its robot's turn, float32 [n, M]; the candidate taken, int64 [n] (0 for robots
        without any); the share of the gain that was claimed before, float32 [n, M].
    """
    some = value > -np.inf
    rest = np.where(some, value, 0.0) - gain
    score, claimed, left = np.zeros_like(gain), np.zeros_like(gain), np.ones_like(gain)
    taken, waiting = np.zeros(len(gain), np.int64), np.any(some, axis=-1)
    while waiting.any():
        now = np.where(some & waiting[:, None], gain * left + rest, -np.inf)
        robot, k = np.unravel_index(now.argmax(), now.shape)
        score[robot], claimed[robot] = (gain * left + rest)[robot], 1.0 - left[robot]
        taken[robot], waiting[robot] = k, False
        gap = np.linalg.norm(point - point[robot, k], axis=-1)
        left = left * np.minimum(gap, 1.0).astype(np.float32)
    return score, taken, claimed
