"""One team as PettingZoo's ParallelEnv: every robot is an agent."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import logger, spaces
from pettingzoo import ParallelEnv
from tensordict import TensorDictBase

from maexp.envs.environment import ExplorationEnv
from maexp.envs.specs import OF_TEAM
from maexp.envs.wrappers.spaces import (
    MASK,
    action_space,
    check_seed,
    named,
    observation_space,
    settle,
    to_action,
    to_numpy,
)

COLLIDED = ("stay", "leave")


class TeamParallelEnv(ParallelEnv):
    """A team of robots that explore, under PettingZoo's interface.

    Args:
        map: a `PointCloudMap`, or several of which every reset chooses one.
        num_robots: robots of the team, the agents ``robot_0``, ``robot_1``, ...
        seed: key of all random numbers until ``reset(seed=...)`` gives another.
        action: "targets", "region_offset", "region" or "goal"; see `maexp.envs.wrappers.spaces`. With targets, every
            robot's observation and info hold ``action_mask``, int8 [M]: which there are.
        collided: "stay" keeps a robot that collided among the agents until the team's episode ends: it cannot move,
            and goes on paying for time; "leave" terminates it at once.
        render_mode: "rgb_array" or None.
        settings: those of `ExplorationEnv` (radar, planner, macro_steps, ...).

    The episode ends for all together: terminated when coverage is reached or all have collided, truncated when the
    macro steps are used up.
    """

    metadata = {"name": "maexp_v0", "render_modes": ["rgb_array"], "is_parallelizable": True}

    def __init__(
        self,
        map,
        num_robots: int = 3,
        *,
        seed: int = 0,
        action: str | None = None,
        collided: str = "stay",
        render_mode: str | None = None,
        **settings,
    ):
        self._kind, settings = settle(action, settings)
        if collided not in COLLIDED:
            raise ValueError(f"collided={collided!r} is unknown: choose one of {', '.join(COLLIDED)}")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode={render_mode!r} is unknown: choose rgb_array or None")
        self.env = ExplorationEnv(map, 1, num_robots, seed=seed, **settings)
        self.render_mode, self.collided = render_mode, collided
        self.metadata = self.metadata | {"render_fps": 10 / self.env.local_steps}
        self.possible_agents = [f"robot_{i}" for i in range(self.env.num_robots)]
        self.agents: list[str] = []
        self._pictures, self._targets = (getattr(self.env.observation_config, name) for name in ("pictures", "targets"))
        spec = self.env.observation_spec
        seen = named(spec["agents", "observation"], self._kind)
        self.observation_spaces = {name: observation_space(seen, 2) for name in self.possible_agents}
        self.action_spaces = {name: action_space(self._kind, self._targets) for name in self.possible_agents}
        if self._pictures:
            self.state_space = observation_space(spec["team"], 1)["map"]
        else:
            numbers = sum(spaces.flatdim(space) for space in self.observation_spaces.values()) + 1
            self.state_space = spaces.Box(-np.inf, np.inf, (numbers,), np.float32)
        self._now: TensorDictBase | None = None  # what the team sees

    def observation_space(self, agent: str) -> spaces.Space:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space:
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """Start the seed's first episode, or without a seed the next one; there are no options.

        Raises:
            ValueError: the seed is no whole number, 0 or more.
        """
        if seed is not None:
            self.env._set_seed(check_seed(seed))  # set_seed() would seed torch's own generator, too
        self._now = self.env.reset()
        self.agents = list(self.possible_agents)
        return self._tell()

    def step(self, actions: dict[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        """One decision of every agent that is left; what follows holds entries for just these."""
        self._check_agents(actions)
        now = self._now = self.env.step(self._action(actions))["next"]
        robots = {name: i for i, name in enumerate(self.possible_agents) if name in self.agents}
        reward = now["agents", "reward"][0, :, 0].tolist()
        leaves = (now["info", "collided"][0] & (self.collided == "leave")).tolist()
        over, out_of_time = bool(now["terminated"]), bool(now["truncated"])
        rewards = {name: reward[i] for name, i in robots.items()}
        terminations = {name: over or leaves[i] for name, i in robots.items()}
        truncations = {name: out_of_time and not terminations[name] for name in robots}
        observations, infos = self._tell()
        self.agents = [name for name in robots if not (terminations[name] or truncations[name])]
        return observations, rewards, terminations, truncations, infos

    def state(self) -> np.ndarray:
        """The team's map: explored, obstacle, number of robots that explored it; uint8 [3, 125, 125].

        Without pictures the numbers of all robots' observations, one after the other, and the coverage; float32 [K].
        """
        if self._now is None:
            raise RuntimeError("the env has no state yet: call reset() first")
        if self._pictures:
            return self._now["team", "map"][0].cpu().numpy()
        seen = [spaces.flatten(self.observation_spaces[name], self._seen_by(i)) for i, name in self._numbered()]
        return np.concatenate([*seen, [self._now["info", "coverage"].item()]]).astype(np.float32)

    def render(self) -> np.ndarray | None:
        """The team from above, uint8 [height, width, 3]."""
        if self.render_mode is None:
            logger.warn('render() draws nothing without render_mode="rgb_array"')
            return None
        if self._now is None:
            raise RuntimeError("there is nothing to draw yet: call reset() first")
        return self.env.render()

    def close(self) -> None:
        if not self.env.is_closed:
            self.env.close(raise_if_closed=False)

    def _check_agents(self, actions: dict[str, Any]) -> None:
        if not self.agents:
            raise RuntimeError("no agents are left: call reset() first")
        if not isinstance(actions, dict):
            raise ValueError(f"actions is a {type(actions).__name__}: give a dict with an action for each agent")
        missing = [name for name in self.agents if name not in actions]
        unknown = [name for name in actions if name not in self.possible_agents]
        if missing or unknown:
            what = f"has no action for {missing[0]}" if missing else f"names {unknown[0]!r}, which is no agent"
            raise ValueError(f"actions {what}: the agents are {', '.join(self.agents)}")

    def _action(self, actions: dict[str, Any]) -> TensorDictBase:
        """All robots' actions; one that has left cannot move, so any of them will do for it."""
        space = self.action_spaces[self.possible_agents[0]]
        if isinstance(space, spaces.Dict):
            idle: Any = {"region": 0, "offset": np.zeros(2)}
        else:
            idle = 0 if isinstance(space, spaces.Discrete) else np.zeros(2)
        given = {name: actions.get(name, idle) for name in self.possible_agents}
        if isinstance(space, spaces.Dict):
            for name, action in given.items():
                if not isinstance(action, dict) or not {"region", "offset"} <= set(action):
                    raise ValueError(f"the action of {name} is {action!r}: give a dict of region and offset")
            together: Any = {key: _stacked(key, [action[key] for action in given.values()]) for key in space}
        else:
            together = _stacked("action", list(given.values()))
        return to_action(together, self._kind, self._targets, self.env)

    def _tell(self) -> tuple[dict[str, dict], dict[str, dict]]:
        """What every agent that is left observes, and what its ``info`` holds of the team and of it, as numbers."""
        team = {key: value[0].tolist() for key, value in self._now["info"].items()}
        observations, infos = {}, {}
        for i, name in self._numbered():
            if name in self.agents:
                observations[name] = self._seen_by(i)
                infos[name] = {key: value[0] if key in OF_TEAM else value[i] for key, value in team.items()}
                if self._kind == "targets":
                    infos[name][MASK] = observations[name][MASK].copy()
        return observations, infos

    def _seen_by(self, robot: int) -> dict[str, np.ndarray]:
        seen = named(self._now["agents", "observation"][0, robot], self._kind)
        return to_numpy(seen, self.observation_spaces[self.possible_agents[robot]])

    def _numbered(self) -> list[tuple[int, str]]:
        return list(enumerate(self.possible_agents))


def _stacked(name: str, values: list) -> np.ndarray:
    """One array [1, N, ...] of the robots' values."""
    try:
        return np.stack([np.asarray(value) for value in values])[None]
    except ValueError as error:
        raise ValueError(f"{name} has a different shape for different agents: {values}") from error
