"""A simulation of many teams: owns the memory, and runs the stages of `step` over shards of envs."""

from dataclasses import dataclass

import torch
import warp as wp

from maexp.kernels import step
from maexp.kernels.dwa import list_curvatures
from maexp.kernels.known_grid import NavGrids
from maexp.kernels.launches import finish_filling, launch_on
from maexp.kernels.planner import set_goals
from maexp.kernels.radio import Radio
from maexp.kernels.reward import RewardWeights
from maexp.kernels.sensing import Sensing
from maexp.kernels.shards import Threads, blocks_per_thread, split
from maexp.kernels.state import SCRATCH, STATE, allocate
from maexp.kernels.types import DT, Maps
from maexp.kernels.wavefront import find_paths, pick_waypoints


@dataclass(frozen=True)
class Settings:
    """What a local step does. Kernels take these by their names."""

    planner: str  # "dwa", "wavefront" or "direct"
    num_accel: int  # accelerations that DWA tries
    num_steering: int  # steering angles (yaw rates, sideways accelerations) that it tries
    horizon: int  # local steps that it looks ahead
    clearance_weight: float  # of its score's term for what is nearer than the clearance
    replan_steps: int  # local steps between two searches of `wavefront`
    footprint: bool  # collisions by oriented footprints, not by distances of centres
    limited: bool  # whether communication is
    comm_range: float  # [m]
    line_of_sight: bool  # whether walls block communication
    loss: float  # probability that two radios miss each other in a local step
    messages: bool  # whether messages take room or time
    message_cells: int  # points that a radio sends in a local step
    message_delay: int  # local steps until a message arrives
    signal: bool  # whether radios hear what arrives of a signal
    base_x: float  # where the base station is [m]; inf: where robot 0 starts
    base_y: float
    faults: bool  # whether robots may fail
    fault_probability: float  # of each robot in an episode
    fault_steps: int  # how long that lasts
    false_alarms: bool  # whether radars take free ground for walls
    drifts: bool  # whether odometry does
    odometry_drift: float  # [m/sqrt(m)]
    odometry_turn: float  # [rad/sqrt(m)]
    odometry_jump: float  # [m]
    odometry_jump_rate: float  # [1/s]
    episode_steps: int  # local steps of an episode
    done: int  # whose coverage ends an episode (`radio.UNION`)
    draw_known: bool  # pictures show what robots know, not what they have seen
    success_coverage: float  # share at which an episode ends
    together: bool  # teams start in one place
    dt: float = DT  # of a local step [s]


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
        self.radio, self.fault_at, self.sensing = radio, wp.from_torch(fault_at), sensing
        self.open_cells = None if open_cells is None else wp.from_torch(open_cells)
        self.tensors = allocate(STATE, sizes, self.device) | allocate(SCRATCH, sizes, self.device)
        self.believed = self.tensors
        if settings.drifts:
            self.believed = self.tensors | {name: self.tensors[f"{name}_estimate"] for name in ("pose", "center")}
        self.tensors["starts"].fill_(torch.inf)
        self.map_starts = torch.full((num_maps, sizes["N"], 3), torch.inf, device=self.device)
        self.map_starts_view = wp.from_torch(self.map_starts, dtype=wp.vec3)
        self.tensors["env_id"].copy_(torch.arange(sizes["E"], dtype=torch.int32))
        self.tensors["seed"].fill_(seed & 0x7FFFFFFF)
        self.tensors["episode"].fill_(-1)
        self.tensors["comm"].fill_(True)
        count = max(1, min(num_shards, sizes["E"]))
        self.shards = split(self, count)
        per_thread = blocks_per_thread(sizes, self.device, count)
        self.blocks = self.shards if per_thread == 1 else split(self, count * per_thread)
        self.threads = Threads(count)
        self._record()

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
        """Take ``region`` and ``offset`` (or ``command``), and start the macro step's reward at zero."""
        self.tensors["terms"].zero_()
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
