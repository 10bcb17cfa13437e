"""What robots think of targets: the classical planners of `maexp.envs.choices`, and one that takes any."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from maexp.envs.choices import CLASSICAL, rank

from .frontiers import STRIDE
from .scene import ArrayScene


def rank_any(scene: ArrayScene) -> np.ndarray:
    """Each robot any target that it can get to, and that one again as long as it is there."""
    start = scene.rng.bit_generator.seed_seq.entropy
    draw = [
        np.random.default_rng([start, robot, *block]).random()
        for robot in scene.robots.tolist()
        for block in (scene.targets.block + STRIDE).tolist()
    ]
    return rank(scene, np.reshape(draw, scene.travel.shape), np.isfinite(scene.travel))


CHOICES: dict[str, Callable[[ArrayScene], np.ndarray]] = {"random": rank_any} | CLASSICAL
"""Name -> `ArrayScene` to what each robot thinks of each target, float [n, K]; -inf: out of reach."""
