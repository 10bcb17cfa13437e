"""All settings of an env."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Literal, Self

from maexp.envs.config.comm import CommConfig
from maexp.envs.config.conditions import FaultsConfig, OdometryConfig
from maexp.envs.config.group import Group
from maexp.envs.config.lookahead import LookaheadConfig
from maexp.envs.config.observation import ObservationConfig
from maexp.envs.config.planner import PlannerConfig
from maexp.envs.config.radar import RadarConfig
from maexp.envs.config.reward import RewardConfig
from maexp.envs.config.robot import RobotConfig
from maexp.envs.config.targets import TargetsConfig
from maexp.envs.config_fields import choices_of, setting
from maexp.envs.scenarios.table import PROTOCOL, Scenario, default_macro_steps

if TYPE_CHECKING:
    from maexp.envs.maps.point_cloud import PointCloudMap

Knower = Literal["union", "base", "everyone"]
"""Whose knowledge counts: what the team has seen together, what the base station knows, or what every robot knows that
has neither collided nor failed."""
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
    local_steps: int | None = setting(
        None,
        "control steps of 0.1 s in one `env.step`; instead of decision_seconds, and an episode has as many steps "
        "of the env as in the scenario's protocol",
        low=1,
    )
    macro_steps: int | None = setting(None, "`env.step` calls in an episode before it is truncated", low=1)
    collision: Literal["centre", "footprint"] = setting(
        "centre", "of centres with walls and centres, or footprint: of oriented rectangles"
    )
    success_coverage: float = setting(
        0.95,
        "share of the free points that ends an episode, up to 1; 0.99 with more macro_steps: to the end",
        above=0,
        high=1,
    )
    done: Knower = setting(
        "union", "whose: what the team has seen; or base, everyone: what the station, or every robot, knows"
    )
    num_threads: int | None = setting(None, "CPU threads of the simulation; results do not depend on it")
    decision_seconds: float | Literal["protocol"] | None = setting(
        None,
        "from decision to decision, whole control steps of 0.1 s; protocol: as the scenario was published; an "
        "episode lasts as long at every pace",
        unit="s",
        above=0,
    )
    decide: Literal["together", "arrival"] = setting(
        "together",
        "when: together, all robots at once; or arrival: each when it has arrived or its target is explored or taken, "
        "after decision_seconds at the latest",
    )
    first_env: int = setting(
        0, "number of the first env in the random keys, where processes share one batch of envs", low=0
    )
    limited: bool = setting(False, "robots may know different things; true where comm or faults make it so")

    def completed(self, scenario: Scenario, maps: "Sequence[PointCloudMap]" = ()) -> Self:
        """With what is None taken from the scenario, each group checked, and a robot and a radar for each robot.

        ``macro_steps`` stays None where the maps tell and none are given; ``decision_seconds`` has come to
        ``local_steps`` and is None.

        Raises:
            ValueError: a value of a group is out of its range (named), or two settings say how often robots decide.
        """
        if self.local_steps is not None and self.decision_seconds not in (None, PROTOCOL):
            raise ValueError(
                f"local_steps={self.local_steps} and decision_seconds={self.decision_seconds} both say how often "
                "robots decide: give one of them"
            )
        robots, radars = (
            tuple(config.completed(scenario) for config in per_robot(name, getattr(self, name), kind, self.num_robots))
            for name, kind in (("robot", RobotConfig), ("radar", RadarConfig))
        )
        others = {name: kind for name, kind in GROUPS.items() if name not in ("robot", "radar")}
        groups: dict[str, Any] = {name: one_config(name, getattr(self, name), kind) for name, kind in others.items()}
        local_steps = scenario.decision_steps(self.local_steps, self.decision_seconds, self.decide)
        macro_steps = self.macro_steps
        if macro_steps is None:
            macro_steps = scenario.episode_decisions(self.local_steps, local_steps)
        if not macro_steps and maps:
            team = [(robot.max_speed, radar.range) for robot, radar in zip(robots, radars, strict=True)]
            macro_steps = default_macro_steps(maps, scenario, team, local_steps)
        groups = {name: group.completed(scenario) for name, group in groups.items()}
        if self.local_steps is None:
            groups |= keep_seconds(groups, scenario, local_steps)
        steps: dict[str, Any] = {"local_steps": local_steps, "macro_steps": macro_steps, "decision_seconds": None}
        return replace(self, robot=robots, radar=radars, **steps, **groups)

    @property
    def observes_radios(self) -> bool:
        """Whether robots are told of radios, and may choose to go and tell the base station."""
        return self.observation.radio and self.limited

    @property
    def episode_steps(self) -> int:
        """Local steps of a whole episode."""
        return (self.local_steps or 0) * (self.macro_steps or 0)


def keep_seconds(groups: dict[str, Any], scenario: Scenario, steps: int) -> dict[str, Any]:
    """The groups that count in decisions, so that they mean as many seconds at every pace: an imagined decision of
    `lookahead` (branches of 1 s hardly differ), and `comm.period`.

    Args:
        steps: control steps from decision to decision.
    """
    lookahead, comm = groups["lookahead"], groups["comm"]
    if lookahead.local_steps is None:
        lookahead = replace(lookahead, local_steps=scenario.local_steps)
    if comm.period != "auto":
        comm = replace(comm, period=max(1, round(comm.period * scenario.local_steps / steps)))
    return {"lookahead": lookahead, "comm": comm}


GROUPS: dict[str, type[Group]] = {
    field.name: type(field.default) for field in fields(EnvSettings) if isinstance(field.default, Group)
}
"""The groups of settings by their names."""
DONE = choices_of(EnvSettings, "done")
"""Whose coverage ends an episode, numbered as in kernels/radio.py."""


def per_robot(what: str, config, kind: type, count: int) -> list:
    """One config per robot from a single one or a list of ``count``."""
    if config is None:
        return [kind()] * count
    if isinstance(config, kind):
        return [config] * count
    if isinstance(config, Sequence) and len(config) == count and all(isinstance(c, kind) for c in config):
        return list(config)
    size = f"a list of {len(config)}" if isinstance(config, Sequence) else repr(config)
    raise ValueError(f"{what}={size}: give one {kind.__name__} or a list of num_robots={count} of them")


def one_config(what: str, config, kind: type):
    """The config given, or one of defaults."""
    if config is not None and not isinstance(config, kind):
        raise ValueError(f"{what}={config!r}: give a {kind.__name__}, as {what}={kind.__name__}(...)")
    return config or kind()
