"""The values that settings come to: what is null in the composed settings is filled in from where it comes."""

import re
from dataclasses import asdict, fields, is_dataclass
from typing import Any

import yaml

from maexp.agents.config.algorithms import AlgorithmSettings
from maexp.agents.config.checks import team_sizes
from maexp.agents.config.env import (
    FREE_GROUPS,
    algorithm_settings,
    decision_steps,
    env_settings,
    episode_decisions,
    map_indices,
    robot_config,
    scenario_row,
    team_configs,
)
from maexp.agents.config.groups import PACE, SUPPLIED, CommonSettings, ScenarioSettings
from maexp.agents.config.schema import helps, settings_of
from maexp.agents.config.verbs import SCHEMAS
from maexp.envs.config import GROUPS, PlannerConfig
from maexp.envs.scenarios import Scenario, find_scenario

PLANNER_LACKS = {
    "direct": [field.name for field in fields(PlannerConfig) if field.name != "name"],
    "dwa": ["replan_steps"],
}


def plain(settings: Any) -> Any:
    """Settings as plain containers: an object's by their names, tuples as lists."""
    if is_dataclass(settings):
        return {setting.name: plain(getattr(settings, setting.name)) for setting in settings_of(type(settings))}
    if isinstance(settings, dict):
        return {name: plain(value) for name, value in settings.items()}
    return [plain(value) for value in settings] if isinstance(settings, list | tuple) else settings


def resolve(cfg: Any, maps: list | None = None) -> dict[str, Any]:
    """All settings with the values that they come to; what does not apply is absent, so that nothing is null.

    Args:
        cfg: the settings of a verb
        maps: those that are played; without them, what scenario=pointcloud takes from its maps is absent

    Raises:
        ValueError: a value out of its range.
    """
    settings = plain(cfg)
    if isinstance(getattr(cfg, "algorithm", None), AlgorithmSettings) and "scenario" in settings:
        settings["algorithm"] = plain(algorithm_settings(cfg))
    if "planner" in settings:
        settings["planner"] = _own_planner(settings["planner"])
    if "scenarios" in settings:  # a benchmark: its cells have one each, and write what that comes to
        del settings["scenario"]["name"], settings["scenario"]["importing"]
    elif "scenario" in settings:
        row = find_scenario(maps[0].scenario if maps else cfg.scenario.name)
        settings["scenario"] |= _resolve_scenario(cfg.scenario, row)
        if maps is not None or row.build is not None:
            settings |= _resolve_env(cfg, row, maps or [])
            settings["scenario"] |= settings.pop("steps")
        else:
            settings |= {name: asdict(getattr(cfg, name).checked()) for name in FREE_GROUPS}
        if settings.get("checkpoint", "") is None:  # nobody who plays was trained with these settings
            settings |= dict.fromkeys(("algorithm", "tuning", "model"))
        if "collector" in settings and settings["collector"]["steps"] is None:  # one whole episode
            settings["collector"]["steps"] = settings["scenario"]["macro_steps"]
    return _without_null(settings)


def _resolve_scenario(scenario: ScenarioSettings, row: Scenario) -> dict[str, Any]:
    row_here = scenario_row(scenario, row)
    settings: dict[str, Any] = {"local_steps": decision_steps(scenario, row), "decision_seconds": None}  # one says it
    settings["macro_steps"] = episode_decisions(scenario, row)
    if find_scenario(scenario.name).build is None:
        return settings | {"importing": plain(scenario.importing) | {"robot_radius": None}}
    settings |= {name: getattr(row_here, name) for name in SUPPLIED if name not in PACE}
    settings["maps"], settings["validation"], held_out = map_indices(scenario)
    settings["held_out"] = held_out if scenario.held_out_count is None else None  # one of the two says it
    return settings | {"importing": None}


def _resolve_env(cfg: CommonSettings, row: Scenario, maps: list) -> dict[str, Any]:
    """The groups of an env on maps of a scenario, and under `steps` the lengths of a decision and an episode."""
    count = min(team_sizes(getattr(cfg, "num_robots", None) or 3))
    played, told = env_settings(cfg, row, count).completed(row, maps), scenario_row(cfg.scenario, row)
    settings = {name: asdict(getattr(played, name)) for name in GROUPS if name not in ("robot", "radar")}
    settings["planner"] = _own_planner(settings["planner"])
    settings["robot"] = _resolve_robot(cfg, told)
    settings["radar"] = asdict(cfg.radar.completed(told))
    return settings | {"steps": {"local_steps": played.local_steps, "macro_steps": played.macro_steps}}


def _resolve_robot(cfg: CommonSettings, row: Scenario) -> dict[str, Any]:
    """The robot, and each entry of `robot.team` with all its values."""
    robots, radars = team_configs(cfg, len(cfg.robot.team or ()))
    team = [
        _without_null(asdict(robot.completed(row))) | {"radar": asdict(radar.completed(row))}
        for robot, radar in zip(robots, radars, strict=True)
    ]
    return asdict(robot_config(cfg).completed(row)) | {"team": team or None}


def describe_radius(cfg: Any) -> str | None:
    """A line of what `robot.radius` came to; None where no robot of an env is round."""
    if not isinstance(cfg, CommonSettings) or cfg.robot.radius is None:
        return None
    robot = robot_config(cfg).completed(scenario_row(cfg.scenario, find_scenario(cfg.scenario.name)))
    told = (
        f"robot.radius={robot.radius:g}: round, {robot.length:g} m across; collides with walls {robot.radius:g} m from "
        "its centre"
    )
    return told + f"; maps are imported without gaps narrower than {robot.length:g} m"


def _own_planner(planner: dict[str, Any]) -> dict[str, Any]:
    """What a planner has, whatever the scenario."""
    return {name: value for name, value in planner.items() if name not in PLANNER_LACKS.get(planner["name"], ())}


def _without_null(node: dict) -> dict:
    clean = {name: _without_null(value) if isinstance(value, dict) else _listed(value) for name, value in node.items()}
    return {name: value for name, value in clean.items() if value is not None and value != {}}


def _listed(value: Any) -> Any:
    """Tuples as lists: YAML has no others."""
    return [_listed(item) for item in value] if isinstance(value, list | tuple) else value


def flatten(node: dict, prefix: str = "") -> dict[str, Any]:
    """{"radar": {"range": 8}} as {"radar.range": 8}."""
    flat: dict[str, Any] = {}
    for name, value in node.items():
        if isinstance(value, dict) and value:
            flat |= flatten(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = value
    return flat


class _Dumper(yaml.SafeDumper):
    """Lists on one line."""


_Dumper.add_representer(
    list, lambda dumper, value: dumper.represent_sequence("tag:yaml.org,2002:seq", value, flow_style=True)
)


def to_yaml(settings: dict, verb: str) -> str:
    """Resolved settings of a verb as the text of a config.yaml, with units and meanings as comments."""
    text = yaml.dump(settings, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=110)
    return with_comments(text, helps(SCHEMAS[verb], settings))


LINE = re.compile(r"( *)(\w+):( \S.*)?")
SPANNING = ("[", "{", "'", '"', "|", ">")  # what may go on in the next line


def with_comments(text: str, comments: dict[str, str]) -> str:
    """The YAML of settings with a comment behind every value that has one under its full name."""
    lines = text.splitlines()
    path: list[str] = []
    for k, line in enumerate(lines):
        found = LINE.fullmatch(line)
        if not found:
            continue
        indent, value = len(found[1]), (found[3] or "").strip()
        path = [*path[: indent // 2], found[2]]
        goes_on = k + 1 < len(lines) and len(lines[k + 1]) - len(lines[k + 1].lstrip()) > indent
        comment = comments.get(".".join(path))
        if value and comment and not goes_on and not value.startswith(SPANNING):
            lines[k] = f"{line}  # {comment}"
    return "\n".join(lines) + "\n"
