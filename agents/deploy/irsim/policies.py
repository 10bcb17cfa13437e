"""Policies of a trial in ir-sim, and the same team in our own simulator for comparison."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from maexp.agents.deploy.irsim.config import TrialConfig
from maexp.agents.deploy.planner import CHOICES, Plan, TeamPlanner
from maexp.agents.deploy.planner.grid import read_grid
from maexp.agents.deploy.planner.grid_search import trace_from
from maexp.agents.deploy.planner.lookahead import LOOKAHEAD
from maexp.agents.deploy.planner.scene import find_ways
from maexp.agents.deploy.planner.team import read_team
from maexp.agents.errors import UserError
from maexp.agents.policies.export import export_policy
from maexp.agents.policies.registry import NamedPolicy
from maexp.agents.policies.remote.numpy_policy import PolicyCalls
from maexp.agents.policies.remote.user_policy import is_numpy_policy
from maexp.envs import ExplorationEnv, ObservationConfig, PlannerConfig, PointCloudMap, RadarConfig, RobotConfig
from maexp.kernels.constants import DT, FREE, OBSTACLE, UNREACHED


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


def check_player(word: str, policy: NamedPolicy) -> None:
    """Raise UserError for a policy that plays in our simulator alone."""
    if policy.kind == "classical" and word not in (names := (*CHOICES, LOOKAHEAD)):
        known = ", ".join(names)
        raise UserError(f"policy={word} looks into our simulator and plays there alone: choose of {known}.")
    if policy.kind == "checkpoint" and policy.targets is None:
        raise UserError(f"policy={word} chooses regions of a whole map: maexp irsim plays those trained on targets.")
    if policy.kind == "own" and not is_numpy_policy(policy.found):
        raise UserError(
            f"policy={word} plays on tensordicts of our simulator's env: maexp irsim takes a class with act "
            "(NumPy arrays in, goals in metres out)."
        )


def make_planner(word: str, policy: NamedPolicy, config: TrialConfig, env: ExplorationEnv, where: Path):
    """What `run_trial` asks for plans.

    Args:
        env: the same team in our simulator.
        where: folder of the trial; a run's policy is exported to it.
    """
    if policy.kind == "own":
        return NumpyTeam(policy, config, env.num_robots)
    if policy.kind == "checkpoint":
        trained = {"iteration": policy.saved["iteration"]}
        export_policy(policy.make(env), env, where / "policy", policy.name, f"# {policy.name}\n", trained)
        word = str(where / "policy")
    return team_planner(word, config)


def team_planner(word: str, config: TrialConfig) -> TeamPlanner:
    """A planner for the team of a trial; `word` is a name or folder that it knows."""
    return TeamPlanner(
        word,
        radar_range=config.radar_range,
        robot_radius=config.clearance,
        seed=config.seed,
        max_speed=config.max_speed,
        max_accel=config.max_accel,
        seconds=config.decide,
    )


class NumpyTeam:
    """A foreign policy in the place of a `TeamPlanner`: all robots hear each other, ways are found as there."""

    def __init__(self, policy: NamedPolicy, config: TrialConfig, num_robots: int):
        self.config, self.calls = config, PolicyCalls(policy.name)
        self.agent = self.calls.make(policy.found)
        self.poses = np.full((num_robots, 3), np.nan)
        self.calls.reset(
            self.agent,
            {
                "num_robots": num_robots,
                "radar_range": config.radar_range,
                "robot_radius": config.clearance,
                "max_speed": config.max_speed,
                "max_accel": config.max_accel,
                "seconds": config.seconds,
                "decision_seconds": config.decide,
                "seed": config.seed,
            },
        )

    def plan(self, grid, resolution, origin, poses, *, velocities, time_left: float, now: float) -> Plan:
        """Goals and ways of all robots; the arguments of `TeamPlanner.plan`. Who is None in `poses` has collided."""
        notes: list[str] = []
        alive = np.array([pose is not None for pose in poses.values()])
        for robot, pose in poses.items():
            self.poses[robot] = self.poses[robot] if pose is None else pose
        known = read_grid(grid, resolution, origin, 50.0, notes)
        goals = self.calls.act(self.agent, self._observe(known, alive, velocities, time_left, now), len(alive))
        team = read_team(poses, None, self.config.clearance, notes)
        return self._plan(known, team, goals, notes)

    def _observe(self, known, alive: np.ndarray, speeds, time_left: float, now: float) -> dict[str, Any]:
        count, heading = len(alive), self.poses[:, 2]
        values = np.full(known.known.shape, -1, np.int8)
        values[known.known == FREE], values[known.known == OBSTACLE] = 0, 100
        velocities = np.asarray(speeds)[:, None] * np.stack([np.cos(heading), np.sin(heading)], -1)
        return {
            "grid": np.repeat(values[None], count, axis=0),
            "resolution": known.cell,
            "origin": known.corner,
            "poses": np.repeat(self.poses[None], count, axis=0),
            "velocities": np.repeat(velocities[None], count, axis=0),
            "heard": np.ones((count, count), bool),
            "alive": alive,
            "time": now,
            "time_left": time_left,
        }

    def _plan(self, known, team, goals: np.ndarray, notes: list[str]) -> Plan:
        """A way to the place nearest to each goal that the robot gets to; none for robots that stay."""
        robots, passable, distance = find_ways(known, team, 2.0, notes)
        active, ways, ends = np.zeros(len(goals), bool), [np.zeros((0, 2))] * len(goals), team.at.copy()
        for row, robot in enumerate(robots):
            reached = np.flatnonzero(distance[row] < UNREACHED)
            if np.isnan(goals[robot]).any() or not len(reached):
                continue
            gap = known.centers(reached) - known.from_map(goals[robot])
            end = reached[(gap**2).sum(-1).argmin()]
            ways[robot] = trace_from(team.at[robot], known, passable[row], distance[row], end)
            ends[robot], active[robot] = ways[robot][-1], True
        none = np.zeros(len(goals), bool)
        return Plan(team.names, ends, active, none, ways, np.zeros((0, 2)), False, tuple(notes), none.copy())
