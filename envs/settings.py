"""The settings of an env, checked and completed once, before anything is built from them."""

import os
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from maexp.envs.config import (
    ROBOT_KINDS,
    VOLUME_KINDS,
    CommConfig,
    EnvSettings,
    FaultsConfig,
    ObservationConfig,
    PlannerConfig,
    RadarConfig,
    RobotConfig,
)
from maexp.envs.config_fields import check_settings, shown
from maexp.envs.maps.nav_grid import stands_free
from maexp.envs.maps.point_cloud import MapError, PointCloudMap
from maexp.envs.scenarios import find_scenario
from maexp.kernels.constants import DT
from maexp.kernels.sensing import return_chance

LEAST_RETURNS = 0.01  # share of the returns in view that has to count


def complete_settings(settings: EnvSettings, maps: Sequence[PointCloudMap]) -> EnvSettings:
    """Check the settings of an env, and fill in what the scenario of the first map fixes.

    Raises:
        ValueError: a setting is out of its range (named, with its value).
        MapError: a map has fewer points than the team has robots.
    """
    num_robots = settings.num_robots
    if not maps:
        raise ValueError("maps=[] is empty: give at least one map")
    for m in maps:
        if not isinstance(m, PointCloudMap):
            raise ValueError(f"maps holds {m!r}: give PointCloudMaps, from make_map or import_map")
    check_settings(settings)
    fewest = min(maps, key=lambda m: len(m.free))
    if num_robots > len(fewest.free):
        raise MapError(
            f"map {fewest.name} has {len(fewest.free)} free points and no room for num_robots={num_robots}: "
            "use fewer robots or a larger map"
        )
    device = find_device(settings.device)
    settings = settings.completed(find_scenario(maps[0].scenario), maps)
    check_plane(settings.robot, settings.radar)
    check_bodies(maps, settings.robot)
    comm, faults = settings.comm, settings.faults
    check_observation(settings.observation, settings.planner, comm)
    check_strategy(comm, num_robots, settings.planner)
    check_base(maps, comm)
    check_noise(maps, settings.radar)
    check_done(settings.done, comm)
    check_decide(settings.decide, settings)
    check_failing(faults, num_robots, settings.episode_steps)
    return finish_settings(settings, device)


def finish_settings(settings: EnvSettings, device: torch.device) -> EnvSettings:
    """With numbers of Python's own kinds, and as many threads as help."""
    comm, faults = settings.comm, settings.faults
    threads = settings.num_threads or max(1, min(len(os.sched_getaffinity(0)), settings.num_envs // 4))
    return replace(
        settings,
        num_envs=int(settings.num_envs),
        num_robots=int(settings.num_robots),
        device=device,
        seed=int(settings.seed),
        first_env=int(settings.first_env),
        num_threads=threads if device.type == "cpu" else 1,
        local_steps=int(settings.local_steps),
        macro_steps=int(settings.macro_steps),
        success_coverage=float(settings.success_coverage),
        limited=settings.limited or comm.limited or faults.enabled,
    )


def check_plane(robots: Sequence[RobotConfig], radars: Sequence[RadarConfig]) -> None:
    """Raise ValueError for what moves or sees in volumes alone."""
    for robot in robots:
        if robot.kind in VOLUME_KINDS:
            raise ValueError(
                f"robot.kind={robot.kind!r} moves in volumes, and these maps are of the plane: choose "
                f"{', '.join(ROBOT_KINDS)}, or use a scenario of volumes"
            )
    for radar in radars:
        for name in ("vertical_fov", "every"):
            if (value := getattr(radar, name)) is not None:
                raise ValueError(
                    f"radar.{name}={value:g} is for volumes, and these maps are of the plane: leave it out, or use a "
                    "scenario of volumes"
                )


def check_bodies(maps: Sequence[PointCloudMap], robots: Sequence[RobotConfig]) -> None:
    """Raise ValueError if a robot is longer than one of the maps."""
    for m in maps:
        sides = [high - low for low, high in zip(*m.extent, strict=True)]
        for robot in robots:
            named = ("length", "width") if robot.radius is None else ("radius",)
            name = max(named, key=lambda name, robot=robot: getattr(robot, name))
            if max(robot.length, robot.width) > max(sides):
                raise ValueError(
                    f"robot.{name}={getattr(robot, name):g} m does not fit on map {m.name} of {sides[0]:.4g} x "
                    f"{sides[1]:.4g} m: give metres, as robot.{name}=0.5"
                )


def check_base(maps: Sequence[PointCloudMap], comm: CommConfig) -> None:
    """Raise ValueError if the place of the base station is no free ground of one of the maps."""
    if isinstance(comm.base_station, bool):
        return
    for m in maps:
        if not stands_free(m, comm.base_station):
            (left, low), (right, high) = m.extent
            raise ValueError(
                f"comm.base_station={list(comm.base_station)} is no free ground of map {m.name}, which reaches from "
                f"[{left:.4g}, {low:.4g}] to [{right:.4g}, {high:.4g}] m: choose another place, or true for where "
                "robot 0 starts"
            )


def check_noise(maps: Sequence[PointCloudMap], radars: Sequence[RadarConfig]) -> None:
    """Raise ValueError if a radar's ranges are so far off that hardly any return is taken for one of its point."""
    for m in maps:
        for radar in radars:
            if return_chance(0.0, radar.noise, m.resolution) < LEAST_RETURNS:
                raise ValueError(
                    f"radar.noise={radar.noise:g} m leaves fewer than one return in {1 / LEAST_RETURNS:.0f} on map "
                    f"{m.name}, whose points are {m.resolution:g} m apart: lower it, or use a coarser map"
                )


def check_observation(config: ObservationConfig, planner: PlannerConfig, comm: CommConfig) -> None:
    """Raise ValueError if targets are shown to a policy that steers, or tell of radios where these always reach."""
    if config.radio and not config.targets:
        raise ValueError("observation.radio=true is about targets, and none are shown: add observation.targets=24")
    if config.radio and not comm.limited:
        raise ValueError(
            "observation.radio=true is about radios that do not reach: add comm=ir2, comm.range or the like"
        )
    if config.radio and comm.has_base and planner.name != "wavefront":
        raise ValueError(
            f"observation.radio=true sends robots to the base station: planner={planner.name} finds no way, use "
            "wavefront"
        )
    if config.targets and planner.name == "direct":
        raise ValueError(
            f"planner=direct takes controls, observation.targets={config.targets} shows goals: add action=regions"
        )


def check_strategy(config: CommConfig, num_robots: int, planner: PlannerConfig) -> None:
    """Raise ValueError if the team, its radios or its planner do not go with `comm.strategy`."""
    name = config.strategy
    if name == "opportunistic":
        return
    if planner.name != "wavefront":
        raise ValueError(f"comm.strategy={name} sends robots back: planner={planner.name} finds no way, use wavefront")
    if not config.limited:
        raise ValueError(f"comm.strategy={name} is for radios that do not reach: add comm=ir2, comm.range or the like")
    if name in ("relay", "return_to_base", "courier") and not config.has_base:
        raise ValueError(f"comm.strategy={name} needs a base station: add comm.base_station=true")
    if name == "relay" and num_robots < 2:
        raise ValueError(f"comm.strategy=relay needs an explorer and a relay: num_robots={num_robots}, give 2 or more")


def check_done(done: str, comm: CommConfig) -> None:
    """Raise ValueError unless whose coverage ends an episode is there."""
    if done == "base" and not comm.has_base:
        raise ValueError("done='base' needs a base station: add comm.base_station=true")


def check_decide(decide: str, settings: EnvSettings) -> None:
    """Raise ValueError if robots are to decide when they arrive, and something else counts in decisions of all."""
    if decide == "together":
        return
    if settings.planner.name == "direct":
        raise ValueError("decide=arrival is about goals, and planner=direct takes controls: choose another planner")
    if settings.comm.strategy != "opportunistic" or settings.observation.radio:
        name = "observation.radio=true" if settings.observation.radio else f"comm.strategy={settings.comm.strategy}"
        raise ValueError(
            f"decide=arrival and {name}, which counts in decisions of the whole team: leave one of them out"
        )


def check_failing(config: FaultsConfig, num_robots: int, steps: int) -> None:
    """Raise ValueError if a robot fails that is not there, or after the episode's last step."""
    for robot, inputs in config.at:
        if config.steps[robot] >= steps:
            raise ValueError(
                f"faults.at: robot {shown(robot)} fails after {inputs:g} s, and an episode ends at {steps * DT:g} s: "
                f"give {(steps - 1) * DT:g} s, when its last step begins, or less"
            )
        if robot >= num_robots:
            last = num_robots - 1
            raise ValueError(
                f"faults.at names robot {shown(robot)}: there are num_robots={num_robots}, from 0 to {last}"
            )


def positive_count(name: str, value: int) -> int:
    """``value`` as an int, if it is a whole number, 1 or more."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise ValueError(f"{name}={value!r} must be a whole number, 1 or more")
    return int(value)


def find_device(device: str | torch.device) -> torch.device:
    """The device, if there is one of that name."""
    try:
        found = torch.device(device)
    except (RuntimeError, TypeError):
        found = None
    if found is None or found.type not in ("cpu", "cuda"):
        raise ValueError(f"device={str(device)!r} is unknown: choose cpu or cuda")
    count = torch.cuda.device_count()
    if found.type == "cuda" and (found.index or 0) >= count:
        raise ValueError(f"device={str(device)!r} is not there: torch sees {count} CUDA devices; choose device=cpu")
    return found
