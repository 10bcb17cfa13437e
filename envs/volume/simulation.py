"""From an env's settings to the kernels' `VolumeSimulation`: sizes, limits, memory."""

from __future__ import annotations

import math

import torch

from maexp.envs.config import DONE, EnvSettings
from maexp.envs.simulation import fault_steps, refuse_too_many, reward_weights
from maexp.envs.volume.bank import VoxelBank, kernel_values, looks_ahead
from maexp.kernels.constants import DT
from maexp.kernels.reward import MARKS, REWARD_TERMS
from maexp.kernels.types import ROBOTS_PER_WORD
from maexp.kernels.volume.motion import SPAN, WAY_POINTS
from maexp.kernels.volume.simulation import VolumeSettings, VolumeSimulation
from maexp.kernels.volume.state import memory_per_env

OF_ROBOTS = ("length", "width", "max_speed", "max_accel", "max_yaw_rate", "collision_threshold")
"""Parameters of robots that the decision layer looks at."""


def build_simulation(settings: EnvSettings, bank: VoxelBank, together: bool = False) -> VolumeSimulation:
    """The simulation of an env with these settings on these maps; ``together``: teams start in one place."""
    device = settings.device
    simulation = VolumeSimulation(
        maps=kernel_values(bank, device),
        map_tensors=map_tensors(bank, device),
        robots={
            name: torch.tensor([getattr(robot, name) for robot in settings.robot], dtype=torch.float32, device=device)
            .expand(settings.num_envs, -1)
            .contiguous()
            for name in OF_ROBOTS
        },
        weights=reward_weights(settings),
        fault_at=fault_steps(settings),
        settings=step_settings(settings, together),
        sizes=sizes(settings, bank),
        device=device,
        seed=settings.seed,
        num_shards=settings.num_threads,
        looks_ahead=torch.tensor([looks_ahead(radar) for radar in settings.radar], device=device),
    )
    simulation.tensors["env_id"] += settings.first_env
    return simulation


def map_tensors(bank: VoxelBank, device: torch.device) -> dict[str, torch.Tensor]:
    """How much there is to see on each map, int32 [M], and its box, float32 [M, 3] [m]."""
    counts = {"total_weight": bank.seeable, "total_surface": bank.surface}
    found = {name: torch.tensor([int(part.sum()) for part in parts]).int() for name, parts in counts.items()}
    corners = torch.tensor([m.extent for m in bank.maps], dtype=torch.float32)
    found |= {"lower": corners[:, 0].contiguous(), "upper": corners[:, 1].contiguous()}
    return {name: value.to(device) for name, value in found.items()}


def step_settings(settings: EnvSettings, together: bool) -> VolumeSettings:
    """What a local step does."""
    comm, faults = settings.comm, settings.faults
    return VolumeSettings(
        limited=settings.limited,
        comm_range=min(comm.range, 1e30),
        line_of_sight=comm.line_of_sight,
        loss=comm.loss,
        faults=faults.enabled,
        fault_probability=faults.probability,
        fault_steps=max(1, round(min(faults.duration, 1e8) / DT)),
        episode_steps=settings.episode_steps,
        done=DONE.index(settings.done) if settings.limited else 0,  # else all know the same
        success_coverage=settings.success_coverage,
        together=together,
    )


def sizes(settings: EnvSettings, bank: VoxelBank) -> dict[str, int]:
    """Lengths of the axes of state and scratch (`kernels.volume.state.AXES`)."""
    robots, limited, side, block = settings.num_robots, settings.limited, bank.side, bank.block
    shapes = [m.shape for m in bank.maps]
    cells = [tuple(-(-count // side) for count in shape) for shape in shapes]
    columns, cell_columns = (max(x * y for x, y, _ in found) for found in (shapes, cells))
    rows = robots if limited else 1
    return {
        "E": settings.num_envs,
        "N": robots,
        "U": robots,
        "W": -(-robots // ROBOTS_PER_WORD),
        "R": rows,
        "C": columns,
        "D": columns if limited else 1,
        "L": max(-(-z // 32) for _, _, z in shapes),
        "c": cell_columns,
        "d": 2 * cell_columns,
        "l": max(-(-z // 32) for _, _, z in cells),
        "z": max(math.prod(found) for found in cells),
        "B": max(math.prod(-(-count // block) for count in shape) for shape in shapes),
        "V": SPAN**3,
        "P": WAY_POINTS,
        "K": len(REWARD_TERMS),
        "M": len(MARKS),
        "1": 1,
    }


def bytes_per_env(settings: EnvSettings, bank: VoxelBank) -> int:
    """What one env takes on its device."""
    return sum(memory_per_env(sizes(settings, bank)).values())


def check_memory(settings: EnvSettings, bank: VoxelBank) -> None:
    """Refuse a batch that the device cannot hold, before anything is allocated.

    Raises:
        ValueError: says how much is needed and free, and what to lower.
    """
    refuse_too_many(settings, bytes_per_env(settings, bank))
