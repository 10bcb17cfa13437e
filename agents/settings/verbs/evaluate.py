"""Settings of `maexp evaluate`."""

from dataclasses import dataclass
from typing import Any

from omegaconf import MISSING

from maexp.agents.deploy.planner.scene import CHOICES
from maexp.agents.settings.groups import MOST_TEAMS, LearnerSettings
from maexp.envs.config_fields import setting

NAMES = (*CHOICES, "lookahead", "oracle", "clairvoyant")
"""Of the policies that come with the package and are not trained."""
OTHERS = "a trained one or its folder, a run, module:function"


@dataclass
class EvaluateSettings(LearnerSettings):
    """`maexp evaluate`."""

    preset: str = MISSING
    action: str = MISSING  # which file of conf/action
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
