"""The values that settings come to: what is null in the composed settings is filled in from where it comes."""

from dataclasses import asdict, fields
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf

from maexp.agents.settings.algorithms import AlgorithmSettings, find_tunings
from maexp.agents.settings.checks import team_sizes
from maexp.agents.settings.comments import with_comments
from maexp.agents.settings.env import decision_steps, env_settings, episode_decisions, robot_config
from maexp.agents.settings.groups import CommonSettings, LearnerSettings, ScenarioSettings, read_free_groups
from maexp.agents.settings.indices import map_indices
from maexp.agents.settings.model import ModelConfig
from maexp.agents.settings.schema import schema
from maexp.agents.settings.storable import helps, read
from maexp.envs.config import GROUPS, PlannerConfig, RadarConfig
from maexp.envs.io.options import ImportOptions
from maexp.envs.scenarios import Scenario, find_scenario
from maexp.kernels.constants import DT

PLANNER_LACKS = {
    "direct": [field.name for field in fields(PlannerConfig) if field.name != "name"],
    "dwa": ["replan_steps"],
}


def plain(cfg: DictConfig) -> dict:
    """Settings as plain containers, without Hydra's own."""
    return OmegaConf.to_container(without_hydra(cfg), resolve=True)


def without_hydra(cfg: DictConfig) -> DictConfig:
    """The settings without Hydra's own."""
    return OmegaConf.masked_copy(cfg, [key for key in cfg if key != "hydra"])


def resolve(cfg: DictConfig, maps: list | None = None) -> dict[str, Any]:
    """All settings with the values that they come to; what does not apply is absent, so that nothing is null.

    Args:
        cfg: the settings of a verb
        maps: those that are played; without them, what scenario=pointcloud takes from its maps is absent

    Raises:
        ValueError: a value out of its range.
    """
    settings = plain(cfg)
    if "planner" in settings:
        settings["planner"] = _own_planner(settings["planner"])
    if "scenarios" in settings:  # a benchmark: its cells have one each, and write what that comes to
        del settings["scenario"]["name"], settings["scenario"]["importing"], settings["algorithm"]["name"]
    elif "scenario" in settings:
        row = find_scenario(maps[0].scenario if maps else cfg.scenario.name)
        settings["scenario"] |= _resolve_scenario(cfg.scenario, row)
        if maps is not None or row.build is not None:
            count = min(team_sizes(settings.get("num_robots") or 3))
            played = env_settings(cfg, row, count).completed(row, maps or ())
            settings |= {name: asdict(getattr(played, name)) for name in GROUPS if name not in ("robot", "radar")}
            settings["planner"] = _own_planner(settings["planner"])
            settings["robot"] |= _resolve_robot(cfg, row)
            settings["radar"] = asdict(read(RadarConfig, cfg.radar).completed(row))
            settings["scenario"] |= {"local_steps": played.local_steps, "macro_steps": played.macro_steps}
        else:
            settings |= {name: asdict(group.checked()) for name, group in read_free_groups(cfg).items()}
        if settings.get("checkpoint", "") is None:  # nobody who plays was trained with these settings
            settings |= dict.fromkeys(("algorithm", "tuning", "model"))
        else:
            settings["algorithm"] = {"name": cfg.algorithm.name} | asdict(algorithm_settings(cfg))
            settings["model"] = asdict(model_settings(cfg))
        if "collector" in settings and settings["collector"]["steps"] is None:  # one whole episode
            settings["collector"]["steps"] = settings["scenario"]["macro_steps"]
    return _without_null(settings)


def _resolve_scenario(scenario: ScenarioSettings, row: Scenario) -> dict[str, Any]:
    settings = {"local_steps": decision_steps(scenario, row), "decision_seconds": None}  # one of the two says it
    settings["macro_steps"] = episode_decisions(scenario, row)
    if find_scenario(scenario.name).build is None:
        return settings | {"importing": asdict(read(ImportOptions, scenario.importing, robot_radius=None))}
    settings["maps"], settings["validation"], held_out = map_indices(scenario)
    settings["held_out"] = held_out if scenario.held_out_count is None else None  # one of the two says it
    return settings | {"importing": None}


def _resolve_robot(cfg: CommonSettings, row: Scenario) -> dict[str, Any]:
    """The robot, and each entry of `robot.team` with all its values."""
    team = []
    for entry in OmegaConf.to_container(cfg.robot.team) if cfg.robot.team else []:
        seen = read(RadarConfig, cfg.radar, **entry.get("radar", {})).completed(row)
        team.append(_without_null(asdict(robot_config(cfg, entry).completed(row))) | {"radar": asdict(seen)})
    return asdict(robot_config(cfg).completed(row)) | {"team": team or None}


def describe_radius(cfg: DictConfig) -> str | None:
    """A line of what `robot.radius` came to; None where no robot of an env is round."""
    if "scenario" not in cfg or cfg.robot.radius is None:
        return None
    robot = robot_config(cfg).completed(find_scenario(cfg.scenario.name))
    told = (
        f"robot.radius={robot.radius:g}: round, {robot.length:g} m across; collides with walls {robot.radius:g} m from "
        "its centre"
    )
    return told + f"; maps are imported without gaps narrower than {robot.length:g} m"


def _own_planner(planner: dict[str, Any]) -> dict[str, Any]:
    """What a planner has, whatever the scenario."""
    return {name: value for name, value in planner.items() if name not in PLANNER_LACKS.get(planner["name"], ())}


def algorithm_settings(cfg: LearnerSettings) -> AlgorithmSettings:
    """The settings of the algorithm, at the pace of the scenario."""
    given = {name: value for name, value in cfg.algorithm.items() if name != "name" and value is not None}
    row = find_scenario(cfg.scenario.name)
    pace = [DT * steps for steps in (decision_steps(cfg.scenario, row), row.local_steps)]
    return find_tunings(cfg.algorithm.name).configure(**given).at_pace(*pace)


def model_settings(cfg: LearnerSettings) -> ModelConfig:
    """The sizes of the networks."""
    return read(ModelConfig, cfg.model)


def _without_null(node: dict) -> dict:
    clean = {name: _without_null(value) if isinstance(value, dict) else _listed(value) for name, value in node.items()}
    return {name: value for name, value in clean.items() if value is not None and value != {}}


def _listed(value: Any) -> Any:
    """Tuples as lists: YAML has no others."""
    return [_listed(item) for item in value] if isinstance(value, list | tuple) else value


def flatten(node: dict, prefix: str = "") -> dict[str, Any]:
    """{"radar": {"range": 8}} as {"radar.range": 8}."""
    flat = {}
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
    return with_comments(text, helps(schema(verb), settings))
