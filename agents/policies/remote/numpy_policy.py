"""Foreign policies: NumPy arrays in, goals in metres out, nothing known of torch, tensordicts or the simulator.

A foreign policy is an object with

    reset(episode: dict) -> None         an episode begins (may be absent)
    act(observation: dict) -> goals      float [N, 2] [m]; NaN: the robot stays

`episode` holds `num_robots`, `radar_range` [m], `robot_radius` [m], `max_speed` [m/s], `max_accel` [m/s^2] (of a mixed
team the largest), `drive` ("ackermann", "differential" or "omnidirectional"; that of robot 0), `seconds` (of the whole
episode), `decision_seconds` and `seed` (of this episode alone).
`observation` holds, row i being what robot i knows:

    grid          int8 [N, H, W]      -1 unknown, 0 free, 100 occupied; row = y
    resolution    float               edge of a cell [m]
    origin        (float, float)      x, y of the grid's lower left corner [m]
    poses         float64 [N, N, 3]   x, y [m], heading [rad] of robot j as i last heard; NaN: never
    velocities    float64 [N, N, 2]   [m/s], likewise
    heard         bool [N, N]         whom i hears now, itself included
    alive         bool [N]            who has not collided
    time          float               since the episode began [s]
    time_left     float               share of the episode, 1 to 0

One object plays one team: every env has its own.
"""

from __future__ import annotations

import sysconfig
import traceback
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import torch
import warp as wp
from tensordict.nn import TensorDictModule

from maexp.agents.errors import UserError
from maexp.agents.policies.classical import as_module
from maexp.envs import ExplorationEnv
from maexp.envs.targets.navigation import known_grids
from maexp.envs.targets.region_action import to_regions
from maexp.kernels.constants import DT
from maexp.kernels.launches import finish_filling, launch_on

LIBRARIES = (sysconfig.get_path("stdlib"), sysconfig.get_path("platstdlib"))
VALUES = np.array([-1, 0, 100], np.int8)
"""What a grid holds where a cell is UNKNOWN, FREE or OBSTACLE."""


class NumpyTeamPolicy(Protocol):
    """What plays one team."""

    def reset(self, episode: dict[str, Any]) -> None: ...

    def act(self, observation: dict[str, Any]) -> np.ndarray: ...


class TeamSight:
    """What the teams of an env know, as NumPy arrays; the env is only read.

    Args:
        env: any; its grids are those that the classical planners plan on.
    """

    def __init__(self, env: ExplorationEnv):
        self.env = env
        self.known_grids = known_grids(env)
        self.rows, grids = self.known_grids.rows_per_env, self.known_grids.grids
        finish_filling(env.device)
        self.launch = launch_on(env.device)
        width, height, cell, origin = (getattr(grids, name).numpy() for name in ("width", "height", "cell", "origin"))
        self.shapes = list(zip(height.tolist(), width.tolist(), strict=True))
        self.cells, self.origins = cell.tolist(), [tuple(corner) for corner in origin.tolist()]
        shape = (env.num_envs, env.num_robots, env.num_robots)
        self.poses, self.velocities = np.full((*shape, 3), np.nan), np.full((*shape, 2), np.nan)

    def look(self) -> None:
        """Take in what the env holds now: once a decision, for what robots last heard of each other is kept here."""
        self.known_grids.paint(self.launch)
        self.known = wp.to_torch(self.known_grids.known).cpu().numpy().reshape(self.env.num_envs, self.rows, -1)
        names = ("map_id", "macro_step", "local_step", "active", "collided", "comm", "pose", "slip", "center")
        self.now = now = {name: self.env.simulation.believed[name].cpu().numpy() for name in names}
        begins = now["macro_step"] == 0
        self.poses[begins], self.velocities[begins] = np.nan, np.nan
        pose, slip = now["pose"].astype(np.float64), now["slip"].astype(np.float64)[..., None]
        speed, cos, sin = pose[..., 2:3], np.cos(pose[..., 3:]), np.sin(pose[..., 3:])
        velocities = np.concatenate([speed * cos - slip * sin, speed * sin + slip * cos], -1)
        poses = np.concatenate([now["center"][..., :2], now["pose"][..., 3:]], -1)
        np.copyto(self.poses, poses[:, None], where=now["comm"][..., None])
        np.copyto(self.velocities, velocities[:, None], where=now["comm"][..., None])

    @property
    def active(self) -> np.ndarray:
        """Teams whose episode runs, bool [E]."""
        return self.now["active"] != 0

    @property
    def begins(self) -> np.ndarray:
        """Teams that have decided nothing yet in their episode, bool [E]."""
        return self.now["macro_step"] == 0

    def observation(self, team: int) -> dict[str, Any]:
        """What a foreign policy is told of env `team` (see the head of this file); arrays of its own."""
        m, now, env = int(self.now["map_id"][team]), self.now, self.env
        height, width = self.shapes[m]
        grid = VALUES[self.known[team, :, : height * width]].reshape(self.rows, height, width)
        return {
            "grid": np.repeat(grid, env.num_robots // self.rows, axis=0),
            "resolution": self.cells[m],
            "origin": self.origins[m],
            "poses": self.poses[team].copy(),
            "velocities": self.velocities[team].copy(),
            "heard": now["comm"][team].copy(),
            "alive": now["collided"][team] == 0,
            "time": round(float(now["local_step"][team]) * DT, 6),
            "time_left": 1.0 - float(now["macro_step"][team]) / env.macro_steps,
        }

    def episode(self, team: int) -> dict[str, Any]:
        """What a foreign policy is told of the episode that env `team` begins."""
        env, robots = self.env, self.env.simulation.robot_tensors
        keys = [
            int(env.simulation.tensors[name].reshape(-1)[row])
            for name, row in (("seed", 0), ("env_id", team), ("episode", team))
        ]
        return {
            "num_robots": env.num_robots,
            "radar_range": float(max(radar.range for radar in env.radar_configs)),
            "robot_radius": _largest(robots["collision_threshold"][team]),
            "max_speed": _largest(robots["max_speed"][team]),
            "max_accel": _largest(robots["max_accel"][team]),
            "drive": env.robot_configs[0].kind,
            "seconds": round(env.macro_steps * env.local_steps * DT, 6),
            "decision_seconds": round(env.local_steps * DT, 6),
            "seed": int(np.random.SeedSequence([key % 2**32 for key in keys]).generate_state(1)[0]) >> 1,
        }

    def to_action(self, goals: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        """Region int64 [E, N] and offset float32 [E, N, 2] of goals, float [E, N, 2] [m]; NaN: the robot stays.

        Goals beyond the map are taken to its edge. A robot that stays has its own place as its goal.
        """
        points = torch.from_numpy(np.asarray(goals, np.float32)).to(self.env.device)
        own = self.env.simulation.believed["center"][..., :2]
        return to_regions(self.env.simulation, torch.where(points.isnan().any(-1, keepdim=True), own, points))


def _largest(values: torch.Tensor) -> float:
    """Of float32 numbers, as it is written: 0.6, not 0.6000000238418579."""
    return float(str(np.float32(values.max().item())))


def read_goals(answer: Any, num_robots: int) -> np.ndarray:
    """The goals of one team, float64 [N, 2] [m], NaN: stay.

    Raises:
        ValueError: the answer is something else; the message completes "act() ...".
    """
    try:
        goals = np.asarray(answer)
    except ValueError:  # rows of different lengths
        goals = np.array(None)
    wanted = f"goals must be numbers [{num_robots}, 2] in metres, a row for each robot, NaN where it stays"
    if goals.dtype.kind not in "iuf":
        raise ValueError(f"returned {_told(answer)}: {wanted}")
    if goals.shape != (num_robots, 2):
        raise ValueError(f"returned numbers of shape {list(goals.shape)}: {wanted}")
    goals = goals.astype(np.float64)
    if np.isinf(goals).any() or np.abs(goals[~np.isnan(goals)]).max(initial=0.0) > 1e9:
        raise ValueError(f"returned a goal that is infinite or beyond 1e9 m: {wanted}")
    return goals


def _told(answer: Any) -> str:
    return "nothing" if answer is None else f"a {type(answer).__name__}"


class PolicyCalls:
    """Calls of a foreign policy; whatever it raises is told in a sentence that names it and the line.

    Args:
        name: of the policy.
    """

    def __init__(self, name: str):
        self.name = name

    def make(self, make: Callable[[], NumpyTeamPolicy]) -> NumpyTeamPolicy:
        """One object, for one team."""
        return self._call("its constructor", make)

    def reset(self, agent: NumpyTeamPolicy, episode: dict[str, Any]) -> None:
        """Tell it that an episode begins, if it likes to know."""
        if hasattr(agent, "reset"):
            self._call("reset()", agent.reset, episode)

    def act(self, agent: NumpyTeamPolicy, observation: dict[str, Any], num_robots: int) -> np.ndarray:
        """Its goals, float64 [N, 2] [m], NaN: stay."""
        answer = self._call("act()", agent.act, observation)
        try:
            return read_goals(answer, num_robots)
        except ValueError as error:
            raise UserError(f"policy {self.name}: act() {error}.") from error

    def _call(self, what: str, function: Callable, *arguments: Any) -> Any:
        try:
            return function(*arguments)
        except Exception as error:
            raise UserError(f"policy {self.name}: {what} raised {describe_error(error)}.") from error


class NumpyPolicy:
    """A foreign policy for all teams of an env; calling it asks those that play.

    Args:
        env: the env to play in, with a planner that drives to goals.
        make: called once for each team; gives an object with `act` and, if it likes, `reset`.
        name: of the policy, for messages.

    Raises:
        UserError: here or when called, where a call of `make`, `reset` or `act` raises, or `act` returns no goals.
    """

    def __init__(self, env: ExplorationEnv, make: Callable[[], NumpyTeamPolicy], name: str = "the policy"):
        self.env, self.sight, self.calls = env, TeamSight(env), PolicyCalls(name)
        self.agents = [self.calls.make(make) for _ in range(env.num_envs)]

    @torch.no_grad()
    def __call__(self, pose: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Region [E, N] and offset [E, N, 2]; the argument only ties the policy to an observation."""
        self.sight.look()
        goals = np.full((self.env.num_envs, self.env.num_robots, 2), np.nan)
        for team in np.flatnonzero(self.sight.active).tolist():
            goals[team] = self._ask(team)
        return self.sight.to_action(goals)

    def _ask(self, team: int) -> np.ndarray:
        agent = self.agents[team]
        if self.sight.begins[team]:
            self.calls.reset(agent, self.sight.episode(team))
        return self.calls.act(agent, self.sight.observation(team), self.env.num_robots)


def as_policy(env: ExplorationEnv, make: Callable[[], NumpyTeamPolicy], name: str = "the policy") -> TensorDictModule:
    """A `NumpyPolicy` on tensordicts, as the classical planners are.

    Raises:
        ValueError: the env takes controls; UserError: as `NumpyPolicy`.
    """
    return as_module(lambda env: NumpyPolicy(env, make, name), env)


def describe_error(error: BaseException) -> str:
    """ValueError in planner.py, line 12: what it says. The last line that is neither ours nor a library's."""
    place = ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        path = frame.f_code.co_filename
        library = path.startswith((*LIBRARIES, "<")) or "site-packages" in path
        if not library and not frame.f_globals.get("__name__", "").startswith("maexp."):
            place = f" in {path.rpartition('/')[2]}, line {line}"
    text = " ".join(str(error).split()).rstrip(".")
    return f"{type(error).__name__}{place}{f': {text}' if text else ''}"
