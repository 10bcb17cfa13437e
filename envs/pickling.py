"""Copies of an env, here or in another process: made anew from its settings, its maps and its state.

Warp's arrays and recorded launches belong to the process that made them, and cannot be sent.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

if TYPE_CHECKING:
    from maexp.envs.environment import ExplorationEnv
    from maexp.envs.maps.point_cloud import PointCloudMap


def describe(env: ExplorationEnv) -> tuple[type, list[PointCloudMap], dict[str, Any], dict[str, torch.Tensor]]:
    """What `rebuild` makes the same env of: its class, maps, settings and state."""
    return type(env), env.maps, vars(env.settings) | {"starts": env.starts}, env.state_dict()


def rebuild(
    kind: type, maps: list[PointCloudMap], chosen: dict[str, Any], state: dict[str, torch.Tensor]
) -> ExplorationEnv:
    """The env that `describe` described. It goes on bit for bit; nobody hooks into its steps."""
    env = kind(maps, **chosen)
    env.load_state_dict(state)
    return env
