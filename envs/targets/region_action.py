"""The paper's action, a region of the map and an offset in it, and goals in metres: the way there and back."""

from typing import Any

import torch
import warp as wp

from maexp.kernels import goals
from maexp.kernels.launches import launch_named, launch_on, view
from maexp.kernels.simulation import Simulation


def from_regions(simulation: Simulation, region: torch.Tensor, offset: torch.Tensor) -> torch.Tensor:
    """Goals float32 [E, N, 2] [m] of regions int64 [E, N] and offsets float32 [E, N, 2]; NaN for what is not finite.

    Regions and offsets out of bounds count as the nearest.
    """
    region, offset = region.long().contiguous(), offset.float().contiguous()
    goal = torch.empty_like(offset)
    _launch(simulation, goals._from_regions, region, offset, goal)
    return goal


def to_regions(simulation: Simulation, goal: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Region int64 [E, N] and offset float32 [E, N, 2] of goals [m], shape [E, N, 2]; the nearest if outside."""
    goal = goal.float().contiguous()
    region, offset = torch.empty(goal.shape[:2], dtype=torch.int64, device=goal.device), torch.empty_like(goal)
    _launch(simulation, goals._to_regions, region, offset, goal)
    return region, offset


def _launch(
    simulation: Simulation, kernel: wp.Kernel, region: torch.Tensor, offset: torch.Tensor, goal: torch.Tensor
) -> None:
    values: dict[str, Any] = {"region": view(region), "offset": view(offset, wp.vec2), "goal": view(goal, wp.vec2)}
    values["map_id"] = view(simulation.tensors["map_id"])
    values |= {name: view(simulation.map_tensors[name], wp.vec2) for name in ("lower", "upper")}
    launch_named(launch_on(simulation.device), kernel, tuple(region.shape), values)
