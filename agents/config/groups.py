"""The groups of settings that verbs share."""

from dataclasses import dataclass, field, fields
from typing import Any, Literal

from maexp.agents.config.algorithms import AlgorithmSettings
from maexp.agents.config.model import ModelConfig
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
)
from maexp.envs.config.env import Knower
from maexp.envs.config_fields import replaced, same, setting
from maexp.envs.io.options import ImportOptions
from maexp.envs.scenarios import Scenario

UNSET = "???"
"""The value of a setting that must be given (OmegaConf's MISSING)."""
MOST_TEAMS = 64  # in one film or on one page
LAST_SEED = 2**31 - 1  # the kernels' random numbers start from a 32-bit integer
SUPPLIED = tuple(setting.name for setting in fields(Scenario) if setting.metadata.get("help"))
"""What a scenario's row supplies; null: what the map's own scenario says."""
PACE = ("decision_seconds", "local_steps", "macro_steps")
"""Of these what is not set follows from what is (`Scenario.decision_steps`)."""


def group(kind: type, **references: str) -> Any:
    """A field with the settings of a dataclass, some of which refer to others: robot_radius="${robot.radius}"."""
    return field(default_factory=kind, metadata={"references": references})


@dataclass
class ScenarioSettings:
    """Where the team explores, and what robot, radar and planner take from there. Null: what the map's row says."""

    name: str = UNSET
    radar_range: float | None = replaced(Scenario, "radar_range", None)
    max_speed: float | None = replaced(Scenario, "max_speed", None)
    max_accel: float | None = replaced(Scenario, "max_accel", None)
    body_length: float | None = replaced(Scenario, "body_length", None)
    body_width: float | None = replaced(Scenario, "body_width", None)
    collision_threshold: float | None = replaced(Scenario, "collision_threshold", None)
    clearance_factor: float | None = replaced(Scenario, "clearance_factor", None)
    local_steps: int | None = replaced(Scenario, "local_steps", None)
    macro_steps: int | None = replaced(Scenario, "macro_steps", None)
    num_steering: int | None = replaced(Scenario, "num_steering", None)
    max_steer: float | None = replaced(Scenario, "max_steer", None)
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
        None, "instead: so many, from the first held-out one on, beyond the table's count too", low=1
    )
    starts: str = setting(
        "drawn", "anew at every reset; together: in one place; fixed: once a map; or a .csv or .npy of poses"
    )
    decision_seconds: Any = same(EnvSettings, "decision_seconds")
    decide: Literal["together", "arrival"] = same(EnvSettings, "decide")
    success_coverage: float = same(EnvSettings, "success_coverage")
    done: Knower = same(EnvSettings, "done")
    collision: Literal["centre", "footprint"] = same(EnvSettings, "collision")
    importing: ImportOptions = group(ImportOptions, robot_radius="${robot.radius}")


@dataclass(frozen=True)
class RobotSettings(RobotConfig):
    """A robot's settings, and those that tell the robots of a team apart: a list, one entry a robot."""

    team: Any = None


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


@dataclass
class CommonSettings:
    """Settings that every verb with an environment shares: `scenario`, the groups of `EnvSettings`, and these.

    `followers` names the settings that follow the scenario, as no word and no choice sets them; it is no setting.
    """

    scenario: ScenarioSettings = group(ScenarioSettings)
    robot: RobotSettings = group(RobotSettings)
    radar: RadarConfig = group(RadarConfig)
    planner: PlannerConfig = group(PlannerConfig)
    reward: RewardConfig = group(RewardConfig)
    observation: ObservationConfig = group(ObservationConfig)
    comm: CommConfig = group(CommConfig)
    faults: FaultsConfig = group(FaultsConfig)
    odometry: OdometryConfig = group(OdometryConfig)
    targets: TargetsConfig = group(TargetsConfig)
    lookahead: LookaheadConfig = group(LookaheadConfig)
    num_envs: int = setting(32, "teams simulated at once", low=1)
    seed: int = setting(0, "of everything random: maps' starts, networks, policy", low=0, high=LAST_SEED)
    device: str = setting("auto", "cpu, cuda, cuda:1, ...; auto: cuda where there is one")
    num_threads: int | None = setting(None, "CPU threads of the simulation; default: as many as help")
    followers: tuple[str, ...] = field(default=(), metadata={"internal": True})


@dataclass
class LearnerSettings(CommonSettings):
    """Settings of everything that has a network."""

    algorithm: AlgorithmSettings = group(AlgorithmSettings)
    tuning: str = "default"  # or reference
    model: ModelConfig = group(ModelConfig)
