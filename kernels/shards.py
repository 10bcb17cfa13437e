"""What a stage gets: settings and a shard, a run of envs; and the threads that run them.

Rows of different envs never share memory. On the CPU each shard of a simulation runs in a thread of its own (native
code releases the interpreter lock). Local steps run over smaller blocks of envs: what the kernels of a block touch
stays in the processor's cache while it goes through all of them, and threads take blocks as they get free. Results
depend on neither the number of shards nor that of blocks.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import warp as wp

from maexp.kernels.constants import DT
from maexp.kernels.launches import EagerStage, Launch, RecordedLaunch, lanes_on, launch_named, record, replay

Stage = Callable[[Launch, "Shard"], None]
"""``stage(launch, shard)`` launches kernels over the envs of a shard."""


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
    map_errors: bool  # whether robots draw what they see where they believe it to be
    episode_steps: int  # local steps of an episode
    done: int  # whose coverage ends an episode (`radio.UNION`)
    draw_known: bool  # pictures show what robots know, not what they have seen
    success_coverage: float  # share at which an episode ends
    together: bool  # teams start in one place
    dt: float = DT  # of a local step [s]


class Shard:
    """Envs ``first`` to ``last`` of a simulation, as its stages see them.

    Attributes:
        settings: what a step does.
        view: Warp arrays of state and scratch, by name.
        robots: their parameters.
        values: all that kernels' parameters may be named after.
        shape: envs and robots of a team.
        radios: envs and radios of a team.
        lanes: threads that share the work of a robot.

    Args:
        sizes: lengths of the axes.
        more: values that all shards have: ``maps`` and the like.
        make_wavefront: what the planner `wavefront` keeps for a shard (`wavefront.Wavefront`).
    """

    def __init__(
        self,
        first: int,
        last: int,
        device: wp.Device,
        settings: Settings,
        sizes: dict[str, int],
        view: SimpleNamespace,
        robots: Any,
        more: dict[str, Any],
        make_wavefront: Callable[["Shard"], Any],
    ):
        self.first, self.last, self.device = first, last, device
        self.settings, self.view, self.robots = settings, view, robots
        self.shape, self.radios = (last - first, sizes["N"]), (last - first, sizes["U"])
        self.lanes = lanes_on(device, 32)
        numbers = {
            name: int(setting) if isinstance(setting, bool) else setting for name, setting in vars(settings).items()
        }
        self.values = numbers | vars(view) | {"robots": robots, "lanes": self.lanes} | more
        self._make_wavefront = make_wavefront
        self._recorded: dict[Stage, list[RecordedLaunch] | list[EagerStage]] = {}

    @cached_property
    def wavefront(self) -> Any:
        """What the planner `wavefront` keeps, made when first needed; None under another planner."""
        return self._make_wavefront(self) if self.settings.planner == "wavefront" else None

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
        launch_named(launch, kernel, self.shape if dim is None else dim, self.values | given)

    def record(self, stage: Stage) -> list[RecordedLaunch] | list[EagerStage]:
        """The launches of a stage, recorded when first asked for."""
        if stage not in self._recorded:
            self._recorded[stage] = record(lambda launch: stage(launch, self), self.device)
        return self._recorded[stage]

    def replay(self, stage: Stage) -> None:
        """Run a stage."""
        replay(self.record(stage))


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
