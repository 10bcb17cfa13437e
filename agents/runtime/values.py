"""What targets are worth, and how a team shares them out in turn: `maexp.envs.targets` in NumPy."""

from __future__ import annotations

import numpy as np

BETA = 0.03  # weight of a radar range of travel against a whole disc of unknown cells
LEAST_GAIN = 0.3  # targets with less to see, as a share of the radar's disc, are hardly worth a way of their own


def value_targets(gain: np.ndarray, travel: np.ndarray, radar_range: float) -> np.ndarray:
    """What every target is worth to every robot by itself, in radar discs, float32 [n, K]; -inf: out of reach.

    Unknown area against the way there (Burgard et al. 2005).
    """
    return (gain - BETA * travel / radar_range).astype(np.float32)


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
    taken, waiting = np.zeros(len(gain), np.int64), some.any(-1)
    while waiting.any():
        now = np.where(some & waiting[:, None], gain * left + rest, -np.inf)
        robot, k = np.unravel_index(now.argmax(), now.shape)
        score[robot], claimed[robot] = (gain * left + rest)[robot], 1.0 - left[robot]
        taken[robot], waiting[robot] = k, False
        gap = np.linalg.norm(point - point[robot, k], axis=-1)
        left = left * np.minimum(gap, 1.0).astype(np.float32)
    return score, taken, claimed
