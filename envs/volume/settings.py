"""The settings of an env on volumes: checked, completed, and what volumes lack refused by name."""

import math
from collections.abc import Sequence
from dataclasses import replace

from maexp.envs.config import VOLUME_KINDS, EnvSettings, ObservationConfig, RadarConfig, RobotConfig
from maexp.envs.config_fields import check_settings, shown
from maexp.envs.maps.point_cloud import MapError
from maexp.envs.scenarios import find_scenario
from maexp.envs.settings import check_failing, find_device, finish_settings
from maexp.envs.volume.map import VoxelMap

SHOWN = ObservationConfig(pictures=False, targets=24)
"""What robots see that are not told otherwise."""
MOST_CELLS = 20.0
"""Voxels in a radar's range: beyond, its rays would part too far."""


def complete_settings(settings: EnvSettings, maps: Sequence[VoxelMap]) -> EnvSettings:
    """Check the settings of an env on volumes, and fill in what the scenario of the first map fixes.

    Raises:
        ValueError: a setting is out of its range, or not there in volumes (named, with its value).
        MapError: a map has fewer free voxels than the team has robots.
    """
    check_settings(settings)
    for m in maps:
        if settings.num_robots > m.free.sum():
            raise MapError(
                f"map {m.name} has {m.free.sum()} free voxels and no room for num_robots={settings.num_robots}: use "
                "fewer robots or a larger map"
            )
    device = find_device(settings.device)
    if settings.observation == ObservationConfig():
        settings = replace(settings, observation=SHOWN)
    settings = settings.completed(find_scenario(maps[0].scenario), maps)
    refuse_planar(settings)
    check_radars(maps, settings.radar)
    check_bodies(maps, settings.robot)
    check_failing(settings.faults, settings.num_robots, settings.episode_steps)
    return finish_settings(settings, device)


def refuse_planar(settings: EnvSettings) -> None:
    """Raise ValueError for the first setting that means something in the plane alone."""
    observation, comm, odometry = settings.observation, settings.comm, settings.odometry
    for wrong, name, value, advice in (
        (observation.pictures, "observation.pictures", True, "use false, and observation.targets=24"),
        (observation.radio, "observation.radio", True, "use false"),
        (settings.planner.name != "wavefront", "planner", settings.planner.name, "use wavefront"),
        (settings.collision != "centre", "collision", settings.collision, "use centre"),
        (comm.signal, "comm.signal", True, "use comm.range and comm.line_of_sight"),
        (comm.has_base, "comm.base_station", comm.base_station, "use false"),
        (comm.strategy != "opportunistic", "comm.strategy", comm.strategy, "use opportunistic"),
        (math.isfinite(comm.bandwidth), "comm.bandwidth", comm.bandwidth, "use inf"),
        (comm.delay > 0.0, "comm.delay", comm.delay, "use 0"),
        (settings.decide != "together", "scenario.decide", settings.decide, "use together"),
        (odometry.drift > 0.0, "odometry.drift", odometry.drift, "use 0"),
        (odometry.turn > 0.0, "odometry.turn", odometry.turn, "use 0"),
        (odometry.jump > 0.0, "odometry.jump", odometry.jump, "use 0"),
    ):
        if wrong:
            raise ValueError(f"{name}={shown(value)} is not there in volumes yet: {advice}")
    for robot in settings.robot:
        if robot.kind == "climber":
            raise ValueError("robot.kind='climber' is not simulated in volumes yet: use quadrotor")
        if robot.kind not in VOLUME_KINDS:
            raise ValueError(
                f"robot.kind={robot.kind!r} drives in the plane: choose {', '.join(VOLUME_KINDS)} for volumes"
            )
    for radar in settings.radar:
        for name in ("missed", "noise", "false_alarm", "evidence", "obstacle_radius"):
            if getattr(radar, name) != getattr(RadarConfig(), name):
                told = f"radar.{name}={shown(getattr(radar, name))}"
                raise ValueError(f"{told} is not there in volumes yet: use {getattr(RadarConfig(), name)}")


def check_radars(maps: Sequence[VoxelMap], radars: Sequence[RadarConfig]) -> None:
    """Raise ValueError if a radar sees farther than its rays tell voxels apart."""
    for m in maps:
        for radar in radars:
            if radar.range > MOST_CELLS * m.resolution * (1.0 + 1e-6):
                raise ValueError(
                    f"radar.range={radar.range:g} m is {radar.range / m.resolution:.4g} voxels of map {m.name}, and at "
                    f"most {MOST_CELLS:g} are possible: use {MOST_CELLS * m.resolution:g} m or less, or larger voxels"
                )


def check_bodies(maps: Sequence[VoxelMap], robots: Sequence[RobotConfig]) -> None:
    """Raise ValueError if a robot is wider than one of the maps."""
    for m in maps:
        sides = [high - low for low, high in zip(*m.extent, strict=True)]
        for robot in robots:
            if 2.0 * robot.collision_threshold > max(sides):
                raise ValueError(
                    f"robot.collision_threshold={robot.collision_threshold:g} m does not fit on map {m.name} of "
                    f"{' x '.join(f'{side:.4g}' for side in sides)} m: give metres, as robot.radius=0.3"
                )
