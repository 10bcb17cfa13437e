"""Our own planners as foreign policies of the arena: NumPy in, goals in metres out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from maexp.agents.deploy.planner.frontiers import look_around
from maexp.agents.deploy.planner.grid import read_grid
from maexp.agents.deploy.planner.team_planner import Plan, TeamPlanner
from maexp.envs.targets.features import drive_until_next


class TeamAgent:
    """A `TeamPlanner` for the episodes of the arena (`maexp.agents.policies.remote.numpy_policy` tells what these
    hold).

    Args:
        policy: a classical planner, a trained policy that ships, or the folder of one.

    Raises:
        ValueError: there is no such policy.
    """

    def __init__(self, policy: str | Path):
        self.policy = policy
        TeamPlanner(policy)

    def reset(self, episode: dict[str, Any]) -> None:
        """Begin with a planner that remembers nothing."""
        self.episode = episode
        self.planners = [TeamPlanner(self.policy, **planner_options(episode)) for _ in range(episode["num_robots"])]

    def act(self, observation: dict[str, Any]) -> np.ndarray:
        """Where each robot goes, float64 [N, 2] [m]; NaN where it stays.

        Robots that all hear each other plan once, together; else each plans with what it knows, and goes where its own
        plan sends it.
        """
        count = len(observation["alive"])
        if observation["heard"].all():
            return self._plan(observation, 0)
        return np.stack([self._plan(observation, robot)[robot] for robot in range(count)])

    def _plan(self, observation: dict[str, Any], robot: int) -> np.ndarray:
        """The goals of all as one robot sees it."""
        poses = np.where(observation["alive"][:, None], observation["poses"][robot], np.nan)
        plan = self.planners[robot].plan(
            observation["grid"][robot],
            observation["resolution"],
            observation["origin"],
            poses,
            velocities=np.nan_to_num(observation["velocities"][robot]),
            time_left=observation["time_left"],
            now=observation["time"],
        )
        grid = observation["grid"][robot], observation["resolution"], observation["origin"]
        at, speed = observation["poses"][robot, :, :2], np.linalg.norm(observation["velocities"][robot], axis=-1)
        return np.where(plan.active[:, None], extend_goals(plan, grid, at, speed, self.episode), np.nan)


def planner_options(episode: dict[str, Any]) -> dict[str, Any]:
    """Arguments of a `TeamPlanner` for an episode of the arena."""
    return {
        "radar_range": episode["radar_range"],
        "robot_radius": episode["robot_radius"],
        "bounded": True,
        "least_area": 0.0,
        "max_speed": episode["max_speed"],
        "max_accel": episode["max_accel"],
        "drive": episode.get("drive", "differential"),
        "seconds": episode["decision_seconds"],
        "seed": episode["seed"],
        "patience": 3.0 * episode["decision_seconds"],
    }


def extend_goals(plan: Plan, grid: tuple, at: np.ndarray, speed: np.ndarray, episode: dict[str, Any]) -> np.ndarray:
    """The goals of a plan, those of active robots as of `go_beyond`, float64 [N, 2] [m].

    Args:
        grid: values [H, W], resolution [m] and origin [m] of what the plan was made on.
        at, speed: of the robots, [N, 2] [m] and [N] [m/s].
        episode: of the arena.
    """
    goals, rows = plan.goals.copy(), np.flatnonzero(plan.active)
    if len(rows):
        known, target = read_grid(*grid, 50.0, []), goals[rows]
        limits = (episode[name] for name in ("max_accel", "max_speed", "decision_seconds"))
        drive = drive_until_next(np, speed[rows], *limits)
        _, middle = look_around(known, known.cells(known.from_map(target)), episode["radar_range"], True)
        goals[rows] = go_beyond(target, middle, at[rows], drive)
    return goals


def go_beyond(target: np.ndarray, middle: np.ndarray, at: np.ndarray, drive: np.ndarray) -> np.ndarray:
    """Goals beyond targets that are near, as far as a robot still gets, float [..., 2] [m].

    One that stopped at its target would stand there until the next decision (as `TargetTracker` in the simulator).

    Args:
        target: [..., 2] [m].
        middle: of what is to be seen from there, from the target, [..., 2] [m].
        at: the robots, [..., 2] [m].
        drive: how far they get, [...] [m].
    """
    left = np.maximum(drive - np.linalg.norm(target - at, axis=-1), 0.0)
    return target + middle * (left / np.maximum(np.linalg.norm(middle, axis=-1), 1e-6))[..., None]
