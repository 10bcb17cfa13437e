"""Runs of envs: shards, each for a thread of its own, and blocks that fit a processor's cache.

Rows of different envs never share memory. On the CPU each shard of a simulation runs in a thread of its own (native
code releases the interpreter lock). Local steps run over smaller blocks of envs: what the kernels of a block touch
stays in the processor's cache while it goes through all of them, and threads take blocks as they get free. Results
depend on neither the number of shards nor that of blocks.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import TYPE_CHECKING

import torch
import warp as wp

from maexp.kernels.launches import Launch, RecordedLaunch, lanes_on, launch_named, record, replay
from maexp.kernels.state import memory_per_env, robots_struct, warp_views
from maexp.kernels.wavefront import Wavefront

if TYPE_CHECKING:
    from maexp.kernels.simulation import Simulation

Stage = Callable[[Launch, "Shard"], None]
"""``stage(launch, shard)`` launches kernels over the envs of a shard."""

BLOCK_BYTES = 2**19
"""State and scratch of a block of envs: what they touch fits a core's own cache."""
BLOCK_ROBOTS = 16
"""A block holds no fewer robots, so that what a launch costs by itself stays small beside them."""


class Shard:
    """Envs ``first`` to ``last`` of a simulation, as its stages see them.

    Attributes:
        settings: what a step does.
        view: Warp arrays of state and scratch, by name.
        robots: their parameters.
        shape: envs and robots of a team.
        radios: envs and radios of a team.
        lanes: threads that share the work of a robot.
    """

    def __init__(self, sim: "Simulation", first: int, last: int):
        self.first, self.last = first, last
        self.sim, self.settings = sim, sim.settings
        self.device = wp.device_from_torch(sim.device)
        self.view = warp_views(sim.tensors, first, last)
        self.robots = robots_struct(sim.robot_tensors, first, last)
        self.shape = (last - first, sim.sizes["N"])
        self.radios = (last - first, sim.sizes["U"])
        self.lanes = lanes_on(self.device, 32)
        numbers = {name: int(one) if isinstance(one, bool) else one for name, one in vars(sim.settings).items()}
        self._values = (
            numbers
            | vars(self.view)
            | {
                "maps": sim.maps,
                "num_maps": sim.num_maps,
                "map_starts": sim.map_starts_view,
                "weights": sim.weights,
                "robots": self.robots,
                "lanes": self.lanes,
            }
        )
        self._recorded: dict[Stage, list[RecordedLaunch]] = {}

    @cached_property
    def wavefront(self) -> Wavefront | None:
        """The planner's grids and paths, made when first needed."""
        return Wavefront(self.sim, self) if self.settings.planner == "wavefront" else None

    def known(self, what: str) -> wp.array:
        """What each robot knows, not 0: flags of robots, or under perfect communication one word, the viewers."""
        prefix = "known" if self.settings.limited else "viewers"
        return getattr(self.view, f"{prefix}_{what}")

    @property
    def false_walls(self) -> wp.array | None:
        """Flags of free points that robots take for walls, if any may."""
        return self.view.false_walls if self.settings.false_alarms else None

    @property
    def believed(self) -> dict[str, wp.array]:
        """Poses and centres as robots believe them to be, for kernels that plan ways and observe."""
        return self._as_drifting("estimate", "pose", "center")

    @property
    def aims(self) -> dict[str, wp.array]:
        """Goals and waypoints from where robots are, for kernels that drive by what is there."""
        return self._as_drifting("aim", "goal", "waypoint")

    def _as_drifting(self, suffix: str, *names: str) -> dict[str, wp.array]:
        return {name: getattr(self.view, f"{name}_{suffix}" if self.settings.drifts else name) for name in names}

    def call(self, launch: Launch, kernel: wp.Kernel, dim: int | tuple[int, ...] | None = None, **given) -> None:
        """Launch a kernel, once for every robot unless ``dim`` says else.

        Its parameters are named after what they get: a field of the state, a setting, ``maps``, ``robots``; what else
        they are is ``given``.
        """
        launch_named(launch, kernel, self.shape if dim is None else dim, self._values | given)

    def record(self, stage: Stage) -> list[RecordedLaunch]:
        """The launches of a stage, recorded when first asked for."""
        if stage not in self._recorded:
            self._recorded[stage] = record(lambda launch: stage(launch, self), self.device)
        return self._recorded[stage]

    def replay(self, stage: Stage) -> None:
        """Run a stage."""
        replay(self.record(stage))


def split(sim: "Simulation", count: int) -> list[Shard]:
    """The envs of a simulation in ``count`` runs of about the same length."""
    cuts = [sim.sizes["E"] * k // count for k in range(count + 1)]
    return [Shard(sim, a, b) for a, b in zip(cuts, cuts[1:], strict=False)]


def blocks_per_thread(sizes: dict[str, int], device: torch.device, threads: int) -> int:
    """How many blocks each thread gets on average; a GPU takes all envs at once."""
    if device.type != "cpu":
        return 1
    fitting = BLOCK_BYTES // sum(memory_per_env(sizes).values())
    envs = max(fitting, -(-BLOCK_ROBOTS // sizes["N"]))
    return max(1, sizes["E"] // (envs * threads))


class Threads:
    """As many threads as there are shards; a single one is the caller's own."""

    def __init__(self, count: int):
        self.pool = ThreadPoolExecutor(count) if count > 1 else None

    def each(self, shards: list[Shard], task: Callable[[Shard], None]) -> None:
        """Run ``task`` on every shard or block."""
        if self.pool is None:
            for shard in shards:
                task(shard)
        else:
            list(self.pool.map(task, shards))
