"""The same team in our simulator: map, starts, radar range, robots and time as in the trial."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch

from maexp.envs import ExplorationEnv, ObservationConfig, PlannerConfig, PointCloudMap, RadarConfig, RobotConfig
from maexp.kernels.constants import DT

from .config import TrialConfig


def make_team(world: PointCloudMap, num_robots: int, config: TrialConfig, targets: int = 0) -> ExplorationEnv:
    """A team of differential drives on the floor, for the trial's time, each shown so many targets."""
    local = max(1, round(config.decide / DT))
    robot = RobotConfig(
        kind="differential", max_speed=config.max_speed, max_accel=config.max_accel, max_yaw_rate=config.max_yaw_rate
    )
    return ExplorationEnv(
        world,
        1,
        num_robots,
        seed=config.seed,
        robot=robot,
        radar=RadarConfig(range=config.radar_range),
        planner=PlannerConfig(name="wavefront"),
        local_steps=local,
        success_coverage=1.0,
        num_threads=1,
        macro_steps=math.ceil(config.seconds / (local * DT)),
        observation=ObservationConfig(pictures=False, targets=targets),
    )


def draw_starts(env: ExplorationEnv, episode: int) -> np.ndarray:
    """Where the team of an evaluation episode starts: x, y [m] and heading [rad], [N, 3]."""
    _begin(env, episode)
    now = env.snapshot()
    return np.concatenate([now["center"], now["pose"][:, 3:4]], axis=1).astype(float)


def run_ours(env: ExplorationEnv, choose: Callable, episode: int) -> tuple[list[float], np.ndarray]:
    """An evaluation episode of a policy made for `env`: coverage every DT, the first at the start, and who has
    collided."""
    curve: list[float] = []
    env.set_step_hook(lambda env: curve.append(env.snapshot()["coverage"]))
    now = _begin(env, episode)
    while not bool(now["done"]):
        with torch.no_grad():
            now = env.step(choose(now))["next"]
    env.set_step_hook(None)
    return curve, now["info", "collided"][0].numpy()


def _begin(env: ExplorationEnv, episode: int):
    env.set_episodes(torch.tensor([episode], dtype=torch.int32))
    return env.reset()
