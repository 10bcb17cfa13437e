"""Settings of `maexp train`."""

from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING

from maexp.agents.settings.groups import LAST_SEED, CollectorSettings, LearnerSettings, LoggerSettings
from maexp.envs.config_fields import setting


@dataclass
class TrainSettings(LearnerSettings):
    """`maexp train`."""

    preset: str = MISSING
    action: str = MISSING  # which file of conf/action
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
    collector: CollectorSettings = field(default_factory=CollectorSettings)
    logger: LoggerSettings = field(default_factory=LoggerSettings)
