"""What an env does on maps in the plane; `maexp.envs.volume.space` has the same names for volumes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tensordict import TensorDictBase

from maexp.envs.config import EnvSettings
from maexp.envs.maps.map_batch import MapBank, build_bank
from maexp.envs.maps.point_cloud import PointCloudMap
from maexp.envs.render.episode import EpisodeRecorder
from maexp.envs.render.snapshot import take_snapshot
from maexp.envs.settings import complete_settings
from maexp.envs.simulation import build_simulation, bytes_per_env, check_memory
from maexp.envs.spawn import check_gathering, check_room, check_starts, fixed_starts
from maexp.envs.targets.region_action import from_regions, to_regions
from maexp.envs.targets.tracker import TargetTracker
from maexp.kernels.observe import picture_shapes
from maexp.kernels.state import STATE
from maexp.kernels.types import ERROR_REGION, REGIONS

if TYPE_CHECKING:
    from maexp.envs.environment import ExplorationEnv

__all__ = [
    "ACTION",
    "DIMENSIONS",
    "EpisodeRecorder",
    "INFO",
    "STATE",
    "anywhere",
    "build_simulation",
    "bytes_per_env",
    "check_memory",
    "check_starts",
    "check_together",
    "complete_settings",
    "find_goals",
    "fixed_starts",
    "make_tracker",
    "measure",
    "observe",
    "prepare_maps",
    "take_snapshot",
    "to_action",
]

DIMENSIONS = 2
"""Coordinates of a point."""
INFO: dict[str, torch.dtype] = {}
"""Entries of ``info`` of shape [E, 1] that are there in the plane alone."""
ACTION = ("region", "offset")
"""What policies write that give goals in metres."""
make_tracker = TargetTracker


def prepare_maps(maps: Sequence[PointCloudMap], settings: EnvSettings) -> MapBank:
    """The maps as the kernels want them.

    Raises:
        MapError: one has no room for the team.
    """
    for m in maps:
        check_room(m, [r.collision_threshold for r in settings.robot])
    return build_bank(list(maps), settings.radar)


def check_together(bank: MapBank, settings: EnvSettings) -> None:
    """MapError unless the team finds room in one place on every map."""
    for m in bank.maps:
        check_gathering(m, [r.collision_threshold for r in settings.robot])


def find_goals(env: ExplorationEnv, action: TensorDictBase) -> torch.Tensor:
    """Goals float32 [E, N, 2] [m] of an action in metres, or by regions and offsets as in the paper."""
    given = action.get("goal", None)
    if given is not None:
        return given
    region = action["region"]
    odd = ((region < 0) | (region >= REGIONS**2)).flatten(1).any(1)
    env.simulation.tensors["error"] |= odd.to(torch.int32) * ERROR_REGION
    return from_regions(env.simulation, region, action["offset"])


def to_action(env: ExplorationEnv, goals: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Goals float32 [E, N, 2] [m] as `ACTION`."""
    return to_regions(env.simulation, goals)


def anywhere(env: ExplorationEnv, draw: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """`ACTION` for a goal anywhere on the map, from numbers drawn evenly from 0 to 1, [E, N, 3]."""
    return (draw[..., 0] * REGIONS**2).long(), 2.0 * draw[..., 1:] - 1.0


def observe(env: ExplorationEnv, mask: torch.Tensor | None) -> tuple[dict[str, Any], dict[str, Any]]:
    """Observations that are of the plane: each robot's, and the team's; ``mask`` as in `ExplorationEnv.observe`."""
    e, n, r = env.num_envs, env.num_robots, REGIONS
    pictures = env.observation_config.pictures
    picture, team = (blank(shape, env.device) if pictures else None for shape in picture_shapes(e, n))
    pose = torch.empty((e, n, 4), dtype=torch.float32, device=env.device)
    grid = torch.empty((e, n, 4, r, r), dtype=torch.float32, device=env.device)
    env.simulation.observe(picture, team, pose, grid, mask)
    return {"pose": pose, "grid": grid} | ({"map": picture} if pictures else {}), {"map": team} if pictures else {}


def measure(env: ExplorationEnv) -> dict[str, torch.Tensor]:
    """What ``info`` holds besides in the plane: nothing."""
    return {}


def blank(shape: tuple[int, ...], device: torch.device) -> torch.Tensor:
    """Black pictures, uint8.

    On the CPU NumPy's: its pages are zero until they are drawn on. `torch.zeros` shares 250 kB among OpenMP's threads
    already, and waits for one that does not run where the machine is busy.
    """
    if device.type == "cpu":
        return torch.from_numpy(np.zeros(shape, dtype=np.uint8))
    return torch.zeros(shape, dtype=torch.uint8, device=device)
