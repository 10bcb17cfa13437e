"""A batch of teams as Gymnasium's VectorEnv, where a team acts as one agent, and one team as Gymnasium's Env."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from tensordict import TensorDict, TensorDictBase

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


class TeamVectorEnv(VectorEnv):
    """``num_envs`` teams that explore side by side, under Gymnasium's vector interface.

    A team is one agent: its observation holds every robot's, its action is every robot's, its reward is the sum over
    robots (``info["robot_reward"]``, [E, N], has the parts).

    Args:
        maps: a `PointCloudMap`, or several of which every reset chooses one.
        num_envs: teams in the batch, E.
        num_robots: robots of a team, N.
        seed: key of all random numbers until ``reset(seed=...)`` gives another.
        action: "targets", "region_offset", "region" or "goal"; see `maexp.envs.wrappers.spaces`. With targets,
            observation and info hold ``action_mask``, int8 [E, N, M]: which there are.
        autoreset_mode: when a team that is done starts anew: in the next step, in the same one, or not by itself.
        render_mode: "rgb_array" or None.
        settings: those of `ExplorationEnv` (radar, planner, macro_steps, ...).
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(
        self,
        maps,
        num_envs: int = 1,
        num_robots: int = 3,
        *,
        seed: int = 0,
        action: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        **settings,
    ):
        self._kind, settings = settle(action, settings)
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode={render_mode!r} is unknown: choose rgb_array or None")
        self.autoreset_mode = _mode(autoreset_mode)
        self.env = ExplorationEnv(maps, num_envs, num_robots, seed=seed, **settings)
        self.num_envs, self.render_mode = self.env.num_envs, render_mode
        self.metadata = self.metadata | {
            "autoreset_mode": self.autoreset_mode,
            "render_fps": 10 / self.env.local_steps,
        }
        spec = self.env.observation_spec
        self._pictures, self._targets = (getattr(self.env.observation_config, name) for name in ("pictures", "targets"))
        seen = named(spec["agents", "observation"], self._kind)
        if self._pictures:
            seen["team_map"] = spec["team", "map"]
        self.single_observation_space = observation_space(seen, 1)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.single_action_space = action_space(self._kind, self._targets, (self.env.num_robots,))
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._done: np.ndarray | None = None
        self._seen: TensorDictBase | None = None  # what the teams saw last

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """Start episodes: of all teams, or of those in ``options["reset_mask"]`` (bool [E]).

        With a seed they are the seed's first ones, otherwise the next ones.
        """
        if seed is not None:
            check_seed(seed)
        mask = (options or {}).get("reset_mask")
        if mask is not None:
            mask = np.asarray(mask)
            if mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any() or seed is not None:
                raise ValueError(f"reset_mask={mask} must be bool [{self.num_envs}] with a True in it, without a seed")
        super().reset(seed=None if seed is None else int(seed))
        if seed is not None:
            self.env._set_seed(seed)  # set_seed() would seed torch's own generator, too
        if mask is None or self._done is None:
            mask = np.ones(self.num_envs, dtype=bool)
            self._done = mask
        now = self._restart(mask)
        self._done = self._done & ~mask
        return self._observation(now), self._info(now)

    def step(self, actions) -> tuple[dict, np.ndarray, np.ndarray, np.ndarray, dict]:
        """One decision of every team: observation, reward [E], terminated [E], truncated [E], info."""
        if self._done is None:
            raise RuntimeError("the env has no state yet: call reset() first")
        before = self._done
        if self.autoreset_mode is AutoresetMode.DISABLED and before.any():
            raise RuntimeError(
                f"teams {np.flatnonzero(before).tolist()} are done: call reset(options={{'reset_mask': ...}})"
            )
        action = to_action(actions, self._kind, self._targets, self.env)
        now = self._seen = self.env.step(action)["next"]
        if self.autoreset_mode is AutoresetMode.NEXT_STEP and before.any():
            now = self._start_anew(now, before)
        terminated, truncated = (now[key].cpu().numpy().reshape(-1) for key in ("terminated", "truncated"))
        self._done = terminated | truncated
        reward = now["agents", "reward"].squeeze(-1).cpu().numpy()
        observation, info = self._observation(now), self._info(now) | self._told("robot_reward", reward)
        if self.autoreset_mode is AutoresetMode.SAME_STEP and self._done.any():
            observation, info = self._end_and_start(observation, info)
        return observation, reward.sum(-1).astype(np.float64), terminated, truncated, info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Every team from above, uint8 [height, width, 3] each."""
        if self.render_mode is None:
            gymnasium.logger.warn('render() draws nothing without render_mode="rgb_array"')
            return None
        if self._done is None:
            raise RuntimeError("there is nothing to draw yet: call reset() first")
        return tuple(self.env.render(i) for i in range(self.num_envs))

    def close_extras(self, **kwargs) -> None:
        self.env.close(raise_if_closed=False)

    def _restart(self, mask: np.ndarray) -> TensorDictBase:
        """A new episode for the teams in ``mask``; what all of them see then.

        The env observes these teams alone: the others go on seeing what they saw.
        """
        wanted = torch.as_tensor(mask, device=self.env.device)
        asked = TensorDict({"_reset": wanted.unsqueeze(-1)}, batch_size=[self.num_envs], device=self.env.device)
        now = self.env._reset(asked)  # reset() would want the last step's tensordict, only to copy it
        if self._seen is not None:
            now = now.where(wanted, self._seen.select(*now.keys(True, True)))
        self._seen = now
        return now

    def _start_anew(self, now: TensorDictBase, before: np.ndarray) -> TensorDictBase:
        """``now`` with a new episode for the teams that were done before; the env lets such teams rest and earn 0."""
        begun = self._restart(before)
        begun["agents", "reward"] = now["agents", "reward"]
        return begun

    def _end_and_start(self, observation: dict, info: dict) -> tuple[dict, dict]:
        """What the next episodes look like; how the last ones ended is told under ``final_obs`` and ``final_info``."""
        done = self._done
        final = np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(done):
            final[i] = row(observation, i)
        begun = self._restart(done)
        told = {"final_obs": final, "_final_obs": done, "final_info": info, "_final_info": done}
        told |= self._told("robot_reward", info["robot_reward"])
        self._done = np.zeros_like(done)
        return self._observation(begun), self._info(begun) | told

    def _observation(self, now: TensorDictBase) -> dict[str, np.ndarray]:
        seen = named(now["agents", "observation"], self._kind)
        if self._pictures:
            seen["team_map"] = now["team", "map"]
        return to_numpy(seen, self.observation_space)

    def _info(self, now: TensorDictBase) -> dict[str, np.ndarray]:
        """The env's ``info``: [E] of the team, [E, N] of its robots, and Gymnasium's masks of who has them."""
        told: dict[str, np.ndarray] = {}
        for name, value in now["info"].items():
            array = value.cpu().numpy()
            told |= self._told(name, array[:, 0] if name in OF_TEAM else array)
        if self._kind == "targets":
            told |= self._told(MASK, now["agents", "observation", "targets_mask"].cpu().numpy().astype(np.int8))
        return told

    def _told(self, name: str, value: np.ndarray) -> dict[str, np.ndarray]:
        return {name: value, f"_{name}": np.ones(self.num_envs, dtype=bool)}


def row(observation: dict, index: int) -> dict:
    """One team's part of an observation, copied."""
    return {
        name: row(value, index) if isinstance(value, dict) else value[index].copy()
        for name, value in observation.items()
    }


def _mode(mode: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError as error:
        known = ", ".join(mode.value for mode in AutoresetMode)
        raise ValueError(f"autoreset_mode={mode!r} is unknown: choose one of {known}") from error


class TeamEnv(gymnasium.Env):
    """A team that explores, under Gymnasium's interface: `TeamVectorEnv` with one team, without its first axis.

    Args:
        map: a `PointCloudMap`, or several of which every reset chooses one.
        num_robots: robots of the team, N.
        seed: key of all random numbers until ``reset(seed=...)`` gives another.
        action, render_mode, settings: as for `TeamVectorEnv`.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}

    def __init__(
        self,
        map,
        num_robots: int = 3,
        *,
        seed: int = 0,
        action: str | None = None,
        render_mode: str | None = None,
        **settings,
    ):
        self.teams = TeamVectorEnv(
            map, 1, num_robots, seed=seed, action=action, autoreset_mode="Disabled", render_mode=render_mode, **settings
        )
        self.metadata = self.metadata | {"render_fps": self.teams.metadata["render_fps"]}
        self.render_mode = render_mode
        self.observation_space = self.teams.single_observation_space
        self.action_space = self.teams.single_action_space
        self._mask: np.ndarray | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """Start the seed's first episode, or without a seed the next one; there are no options."""
        super().reset(seed=seed)
        observation, info = self.teams.reset(seed=seed)
        return self._tell(observation, info)

    def step(self, action) -> tuple[dict, float, bool, bool, dict]:
        """One decision of the team: observation, reward (the sum over robots), terminated, truncated, info."""
        if isinstance(action, dict):
            actions: Any = {name: np.asarray(value)[None] for name, value in action.items()}
        else:
            actions = np.asarray(action)[None]
        observation, reward, terminated, truncated, info = self.teams.step(actions)
        observation, info = self._tell(observation, info)
        return observation, float(reward[0]), bool(terminated[0]), bool(truncated[0]), info

    def action_masks(self) -> np.ndarray:
        """Which targets there are, robot after robot, bool [N * M]: what sb3-contrib's MaskablePPO asks for."""
        if self._mask is None:
            raise RuntimeError('there is no mask: give action="targets" and call reset() first')
        return self._mask.astype(bool).ravel()

    def render(self) -> np.ndarray | None:
        """The team from above, uint8 [height, width, 3]."""
        frames = self.teams.render()
        return None if frames is None else frames[0]

    def close(self) -> None:
        self.teams.close()

    def _tell(self, observation: dict, info: dict) -> tuple[dict, dict]:
        info = {name: value[0] for name, value in info.items() if not name.startswith("_")}
        self._mask = info.get(MASK)
        return row(observation, 0), info
