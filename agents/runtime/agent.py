"""Our own planners as foreign policies of the arena: NumPy in, goals in metres out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .frontiers import look_around
from .grid import read_grid
from .planner import Plan, TeamPlanner


class TeamAgent:
    """A `TeamPlanner` for the episodes of the arena (`maexp.agents.policies.foreign` tells what these hold).

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
        self.planners = [
            TeamPlanner(
                self.policy, radar_range=episode["radar_range"], robot_radius=episode["robot_radius"], bounded=True,
                least_area=0.0, max_speed=episode["max_speed"], max_accel=episode["max_accel"],
                seconds=episode["decision_seconds"], seed=episode["seed"], patience=3.0 * episode["decision_seconds"],
            )
            for _ in range(episode["num_robots"])
        ]  # fmt: skip

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
            observation["grid"][robot], observation["resolution"], observation["origin"], poses,
            velocities=np.nan_to_num(observation["velocities"][robot]), time_left=observation["time_left"],
            now=observation["time"],
        )  # fmt: skip
        return np.where(plan.active[:, None], self._go_beyond(plan, observation, robot), np.nan)

    def _go_beyond(self, plan: Plan, observation: dict[str, Any], robot: int) -> np.ndarray:
        """Goals beyond targets that are near, toward what is to be seen from there, as far as a robot still gets.

        One that stopped at its target would stand there until the next decision (as `TargetTracker` in the simulator).
        """
        told, goals, notes = self.episode, plan.goals.copy(), []
        grid = read_grid(observation["grid"][robot], observation["resolution"], observation["origin"], 50.0, notes)
        at, speed = observation["poses"][robot, :, :2], np.linalg.norm(observation["velocities"][robot], axis=-1)
        seconds = told["decision_seconds"]
        drive = np.minimum(speed * seconds + 0.5 * told["max_accel"] * seconds**2, told["max_speed"] * seconds)
        rows = np.flatnonzero(plan.active)
        if len(rows):
            _, middle = look_around(grid, grid.cells(grid.from_map(goals[rows])), told["radar_range"], True)
            left = np.maximum(drive[rows] - np.linalg.norm(goals[rows] - at[rows], axis=-1), 0.0)
            goals[rows] += middle * (left / np.maximum(np.linalg.norm(middle, axis=-1), 1e-6))[:, None]
        return goals
