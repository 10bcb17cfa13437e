"""The settings of an env, checked and completed once, before anything is built from them."""

import os
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from maexp.envs.config import (
    CommConfig,
    EnvSettings,
    FaultsConfig,
    LookaheadConfig,
    ObservationConfig,
    OdometryConfig,
    PlannerConfig,
    RadarConfig,
    RewardConfig,
    RobotConfig,
    TargetsConfig,
    check_comm,
    check_done,
    check_faults,
    check_lookahead,
    check_observation,
    check_odometry,
    check_reward,
    check_strategy,
    check_targets,
    complete_planner,
    complete_radar,
    complete_robot,
    one_config,
    per_robot,
)
from maexp.envs.fields import check_settings
from maexp.envs.map import MapError, PointCloudMap
from maexp.envs.nav_grid import stands_free
from maexp.envs.scenarios import default_macro_steps, find_scenario
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
    scenario, device = find_scenario(maps[0].scenario), _device(settings.device)
    local_steps = int(scenario.local_steps if settings.local_steps is None else settings.local_steps)
    robots = tuple(complete_robot(r, scenario) for r in per_robot("robot", settings.robot, RobotConfig, num_robots))
    radars = tuple(complete_radar(r, scenario) for r in per_robot("radar", settings.radar, RadarConfig, num_robots))
    macro_steps = settings.macro_steps
    if macro_steps is None:
        team = [(robot.max_speed, radar.range) for robot, radar in zip(robots, radars, strict=True)]
        macro_steps = scenario.macro_steps or default_macro_steps(maps, scenario, team, local_steps)
    check_bodies(maps, robots)
    planner = complete_planner(one_config("planner", settings.planner, PlannerConfig), scenario)
    observation = one_config("observation", settings.observation, ObservationConfig)
    check_observation(observation, planner)
    comm = check_comm(one_config("comm", settings.comm, CommConfig))
    check_strategy(comm, num_robots, planner)
    check_base(maps, comm)
    check_noise(maps, radars)
    check_done(settings.done, comm)
    faults = check_faults(one_config("faults", settings.faults, FaultsConfig), num_robots)
    threads = settings.num_threads or max(1, min(len(os.sched_getaffinity(0)), settings.num_envs // 4))
    return replace(
        settings,
        num_envs=int(settings.num_envs),
        num_robots=int(num_robots),
        device=device,
        seed=int(settings.seed),
        first_env=int(settings.first_env),
        num_threads=threads if device.type == "cpu" else 1,
        local_steps=local_steps,
        macro_steps=int(macro_steps),
        success_coverage=float(settings.success_coverage),
        robot=robots,
        radar=radars,
        planner=planner,
        reward=check_reward(one_config("reward", settings.reward, RewardConfig)),
        observation=observation,
        comm=comm,
        faults=faults,
        odometry=check_odometry(one_config("odometry", settings.odometry, OdometryConfig)),
        limited=settings.limited or comm.limited or faults.some,
        targets=check_targets(one_config("targets", settings.targets, TargetsConfig)),
        lookahead=check_lookahead(one_config("lookahead", settings.lookahead, LookaheadConfig)),
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


def positive_count(name: str, value: int) -> int:
    """``value`` as an int, if it is a whole number, 1 or more."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise ValueError(f"{name}={value!r} must be a whole number, 1 or more")
    return int(value)


def _device(device: str | torch.device) -> torch.device:
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
