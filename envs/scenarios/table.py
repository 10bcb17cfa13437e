"""The table of scenarios: sizes, robots, radars and episode lengths that belong together."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from numbers import Integral
from typing import Any

from maexp.envs.config_fields import setting
from maexp.envs.maps.point_cloud import PointCloudMap
from maexp.envs.scenarios.indoor import build_indoor
from maexp.envs.scenarios.maze import build_maze
from maexp.envs.scenarios.outdoor import build_outdoor
from maexp.envs.scenarios.random_obstacles import build_adaptive, build_random_obstacles
from maexp.kernels.constants import DT

LEAST_MACRO_STEPS = 10
SWEEPS_OF_VOLUME = 8.0  # the same of an imported volume, by the squares of the radars' ranges
SWEEPS = 2.0
"""A team that drove without pause could sweep an imported map this many times in an episode, as in `maze`."""


@dataclass(frozen=True)
class Scenario:
    """One kind of place, and the robot, radar, planner and episode length that fit it."""

    name: str
    count: int | None  # maps in the suite; None: the user brings the map
    resolution: float  # spacing of the points [m]; the finest where maps of a scenario differ
    size: float | None  # longest side of the largest maps, in points x resolution [m]
    radar_range: float = setting(help="how far a radar sees", unit="m")
    max_speed: float = setting(help="of a robot", unit="m/s")
    max_accel: float = setting(help="of a robot", unit="m/s^2")
    body_length: float = setting(help="of a robot", unit="m")
    body_width: float = setting(help="of a robot", unit="m")
    collision_threshold: float = setting(help="a centre this near to a wall or another centre collides", unit="m")
    clearance_factor: float = setting(help="the paper's: DWA keeps so many thresholds away (preset=paper)")
    local_steps: int = setting(help="control steps of 0.1 s in one decision")
    macro_steps: int | None = setting(help="decisions in one episode, at most; default: from the free area")
    num_steering: int = setting(25, "DWA's candidates of the steering angle")
    max_steer: float = setting(math.pi / 3, "steering limit of a car", unit="rad")
    build: Callable[[int], PointCloudMap] | None = None  # index -> map; None: the user brings the map
    summary: str = ""  # a line for `--help`
    kind: str = "plane"  # or "volume": its maps are voxels, in `VOLUMES`
    height: float | None = None  # of the maps of a volume [m]
    vertical_fov: float | None = None  # of the radar of a volume [rad]
    robot_kind: str = "ackermann"  # how robots move that are not told otherwise
    scan_every: int | None = None  # local steps from one scan to the next in a volume

    def with_radius(self, radius: float | None) -> "Scenario":
        """With a round robot of that radius [m], which collides where its body touches a wall; None: as it is."""
        if radius is None:
            return self
        return replace(self, body_length=2 * radius, body_width=2 * radius, collision_threshold=radius)


_CAR: dict[str, Any] = dict(max_accel=2.0, body_length=1.5, body_width=1.0, collision_threshold=0.75)
_MAZE: dict[str, Any] = dict(
    _CAR, count=80, resolution=1.0, radar_range=10.0, max_speed=8.0, clearance_factor=4.0, local_steps=20
)
_RANDOM: dict[str, Any] = dict(
    _CAR,
    count=32,
    resolution=1.0,
    size=125.0,
    radar_range=10.0,
    max_speed=6.0,
    clearance_factor=3.0,
    local_steps=40,
    macro_steps=15,
)
_INDOOR: dict[str, Any] = dict(
    resolution=0.1,
    radar_range=1.0,
    max_speed=0.6,
    max_accel=0.2,
    body_length=0.15,
    body_width=0.1,
    collision_threshold=0.06,
    clearance_factor=4.2,
    local_steps=40,
    macro_steps=15,
    num_steering=21,
)

_ROWS = [
    Scenario(
        "random_obstacles",
        summary="125 m of corridors, rooms and scattered obstacles (paper)",
        **_RANDOM,
        build=partial(build_random_obstacles, scenario="random_obstacles", resolution=1.0),
    ),
    Scenario(
        "random_obstacles_adaptive",
        summary="the same with points 2 m apart in open ground: a fifth fewer",
        **_RANDOM,
        build=partial(build_adaptive, scenario="random_obstacles_adaptive", resolution=1.0, near=2.0),
    ),
    Scenario(
        "maze",
        summary="125 m mazes, corridors of constant width, no loops (paper)",
        size=125.0,
        macro_steps=30,
        **_MAZE,
        build=partial(build_maze, scenario="maze", cells=12, corridor=5, wall=5, resolution=1.0),
    ),
    Scenario(
        "maze_small",
        summary="37 m mazes, 1 m points: small enough to learn in minutes",
        size=37.0,
        macro_steps=15,
        **_MAZE,
        build=partial(build_maze, scenario="maze_small", cells=6, corridor=5, wall=1, resolution=1.0),
    ),
    Scenario(
        "indoor_small",
        summary="furnished floor plans under 10 m, 0.1 m points",
        count=17,
        size=10.0,
        **_INDOOR,
        build=partial(build_indoor, scenario="indoor_small", longest=(6.5, 9.8)),
    ),
    Scenario(
        "indoor_medium",
        summary="furnished floor plans of 10 to 14 m, 0.1 m points",
        count=32,
        size=14.0,
        **_INDOOR,
        build=partial(build_indoor, scenario="indoor_medium", longest=(10.2, 13.8)),
    ),
    Scenario(
        "indoor_large",
        summary="furnished floor plans over 14 m, 0.1 m points",
        count=22,
        size=20.0,
        **_INDOOR,
        build=partial(build_indoor, scenario="indoor_large", longest=(14.4, 19.8)),
    ),
    Scenario(
        "outdoor",
        summary="288 m of city blocks, trees and open ground, 1.5 to 2 m points",
        count=32,
        resolution=1.5,
        size=288.0,
        radar_range=20.0,
        max_speed=6.0,
        **_CAR,
        clearance_factor=4.2,
        local_steps=40,
        macro_steps=20,
        num_steering=21,
        build=partial(build_outdoor, scenario="outdoor"),
    ),
    Scenario(
        "pointcloud",
        summary="a map of your own: set scenario.path=FILE or FILE,FILE "
        "(.yaml .pcd .ply .xyz .las .laz .obj .glb .npz .npy)",
        count=None,
        resolution=0.25,
        size=None,
        radar_range=5.0,
        max_speed=2.0,
        max_accel=1.0,
        body_length=0.6,
        body_width=0.4,
        collision_threshold=0.3,
        clearance_factor=3.0,
        local_steps=20,
        macro_steps=None,
    ),
    Scenario(
        "ir2",
        summary="IR2's protocol (arXiv 2409.04730) on plans of your own: set scenario.path=PLAN.png or several",
        count=None,
        resolution=0.3,
        size=None,
        radar_range=16.0,
        max_speed=2.0,
        max_accel=1.0,
        body_length=0.4,
        body_width=0.4,
        collision_threshold=0.3,
        clearance_factor=3.0,
        local_steps=40,
        macro_steps=196,
    ),
]

_FLYING: dict[str, Any] = dict(
    kind="volume",
    resolution=0.25,
    size=30.0,
    height=6.0,
    radar_range=5.0,
    vertical_fov=math.pi / 2,
    max_speed=2.0,
    max_accel=2.0,
    body_length=0.5,
    body_width=0.5,
    collision_threshold=0.25,
    clearance_factor=3.0,
    local_steps=20,
    robot_kind="quadrotor",
    scan_every=3,
)


def _build_volume(name: str, index: int) -> Any:
    """A map of voxels; those who stay in the plane never load what makes them."""
    from maexp.envs.volume.generate import build_volume

    return build_volume(name, index)


_VOLUME_ROWS = [
    Scenario(
        "cave",
        summary="30 x 30 x 6 m of caves on several levels, 0.25 m voxels",
        count=40,
        macro_steps=60,
        build=partial(_build_volume, "cave"),
        **_FLYING,
    ),
    Scenario(
        "office_3d",
        summary="two office storeys of 30 x 30 m joined by stairs, 0.25 m voxels",
        count=40,
        macro_steps=90,
        build=partial(_build_volume, "office_3d"),
        **_FLYING,
    ),
    Scenario(
        "town_3d",
        summary="30 x 30 m of houses, trees and roofs under a closed sky, 0.25 m voxels",
        count=40,
        macro_steps=50,
        build=partial(_build_volume, "town_3d"),
        **_FLYING,
    ),
    Scenario(
        "volume",
        summary="voxels of your own: set scenario.path=FILE (.pcd .ply .las .laz .stl .obj .glb .bt .ot .npz)",
        count=None,
        macro_steps=None,
        **_FLYING | dict(size=None, height=None),
    ),
]

SCENARIOS: dict[str, Scenario] = {row.name: row for row in _ROWS}
"""Scenarios in the plane."""
VOLUMES: dict[str, Scenario] = {row.name: row for row in _VOLUME_ROWS}
"""Scenarios of voxels, apart from the others: what is made for the plane never meets them."""
GENERATED = tuple(name for name, row in SCENARIOS.items() if row.build is not None)
"""Those with maps of their own; the user brings the map of the others."""


def find_scenario(name: str) -> Scenario:
    """The scenario called `name`; ValueError naming the choices if there is none."""
    rows = SCENARIOS | VOLUMES
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
    maps: Sequence[PointCloudMap],
    scenario: Scenario,
    team: Sequence[tuple[float, float]] | None = None,
    local_steps: int | None = None,
) -> int:
    """Macro steps for a map without a fixed number: the team can sweep its free area `SWEEPS` times over (the largest
    of ``maps``), and its slowest robot drive across as many times.

    Args:
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
