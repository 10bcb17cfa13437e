"""All settings of an env."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

from maexp.envs.fields import setting, words_of

from .comm import CommConfig
from .faults import FaultsConfig
from .group import Group
from .lookahead import LookaheadConfig
from .observation import ObservationConfig
from .odometry import OdometryConfig
from .planner import PlannerConfig
from .radar import RadarConfig
from .reward import RewardConfig
from .robot import RobotConfig
from .targets import TargetsConfig

STARTS = ("drawn", "together", "fixed")
"""Where robots start, besides poses that are given: drawn at every reset, each by itself or all beside each other, or
drawn once for each map and kept."""


@dataclass(frozen=True)
class EnvSettings:
    """What an `ExplorationEnv` is, besides its maps and starts; None: what the scenario of the first map says.

    `maexp.envs.settings.complete_settings` checks and fills in; then nothing is None, and ``robot``, ``radar`` are
    tuples with one config per robot.
    """

    num_envs: int = setting(1, "teams in the batch, E", low=1)
    num_robots: int = setting(3, "robots in a team, N", low=1)
    device: Any = setting("cpu", "cpu or cuda")
    seed: int = setting(0, "key of all random numbers: env i's episode k depends on (seed, first_env + i, k) alone")
    robot: RobotConfig | Sequence[RobotConfig] = setting(RobotConfig(), "or a list with one for each robot")
    radar: RadarConfig | Sequence[RadarConfig] = setting(RadarConfig(), "or a list with one for each robot")
    planner: PlannerConfig = setting(PlannerConfig(), "how robots drive to their goals")
    reward: RewardConfig = setting(RewardConfig(), "weights of the reward")
    observation: ObservationConfig = setting(ObservationConfig(), "what robots see")
    comm: CommConfig = setting(CommConfig(), "who hears whom")
    faults: FaultsConfig = setting(FaultsConfig(), "robots that fail")
    odometry: OdometryConfig = setting(OdometryConfig(), "how far robots are from where they believe to be")
    targets: TargetsConfig = setting(TargetsConfig(), "how robots share targets out")
    lookahead: LookaheadConfig = setting(LookaheadConfig(), "how `policy=lookahead` plans")
    local_steps: int | None = setting(None, "control steps of 0.1 s in one `env.step`", low=1)
    macro_steps: int | None = setting(None, "`env.step` calls in an episode before it is truncated", low=1)
    collision: Literal["centre", "footprint"] = setting(
        "centre", "of centres with walls and centres, or footprint: of oriented rectangles"
    )
    success_coverage: float = setting(
        0.95, "share of the free points that ends an episode, up to 1; 0.99 with more macro_steps: to the end",
        above=0, high=1,
    )  # fmt: skip
    done: Literal["union", "base", "everyone"] = setting(
        "union", "whose: what the team has seen; or base, everyone: what the station, or every robot, knows"
    )
    num_threads: int | None = setting(None, "CPU threads of the simulation; results do not depend on it")
    first_env: int = setting(
        0, "number of the first env in the random keys, where processes share one batch of envs", low=0
    )
    limited: bool = setting(False, "robots may know different things; true where comm or faults make it so")

    @property
    def episode_steps(self) -> int:
        """Local steps of a whole episode."""
        return self.local_steps * self.macro_steps


GROUPS: dict[str, type[Group]] = {
    one.name: type(one.default) for one in fields(EnvSettings) if isinstance(one.default, Group)
}
"""The groups of settings by their names."""
DONE = words_of(EnvSettings, "done")
"""Whose coverage ends an episode, numbered as in kernels/radio.py: what the team has seen together, what the base
station knows, or what every robot knows that has neither collided nor failed."""
