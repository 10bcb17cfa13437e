"""Settings of `maexp bench`."""

from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING

from maexp.agents.settings.groups import CollectorSettings, LearnerSettings
from maexp.envs.config_fields import setting


@dataclass
class BenchSettings(LearnerSettings):
    """`maexp bench`."""

    task: str = MISSING
    num_envs: int = setting(
        256, "teams simulated at once (train: 32); several as num_envs=64,256, as any setting", low=1
    )
    num_robots: Any = setting(None, "team sizes; default 2,4,6,8 for env, 4 for kernels, 3 for train and scale")
    seconds: float = setting(5.0, "time measured per row", unit="s", above=0)
    baseline: str | None = setting(None, "kernels: an earlier bench_kernels.json to compare with")
    axes: Any = setting(None, "scale: what to vary, of envs,robots,map,radar; default all")
    largest: int | None = setting(None, "scale: leave out values beyond this one", low=1)
    collector: CollectorSettings = field(default_factory=CollectorSettings)
    sweep: Any = None  # settings that were given several values; filled by the command line
