"""From the settings of a verb to those of an env."""

from dataclasses import fields, replace
from typing import Any

from omegaconf import DictConfig, OmegaConf

from maexp.agents.errors import UserError
from maexp.agents.settings.groups import PACE, CommonSettings, ScenarioSettings, read_free_groups
from maexp.agents.settings.storable import read
from maexp.envs.config import BODY, GROUPS, EnvSettings, PlannerConfig, RadarConfig, RobotConfig, supplied
from maexp.envs.scenarios import Scenario


def env_settings(cfg: CommonSettings, row: Scenario, num_robots: int) -> EnvSettings:
    """The settings of an env on maps of a scenario, as far as they are known without the machine: no device."""
    robot, radar = team_configs(cfg, num_robots)
    same = (*PACE, "decide", "collision", "success_coverage", "done")
    return EnvSettings(
        num_envs=cfg.num_envs,
        num_robots=num_robots,
        seed=cfg.seed,
        num_threads=cfg.num_threads,
        robot=robot,
        radar=radar,
        planner=planner_config(cfg, row),
        **{name: cfg.scenario[name] for name in same},
        **read_free_groups(cfg),
    )


def decision_steps(scenario: ScenarioSettings, row: Scenario) -> int:
    """Control steps from decision to decision."""
    return row.decision_steps(scenario.local_steps, scenario.decision_seconds, scenario.decide)


def episode_decisions(scenario: ScenarioSettings, row: Scenario) -> int | None:
    """Decisions of an episode; None: that depends on the map."""
    return scenario.macro_steps or row.episode_decisions(scenario.local_steps, decision_steps(scenario, row))


def team_configs(
    cfg: CommonSettings, num_robots: int
) -> tuple[RobotConfig | list[RobotConfig], RadarConfig | list[RadarConfig]]:
    """Robot and radar of a team: one of each for all robots, or lists where `robot.team` tells robots apart.

    An entry of `robot.team` holds settings of a robot, and under `radar` those of its radar. A team larger than
    the list repeats it.
    """
    if not cfg.robot.team:
        return robot_config(cfg), read(RadarConfig, cfg.radar)
    entries = OmegaConf.to_container(cfg.robot.team)
    _check_team(entries)
    entries = [entries[i % len(entries)] for i in range(num_robots)]
    robots = [robot_config(cfg, entry) for entry in entries]
    return robots, [read(RadarConfig, cfg.radar, **entry.get("radar", {})) for entry in entries]


def _check_team(entries: object) -> None:
    allowed = [field.name for field in fields(RobotConfig)] + ["radar"]
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise UserError("robot.team must be a list of settings, as [{kind: ackermann}, {kind: differential}].")
    for name in (name for entry in entries for name in entry):
        if name not in allowed:
            raise UserError(f"robot.team has no setting {name}: choose one of {', '.join(allowed)}.")


def robot_config(cfg: CommonSettings, entry: dict[str, Any] | None = None) -> RobotConfig:
    """The robot's settings, with those of an entry of `robot.team`; what a scenario says of bodies yields to a radius.

    Args:
        entry: may hold the radar's settings, too, which are left out.
    """
    own = {name: value for name, value in (entry or {}).items() if name != "radar"}
    if own.get("radius", cfg.robot.radius) is not None:
        own = {name: None for name in BODY if _follows(cfg, "robot", name)} | own
    return read(RobotConfig, cfg.robot, **own)


def planner_config(cfg: CommonSettings, row: Scenario) -> PlannerConfig:
    """The planner's settings; without a clearance DWA takes that of the map's scenario (`planner=paper`)."""
    planner = read(PlannerConfig, cfg.planner)
    if planner.name == "dwa" and planner.clearance_factor is None:
        return replace(planner, clearance_factor=row.clearance_factor)
    return planner


def find_followers(cfg: DictConfig) -> list[str]:
    """Names of the settings that follow the scenario, as radar.range: null, or a reference to what it says."""
    names = [f"scenario.{name}" for name in ("local_steps", "macro_steps", "maps", "validation", "held_out")]
    for group, kind in GROUPS.items():
        names += [f"{group}.{name}" for name in supplied(kind)]
    names.append("lookahead.local_steps")
    found = [name for name in names if _follows(cfg, *name.split("."))]
    return found + ["robot.team"] * bool(cfg.robot.team)


def _follows(cfg: DictConfig, group: str, name: str) -> bool:
    return OmegaConf.is_interpolation(cfg[group], name) or cfg[group][name] is None
