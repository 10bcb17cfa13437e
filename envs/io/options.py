"""Settings of an import: every automatic step can be set by hand."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

from maexp.envs.config_fields import check_settings, setting
from maexp.envs.maps.point_cloud import MapError
from maexp.envs.scenarios import Scenario, find_scenario

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048, "us-ft": 1200 / 3937, "in": 0.0254}


@dataclass(frozen=True)
class ImportOptions:
    """How a file becomes a planar map. None or "auto": chosen from the file, and the report says what."""

    scenario: str = setting(
        "auto", "whose robot and radar fit the map; auto: outdoor for a scan from the air, else pointcloud"
    )
    name: str | None = setting(None, "of the map; default: the stem of the file")
    resolution: float | None = setting(
        None, "spacing of the map's points; default: at most the robot's collision threshold", unit="m", above=0
    )
    max_points: int = setting(50_000, "free points that the automatic resolution may produce", low=1)
    num_robots: int = setting(3, "the team that must find room", low=1)
    robot_radius: float | None = setting(
        None, "of round robots, which fit through gaps twice as wide; default: the scenario's robot", unit="m"
    )
    pixel_size: float | None = setting(None, "of an image that comes without its yaml", unit="m", above=0)
    free_threshold: float | None = setting(None, "share of black up to which ground is free; overrules the yaml")
    occupied_threshold: float | None = setting(None, "share of black from which on it is an obstacle, the same")
    grey_walls: bool | None = setting(
        None,
        "pixels between the thresholds but darker than the grey of unknown space are obstacles; default: where they "
        "outnumber the black ones",
    )
    strict: bool = setting(
        False, "refuse a file that leaves its unit, axis up, thresholds or the like to be assumed, instead of a note"
    )
    topic: str | None = setting(
        None, "OccupancyGrid or PointCloud2 of a bag to read; default: the only grid, or else the only cloud"
    )
    units: str | float = setting("auto", f"of the file: {', '.join(UNITS)}, or metres per unit")
    up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = setting("auto", "axis that points up")
    level: bool | None = setting(None, "rotate a tilted floor level")
    place: Literal["auto", "indoor", "outdoor"] = setting(
        "auto", "indoor: one flat floor; outdoor: terrain seen from above"
    )
    floor: float | None = setting(None, "height of the floor after levelling, when no floor was scanned", unit="m")
    step_height: float | None = setting(None, "a robot drives over anything lower", unit="m", low=0)
    robot_height: float | None = setting(None, "a robot passes under anything higher", unit="m", above=0)
    voxel: float | None = setting(None, "points are thinned to one a voxel of this size", unit="m", above=0)
    outliers: bool | None = setting(None, "remove stray points")
    infer_free: bool | None = setting(None, "take the inside of the walls as free where the floor was not scanned")
    fill_holes: int | None = setting(None, "pinholes of the floor up to this many cells across are filled")
    drop_invalid: bool = setting(False, "drop NaN and infinite points instead of refusing the file")
    sample_spacing: float | None = setting(None, "between the points of a sampled mesh", unit="m", above=0)
    crop: tuple[float, float, float, float] | None = setting(
        None, "[xmin, ymin, xmax, ymax] in the map's frame", unit="m"
    )
    tile: float | None = setting(
        None, "side of the square cut from a larger outdoor scan, where it has most free space", unit="m", above=0
    )
    recentre: bool | None = setting(
        None, "move the map to the origin; default: where coordinates are larger than 10 km"
    )
    component: str | tuple[float, float] = setting(
        "largest", "part of the free space: the largest, or that around a place [x, y]", unit="m"
    )
    min_passage: float | None = setting(
        None, "gaps narrower than this are closed; default: twice the collision threshold, or radius", unit="m", low=0
    )
    wall_depth: int = setting(3, "obstacle points kept behind the boundary", unit="cells", low=1)

    def __post_init__(self):
        radius = self.robot_radius
        if radius is not None and not _positive(radius):
            raise MapError(f"robot.radius={radius!r} must be a number of metres greater than 0")
        check_settings(self, "importing", MapError)
        known = self.units == "auto" or self.units in UNITS or _positive(self.units)
        _require(known, "units", self.units, f'"auto", one of {", ".join(UNITS)}, or metres per unit')
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
