"""The order of launches: a local step, a reset, an observation; nothing else.

A `Simulation` owns state and scratch, split into shards of envs. The launches of every shard are
recorded once and replayed; on the CPU each shard runs in a thread of its own (native code releases
the interpreter lock). Local steps run over smaller blocks of envs: what the kernels of a block touch
stays in the processor's cache while it goes through all of them, and threads take blocks as they get
free. Results depend on neither the number of shards nor that of blocks.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import torch
import warp as wp

from maexp.kernels import collision, dynamics, merge, observe, planner, reset, reward, visibility
from maexp.kernels.known_grid import NavGrids
from maexp.kernels.launches import RecordedLaunch, finish_filling, lanes_on, launch_on, replay
from maexp.kernels.state import SCRATCH, STATE, allocate, memory_per_env, robots_struct, warp_views
from maexp.kernels.types import Maps
from maexp.kernels.wavefront import Wavefront

BLOCK_BYTES = 2**19
"""State and scratch of a block of envs: what they touch fits a core's own cache."""
BLOCK_ROBOTS = 16
"""A block holds no fewer robots, so that what a launch costs by itself stays small beside them."""


@dataclass(frozen=True)
class Settings:
    """What a local step does; units in metres and seconds."""

    planner: str  # "dwa", "wavefront" or "direct"
    num_accels: int
    num_turns: int
    horizon: int
    clearance_weight: float
    replan_steps: int
    footprint: bool
    comm_limited: bool
    comm_range: float
    line_of_sight: bool
    draw_known: bool
    goal_coverage: float
    dt: float = 0.1


class Shard:
    """Envs ``first`` to ``last`` of a simulation: Warp views, and launches recorded when first needed."""

    def __init__(self, sim: "Simulation", first: int, last: int):
        self.first, self.last = first, last
        self.sim = sim
        self.device = wp.device_from_torch(sim.device)
        self.view = warp_views(sim.tensors, first, last)
        self.robots = robots_struct(sim.robot_tensors, first, last)
        self.shape = (last - first, sim.sizes["N"])
        self.lanes = lanes_on(self.device, 32)

    @cached_property
    def wavefront(self) -> Wavefront | None:
        return Wavefront(self.sim, self) if self.sim.settings.planner == "wavefront" else None

    @cached_property
    def goal_launches(self) -> list[RecordedLaunch]:
        return self.record(self.set_goals)

    @cached_property
    def step_launches(self) -> list[RecordedLaunch]:
        return self.record(self.local_step)

    @cached_property
    def reset_launches(self) -> list[RecordedLaunch]:
        return self.record(self.place)

    def prepare(self, *names: str) -> None:
        """Make what is made when first needed."""
        for name in names:
            getattr(self, name)

    def record(self, stage: Callable) -> list[RecordedLaunch]:
        """Record the launches that ``stage(launch)`` makes."""
        launches: list[RecordedLaunch] = []

        def launch(kernel, dim, inputs, outputs):
            launches.append(RecordedLaunch(kernel, dim, inputs, outputs, self.device))

        stage(launch)
        return launches

    def set_goals(self, launch: Callable) -> None:
        """Turn the policy's region and offset into goals."""
        s, maps = self.view, self.sim.maps
        if self.sim.settings.planner != "direct":
            launch(
                planner._set_goal, self.shape,
                [maps, s.map_id, s.region, s.offset, s.active], [s.goal, s.target, s.error],
            )  # fmt: skip

    def look(self, launch: Callable, running: wp.array) -> None:
        """Who is near whom in this local step, and which way robots face, in the envs where ``running`` is set."""
        s = self.view
        launch(
            dynamics._face_robots, self.shape, [self.robots, self.sim.settings.dt, running, s.pose, s.slip, s.center],
            [s.facing, s.place],
        )  # fmt: skip
        launch(dynamics._list_near, self.shape, [self.robots, running, s.place], [s.near, s.near_count])

    def plan(self, launch: Callable) -> None:
        """How to go: controls of every robot."""
        s, maps, cfg = self.view, self.sim.maps, self.sim.settings
        if cfg.planner == "direct":
            launch(planner._plan_direct, self.shape, [self.robots, s.active, s.command], [s.control])
            return
        robots = self.wavefront.narrowed if self.wavefront is not None else self.robots
        launch(
            planner._plan_dwa, self.shape,
            [maps, s.map_id, robots, cfg.num_accels, cfg.num_turns, cfg.horizon, cfg.clearance_weight,
             int(cfg.footprint), int(cfg.comm_limited), cfg.dt,
             s.active, s.collided, s.pose, s.slip, s.center, s.facing, s.target, self.known("boundary"), s.near,
             s.near_count, s.nearby, s.mates],
            [s.control, s.error],
        )  # fmt: skip

    def known(self, what: str) -> wp.array:
        """What each robot knows, not 0: flags of robots, or under perfect communication one word, the viewers."""
        prefix = "known" if self.sim.settings.comm_limited else "viewers"
        return getattr(self.view, f"{prefix}_{what}")

    def move(self, launch: Callable) -> None:
        """Move, then collide."""
        s, maps, cfg = self.view, self.sim.maps, self.sim.settings
        launch(
            dynamics._move_robots, self.shape,
            [self.robots, cfg.dt, s.active, s.collided, s.control],
            [s.pose, s.slip, s.center, s.path_length, s.facing],
        )  # fmt: skip
        launch(
            collision._detect_collisions, self.shape,
            [maps, s.map_id, self.robots, int(cfg.footprint), s.active, s.center, s.near, s.near_count],
            [s.pose, s.slip, s.collided, s.crashed],
        )  # fmt: skip

    def scan(self, launch: Callable, running: wp.array) -> None:
        """Scan, count, merge, and share, in the envs where ``running`` is set."""
        s, maps, cfg = self.view, self.sim.maps, self.sim.settings
        launch(
            visibility._collect_occluders, self.shape,
            [maps, s.map_id, 1, self.robots, running, s.pose, s.center, s.facing, s.near, s.near_count],
            [s.bins, s.direction, s.limit, s.occluder_count, s.wall_count, s.visible_count, s.error],
        )  # fmt: skip
        launch(
            visibility._scan_free, (*self.shape, self.lanes),
            [maps, s.map_id, 1, self.robots, self.lanes, running, s.pose, s.center,
             s.bins, s.direction, s.limit, s.occluder_count, s.wall_count],
            [s.viewers_free, s.visible, s.visible_count, s.error],
        )  # fmt: skip
        launch(
            visibility._scan_boundary, (*self.shape, self.lanes),
            [maps, s.map_id, self.robots, self.lanes, running, s.center, s.visible, s.visible_count],
            [s.seen_boundary, s.viewers_boundary],
        )  # fmt: skip
        launch(
            merge._count_points, self.shape,
            [maps, s.map_id, running, s.viewers_free, s.visible, s.visible_count],
            [s.fresh, s.overlap],
        )  # fmt: skip
        launch(
            merge._merge_scan, self.shape, [maps, s.map_id, running, s.visible, s.visible_count],
            [s.seen_free, s.viewers_free, s.covered, s.shared],
        )  # fmt: skip
        if cfg.comm_limited:
            launch(
                merge._hear_robots, self.shape,
                [maps, s.map_id, running, s.center, cfg.comm_range, int(cfg.line_of_sight)], [s.comm, s.hears],
            )  # fmt: skip
            for what in ("free", "boundary"):
                seen, known, told = (getattr(s, f"{k}_{what}") for k in ("seen", "known", "told"))
                launch(merge._copy_flags, known.shape, [running, known], [told])
                launch(
                    merge._share_points, (known.shape[0], known.shape[2]), [running, s.hears, seen, told], [known]
                )

    def local_step(self, launch: Callable) -> None:
        """Plan, move, collide, scan, merge, reward, terminate (design 4.2)."""
        s, maps = self.view, self.sim.maps
        self.look(launch, s.active)
        self.plan(launch)
        self.move(launch)
        self.scan(launch, s.active)
        launch(
            reward._reward_robots, self.shape,
            [maps, s.map_id, self.sim.weights, s.active, s.fresh, s.overlap, s.collided, s.crashed, s.covered,
             s.covered_before, s.local_step],
            [s.terms, s.raw],
        )  # fmt: skip
        launch(
            observe._record_track, self.shape, [maps, s.map_id, s.active, s.center, s.local_step, 1], [s.track]
        )
        launch(
            reward._close_step, self.shape[0],
            [maps, s.map_id, self.sim.settings.goal_coverage, s.collided, s.covered, s.shared, s.path_length],
            [s.active, s.covered_before, s.covered_sum, s.local_step, s.milestone_step, s.milestone_overlap,
             s.milestone_path, s.terminated],
        )  # fmt: skip

    def place(self, launch: Callable) -> None:
        """Reset the envs of ``mask``: clear, place the team, take the first scan."""
        s, maps, cfg = self.view, self.sim.maps, self.sim.settings
        envs, n = self.shape
        flags = [s.seen_free, s.seen_boundary, s.viewers_free, s.viewers_boundary]
        if cfg.comm_limited:
            flags += [s.known_free, s.known_boundary]
        for f in flags:
            launch(reset._clear_flags, f.shape, [s.mask], [f])
        launch(
            reset._clear_env, envs, [s.mask],
            [s.covered, s.covered_before, s.covered_sum, s.shared, s.local_step, s.macro_step, s.terminated,
             s.milestone_step, s.milestone_overlap],
        )  # fmt: skip
        launch(
            reset._place_team, envs,
            [maps, self.sim.num_maps, self.robots, s.seed, s.mask, s.env_id, s.episode, s.starts,
             self.sim.map_starts_view],
            [s.map_id, s.pose, s.center, s.error],
        )  # fmt: skip
        launch(
            reset._clear_robots, (envs, n), [s.mask, s.center],
            [s.slip, s.control, s.goal, s.target, s.collided, s.crashed, s.path_length, s.milestone_path,
             s.terms, s.raw, s.episode_reward],
        )  # fmt: skip
        self.look(launch, s.mask)
        self.scan(launch, s.mask)
        launch(observe._record_track, (envs, n), [maps, s.map_id, s.mask, s.center, s.local_step, 0], [s.track])
        launch(
            reset._start_env, envs, [s.mask, s.covered], [s.covered_before, s.active, s.fresh, s.overlap]
        )

    def run(self, start: int, count: int) -> None:
        """Local steps ``start`` to ``start + count`` of a macro step."""
        for k in range(start, start + count):
            if self.wavefront is not None and k % self.sim.settings.replan_steps == 0:
                replay(self.wavefront.field_launches)
            if self.wavefront is not None:
                replay(self.wavefront.waypoint_launches)
            replay(self.step_launches)

    def observe(self, picture, team, pose, grid) -> None:
        """Draw into fresh tensors of all envs (what leaves the env is never used again)."""
        self.draw(launch_on(self.device), picture, team, pose, grid)

    def draw(self, launch: Callable, picture, team, pose, grid) -> None:
        """Pictures, poses and region offsets of this shard's envs, into tensors of all envs."""
        s, maps = self.view, self.sim.maps
        part = slice(self.first, self.last)
        if picture is not None:
            self.draw_pictures(launch, picture[part], team[part])
        launch(
            observe._observe_pose, dim=self.shape,
            inputs=[maps, s.map_id, self.robots, s.pose, s.slip, s.center, s.goal],
            outputs=[wp.from_torch(pose[part], dtype=wp.vec4), wp.from_torch(grid[part].flatten(3))],
        )  # fmt: skip

    def draw_pictures(self, launch: Callable, picture, team) -> None:
        """Pictures of the envs of ``mask``, into tensors of this shard's envs."""
        s, maps = self.view, self.sim.maps
        out = [wp.from_torch(picture.flatten(3), dtype=wp.uint8), wp.from_torch(team.flatten(2), dtype=wp.uint8)]
        free, boundary = s.seen_free, s.seen_boundary
        if self.sim.settings.draw_known and self.sim.settings.comm_limited:
            free, boundary = s.known_free, s.known_boundary
        lanes = lanes_on(self.device, 1024)
        launch(
            observe._draw_points, dim=(self.shape[0], lanes),
            inputs=[maps, s.map_id, s.mask, self.shape[1], self.sim.team_bits, lanes,
                    free, boundary, s.seen_free, s.viewers_free, s.viewers_boundary],
            outputs=out,
        )  # fmt: skip
        launch(
            observe._list_bodies, dim=self.shape, inputs=[maps, s.map_id, s.mask, self.robots, s.pose, s.center],
            outputs=[s.body_pixel, s.body_count, s.error],
        )  # fmt: skip
        launch(
            observe._draw_robots, dim=self.shape,
            inputs=[s.mask, s.comm, s.body_pixel, s.body_count, s.local_step, s.track], outputs=[out[0]],
        )  # fmt: skip


class Simulation:
    """Thousands of teams, step by step.

    Args:
        maps: static data, every field of `Maps` as a torch tensor on ``device``.
        num_maps: how many maps those are.
        robots: one [E, N] tensor per field of `Robots`.
        weights: reward coefficients.
        settings: what a step does.
        sizes: lengths of the axes (`kernels.state.axis_sizes`).
        device: where it runs.
        seed: key of the random numbers.
        num_shards: runs of envs, each with a thread of its own on the CPU.
        nav: navigation grids of the maps and the cells of the largest; the `wavefront` planner needs them.
    """

    def __init__(
        self,
        maps: dict[str, torch.Tensor],
        num_maps: int,
        robots: dict[str, torch.Tensor],
        weights: reward.RewardWeights,
        settings: Settings,
        sizes: dict[str, int],
        device: torch.device,
        seed: int,
        num_shards: int = 1,
        nav: tuple[NavGrids, int] | None = None,
    ):
        self.map_tensors, self.num_maps, self.robot_tensors = maps, num_maps, robots
        self.weights, self.settings, self.sizes = weights, settings, sizes
        self.device = torch.device(device)
        self.maps = maps_struct(maps)
        self.nav_grids, self.nav_cells = nav or (None, 0)
        self.team_bits = int(settings.draw_known and not settings.comm_limited)
        self.tensors = allocate(STATE, sizes, self.device) | allocate(SCRATCH, sizes, self.device)
        self.tensors["starts"].fill_(torch.inf)
        self.map_starts = torch.full((num_maps, sizes["N"], 3), torch.inf, device=self.device)
        self.map_starts_view = wp.from_torch(self.map_starts, dtype=wp.vec3)
        self.tensors["env_id"].copy_(torch.arange(sizes["E"], dtype=torch.int32))
        self.tensors["seed"].fill_(seed & 0x7FFFFFFF)
        self.tensors["episode"].fill_(-1)
        self.tensors["comm"].fill_(True)
        count = max(1, min(num_shards, sizes["E"]))
        self.shards = self.split(count)
        per_thread = self.blocks_per_thread(count)
        self.blocks = self.shards if per_thread == 1 else self.split(count * per_thread)
        for shard in self.shards:  # here, for threads must not load kernels at the same time
            shard.prepare("goal_launches", "reset_launches")
        for block in self.blocks:
            block.prepare("wavefront", "step_launches")
        finish_filling(wp.device_from_torch(self.device))
        self.pool = ThreadPoolExecutor(count) if count > 1 else None

    def split(self, count: int) -> list[Shard]:
        """The envs in ``count`` runs of about the same length."""
        cuts = [self.sizes["E"] * k // count for k in range(count + 1)]
        return [Shard(self, a, b) for a, b in zip(cuts, cuts[1:], strict=False)]

    def blocks_per_thread(self, threads: int) -> int:
        """How many blocks each thread gets on average; a GPU takes all envs at once."""
        if self.device.type != "cpu":
            return 1
        fitting = BLOCK_BYTES // sum(memory_per_env(self.sizes).values())
        envs = max(fitting, -(-BLOCK_ROBOTS // self.sizes["N"]))
        return max(1, self.sizes["E"] // (envs * threads))

    def each(self, shards: list[Shard], task: Callable[[Shard], None]) -> None:
        """Run ``task`` on every shard or block, in threads where there are several."""
        if self.pool is None:
            for shard in shards:
                task(shard)
        else:
            list(self.pool.map(task, shards))

    def reset(self, mask: torch.Tensor) -> None:
        """Start a new episode in the envs where ``mask`` [E] is true."""
        self.tensors["mask"].copy_(mask)
        self.each(self.shards, lambda shard: replay(shard.reset_launches))

    def set_goals(self) -> None:
        """Take ``region`` and ``offset`` (or ``command``), and start the macro step's reward at zero."""
        self.tensors["terms"].zero_()
        self.each(self.shards, lambda shard: replay(shard.goal_launches))

    def step(self, start: int, count: int) -> None:
        """Run ``count`` local steps, the first being number ``start`` of the macro step."""
        self.each(self.blocks, lambda block: block.run(start, count))

    def observe(self, picture, team, pose, grid, mask: torch.Tensor | None = None) -> None:
        """Fill the observation tensors.

        Args:
            picture, team: zeros, uint8 [E, N, 4, 125, 125] and [E, 3, 125, 125]; None: no pictures.
            pose, grid: float32 [E, N, 4] and [E, N, 4, 8, 8].
            mask: int32 [E], the envs whose pictures are drawn; None: all.
        """
        self.tensors["mask"].fill_(1) if mask is None else self.tensors["mask"].copy_(mask)
        self.each(self.shards, lambda shard: shard.observe(picture, team, pose, grid))


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
