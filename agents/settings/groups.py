"""The groups of settings that verbs share, as types that Hydra checks."""

from dataclasses import dataclass, field, fields, make_dataclass
from typing import Any

from omegaconf import DictConfig

from maexp.agents.settings.algorithms import TUNINGS
from maexp.agents.settings.model import ModelConfig
from maexp.agents.settings.storable import optional_settings, read, storable
from maexp.envs.config import GROUPS, EnvSettings, supplied
from maexp.envs.config_fields import same, setting
from maexp.envs.io.options import ImportOptions
from maexp.envs.scenarios import Scenario

MOST_TEAMS = 64  # in one film or on one page
LAST_SEED = 2**31 - 1  # the kernels' random numbers start from a 32-bit integer
FREE_GROUPS = tuple(name for name, kind in GROUPS.items() if not supplied(kind))
"""Groups of `EnvSettings` in which a scenario supplies nothing."""
ModelSettings = storable(ModelConfig)
AlgorithmSettings = optional_settings(*{type(row.default): None for row in TUNINGS.values()})
ImportSettings = storable(ImportOptions)
SUPPLIED = tuple(setting.name for setting in fields(Scenario) if setting.metadata.get("help"))
"""What a scenario's row supplies; null: what the map's own scenario says."""
PACE = ("decision_seconds", "local_steps", "macro_steps")
"""Of these what is not set follows from what is (`Scenario.decision_steps`)."""


def import_settings(**references: str) -> Any:
    """A field with the settings of the import, some of which refer to others."""
    return field(default_factory=lambda: ImportSettings(**references))


def read_free_groups(cfg: DictConfig) -> dict[str, Any]:
    """The settings of these groups as the objects that an env takes."""
    return {name: read(GROUPS[name], cfg[name]) for name in FREE_GROUPS}


@dataclass
class ScenarioSettings(optional_settings(Scenario)):
    """Where the team explores, and what robot, radar and planner take from there. Null: what the map says."""

    also: Any = setting(
        None,
        "further scenarios to train on, each with its own robots and episode, as [maze,outdoor], or with settings of "
        "their own: [{name:maze,local_steps:5},{name:pointcloud,path:hall.yaml}]",
    )
    path: str | None = setting(None, "the map of scenario=pointcloud or ir2, or several: a.yaml,b.pcd")
    maps: Any = setting(None, "indices trained on; default: what held_out and validation leave of the table's count")
    validation: Any = setting(
        None, "indices that choose between checkpoints and planners; default: the last fifth of the rest"
    )
    held_out: Any = setting(None, "indices evaluated; default: the last fifth of the table's count")
    held_out_count: int | None = setting(
        None, "instead: so many, from the first held-out one on, beyond the table's count too"
    )
    starts: str = setting(
        "drawn", "anew at every reset; together: in one place; fixed: once a map; or a .csv or .npy of poses"
    )
    decision_seconds: Any = same(EnvSettings, "decision_seconds")
    decide: str = same(EnvSettings, "decide")
    success_coverage: float = same(EnvSettings, "success_coverage")
    done: str = same(EnvSettings, "done")
    collision: str = same(EnvSettings, "collision")
    importing: ImportSettings = import_settings(robot_radius="${robot.radius}")


@dataclass
class CollectorSettings:
    """How experience is gathered."""

    steps: int | None = setting(
        None, "macro steps of every team in one iteration; default: scenario.macro_steps, a whole episode", low=1
    )
    backend: str = setting("single", "one process; or processes, ray")
    workers: int = setting(1, "worker processes, for each team size", low=1)
    overlap: bool = setting(
        False, "collect the next batch while learning from this one; the policy that acts is one batch old"
    )
    sample_device: str | None = setting(None, "where teams play; default: device")
    train_device: str | None = setting(None, "where the networks learn; default: device")
    ray_address: str | None = setting(None, "of a cluster's head, or auto; default: a cluster of this machine alone")


@dataclass
class LoggerSettings:
    """Where the metrics go besides metrics.csv."""

    backends: list[str] = setting([], "tensorboard, wandb")
    project: str = setting("maexp", "of Weights & Biases")
    mode: str = setting("online", "of Weights & Biases; or offline")


TEAM = {"robot": {"team": Any}}  # a list of settings, one per robot
Groups = make_dataclass(
    "Groups",
    [
        (name, kind, field(default_factory=kind))
        for name, kind in {
            "scenario": ScenarioSettings,
            **{name: storable(kind, **TEAM.get(name, {})) for name, kind in GROUPS.items()},
        }.items()
    ],
)


@dataclass
class CommonSettings(Groups):
    """Settings that every verb with an environment shares: `scenario`, the groups of `EnvSettings`, and these."""

    num_envs: int = setting(32, "teams simulated at once", low=1)
    seed: int = setting(0, "of everything random: maps' starts, networks, policy", low=0, high=LAST_SEED)
    device: str = setting("auto", "cpu, cuda, cuda:1, ...; auto: cuda where there is one")
    num_threads: int | None = setting(None, "CPU threads of the simulation; default: as many as help")


@dataclass
class LearnerSettings(CommonSettings):
    """Settings of everything that has a network."""

    algorithm: AlgorithmSettings = field(default_factory=AlgorithmSettings)
    tuning: str = "default"  # or reference
    model: ModelSettings = field(default_factory=ModelSettings)
