"""The settings of the verbs, a dataclass for each: what a verb's command composes and what a run keeps.

They stand here and not beside the verbs' code, which loads torch: `--help` and the check of words wait for nothing.
"""

from dataclasses import dataclass, field
from typing import Any

from maexp.agents.config.groups import (
    LAST_SEED,
    MOST_TEAMS,
    UNSET,
    CollectorSettings,
    LearnerSettings,
    LoggerSettings,
    group,
)
from maexp.agents.deploy.planner.scene import CHOICES
from maexp.agents.deploy.planner.team_driver import DriverSettings
from maexp.envs.config import CommConfig
from maexp.envs.config_fields import setting
from maexp.envs.io.options import ImportOptions
from maexp.envs.targets.heuristics import CLASSICAL


@dataclass
class TrainSettings(LearnerSettings):
    """`maexp train`."""

    preset: str = UNSET
    action: str = UNSET  # which file of conf/action
    num_robots: Any = setting(3, "robots in a team; teams of several sizes at once as num_robots=2,3,4")
    total_frames: int = setting(240_000, "macro steps of teams to train for", low=1, high=10**12)
    episodes: int = setting(256, "episodes of the evaluation after training; 0: none", low=0)
    classical: Any = setting(None, "policies played beside the trained team")
    warm_start: str | None = setting(None, "policy to imitate first: a name, a folder, a run or module:function")
    warm_start_frames: int = setting(9_600, "macro steps of teams in which it is imitated", low=1)
    resume: str | None = setting(None, "folder of a run to go on with (its settings are kept)")
    checkpoint_every: int = setting(10, "iterations between two checkpoints", low=1)
    checkpoint_keep: int = setting(3, "newest checkpoints kept, besides the best", low=1)
    evaluate_every: int = setting(
        5, "iterations between two evaluations on validation maps, from the start; 0: none", low=0
    )
    evaluate_episodes: int = setting(
        64, "validation episodes, of the team and of the planners it is compared with", low=1
    )
    evaluation_seed: int | None = setting(
        None, "of episodes that judge a team; default: seed, of a sweep the first", low=0, high=LAST_SEED
    )
    collector: CollectorSettings = group(CollectorSettings)
    logger: LoggerSettings = group(LoggerSettings)


NAMES = (*CHOICES, "lookahead", "oracle", "clairvoyant")
"""Of the policies that come with the package and are not trained."""
OTHERS = "a trained one or its folder, a run, module:function"


@dataclass
class EvaluateSettings(LearnerSettings):
    """`maexp evaluate`."""

    preset: str = UNSET
    action: str = UNSET  # which file of conf/action
    num_robots: Any = setting(3, "robots in a team; several as num_robots=1,2,6,8")
    policy: Any = setting(None, f"{', '.join(NAMES)}, {OTHERS}; several as a,b")
    checkpoint: str | None = setting(None, "a run's folder or one checkpoint file")
    resume: str | None = setting(None, "folder of an evaluation to go on with (its settings are kept)")
    episodes: int = setting(256, "episodes of each policy and team size", low=1)
    baseline: str | None = setting(None, "an earlier evaluation of the same episodes, to compare with: its folder")
    render: bool = setting(False, "also write a film of each policy, and the episodes for maexp view")
    render_envs: int = setting(
        1, "teams in a film, side by side, each in a held-out episode of its own", low=1, high=MOST_TEAMS
    )
    render_format: str = setting("gif", "of the film: gif, or mp4 with the extra maexp[video]")


@dataclass
class ViewSettings(LearnerSettings):
    """`maexp view`."""

    action: str = UNSET  # which file of conf/action
    place: str | None = setting(None, "a run, a checkpoint, a folder of maexp evaluate, an episode or a map")
    index: int | None = setting(
        None, "which map of the scenario; default: the first, for a team the first held out", low=0
    )
    policy: str | None = setting(None, "a policy to watch, as of maexp evaluate, on the map given or a held-out one")
    checkpoint: str | None = None  # what `place` becomes where it is a run
    num_robots: int = setting(3, "robots in a team", low=1)
    num_envs: int = setting(1, "teams to watch, each in a held-out episode of its own", low=1, high=MOST_TEAMS)
    episode: int | None = setting(None, "number of the first held-out episode to watch; default: the first there is")
    seconds: float | None = setting(None, "moment of the picture; default: the end", unit="s", low=0)
    seen_by: int | None = setting(None, "count as explored only what this robot has seen, from 0")
    browser: bool = setting(False, "replay on a page in the browser, with the extra maexp[view]")
    port: int = setting(8080, "of the page; another one where it is taken", low=0, high=65535)
    out: str | None = setting(None, "file to write: .png, or .html for a page that needs no server")
    renderer: str = setting("auto", "of the picture: open3d, painter (ours), or auto: the first that works")
    size: int = setting(1200, "width of the picture", unit="px", low=64, high=8192)
    azimuth: float = setting(
        -60.0, "where the camera stands, counter-clockwise from x", unit="degrees", low=-360, high=360
    )
    elevation: float = setting(50.0, "of the camera over the ground", unit="degrees", low=1, high=89)
    cut: float | None = setting(
        None, "highest walls drawn; default: as scanned, with a team 6 % of the map's side", unit="m", above=0
    )


@dataclass
class ExportSettings(LearnerSettings):
    """`maexp export`."""

    action: str = UNSET  # which file of conf/action
    checkpoint: str | None = setting(None, "a run's folder or one checkpoint file, whose policy chooses targets")
    out: str | None = setting(None, "folder to write, new or empty")
    name: str | None = setting(None, "of the policy; default: the folder's")
    results: str | None = setting(None, "evaluations for its card: results=FOLDER,FOLDER; default: the run's own")
    note: str | None = setting(None, "for its card, below the training: what else is to be known")
    num_robots: Any = setting(3, "robots in a team")


@dataclass
class BenchmarkSettings(LearnerSettings):
    """`maexp benchmark`; `algorithm` holds what all cells share, null where each has its own."""

    algorithm: dict[str, Any] = field(default_factory=dict)  # type: ignore[assignment]
    seed: int = 0  # each cell has its own, from `seeds`
    preset: str = UNSET
    action: str = UNSET  # which file of conf/action
    scenarios: Any = setting(None, "where they are compared")
    algorithms: Any = setting(None, "trained and then evaluated")
    policies: Any = setting(["random", *CLASSICAL, "oracle"], "only evaluated: planners, trained ones, module:function")
    seeds: Any = setting(None, "of training, starts and maps")
    episodes: int = setting(100, "episodes of each cell (a cell: one policy, scenario and seed)", low=1)
    num_robots: int = setting(3, "robots in a team", low=1)
    total_frames: int = setting(80_000, "macro steps of teams to train each algorithm for", low=1, high=10**12)
    iterations: int | None = setting(None, "instead: iterations of one episode of each of the num_envs teams", low=1)
    maps: Any = setting("held_out", "evaluated on held_out, trained, held_out_together (so teams start), or several")
    train_maps: int | None = setting(
        None, "train on the first so many maps; default: all that may be trained on", low=1
    )
    test_maps: int | None = setting(
        None, "evaluate on so many held-out maps, new ones too; default: the last fifth", low=1
    )
    policy_per_map: Any = setting(None, "a policy for each of so many maps, as {maze: 4}; default: one for all")
    together: bool = setting(False, "train one policy on all scenarios at once; default: one for each scenario")
    workers: int | None = setting(None, "cells at once; default: the cores, or the GPUs where there are some", low=1)
    resume: str | None = setting(None, "folder of a benchmark to go on with (its settings are kept)")
    report: bool = setting(False, "run nothing, only write the tables and pictures of the cells that are done")
    confirm: bool = setting(False, "run it although it would take more than a day")
    estimate: bool = setting(True, "measure a few steps first and say how long it will take")
    checkpoint_every: int = setting(10, "iterations between two checkpoints of a training", low=1)
    checkpoint_keep: int = setting(2, "newest checkpoints kept, besides the best", low=1)
    collector: CollectorSettings = group(CollectorSettings)


@dataclass
class BenchSettings(LearnerSettings):
    """`maexp bench`."""

    task: str = UNSET
    num_envs: int = setting(
        256, "teams simulated at once (train: 32); several as num_envs=64,256, as any setting", low=1
    )
    num_robots: Any = setting(None, "team sizes; default 2,4,6,8 for env, 4 for kernels, 3 for train and scale")
    seconds: float = setting(5.0, "time measured per row", unit="s", above=0)
    baseline: str | None = setting(None, "kernels: an earlier bench_kernels.json to compare with")
    axes: Any = setting(None, "scale: what to vary, of envs,robots,map,radar; default all")
    largest: int | None = setting(None, "scale: leave out values beyond this one", low=1)
    collector: CollectorSettings = group(CollectorSettings)
    sweep: Any = None  # settings that were given several values; filled by the command line


@dataclass
class RoundSettings:
    """Of the robots a map is for."""

    radius: float | None = setting(None, "of a round body; default: the robot of the map's scenario", unit="m")


@dataclass
class MapsSettings:
    """`maexp maps`."""

    task: str = UNSET
    file: str | None = setting(
        None, "a map's file, for import also a folder of them, for make and show a scenario, for fetch a set"
    )
    index: int = setting(0, "which map of the scenario", low=0)
    out: str | None = setting(
        None, "file to write, .npz or for nav2 .yaml; default: in the run's folder; fetch: folder of sets, the cache"
    )
    mirror: str | None = setting(None, "fetch: address in place of the one where the set is published")
    num_robots: int = setting(3, "the team that must find room", low=1)
    volume: bool = setting(False, "import: keep a cloud, mesh or octree in three dimensions, as voxels")
    repair: bool = setting(False, "check: mend what can be mended and write the mended map")
    robot: RoundSettings = group(RoundSettings)
    importing: ImportOptions = group(ImportOptions, robot_radius="${robot.radius}", num_robots="${num_robots}")


@dataclass
class IrsimSettings:
    """`maexp irsim`."""

    floor: str | None = setting(None, "a floor's file, as for maexp maps import")
    policy: str = setting("cost_utility", "a classical one, a trained one or its folder, a run, module:Class")
    num_robots: int = setting(3, "robots in the team", low=1)
    seconds: float | None = setting(None, "length of the trial [s]; default: an episode of our simulator on this floor")
    episode: int = setting(0, "the robots start where they do in this evaluation episode of our simulator", low=0)
    seed: int = setting(0, "of starts, noise and people", low=0, high=LAST_SEED)
    ours: bool = setting(True, "play the same team in our simulator, too")
    radar_range: float | None = setting(None, "of the lidars [m]; default: of the floor's scenario")
    beams: int = setting(180, "of a lidar, all around")
    cell: float = setting(0.1, "of the grid the team maps with [m]")
    clearance: float | None = setting(None, "of a robot's centre from walls [m]; default: as in our simulator")
    body_radius: float | None = setting(None, "of a robot [m]; default: 0.05 m less than the clearance")
    range_noise: float = setting(0.0, "standard deviation of a range [m]")
    pose_noise: float = setting(0.0, "of x and y a robot believes, anew every 0.1 s [m]; of its heading, a fifth [rad]")
    pose_drift: float = setting(0.0, "the same, of an error that walks at random with the way, after 1 m [m]")
    people: int = setting(0, "people who walk about", low=0)
    importing: ImportOptions = group(ImportOptions, num_robots="${num_robots}")


@dataclass
class SuiteSettings:
    """`maexp suite`."""

    task: str = UNSET
    place: str | None = setting(None, "the suite, or the .yaml file of one; verify: the folder of a run")
    policy: str | None = setting(None, "run: a name, run or folder, module:Class, exec:COMMAND, socket:HOST:PORT")
    name: str | None = setting(None, "run: what results call the policy; default: its own name")
    suite: str | None = setting(None, "verify: the .yaml file of a suite that does not come with the package")
    seed: int | None = setting(
        None, "run: plays other maps and starts than the frozen ones, those of this seed", low=0, high=LAST_SEED
    )
    resume: str | None = setting(None, "run: folder of a run to go on with")
    num_envs: int = setting(16, "run: teams at once", low=1)
    workers: int | None = setting(
        None, "run: teams at once in processes; default: as many as cores, by socket one", low=1
    )
    decision_limit: float | None = setting(
        None, "run: its processor time a decision; default: the suite's", unit="s", above=0
    )
    patience: float = setting(120.0, "run: how long it may be silent", unit="s", above=0)
    device: str = setting("cpu", "run: cpu, cuda, ...; bits are promised on one platform alone")


@dataclass(frozen=True)
class Ros2Settings(DriverSettings):
    """`maexp ros2`; what it shares with `DriverSettings` is for the task team."""

    task: str = UNSET
    comm: CommConfig = group(CommConfig)
    place: str | None = setting(None, "serve: the suite, or the .yaml file of one")
    domain: int | None = setting(None, "number of DDS's domain; default: ROS_DOMAIN_ID, or 0")
    answer: float = setting(60.0, "how long the other side may be silent before this ends", unit="s", above=0)
    robots: Any = setting(None, "namespaces, a,b,c; serve: default robot1,robot2,...")
    goals: str = setting("goal_pose", "team: sends goals by this topic, or by the action navigate_to_pose")
    name: str = setting("ros2", "serve: what results call those who play")
    seed: int | None = setting(
        None, "serve: plays other maps and starts than the frozen ones, those of this seed", low=0, high=LAST_SEED
    )
    resume: str | None = setting(None, "serve: folder of a run to go on with")
    tf: str = setting("shared", "serve: /tf with frames NAME/base_link; own: /NAME/tf with base_link")
    wait_for: str = setting("all", "serve: the clock waits until all robots have a new goal; idle: those without one")
    stands: float = setting(5.0, "serve: how long the clock stands still for goals", unit="s", above=0)
    limit: float = setting(
        10.0, "serve: how long it runs on then, before robots without a goal stay", unit="s", above=0
    )


@dataclass
class LeaderboardSettings:
    """`maexp leaderboard`."""

    places: Any = setting(None, "folders of maexp suite run, rows, or folders of rows; written without places=")
    out: str | None = setting(None, "folder of rows and the page; rows that are there stay")
    verify: bool = setting(True, "play the actions of each run again, and refuse those that are not what they say")
    note: str | None = setting(None, "a sentence for these rows: how the policy was made, with which weights")
    suite: str | None = setting(None, "the .yaml file of a suite that does not come with the package")


@dataclass
class PoliciesSettings:
    """`maexp policies`."""

    task: str = UNSET
    name: str | None = setting(None, "show: the policy, or the folder of one")


EpisodeSettings = TrainSettings | EvaluateSettings
"""Of the verbs that play evaluation episodes with several policies."""
SCHEMAS: dict[str, type] = {
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
"""The dataclass of each verb's settings."""
