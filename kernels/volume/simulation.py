"""A simulation of many teams in volumes: owns the memory, and runs the stages of `step` over shards of envs."""

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp

from maexp.kernels.constants import DT
from maexp.kernels.launches import finish_filling
from maexp.kernels.reward import RewardWeights
from maexp.kernels.shards import Shard, Threads
from maexp.kernels.types import Maps
from maexp.kernels.volume import step
from maexp.kernels.volume.state import allocate, warp_views


@dataclass(frozen=True)
class VolumeSettings:
    """What a local step does in volumes. Kernels take these by their names; see `kernels.shards.Settings`."""

    limited: bool
    comm_range: float
    line_of_sight: bool
    loss: float
    faults: bool
    fault_probability: float
    fault_steps: int
    episode_steps: int
    done: int
    success_coverage: float
    together: bool
    planner: str = "volume"
    base_x: float = float("inf")
    base_y: float = float("inf")
    dt: float = DT


class VolumeSimulation:
    """Thousands of teams in volumes, step by step.

    ``tensors`` holds state and scratch by name; ``believed`` is the same, for robots know where they are.

    Args:
        maps: values of kernels' parameters by name: ``maps`` (`VoxelMaps`), ``places``, ``sensors``, ``cells``,
            ``views``, ``fliers``; also `values`.
        map_tensors: by map: ``total_weight`` and ``total_surface`` int32 [M], ``lower`` and ``upper`` float32 [M, 3].
        robots: one [E, N] tensor per parameter of robots.
        weights: reward coefficients.
        fault_at: int32 [N], local step in which each robot is to fail; -1: none.
        settings: what a step does.
        sizes: lengths of the axes (`kernels.volume.state.AXES`).
        device: where it runs.
        seed: key of the random numbers.
        num_shards: runs of envs, each with a thread of its own on the CPU.
        looks_ahead: bool [N], robots whose sensors do not see all around.
    """

    def __init__(
        self,
        maps: dict[str, Any],
        map_tensors: dict[str, torch.Tensor],
        robots: dict[str, torch.Tensor],
        weights: RewardWeights,
        fault_at: torch.Tensor,
        settings: VolumeSettings,
        sizes: dict[str, int],
        device: torch.device,
        seed: int,
        num_shards: int,
        looks_ahead: torch.Tensor,
    ):
        self.map_tensors, self.robot_tensors, self.weights = map_tensors, robots, weights
        self.settings, self.sizes, self.device = settings, sizes, torch.device(device)
        self.looks_ahead = looks_ahead
        self.tensors = allocate(sizes, self.device)
        self.believed = self.tensors
        count = len(map_tensors["total_weight"])
        self.tensors["starts"].fill_(torch.inf)
        self.map_starts = torch.full((count, sizes["N"], 4), torch.inf, device=self.device)
        self.tensors["env_id"].copy_(torch.arange(sizes["E"], dtype=torch.int32))
        self.tensors["seed"].fill_(seed & 0x7FFFFFFF)
        self.tensors["episode"].fill_(-1)
        self.tensors["comm"].fill_(True)
        totals = Maps()  # the reward and the end of an episode look at how much there is
        totals.total_weight = wp.from_torch(map_tensors["total_weight"])
        begin = torch.cat([torch.zeros_like(map_tensors["total_weight"][:1]), map_tensors["total_weight"].cumsum(0)])
        self._begin = begin.to(torch.int32)
        totals.free_begin = wp.from_torch(self._begin)
        self.values, self._totals = maps, totals
        self._values = {
            "num_maps": count,
            "map_starts": wp.from_torch(self.map_starts, dtype=wp.vec4),
            "weights": weights,
            "fault_at": wp.from_torch(fault_at),
        }
        self.stale = torch.ones(sizes["E"], dtype=torch.bool, device=self.device)
        shards = max(1, min(num_shards, sizes["E"]))
        cuts = [sizes["E"] * k // shards for k in range(shards + 1)]
        self.shards = [self._shard(a, b) for a, b in zip(cuts, cuts[1:], strict=False)]
        self.threads = Threads(shards)
        for shard in self.shards:
            for stage in step.STAGES:
                shard.record(stage)
        finish_filling(wp.device_from_torch(self.device))

    def _shard(self, first: int, last: int) -> Shard:
        views = warp_views(self.tensors, first, last)
        device = wp.device_from_torch(self.device)
        return VolumeShard(
            first,
            last,
            device,
            self.settings,
            self.sizes,
            views,
            None,
            self._values | self.values,
            lambda shard: None,
            totals=self._totals,
        )

    def reset(self, mask: torch.Tensor) -> None:
        """Start a new episode in the envs where ``mask`` [E] is true."""
        self.tensors["mask"].copy_(mask)
        self._replay(step.reset)
        self.stale |= mask != 0

    def look(self, envs: torch.Tensor | None = None) -> None:
        """Bring distances and targets up to date with what is known, of some envs, int64 [S], or of all."""
        looked = self.stale.clone()
        if envs is not None:
            looked = torch.zeros_like(looked).index_fill_(0, envs, True) & looked
        if bool(looked.any()):
            self.tensors["looked"].copy_(looked)
            self._replay(step.look)
            self.stale &= ~looked

    def set_goals(self) -> None:
        """Take ``wanted``, and start the macro step's reward and contacts at zero."""
        self.look()
        self.tensors["terms"].zero_()
        self.tensors["contacts"].zero_()
        self._replay(step.find_ways)

    def step(self, start: int, count: int) -> None:
        """Run ``count`` local steps, the first being number ``start`` of the macro step."""
        for _ in range(count):
            self._replay(step.local_step)
        self.stale |= self.tensors["active"] != 0
        self.stale |= self.tensors["terminated"] != 0

    def _replay(self, stage) -> None:
        self.threads.each(self.shards, lambda shard: shard.replay(stage))


class VolumeShard(Shard):
    """A run of envs in volumes. Stages that they share with the plane take the totals of the maps as ``maps``."""

    def __init__(self, *args, totals: Maps):
        super().__init__(*args)
        self.totals = totals

    def call(self, launch, kernel, dim=None, **given) -> None:
        if any(argument.label == "maps" and argument.type is Maps for argument in kernel.adj.args):
            given = {"maps": self.totals} | given
        super().call(launch, kernel, dim, **given)
