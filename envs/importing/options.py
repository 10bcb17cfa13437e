"""Settings of an import: every automatic step can be set by hand."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any

from maexp.envs.map import MapError
from maexp.envs.scenarios import Scenario, find_scenario

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048, "us-ft": 1200 / 3937, "in": 0.0254}
UP_AXES = ("x", "y", "z", "-x", "-y", "-z")


@dataclass(frozen=True)
class ImportOptions:
    """How a file becomes a planar map. None or "auto": chosen from the file, and the report says what.

    Robot and map:
        scenario: whose robot and radar fit the map; "auto": "outdoor" for airborne scans where that scenario
            exists, else "pointcloud".
        name: name of the map; None: the stem of the file.
        resolution: spacing of the map's points [m]; None: at most the robot's collision threshold.
        max_points: free points the automatic resolution may produce; it is coarser where they are not enough.
        num_robots: the team that must find room.
        robot_radius: of round robots [m], which fit through gaps twice as wide; None: the scenario's robot.

    Grids (ROS map_server): `pixel_size` [m] when an image comes without its yaml; `free_threshold` and
        `occupied_threshold` (shares of black) overrule the yaml; `grey_walls`: pixels between the thresholds but
        darker than the grey of unknown space are obstacles; None: where they outnumber the black ones.

    Bags (rosbag2): `topic`: the `OccupancyGrid` or `PointCloud2` to read; None: the only grid, or else the only cloud.
        The two thresholds hold for grids of bags, too, as shares of 100.

    Clouds and meshes:
        units: of the file: "m", "cm", "mm", "ft", "us-ft", "in", or metres per unit.
        up: axis that points up: "x", "y", "z", "-x", "-y", "-z".
        level: rotate a tilted floor level; True, False.
        place: "indoor" (one flat floor) or "outdoor" (terrain seen from above).
        floor: height of the floor [m] after levelling, when no floor was scanned.
        step_height: a robot drives over anything lower [m].
        robot_height: a robot passes under anything higher [m].
        voxel: points are thinned to one a voxel of this size [m].
        outliers: remove stray points; True, False.
        infer_free: take the inside of the walls as free where the floor was not scanned; True, False.
        fill_holes: pinholes of the floor up to this many cells across are filled.
        drop_invalid: drop NaN and infinite points instead of refusing the file.
        sample_spacing: meshes are sampled every so many metres.

    Cleaning:
        crop: (xmin, ymin, xmax, ymax) [m] in the map's frame.
        tile: side [m] of the square cut from a larger outdoor scan, where it has most free space.
        recentre: move the map to the origin; "auto": where coordinates are larger than 10 km.
        component: "largest", or (x, y) [m]: the free space around that place.
        min_passage: gaps narrower than this [m] are closed; None: twice the collision threshold, or radius.
        wall_depth: obstacle points kept behind the boundary [cells].
    """

    scenario: str = "auto"
    name: str | None = None
    resolution: float | None = None
    max_points: int = 50_000
    num_robots: int = 3
    robot_radius: float | None = None
    pixel_size: float | None = None
    free_threshold: float | None = None
    occupied_threshold: float | None = None
    grey_walls: bool | None = None
    topic: str | None = None
    units: str | float = "auto"
    up: str = "auto"
    level: bool | None = None
    place: str = "auto"
    floor: float | None = None
    step_height: float | None = None
    robot_height: float | None = None
    voxel: float | None = None
    outliers: bool | None = None
    infer_free: bool | None = None
    fill_holes: int | None = None
    drop_invalid: bool = False
    sample_spacing: float | None = None
    crop: tuple[float, float, float, float] | None = None
    tile: float | None = None
    recentre: bool | None = None
    component: str | tuple[float, float] = "largest"
    min_passage: float | None = None
    wall_depth: int = 3

    def __post_init__(self):
        _require(self.place in ("auto", "indoor", "outdoor"), "place", self.place, '"auto", "indoor" or "outdoor"')
        _require(self.up in ("auto", *UP_AXES), "up", self.up, f'"auto" or one of {", ".join(UP_AXES)}')
        known = self.units == "auto" or self.units in UNITS or _positive(self.units)
        _require(known, "units", self.units, f'"auto", one of {", ".join(UNITS)}, or metres per unit')
        for name in ("resolution", "pixel_size", "voxel", "sample_spacing", "tile", "robot_height"):
            value = getattr(self, name)
            _require(value is None or _positive(value), name, value, "a number of metres greater than 0")
        radius = self.robot_radius
        if radius is not None and not _positive(radius):
            raise MapError(f"robot.radius={radius!r} must be a number of metres greater than 0")
        for name in ("step_height", "min_passage"):
            value = getattr(self, name)
            _require(value is None or value == 0 or _positive(value), name, value, "a number of metres >= 0")
        for name in ("max_points", "num_robots", "wall_depth"):
            value = getattr(self, name)
            _require(isinstance(value, int) and value >= 1, name, value, "an integer >= 1")
        if self.crop is not None:
            good = len(self.crop) == 4 and self.crop[0] < self.crop[2] and self.crop[1] < self.crop[3]
            _require(good, "crop", self.crop, "(xmin, ymin, xmax, ymax) with xmin < xmax and ymin < ymax")
        named = self.component == "largest"
        _require(named or len(self.component) == 2, "component", self.component, '"largest" or a place (x, y)')
        if self.scenario != "auto":
            find_scenario(self.scenario)

    def find_scenario(self, automatic: str = "pointcloud") -> Scenario:
        """The scenario whose robot and radar fit the map, its robot that of `robot_radius` where there is one."""
        return find_scenario(automatic if self.scenario == "auto" else self.scenario).with_radius(self.robot_radius)

    @property
    def metres_per_unit(self) -> float | None:
        """None where the file decides."""
        if self.units == "auto":
            return None
        return UNITS[self.units] if self.units in UNITS else float(self.units)


def make_options(options: ImportOptions | None, overrides: dict[str, Any]) -> ImportOptions:
    """`options` with `overrides`; an unknown name is an error that lists the choices."""
    names = [field.name for field in fields(ImportOptions)]
    for name in overrides:
        if name not in names:
            raise MapError(f"{name}={overrides[name]!r} is not an import option; choose from {', '.join(names)}")
    return replace(options or ImportOptions(), **overrides)


def _positive(value) -> bool:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return number and math.isfinite(value) and value > 0


def _require(good: bool, name: str, value, wanted: str) -> None:
    if not good:
        raise MapError(f"importing.{name}={value!r} must be {wanted}")
