"""What an env does in volumes: the same names as `maexp.envs.plane`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase

from maexp.envs.config import EnvSettings
from maexp.envs.volume.bank import VoxelBank, build_bank
from maexp.envs.volume.episode import VolumeRecorder as EpisodeRecorder
from maexp.envs.volume.map import VoxelMap
from maexp.envs.volume.settings import complete_settings
from maexp.envs.volume.simulation import build_simulation, bytes_per_env, check_memory
from maexp.envs.volume.snapshot import take_snapshot
from maexp.envs.volume.starts import check_gathering, check_room, check_starts, fixed_starts
from maexp.envs.volume.targets import VolumeTracker
from maexp.kernels.volume.state import STATE

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

DIMENSIONS = 3
"""Coordinates of a point."""
INFO = {"surface_coverage": torch.float32}
"""Entries of ``info`` of shape [E, 1] that are there in volumes alone."""
ACTION = ("goal", "heading")
"""What policies write that give goals in metres."""
make_tracker = VolumeTracker


def prepare_maps(maps: Sequence[VoxelMap], settings: EnvSettings) -> VoxelBank:
    """The maps as the kernels want them.

    Raises:
        MapError: one has no room for the team.
    """
    bank = build_bank(maps, settings.robot, settings.radar)
    for number, m in enumerate(maps):
        check_room(m, bank.places(number), [robot.collision_threshold for robot in settings.robot])
    return bank


def check_together(bank: VoxelBank, settings: EnvSettings) -> None:
    """MapError unless the team finds room in one place on every map."""
    for number, m in enumerate(bank.maps):
        check_gathering(m, bank.places(number), [robot.collision_threshold for robot in settings.robot])


def find_goals(env: ExplorationEnv, action: TensorDictBase) -> torch.Tensor:
    """Goals float32 [E, N, 4] of an action: x, y, z [m] and heading [rad]; NaN: none is given, the env takes the
    heading from which most is to be seen.

    Raises:
        ValueError: no goal, or a heading for a robot that sees all around.
    """
    goal, heading = action.get("goal", None), action.get("heading", None)
    if goal is None:
        raise ValueError("the action names no goal: volumes have no regions; give target, or goal [E, N, 3] in metres")
    if heading is None:
        heading = torch.full(goal.shape[:2], torch.nan, device=goal.device)
    elif bool((heading.isfinite() & ~env.simulation.looks_ahead).any()):
        robot = int((heading.isfinite() & ~env.simulation.looks_ahead).any(0).int().argmax())
        raise ValueError(f"the action gives robot {robot} a heading, and it sees all around: leave it out, or give NaN")
    return torch.cat([goal.float(), heading.float().unsqueeze(-1)], -1)


def to_action(env: ExplorationEnv, goals: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Goals float32 [E, N, 4] (x, y, z [m], heading [rad]) as `ACTION`."""
    return goals[..., :3].clone(), goals[..., 3].clone()


def anywhere(env: ExplorationEnv, draw: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """`ACTION` for a goal anywhere on the map, from numbers drawn evenly from 0 to 1, [E, N, 3]."""
    sim = env.simulation
    low, high = (sim.map_tensors[name][sim.tensors["map_id"].long()].unsqueeze(1) for name in ("lower", "upper"))
    return low + draw * (high - low), torch.full(draw.shape[:2], torch.nan, device=draw.device)


def observe(env: ExplorationEnv, mask: torch.Tensor | None) -> tuple[dict[str, Any], dict[str, Any]]:
    """Observations that are of volumes: each robot's pose, scaled to about [-1, 1]; nothing of the team's."""
    sim = env.simulation
    s, m = sim.tensors, sim.tensors["map_id"].long()
    low, high = (sim.map_tensors[name][m].unsqueeze(1) for name in ("lower", "upper"))
    place = (2.0 * s["center"] - low - high) / (high - low)
    speed = torch.hypot(s["pose"][..., 2], s["slip"]) / sim.robot_tensors["max_speed"]
    return {"pose": torch.cat([place, speed.unsqueeze(-1), s["pose"][..., 3:] / torch.pi], -1)}, {}


def measure(env: ExplorationEnv) -> dict[str, torch.Tensor]:
    """What ``info`` holds besides in volumes (`INFO`)."""
    sim = env.simulation
    total = sim.map_tensors["total_surface"][sim.tensors["map_id"].long()].clamp_min(1)
    return {"surface_coverage": (sim.tensors["covered_surface"] / total).unsqueeze(-1)}
