"""Types of the settings, registered with Hydra: a misspelt name or a word in a number's place is refused.

A setting is declared once, as a field of a dataclass (`maexp.envs.fields`). Where settings belong to a class of the
layers below (`RobotConfig`, `ModelConfig`, ...), their names, types and help are read from that class.

Hydra hands on a `DictConfig` of these types. A function that reads settings by attribute names the dataclass, so that
one sees what there is; one that looks settings up by name, or takes any verb's, says `DictConfig`.
"""

from dataclasses import MISSING as NO_DEFAULT
from dataclasses import Field, asdict, dataclass, field, fields, is_dataclass, make_dataclass
from types import NoneType
from typing import Any, Literal, get_origin

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, DictConfig

from maexp.agents.runtime.choices import CHOICES
from maexp.agents.runtime.driver import DriverSettings
from maexp.agents.settings.algorithms import TUNINGS, find_tunings
from maexp.agents.settings.model import SIZES, SUMMARIES, ModelConfig
from maexp.envs.config import (
    CLEARANCE,
    PLANNERS,
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
from maexp.envs.fields import explain, kinds, same, setting
from maexp.envs.importing.options import ImportOptions
from maexp.envs.scenarios import SCENARIOS, Scenario

NAMES = (*CHOICES, "lookahead", "oracle", "clairvoyant")
"""Of the policies that come with the package and are not trained."""
OTHERS = "a trained one or its folder, a run, module:function"
PRIMITIVES = (int, float, bool, str)


def storable(cls: type, *names: str, **extra: Any) -> type:
    """Dataclass with the settings of `cls`, their defaults and types that OmegaConf can check.

    What a scenario supplies refers to it: `radar.range` is `${scenario.radar_range}`.

    Args:
        names: only these; none: all.
        extra: further fields, name=type, null by default.
    """
    chosen = [one for one in fields(cls) if one.init and (not names or one.name in names)]
    entries = [(one.name, _storable(kinds(cls)[one.name]), _supplied(one)) for one in chosen]
    return make_dataclass(cls.__name__, entries + [(name, kind, field(default=None)) for name, kind in extra.items()])


def _supplied(one: Field) -> Any:
    """A copy of the field; its default refers to the scenario where that says it."""
    source, default = one.metadata.get("scenario"), one.default
    if default is NO_DEFAULT and one.default_factory is not NO_DEFAULT:
        return field(default_factory=one.default_factory, metadata=one.metadata)
    return field(default=f"${{scenario.{source}}}" if source else default, metadata=one.metadata)


def _storable(members: tuple, optional: bool = False) -> Any:
    """The nearest type that OmegaConf can check: Literal becomes str, a mixture with tuples Any."""
    if get_origin(members[0]) is list:
        return members[0]
    plain = {str if get_origin(one) is Literal else one for one in members if one is not NoneType}
    if not plain.issubset(PRIMITIVES):
        return Any
    union = None
    for one in sorted(plain, key=PRIMITIVES.index):
        union = one if union is None else union | one
    return union | None if optional or NoneType in members else union


def optional_settings(*classes: type) -> type:
    """Dataclass with a name and the settings of all of `classes`, each optional and null by default."""
    entries = {
        one.name: (one.name, _storable(kinds(cls)[one.name], True), field(default=None, metadata=one.metadata))
        for cls in classes
        for one in fields(cls)
        if one.metadata.get("help")
    }
    return make_dataclass(f"{classes[0].__name__}Settings", [("name", str, MISSING), *entries.values()])


def read(kind: type, node: DictConfig, /, **others: Any) -> Any:
    """The settings of a group as the object that declares them; `others` stand for values of the group."""
    return kind(**{one.name: node[one.name] for one in fields(kind) if one.name not in others} | others)


def describe(cls: type) -> list[tuple[str, Any, str]]:
    """(name, default, line of help) of the top-level settings of a verb, its own before those it shares."""
    documented = [one for one in fields(cls) if one.metadata.get("help")]
    documented.sort(key=lambda one: one.name not in vars(cls)["__annotations__"])
    return [(one.name, None if one.default is NO_DEFAULT else one.default, explain(one.metadata)) for one in documented]


def helps(cls: type, settings: dict[str, Any], prefix: str = "") -> dict[str, str]:
    """{"radar.range": "how far it sees [m]"} of all settings of a verb's dataclass, those of groups included."""
    found = {prefix + one.name: explain(one.metadata) for one in fields(cls) if one.metadata.get("help")}
    for one in fields(cls):
        kind, values = kinds(cls)[one.name][0], settings.get(one.name)
        if is_dataclass(kind) and isinstance(values, dict):
            kind = type(find_tunings(values["name"]).default) if one.name == "algorithm" and "name" in values else kind
            found |= helps(kind, values, f"{prefix}{one.name}.")
            found |= {f"{prefix}{one.name}.{name}": "does nothing here" for name in getattr(kind, "unused", ())}
    return found


FREE_GROUPS = ("reward", "observation", "comm", "faults", "odometry", "targets", "lookahead")
"""Groups of `EnvSettings` in which a scenario supplies nothing."""


def read_free_groups(cfg: DictConfig) -> dict[str, Any]:
    """The settings of these groups as the objects that an env takes."""
    return {name: read(kinds(EnvSettings)[name][0], cfg[name]) for name in FREE_GROUPS}


RobotSettings = storable(RobotConfig, team=Any)  # team: a list of settings, one per robot
ModelSettings = storable(ModelConfig)
RadarSettings = storable(RadarConfig)
PlannerSettings = storable(PlannerConfig)
RewardSettings = storable(RewardConfig)
ObservationSettings = storable(ObservationConfig)
CommSettings = storable(CommConfig)
FaultsSettings = storable(FaultsConfig)
OdometrySettings = storable(OdometryConfig)
TargetsSettings = storable(TargetsConfig)
LookaheadSettings = storable(LookaheadConfig)
AlgorithmSettings = optional_settings(*{type(row.default): None for row in TUNINGS.values()})
ImportSettings = storable(ImportOptions)
SUPPLIED = tuple(one.name for one in fields(Scenario) if one.metadata.get("help"))
"""What a scenario's row supplies; null: what the map's own scenario says."""


def import_settings(**references: str) -> Any:
    """A field with the settings of the import, some of which refer to others."""
    return field(default_factory=lambda: ImportSettings(**references))


@dataclass
class ScenarioSettings(optional_settings(Scenario)):
    """Where the team explores, and what robot, radar and planner take from there. Null: what the map says."""

    also: Any = setting(
        None,
        "further scenarios to train on, each with its own robots and episode, as [maze,outdoor], or with settings of "
        "their own: [{name:maze,local_steps:5},{name:pointcloud,path:hall.yaml}]",
    )
    path: str | None = setting(None, "the map of scenario=pointcloud, or several: a.yaml,b.pcd")
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
    success_coverage: float = same(EnvSettings, "success_coverage")
    done: str = same(EnvSettings, "done")
    collision: str = same(EnvSettings, "collision")
    importing: ImportSettings = import_settings(robot_radius="${robot.radius}")


@dataclass
class CollectorSettings:
    """How experience is gathered."""

    steps: int | None = setting(
        None, "macro steps of every team in one iteration; default: scenario.macro_steps, a whole episode"
    )
    backend: str = setting("single", "one process; or processes, ray")
    workers: int = setting(1, "worker processes, for each team size")
    overlap: bool = setting(
        False, "collect the next batch while learning from this one; the policy that acts is one batch old"
    )
    sample_device: str | None = setting(None, "where teams play; default: device")
    train_device: str | None = setting(None, "where the networks learn; default: device")
    ray_address: str | None = setting(
        None, "of a cluster's head, or auto; default: a cluster of this machine alone"
    )


@dataclass
class LoggerSettings:
    """Where the metrics go besides metrics.csv."""

    backends: list[str] = setting([], "tensorboard, wandb")
    project: str = setting("maexp", "of Weights & Biases")
    mode: str = setting("online", "of Weights & Biases; or offline")


@dataclass
class CommonSettings:
    """Settings that every verb with an environment shares."""

    scenario: ScenarioSettings = field(default_factory=ScenarioSettings)
    robot: RobotSettings = field(default_factory=RobotSettings)
    radar: RadarSettings = field(default_factory=RadarSettings)
    planner: PlannerSettings = field(default_factory=PlannerSettings)
    reward: RewardSettings = field(default_factory=RewardSettings)
    observation: ObservationSettings = field(default_factory=ObservationSettings)
    comm: CommSettings = field(default_factory=CommSettings)
    faults: FaultsSettings = field(default_factory=FaultsSettings)
    odometry: OdometrySettings = field(default_factory=OdometrySettings)
    targets: TargetsSettings = field(default_factory=TargetsSettings)
    lookahead: LookaheadSettings = field(default_factory=LookaheadSettings)
    num_envs: int = setting(32, "teams simulated at once")
    seed: int = setting(0, "of everything random: maps' starts, networks, policy")
    device: str = setting("auto", "cpu, cuda, cuda:1, ...; auto: cuda where there is one")
    num_threads: int | None = setting(None, "CPU threads of the simulation; default: as many as help")


@dataclass
class LearnerSettings(CommonSettings):
    """Settings of everything that has a network."""

    algorithm: AlgorithmSettings = field(default_factory=AlgorithmSettings)
    tuning: str = "default"  # or reference
    model: ModelSettings = field(default_factory=ModelSettings)


@dataclass
class TrainSettings(LearnerSettings):
    """`maexp train`."""

    preset: str = MISSING
    action: str = MISSING  # which file of conf/action
    num_robots: Any = setting(3, "robots in a team; teams of several sizes at once as num_robots=2,3,4")
    total_frames: int = setting(60_000, "macro steps of teams to train for")
    episodes: int = setting(256, "episodes of the evaluation after training; 0: none")
    classical: Any = setting(None, "policies played beside the trained team")
    warm_start: str | None = setting(None, "policy to imitate first: a name, a folder, a run or module:function")
    warm_start_frames: int = setting(9_600, "macro steps of teams in which it is imitated")
    resume: str | None = setting(None, "folder of a run to go on with (its settings are kept)")
    checkpoint_every: int = setting(10, "iterations between two checkpoints")
    checkpoint_keep: int = setting(3, "newest checkpoints kept, besides the best")
    evaluate_every: int = setting(5, "iterations between two evaluations on validation maps, from the start; 0: none")
    evaluate_episodes: int = setting(64, "validation episodes, of the team and of the planners it is compared with")
    evaluation_seed: int | None = setting(None, "of episodes that judge a team; default: seed, of a sweep the first")
    collector: CollectorSettings = field(default_factory=CollectorSettings)
    logger: LoggerSettings = field(default_factory=LoggerSettings)


@dataclass
class EvaluateSettings(LearnerSettings):
    """`maexp evaluate`."""

    preset: str = MISSING
    action: str = MISSING  # which file of conf/action
    num_robots: Any = setting(3, "robots in a team; several as num_robots=1,2,6,8")
    policy: Any = setting(None, f"{', '.join(NAMES)}, {OTHERS}; several as a,b")
    checkpoint: str | None = setting(None, "a run's folder or one checkpoint file")
    resume: str | None = setting(None, "folder of an evaluation to go on with (its settings are kept)")
    episodes: int = setting(256, "episodes of each policy and team size")
    baseline: str | None = setting(None, "an earlier evaluation of the same episodes, to compare with: its folder")
    render: bool = setting(False, "also write a film of each policy, and the episodes for maexp view")
    render_envs: int = setting(1, "teams in a film, side by side, each in a held-out episode of its own")
    render_format: str = setting("gif", "of the film: gif, or mp4 with the extra maexp[video]")


EpisodeSettings = TrainSettings | EvaluateSettings
"""Of the verbs that play evaluation episodes with several policies."""


@dataclass
class ViewSettings(LearnerSettings):
    """`maexp view`."""

    action: str = MISSING  # which file of conf/action
    place: str | None = setting(None, "a run, a checkpoint, a folder of maexp evaluate, an episode or a map")
    index: int | None = setting(None, "which map of the scenario; default: the first, for a team the first held out")
    policy: str | None = setting(None, "a policy to watch, as of maexp evaluate, on the map given or a held-out one")
    checkpoint: str | None = None  # what `place` becomes where it is a run
    num_robots: int = setting(3, "robots in a team")
    num_envs: int = setting(1, "teams to watch, each in a held-out episode of its own")
    episode: int | None = setting(None, "number of the first held-out episode to watch; default: the first there is")
    seconds: float | None = setting(None, "moment of the picture [s]; default: the end")
    seen_by: int | None = setting(None, "count as explored only what this robot has seen, from 0")
    browser: bool = setting(False, "replay on a page in the browser, with the extra maexp[view]")
    port: int = setting(8080, "of the page; another one where it is taken")
    out: str | None = setting(None, "file to write: .png, or .html for a page that needs no server")
    renderer: str = setting("auto", "of the picture: open3d, painter (ours), or auto: the first that works")
    size: int = setting(1200, "width of the picture [px]")
    azimuth: float = setting(-60.0, "where the camera stands, counter-clockwise from x [degrees]")
    elevation: float = setting(50.0, "of the camera over the ground [degrees]")
    cut: float | None = setting(None, "highest walls drawn [m]; default: as scanned, with a team 6 % of the map's side")


@dataclass
class ExportSettings(LearnerSettings):
    """`maexp export`."""

    action: str = MISSING  # which file of conf/action
    checkpoint: str | None = setting(None, "a run's folder or one checkpoint file, whose policy chooses targets")
    out: str | None = setting(None, "folder to write, new or empty")
    name: str | None = setting(None, "of the policy; default: the folder's")
    results: str | None = setting(None, "evaluations for its card: results=FOLDER,FOLDER; default: the run's own")
    note: str | None = setting(None, "for its card, below the training: what else is to be known")
    num_robots: Any = setting(3, "robots in a team")


@dataclass
class PoliciesSettings:
    """`maexp policies`."""

    task: str = MISSING
    name: str | None = setting(None, "show: the policy, or the folder of one")


@dataclass
class RoundSettings:
    """Of the robots a map is for."""

    radius: float | None = setting(None, "of a round body; default: the robot of the map's scenario", unit="m")


@dataclass
class MapsSettings:
    """`maexp maps`."""

    task: str = MISSING
    file: str | None = setting(
        None, "a map's file, for import also a folder of them, for make and show a scenario, for fetch a set"
    )
    index: int = setting(0, "which map of the scenario")
    out: str | None = setting(
        None, "file to write, .npz or for nav2 .yaml; default: in the run's folder; fetch: folder of sets, the cache"
    )
    mirror: str | None = setting(None, "fetch: address in place of the one where the set is published")
    num_robots: int = setting(3, "the team that must find room")
    repair: bool = setting(False, "check: mend what can be mended and write the mended map")
    robot: RoundSettings = field(default_factory=RoundSettings)
    importing: ImportSettings = import_settings(robot_radius="${robot.radius}", num_robots="${num_robots}")


@dataclass
class IrsimSettings:
    """`maexp irsim`."""

    floor: str | None = setting(None, "a floor's file, as for maexp maps import")
    policy: str = setting("cost_utility", "a classical one, a trained one or its folder, a run, module:Class")
    num_robots: int = setting(3, "robots in the team")
    seconds: float | None = setting(None, "length of the trial [s]; default: an episode of our simulator on this floor")
    episode: int = setting(0, "the robots start where they do in this evaluation episode of our simulator")
    seed: int = setting(0, "of starts, noise and people")
    ours: bool = setting(True, "play the same team in our simulator, too")
    radar_range: float | None = setting(None, "of the lidars [m]; default: of the floor's scenario")
    beams: int = setting(180, "of a lidar, all around")
    cell: float = setting(0.1, "of the grid the team maps with [m]")
    clearance: float | None = setting(None, "of a robot's centre from walls [m]; default: as in our simulator")
    body_radius: float | None = setting(None, "of a robot [m]; default: 0.05 m less than the clearance")
    range_noise: float = setting(0.0, "standard deviation of a range [m]")
    pose_noise: float = setting(0.0, "of x and y a robot believes, anew every 0.1 s [m]; of its heading, a fifth [rad]")
    pose_drift: float = setting(0.0, "the same, of an error that walks at random with the way, after 1 m [m]")
    people: int = setting(0, "people who walk about")
    importing: ImportSettings = import_settings(num_robots="${num_robots}")


@dataclass
class SuiteSettings:
    """`maexp suite`."""

    task: str = MISSING
    place: str | None = setting(None, "the suite, or the .yaml file of one; verify: the folder of a run")
    policy: str | None = setting(None, "run: a name, run or folder, module:Class, exec:COMMAND, socket:HOST:PORT")
    name: str | None = setting(None, "run: what results call the policy; default: its own name")
    suite: str | None = setting(None, "verify: the .yaml file of a suite that does not come with the package")
    seed: int | None = setting(None, "run: plays other maps and starts than the frozen ones, those of this seed")
    resume: str | None = setting(None, "run: folder of a run to go on with")
    num_envs: int = setting(16, "run: teams at once")
    workers: int | None = setting(None, "run: teams at once in processes; default: as many as cores, by socket one")
    decision_limit: float | None = setting(None, "run: its processor time a decision [s]; default: the suite's")
    patience: float = setting(120.0, "run: how long it may be silent [s]")
    device: str = setting("cpu", "run: cpu, cuda, ...; bits are promised on one platform alone")


DriveSettings = make_dataclass(
    "DriveSettings",
    [(one.name, Any, setting(None if one.default == () else one.default, f"team: {one.metadata['help']}"))
     for one in fields(DriverSettings)],
)  # fmt: skip


@dataclass
class Ros2Settings(DriveSettings):
    """`maexp ros2`."""

    task: str = MISSING
    place: str | None = setting(None, "serve: the suite, or the .yaml file of one")
    domain: int | None = setting(None, "number of DDS's domain; default: ROS_DOMAIN_ID, or 0")
    answer: float = setting(60.0, "how long the other side may be silent before this ends [s]")
    robots: Any = setting(None, "namespaces, a,b,c; serve: default robot1,robot2,...")
    name: str = setting("ros2", "serve: what results call those who play")
    seed: int | None = setting(None, "serve: plays other maps and starts than the frozen ones, those of this seed")
    resume: str | None = setting(None, "serve: folder of a run to go on with")
    tf: str = setting("shared", "serve: /tf with frames NAME/base_link; own: /NAME/tf with base_link")
    wait_for: str = setting("all", "serve: the clock waits until all robots have a new goal; idle: those without one")
    stands: float = setting(5.0, "serve: how long the clock stands still for goals [s]")
    limit: float = setting(10.0, "serve: how long it runs on then, before robots without a goal stay [s]")


@dataclass
class LeaderboardSettings:
    """`maexp leaderboard`."""

    places: Any = setting(None, "folders of maexp suite run, rows, or folders of rows; written without places=")
    out: str | None = setting(None, "folder of rows and the page; rows that are there stay")
    verify: bool = setting(True, "play the actions of each run again, and refuse those that are not what they say")
    suite: str | None = setting(None, "the .yaml file of a suite that does not come with the package")


@dataclass
class BenchSettings(LearnerSettings):
    """`maexp bench`."""

    task: str = MISSING
    num_envs: int = setting(256, "teams simulated at once (train: 32); several as num_envs=64,256, as any setting")
    num_robots: Any = setting(None, "team sizes; default 2,4,6,8 for env, 4 for kernels, 3 for train and scale")
    seconds: float = setting(5.0, "time measured per row [s]")
    baseline: str | None = setting(None, "kernels: an earlier bench_kernels.json to compare with")
    axes: Any = setting(None, "scale: what to vary, of envs,robots,map,radar; default all")
    largest: int | None = setting(None, "scale: leave out values beyond this one")
    collector: CollectorSettings = field(default_factory=CollectorSettings)
    sweep: Any = None  # settings that were given several values; filled by the command line


@dataclass
class BenchmarkSettings(LearnerSettings):
    """`maexp benchmark`."""

    seed: int = 0  # each cell has its own, from `seeds`
    preset: str = MISSING
    action: str = MISSING  # which file of conf/action
    scenarios: Any = setting(None, "where they are compared")
    algorithms: Any = setting(None, "trained and then evaluated")
    policies: Any = setting(None, "only evaluated: planners, trained ones, module:function")
    seeds: Any = setting(None, "of training, starts and maps")
    episodes: int = setting(100, "episodes of each cell (a cell: one policy, scenario and seed)")
    num_robots: int = setting(3, "robots in a team")
    total_frames: int = setting(20_000, "macro steps of teams to train each algorithm for")
    iterations: int | None = setting(None, "instead: iterations of one episode of each of the num_envs teams")
    maps: Any = setting("held_out", "evaluated on held_out, trained, held_out_together (so teams start), or several")
    train_maps: int | None = setting(None, "train on the first so many maps; default: all that may be trained on")
    test_maps: int | None = setting(None, "evaluate on so many held-out maps, new ones too; default: the last fifth")
    policy_per_map: Any = setting(None, "a policy for each of so many maps, as {maze: 4}; default: one for all")
    together: bool = setting(False, "train one policy on all scenarios at once; default: one for each scenario")
    workers: int | None = setting(None, "cells at once; default: the cores, or the GPUs where there are some")
    resume: str | None = setting(None, "folder of a benchmark to go on with (its settings are kept)")
    report: bool = setting(False, "run nothing, only write the tables and pictures of the cells that are done")
    confirm: bool = setting(False, "run it although it would take more than a day")
    estimate: bool = setting(True, "measure a few steps first and say how long it will take")
    checkpoint_every: int = setting(10, "iterations between two checkpoints of a training")
    checkpoint_keep: int = setting(2, "newest checkpoints kept, besides the best")
    collector: CollectorSettings = field(default_factory=CollectorSettings)


SCHEMAS = {
    "train": TrainSettings,
    "evaluate": EvaluateSettings,
    "view": ViewSettings,
    "export": ExportSettings,
    "policies": PoliciesSettings,
    "maps": MapsSettings,
    "irsim": IrsimSettings,
    "suite": SuiteSettings,
    "ros2": Ros2Settings,
    "leaderboard": LeaderboardSettings,
    "bench": BenchSettings,
    "benchmark": BenchmarkSettings,
}


def schema(verb: str) -> type:
    """The dataclass of a verb's settings."""
    return SCHEMAS[verb]


def register_schema(verb: str) -> None:
    """Make the types known to Hydra as `<verb>_schema`, the first entry of the verb's primary config."""
    store = ConfigStore.instance().store
    store(name=f"{verb}_schema", node=schema(verb))
    for group, choices in stored_choices().items():
        for name, (_, values) in choices.items():
            store(group=group, name=name, node=values)
    for name, row in TUNINGS.items():
        if row.reference != row.default:
            store(group="_tuning", name=f"reference_{name}", node=asdict(row.reference))


def stored_choices() -> dict[str, dict[str, tuple[str, dict[str, Any]]]]:
    """Choices of groups that tables of the code hold: {"scenario": {"maze": (summary, values)}}."""
    return {
        "scenario": {name: (row.summary, _place(row)) for name, row in SCENARIOS.items()},
        "algorithm": {name: (row.summary, {"name": name} | asdict(row.default)) for name, row in TUNINGS.items()},
        "planner": {name: (summary, _planner(name)) for name, summary in PLANNERS.items()},
        "model": {name: (SUMMARIES[name], asdict(sizes)) for name, sizes in SIZES.items()},
    }


def _planner(name: str) -> dict[str, Any]:
    return {"name": name} | ({"clearance_factor": CLEARANCE[name]} if name in CLEARANCE else {})


def _place(row: Scenario) -> dict[str, Any]:
    """What a scenario's row supplies; of a map of one's own that is known when it is read."""
    if row.build is None:
        return {"name": row.name, "path": MISSING}
    return {"name": row.name} | {name: getattr(row, name) for name in SUPPLIED}
