"""Where robots believe to be: the truth with noise, and with an error that grows along the way."""

from __future__ import annotations

import math

import numpy as np

TURN = 0.2  # [rad] of heading for each metre of noise or drift


class Odometry:
    """Beliefs of a team that began in the right place.

    Args:
        poses: where they are, [N, 3] [m, rad].
        noise, drift: see `TrialConfig`.
        rng: draws the errors.
    """

    def __init__(self, poses: np.ndarray, noise: float, drift: float, rng: np.random.Generator):
        self.noise, self.drift, self.rng = noise, drift, rng
        self.believed, self._walked, self._last = poses.copy(), poses.copy(), poses.copy()

    def update(self, poses: np.ndarray) -> np.ndarray:
        """What they believe now that they are at `poses`, [N, 3]."""
        scale = np.array([1.0, 1.0, TURN])
        moved = poses - self._last
        turned = wrapped(moved[:, 2])
        angle = self._walked[:, 2] - self._last[:, 2]  # steps count in the frame of the belief
        c, s = np.cos(angle), np.sin(angle)
        step = np.stack([c * moved[:, 0] - s * moved[:, 1], s * moved[:, 0] + c * moved[:, 1], turned], axis=1)
        length = np.sqrt(np.linalg.norm(moved[:, :2], axis=1))[:, None]
        self._walked = self._walked + step + self.drift * length * scale * self.rng.normal(size=poses.shape)
        self._last = poses.copy()
        self.believed = self._walked + self.noise * scale * self.rng.normal(size=poses.shape)
        return self.believed


def wrapped(angle: np.ndarray) -> np.ndarray:
    """The same angle [rad] from -pi to pi."""
    return (np.asarray(angle) + math.pi) % (2 * math.pi) - math.pi
