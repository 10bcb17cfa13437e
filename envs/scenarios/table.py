"""The table of scenarios: sizes, robots, radars and episode lengths that belong together.

A row is the `row` of a file in `conf/scenario/`.
"""

import importlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from numbers import Integral
from typing import Any

from maexp.conf import list_choices, read_choice
from maexp.envs.config_fields import setting
from maexp.envs.maps.point_cloud import PointCloudMap
from maexp.kernels.constants import DT

LEAST_MACRO_STEPS = 10
PROTOCOL = "protocol"
"""The pace at which a scenario was published: `Scenario.local_steps` and `macro_steps`."""
SWEEPS_OF_VOLUME = 8.0  # as `SWEEPS`, of an imported volume, by the squares of the radars' ranges
SWEEPS = 2.0
"""A team that drove without pause could sweep an imported map this many times in an episode, as in `maze`."""


@dataclass(frozen=True)
class Builder:
    """Builds the maps of a scenario.

    Attributes:
        function: "MODULE.NAME" of this package: (index, scenario=..., ...) -> map
        scenario: the scenario's name
        settings: the function's other arguments
    """

    function: str
    scenario: str
    settings: dict[str, Any]

    def __call__(self, index: int) -> PointCloudMap:
        module, _, name = self.function.rpartition(".")
        build = getattr(importlib.import_module(f"maexp.envs.scenarios.{module}"), name)
        return build(index, scenario=self.scenario, **self.settings)


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """One kind of place, and the robot, radar, planner and episode length that fit it. The defaults are those of the
    paper's car."""

    name: str
    count: int | None = None  # maps in the suite; None: the user brings the map
    resolution: float  # spacing of the points [m]; the finest where maps of a scenario differ
    size: float | None = None  # longest side of the largest maps, in points x resolution [m]
    radar_range: float = setting(help="how far a radar sees", unit="m")
    max_speed: float = setting(help="of a robot", unit="m/s")
    max_accel: float = setting(2.0, "of a robot", unit="m/s^2")
    body_length: float = setting(1.5, "of a robot", unit="m")
    body_width: float = setting(1.0, "of a robot", unit="m")
    collision_threshold: float = setting(0.75, "a centre this near to a wall or another centre collides", unit="m")
    clearance_factor: float = setting(help="the paper's: DWA keeps so many thresholds away (preset=paper)")
    local_steps: int = setting(help="control steps of 0.1 s in one decision; default: from decision_seconds")
    macro_steps: int | None = setting(None, "decisions in one episode, at most; default: from its seconds")
    num_steering: int = setting(25, "DWA's candidates of the steering angle")
    max_steer: float = setting(math.pi / 3, "steering limit of a car", unit="rad")
    build: Callable[[int], PointCloudMap] | None = None  # index -> map; None: the user brings the map
    kind: str = "plane"  # or "volume": its maps are voxels
    height: float | None = None  # of the maps of a volume [m]
    vertical_fov: float | None = None  # of the radar of a volume [rad]
    robot_kind: str = "ackermann"  # how robots move unless `robot.kind` is set
    scan_every: int | None = None  # local steps from one scan to the next in a volume
    decision_seconds: float | str = setting(
        1.0, "from decision to decision, or protocol: as the scenario was published", unit="s"
    )

    def decision_steps(
        self, local_steps: int | None = None, seconds: float | str | None = None, decide: str = "together"
    ) -> int:
        """Control steps from decision to decision.

        Args:
            local_steps: what is said of them; else
            seconds: of `EnvSettings.decision_seconds`; None: the scenario's, and the protocol's where robots decide
                when they arrive, for then it is the longest time.
            decide: of `EnvSettings`.

        Raises:
            ValueError: seconds that are no whole control steps.
        """
        if local_steps is not None:
            return local_steps
        if seconds is None:
            seconds = self.decision_seconds if decide == "together" else PROTOCOL
        if seconds == PROTOCOL:
            return self.local_steps
        seconds = float(seconds)
        steps = round(seconds / DT)
        if steps < 1 or abs(steps * DT - seconds) > 1e-6:
            raise ValueError(
                f"decision_seconds={seconds:g} is no whole number of control steps of {DT:g} s: give {DT:g} or a "
                f"multiple, or {PROTOCOL} for the {DT * self.local_steps:g} s of scenario={self.name}"
            )
        return steps

    def episode_decisions(self, local_steps: int | None, steps: int) -> int | None:
        """Decisions of an episode, which lasts as long whatever the pace; None: that depends on the map.

        Args:
            local_steps: what is said of them: then an episode has as many decisions as the protocol's.
            steps: control steps from decision to decision.
        """
        if self.macro_steps is None or local_steps is not None:
            return self.macro_steps
        return math.ceil(self.macro_steps * self.local_steps / steps - 1e-9)

    def with_radius(self, radius: float | None) -> "Scenario":
        """With a round robot of that radius [m], which collides where its body touches a wall; None: as it is."""
        if radius is None:
            return self
        return replace(self, body_length=2 * radius, body_width=2 * radius, collision_threshold=radius)


def _read_scenario(name: str) -> Scenario:
    row = dict(read_choice("scenario", name)["row"])
    if "build" in row:
        settings = dict(row["build"])
        row["build"] = Builder(settings.pop("function"), name, settings)
    return Scenario(name=name, **row)


@cache
def all_scenarios() -> dict[str, Scenario]:
    """The table. Its files are read when it is first asked for: robots that only plan do without."""
    return {name: _read_scenario(name) for name in list_choices("scenario")}


def __getattr__(name: str) -> Any:
    """`SCENARIOS`, the table of the plane; `VOLUMES`, that of voxels; and `GENERATED`: those of the plane with maps of
    their own; the user brings the map of the others."""
    rows = all_scenarios().items() if name in ("SCENARIOS", "VOLUMES", "GENERATED") else ()
    if name == "SCENARIOS":
        return {name: row for name, row in rows if row.kind == "plane"}
    if name == "VOLUMES":
        return {name: row for name, row in rows if row.kind == "volume"}
    if name == "GENERATED":
        return tuple(name for name, row in rows if row.kind == "plane" and row.build is not None)
    raise AttributeError(name)


def find_scenario(name: str) -> Scenario:
    """The scenario called `name`; ValueError naming the choices if there is none."""
    rows = all_scenarios()
    if name not in rows:
        raise ValueError(f"scenario={name!r} is unknown: choose one of {', '.join(rows)}.")
    return rows[name]


def make_map(name: str, index: int = 0) -> Any:
    """Map `index` (any integer >= 0) of scenario `name`: the same points, or voxels (`VoxelMap`), on every call.

    ValueError for an unknown scenario, a negative index, or a scenario whose map the user brings.
    """
    scenario = find_scenario(name)
    if scenario.build is None:
        raise ValueError(
            f"scenario={name!r} has no generated maps: give the file of your map as scenario.path=FILE "
            "(in Python: maexp.envs.import_map(FILE))."
        )
    if not isinstance(index, Integral) or index < 0:
        raise ValueError(f"index={index!r} of scenario {name!r} must be an integer >= 0.")
    return scenario.build(int(index))


def split(name: str) -> tuple[range, range]:
    """Indices of the training maps and of the held-out maps (the last fifth of the table's count)."""
    scenario = find_scenario(name)
    if scenario.count is None:
        raise ValueError(f"scenario={name!r} has no generated maps to hold out: it plays the map you bring.")
    return cut_last_fifth(range(scenario.count))


def cut_last_fifth(indices: range) -> tuple[range, range]:
    """The first four fifths and the last, which has one index at least: held out of all maps, or of those that teams
    are trained on for validation."""
    first = len(indices) - max(1, round(0.2 * len(indices)))
    return indices[:first], indices[first:]


def default_macro_steps(
    maps: Sequence[Any],
    scenario: Scenario,
    team: Sequence[tuple[float, float]] | None = None,
    local_steps: int | None = None,
) -> int:
    """Macro steps for a map without a fixed number: the team can sweep its free area `SWEEPS` times over (the largest
    of ``maps``), and its slowest robot drive across as many times.

    Args:
        maps: point clouds, or voxels where the scenario is one of volumes.
        team: speed [m/s] and radar range [m] of every robot; None: three as the scenario has them.
        local_steps: of a macro step; None: the scenario's.
    """
    team = team or [(scenario.max_speed, scenario.radar_range)] * 3
    seconds = DT * (local_steps or scenario.local_steps)
    across = max(math.dist(*m.extent) for m in maps)
    crossing = across / min(speed for speed, _ in team)
    if scenario.kind == "volume":
        volume = max(m.free_volume for m in maps)
        sweeping = volume / sum(speed * reach**2 for speed, reach in team)
        return max(LEAST_MACRO_STEPS, math.ceil(max(SWEEPS_OF_VOLUME * sweeping, SWEEPS * crossing) / seconds - 1e-9))
    area = max(m.free_area for m in maps)
    sweeping = area / sum(speed * reach for speed, reach in team)
    return max(LEAST_MACRO_STEPS, math.ceil(SWEEPS * max(sweeping, crossing) / seconds - 1e-9))
