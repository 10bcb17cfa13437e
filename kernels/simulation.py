"""A simulation of many teams: owns the memory, and runs the stages of `step` over shards of envs."""

import torch
import warp as wp

from maexp.kernels import step
from maexp.kernels.drifting_maps import measure_maps
from maexp.kernels.dwa import list_curvatures
from maexp.kernels.dynamics import Robots
from maexp.kernels.launches import EAGER, finish_filling, launch_on
from maexp.kernels.occupancy_grid import NavGrids
from maexp.kernels.planner import find_paths, pick_waypoints, set_goals
from maexp.kernels.radio import Radio
from maexp.kernels.reward import RewardWeights
from maexp.kernels.sensing import Sensing
from maexp.kernels.shards import Settings, Shard, Threads
from maexp.kernels.state import SCRATCH, STATE, allocate, memory_per_env, robots_struct, warp_views
from maexp.kernels.types import Maps
from maexp.kernels.wavefront import Wavefront

BLOCK_BYTES = 2**19
"""State and scratch of a block of envs: what they touch fits a core's own cache."""
BLOCK_ROBOTS = 16
"""A block holds no fewer robots, so that what a launch costs by itself stays small beside them."""


def blocks_per_thread(sizes: dict[str, int], device: torch.device, threads: int) -> int:
    """How many blocks each thread gets on average; a GPU takes all envs at once."""
    if device.type != "cpu":
        return 1
    fitting = BLOCK_BYTES // sum(memory_per_env(sizes).values())
    envs = max(fitting, -(-BLOCK_ROBOTS // sizes["N"]))
    return max(1, sizes["E"] // (envs * threads))


class Simulation:
    """Thousands of teams, step by step.

    ``tensors`` holds state and scratch by name; ``believed`` the same with the poses that robots believe to have.

    Args:
        maps: static data, every field of `Maps` as a torch tensor on ``device``.
        num_maps: how many maps those are.
        robots: one [E, N] tensor per field of `Robots`.
        weights: reward coefficients.
        radio: parameters of the radios.
        fault_at: int32 [N], local step in which each robot is to fail; -1: none.
        settings: what a step does.
        sizes: lengths of the axes (`kernels.state.axis_sizes`).
        device: where it runs.
        seed: key of the random numbers.
        num_shards: runs of envs, each with a thread of its own on the CPU.
        nav: navigation grids of the maps and the cells of the largest; the `wavefront` planner and signals need them.
        open_cells: uint8, cells of all navigation grids, 1 where the ground is free; signals need them.
        sensing: radars that miss returns; None: all that is in view is seen.
    """

    def __init__(
        self,
        maps: dict[str, torch.Tensor],
        num_maps: int,
        robots: dict[str, torch.Tensor],
        weights: RewardWeights,
        radio: Radio,
        fault_at: torch.Tensor,
        settings: Settings,
        sizes: dict[str, int],
        device: torch.device,
        seed: int,
        num_shards: int = 1,
        nav: tuple[NavGrids, int] | None = None,
        open_cells: torch.Tensor | None = None,
        sensing: "Sensing | None" = None,
    ):
        self.map_tensors, self.num_maps = maps, num_maps
        self.robot_tensors = robots | {"curvature": list_curvatures(robots, settings.num_steering)}
        self.weights, self.settings, self.sizes = weights, settings, sizes
        self.device = torch.device(device)
        self.maps = maps_struct(maps)
        self.nav_grids, self.nav_cells = nav or (None, 0)
        self.tensors = allocate(STATE, sizes, self.device) | allocate(SCRATCH, sizes, self.device)
        self.believed = self.tensors
        if settings.drifts:
            self.believed = self.tensors | {name: self.tensors[f"{name}_estimate"] for name in ("pose", "center")}
        self.tensors["starts"].fill_(torch.inf)
        self.map_starts = torch.full((num_maps, sizes["N"], 3), torch.inf, dtype=torch.float32, device=self.device)
        self.tensors["env_id"].copy_(torch.arange(sizes["E"], dtype=torch.int32))
        self.tensors["seed"].fill_(seed & 0x7FFFFFFF)
        self.tensors["episode"].fill_(-1)
        self.tensors["comm"].fill_(True)
        self._values = {
            "maps": self.maps,
            "num_maps": num_maps,
            "map_starts": wp.from_torch(self.map_starts, dtype=wp.vec3),
            "weights": weights,
            "radio": radio,
            "fault_at": wp.from_torch(fault_at),
            "sensing": sensing,
            "grids": self.nav_grids,
            "open": None if open_cells is None else wp.from_torch(open_cells),
        }
        count = 1 if EAGER else max(1, min(num_shards, sizes["E"]))  # threads must not load kernels at the same time
        self.shards = self._split(count)
        per_thread = blocks_per_thread(sizes, self.device, count)
        self.blocks = self.shards if per_thread == 1 else self._split(count * per_thread)
        self.threads = Threads(count)
        self._record()

    def _split(self, count: int) -> list[Shard]:
        """The envs in ``count`` runs of about the same length."""
        cuts = [self.sizes["E"] * k // count for k in range(count + 1)]
        return [self._shard(a, b) for a, b in zip(cuts, cuts[1:], strict=False)]

    def _shard(self, first: int, last: int) -> Shard:
        def robots() -> Robots:
            return robots_struct(self.robot_tensors, first, last)

        return Shard(
            first,
            last,
            wp.device_from_torch(self.device),
            self.settings,
            self.sizes,
            warp_views(self.tensors, first, last),
            robots(),
            self._values,
            lambda shard: Wavefront(shard, self.maps, self.nav_grids, self.nav_cells, robots()),
        )

    def _record(self) -> None:
        """Record all launches here: threads must not load kernels at the same time."""
        for shard in self.shards:
            shard.record(set_goals)
            shard.record(step.reset)
        for block in self.blocks:
            for stage in (find_paths, pick_waypoints, step.local_step):
                block.record(stage)
        finish_filling(wp.device_from_torch(self.device))

    def reset(self, mask: torch.Tensor) -> None:
        """Start a new episode in the envs where ``mask`` [E] is true."""
        self.tensors["mask"].copy_(mask)
        self.threads.each(self.shards, lambda shard: shard.replay(step.reset))

    def set_goals(self) -> None:
        """Take ``wanted`` (or ``command``), and start the macro step's reward and contacts at zero."""
        self.tensors["terms"].zero_()
        self.tensors["contacts"].zero_()
        self.threads.each(self.shards, lambda shard: shard.replay(set_goals))

    def step(self, start: int, count: int) -> None:
        """Run ``count`` local steps, the first being number ``start`` of the macro step."""
        self.threads.each(self.blocks, lambda block: step.run_steps(block, start, count))

    def observe(self, picture, team, pose, grid, mask: torch.Tensor | None = None) -> None:
        """Fill the observation tensors, new ones: what leaves the env is never used again.

        Args:
            picture, team: zeros, uint8, of `observe.picture_shapes`; None: no pictures.
            pose, grid: float32 [E, N, 4] and [E, N, 4, 8, 8].
            mask: int32 [E], the envs whose pictures are drawn; None: all.
        """
        self.tensors["mask"].fill_(1) if mask is None else self.tensors["mask"].copy_(mask)
        launch = launch_on(self.device)
        self.threads.each(self.shards, lambda shard: step.observe(launch, shard, picture, team, pose, grid))

    def map_error(self) -> torch.Tensor:
        """How far known ground is from where it is drawn [m], on average over points, then over the maps of a team:
        float32 [E]. Maps without any do not count."""
        launch = launch_on(self.device)
        found = [measure_maps(launch, shard) for shard in self.shards]
        total, count = (torch.cat(parts) for parts in zip(*found, strict=True))
        mean = 1.0e-6 * total.double() / count.clamp_min(1)
        return (mean.sum(1) / (count > 0).sum(1).clamp_min(1)).float()


def maps_struct(tensors: dict[str, torch.Tensor]) -> Maps:
    """`Maps` over torch tensors (one per field)."""
    maps = Maps()
    for name, tensor in tensors.items():
        if tensor.dtype == torch.int32:
            kind = wp.int32
        else:
            kind = {1: wp.float32, 2: {2: wp.vec2, 3: wp.vec3}.get(tensor.shape[-1])}[tensor.dim()]
        if not tensor.numel():  # a map without obstacles: empty arrays may come with strides that Warp refuses
            tensor = tensor.new_zeros(tensor.shape)
        setattr(maps, name, wp.from_torch(tensor, dtype=kind))
    return maps
