"""From the settings of a verb to those of an env, and the maps that a scenario's settings choose."""

from collections.abc import Iterable
from dataclasses import fields, replace
from functools import cache
from typing import Any

from maexp.agents.config.algorithms import AlgorithmSettings
from maexp.agents.config.groups import PACE, SUPPLIED, CommonSettings, LearnerSettings, ScenarioSettings
from maexp.agents.errors import UserError
from maexp.envs.config import GROUPS, EnvSettings, PlannerConfig, RadarConfig, RobotConfig, supplied
from maexp.envs.scenarios import Scenario, cut_last_fifth, find_scenario, split
from maexp.kernels.constants import DT

FREE_GROUPS = tuple(name for name, kind in GROUPS.items() if not supplied(kind))
"""Groups of `EnvSettings` in which a scenario supplies nothing."""


@cache
def follower_names() -> tuple[str, ...]:
    """Settings that may follow the scenario: those that it supplies, and the robots of a team."""
    own = [f"scenario.{name}" for name in ("local_steps", "macro_steps", "maps", "validation", "held_out")]
    own.append("lookahead.local_steps")
    groups = (f"{group}.{name}" for group, kind in GROUPS.items() for name in supplied(kind))
    return (*own, *groups, "robot.team", "collector.steps")


def scenario_row(scenario: ScenarioSettings, row: Scenario) -> Scenario:
    """The row of a map's scenario, with what the settings say in its place."""
    told = {name: getattr(scenario, name) for name in SUPPLIED}
    return replace(row, **{name: value for name, value in told.items() if value is not None})


def env_settings(cfg: CommonSettings, row: Scenario, num_robots: int) -> EnvSettings:
    """The settings of an env on maps of a scenario, as far as they are known without the machine: no device.

    Args:
        row: the scenario of the maps.

    Raises:
        ValueError: a value is out of its range, or values do not go together.
    """
    row = scenario_row(cfg.scenario, row)
    robots, radars = team_configs(cfg, num_robots)
    return EnvSettings(
        num_envs=cfg.num_envs,
        num_robots=num_robots,
        seed=cfg.seed,
        num_threads=cfg.num_threads,
        robot=[robot.completed(row) for robot in robots],
        radar=[radar.completed(row) for radar in radars],
        planner=planner_config(cfg, row).completed(row),
        **{name: getattr(cfg.scenario, name) for name in PACE},
        decide=cfg.scenario.decide,
        collision=cfg.scenario.collision,
        success_coverage=cfg.scenario.success_coverage,
        done=cfg.scenario.done,
        **{name: getattr(cfg, name) for name in FREE_GROUPS},
    )


def decision_steps(scenario: ScenarioSettings, row: Scenario) -> int:
    """Control steps from decision to decision."""
    return row.decision_steps(scenario.local_steps, scenario.decision_seconds, scenario.decide)


def episode_decisions(scenario: ScenarioSettings, row: Scenario) -> int | None:
    """Decisions of an episode; None: that depends on the map."""
    return scenario.macro_steps or row.episode_decisions(scenario.local_steps, decision_steps(scenario, row))


def algorithm_settings(cfg: LearnerSettings) -> AlgorithmSettings:
    """The settings of the algorithm at the pace of the scenario."""
    row = find_scenario(cfg.scenario.name)
    pace = [DT * steps for steps in (decision_steps(cfg.scenario, row), row.local_steps)]
    return cfg.algorithm.at_pace(*pace)


def team_configs(cfg: CommonSettings, num_robots: int) -> tuple[list[RobotConfig], list[RadarConfig]]:
    """Robot and radar of each robot of a team.

    An entry of `robot.team` holds settings of a robot, and under `radar` those of its radar. A team larger than
    the list repeats it.
    """
    entries = cfg.robot.team or [{}]
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise UserError("robot.team must be a list of settings, as [{kind: ackermann}, {kind: differential}].")
    for entry in entries:
        _check_names("", entry, RobotConfig, "radar")
        _check_names("radar.", entry.get("radar", {}), RadarConfig)
    entries = [entries[i % len(entries)] for i in range(num_robots)]
    radars = [replace(cfg.radar, **entry.get("radar", {})) for entry in entries]
    return [robot_config(cfg, entry) for entry in entries], radars


def _check_names(prefix: str, entry: dict[str, Any], kind: type, *others: str) -> None:
    allowed = [*(field.name for field in fields(kind)), *others]
    for name in entry:
        if name not in allowed:
            raise UserError(f"robot.team has no setting {prefix}{name}: choose one of {', '.join(allowed)}.")


def robot_config(cfg: CommonSettings, entry: dict[str, Any] | None = None) -> RobotConfig:
    """The robot's settings, with those of an entry of `robot.team`, whose radar is left out."""
    values = {field.name: getattr(cfg.robot, field.name) for field in fields(RobotConfig)} | (entry or {})
    return RobotConfig(**{name: value for name, value in values.items() if name != "radar"})


def planner_config(cfg: CommonSettings, row: Scenario) -> PlannerConfig:
    """The planner's settings; without a clearance DWA takes that of the scenario (`planner=paper`)."""
    if cfg.planner.name == "dwa" and cfg.planner.clearance_factor is None:
        return replace(cfg.planner, clearance_factor=row.clearance_factor)
    return cfg.planner


# Maps


def map_indices(scenario: ScenarioSettings) -> tuple[list[int], list[int], list[int]]:
    """Indices of the maps that a scenario's settings train on, validate on (none: those trained on) and hold out."""
    trained_on, held_out = split(scenario.name)
    if scenario.held_out is not None and scenario.held_out_count is not None:
        raise UserError("scenario.held_out and scenario.held_out_count were both given: give one of them.")
    if scenario.held_out_count is not None:
        held_out = range(held_out.start, held_out.start + scenario.held_out_count)
    others = _indices("scenario.held_out", scenario.held_out, held_out)
    none = scenario.validation == []
    trained_on, choosing = (trained_on, []) if none else cut_last_fifth(trained_on)
    indices = _indices("scenario.maps", scenario.maps, trained_on)
    unused = [index for index in choosing if index not in indices and index not in others]
    return indices, [] if none else _indices("scenario.validation", scenario.validation, unused), others


def _indices(name: str, value: Any, default: Iterable[int]) -> list[int]:
    if value is None:
        return list(default)
    indices = [value] if isinstance(value, int) else value
    good = isinstance(indices, list) and indices and all(type(index) is int and index >= 0 for index in indices)
    if not good:
        raise UserError(f"{name}={value} must be a list of whole numbers, 0 or more, as [0,1,2].")
    return indices
