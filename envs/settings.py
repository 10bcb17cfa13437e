"""All settings of an env in one frozen object: checked and completed once, before anything is built from them."""

import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from maexp.envs.config import (
    CommConfig,
    FaultsConfig,
    LookaheadConfig,
    ObservationConfig,
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
    check_reward,
    check_strategy,
    check_targets,
    complete_planner,
    complete_radar,
    complete_robot,
    one_config,
    per_robot,
)
from maexp.envs.map import MapError, PointCloudMap
from maexp.envs.nav_grid import stands_free
from maexp.envs.scenarios import Scenario, default_macro_steps, find_scenario
from maexp.kernels.sensing import return_chance

LEAST_RETURNS = 0.01  # share of the returns in view that has to count


@dataclass(frozen=True)
class EnvSettings:
    """What an `ExplorationEnv` is, without its maps. No value is None any more."""

    scenario: Scenario  # of the first map: its values stand for what was not given
    num_envs: int  # teams, E
    num_robots: int  # robots of a team, N
    device: torch.device
    seed: int
    first_env: int  # number of the first env in the random keys
    num_threads: int  # CPU threads of the simulation
    local_steps: int  # control steps of 0.1 s in a macro step
    macro_steps: int  # of an episode
    collision: str  # "centre" or "footprint"
    success_coverage: float  # share that ends an episode
    done: str  # whose: "union", "base" or "everyone"
    robots: tuple[RobotConfig, ...]  # one per robot
    radars: tuple[RadarConfig, ...]  # one per robot
    planner: PlannerConfig
    reward: RewardConfig
    observation: ObservationConfig
    comm: CommConfig
    faults: FaultsConfig
    limited: bool  # whether robots may know different things
    targets: TargetsConfig
    lookahead: LookaheadConfig

    @property
    def episode_steps(self) -> int:
        """Local steps of a whole episode."""
        return self.local_steps * self.macro_steps


def complete_settings(
    maps: Sequence[PointCloudMap],
    num_envs: int,
    num_robots: int,
    device: str | torch.device,
    seed: int,
    *,
    robot: RobotConfig | Sequence[RobotConfig] | None,
    radar: RadarConfig | Sequence[RadarConfig] | None,
    planner: PlannerConfig | None,
    reward: RewardConfig | None,
    observation: ObservationConfig | None,
    comm: CommConfig | None,
    faults: FaultsConfig | None,
    targets: TargetsConfig | None,
    lookahead: LookaheadConfig | None,
    local_steps: int | None,
    macro_steps: int | None,
    collision: str,
    success_coverage: float,
    done: str,
    num_threads: int | None,
    first_env: int,
) -> EnvSettings:
    """Check what `ExplorationEnv` was given, and fill in what the scenario of the first map fixes.

    Raises:
        ValueError: a setting is out of its range (named, with its value).
        MapError: a map has fewer points than the team has robots.
    """
    if not maps:
        raise ValueError("maps=[] is empty: give at least one map")
    num_envs, num_robots = positive_count("num_envs", num_envs), positive_count("num_robots", num_robots)
    for m in maps:
        if not isinstance(m, PointCloudMap):
            raise ValueError(f"maps holds {m!r}: give PointCloudMaps, from make_map or import_map")
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer):
        raise ValueError(f"seed={seed!r} must be a whole number")
    if isinstance(first_env, bool) or not isinstance(first_env, int | np.integer) or first_env < 0:
        raise ValueError(f"first_env={first_env!r} must be a whole number, 0 or more")
    fewest = min(maps, key=lambda m: len(m.free))
    if num_robots > len(fewest.free):
        raise MapError(
            f"map {fewest.name} has {len(fewest.free)} free points and no room for num_robots={num_robots}: "
            "use fewer robots or a larger map"
        )
    scenario = find_scenario(maps[0].scenario)
    device = _device(device)
    local_steps = positive_count("local_steps", scenario.local_steps if local_steps is None else local_steps)
    if collision not in ("centre", "footprint"):
        raise ValueError(f"collision={collision!r} is unknown: choose centre or footprint")
    if not 0.0 < success_coverage <= 1.0:
        raise ValueError(f"success_coverage={success_coverage} must lie in (0, 1]")
    robots = tuple(complete_robot(r, scenario) for r in per_robot("robot", robot, RobotConfig, num_robots))
    radars = tuple(complete_radar(r, scenario) for r in per_robot("radar", radar, RadarConfig, num_robots))
    if macro_steps is None:
        team = [(robot.max_speed, radar.range) for robot, radar in zip(robots, radars, strict=True)]
        macro_steps = scenario.macro_steps or default_macro_steps(maps, scenario, team, local_steps)
    macro_steps = positive_count("macro_steps", macro_steps)
    check_bodies(maps, robots)
    planner = complete_planner(one_config("planner", planner, PlannerConfig), scenario)
    reward = check_reward(one_config("reward", reward, RewardConfig))
    observation = one_config("observation", observation, ObservationConfig)
    check_observation(observation, planner)
    comm = check_comm(one_config("comm", comm, CommConfig))
    faults = check_faults(one_config("faults", faults, FaultsConfig), num_robots)
    check_strategy(comm, num_robots, planner)
    check_base(maps, comm)
    check_noise(maps, radars)
    targets = check_targets(one_config("targets", targets, TargetsConfig))
    lookahead = check_lookahead(one_config("lookahead", lookahead, LookaheadConfig))
    threads = num_threads or max(1, min(len(os.sched_getaffinity(0)), num_envs // 4))
    return EnvSettings(
        scenario=scenario,
        num_envs=num_envs,
        num_robots=num_robots,
        device=device,
        seed=int(seed),
        first_env=int(first_env),
        num_threads=threads if device.type == "cpu" else 1,
        local_steps=local_steps,
        macro_steps=macro_steps,
        collision=collision,
        success_coverage=float(success_coverage),
        done=check_done(done, comm),
        robots=robots,
        radars=radars,
        planner=planner,
        reward=reward,
        observation=observation,
        comm=comm,
        faults=faults,
        limited=comm.limited or faults.some,
        targets=targets,
        lookahead=lookahead,
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
