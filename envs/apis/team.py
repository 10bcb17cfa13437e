"""One team as Gymnasium's Env: for code that makes its batches itself, out of many envs."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from .gymnasium import TeamVectorEnv, row
from .spaces import MASK


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
