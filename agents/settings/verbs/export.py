"""Settings of `maexp export`."""

from dataclasses import dataclass
from typing import Any

from omegaconf import MISSING

from maexp.agents.settings.groups import LearnerSettings
from maexp.envs.config_fields import setting


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
