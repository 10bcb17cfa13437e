"""Settings of an env as dataclasses; every default that a scenario fixes comes from its row of the table."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

from maexp.envs.fields import check_settings, check_value, kinds, setting, words_of
from maexp.envs.scenarios import Scenario

STARTS = ("drawn", "together", "fixed")
"""Where robots start, besides poses that are given: drawn at every reset, each by itself or all beside each other, or
drawn once for each map and kept."""
MOST_CANDIDATES = 64
MOST_HORIZON = 100
MOST_TARGETS = 256  # that a robot is shown
MOST_MISSED = 0.99  # of a radar's returns
MOST_EVIDENCE = 100  # returns that a robot may ask for before it knows a point
PLANNERS = {
    "dwa": "dynamic window: straight to the goal, around what is near (paper)",
    "wavefront": "shortest way through the known map to a waypoint in sight, driven there by dwa",
    "direct": "none: the policy itself accelerates and steers",
}
CLEARANCE = {"wavefront": 2.0, "dwa": 3.0}  # clearance factors (measured in docs/notes.md)
SIGNAL_LOSS = 31.0  # of the nearest radio's signal [dB] (`maexp.kernels.radio`)
CELLS_OF_RADAR = 80  # that IR2's sensor reaches


@dataclass(frozen=True)
class RobotConfig:
    """One robot; None takes the scenario's value. ``radius`` makes the body round: length, width and collision
    threshold follow from it (`Scenario.with_radius`)."""

    kind: Literal["ackermann", "differential", "omnidirectional"] = setting("ackermann", "how it drives")
    length: float | None = setting(None, "of the body", unit="m", above=0, scenario="body_length")
    width: float | None = setting(None, "of the body", unit="m", above=0, scenario="body_width")
    wheelbase: float | Literal["width", "length"] | None = setting(
        None, "of a car, or width or length: that of the body; default: its width", unit="m", above=0
    )
    max_speed: float | None = setting(None, "greatest speed", unit="m/s", above=0, scenario="max_speed")
    max_accel: float | None = setting(None, "greatest acceleration", unit="m/s^2", above=0, scenario="max_accel")
    max_steer: float | None = setting(None, "steering limit of a car", unit="rad", above=0, scenario="max_steer")
    max_yaw_rate: float = setting(math.pi / 2, "turn limit of a differential drive", unit="rad/s", above=0)
    collision_threshold: float | None = setting(
        None, "centre to a wall or another centre", unit="m", above=0, scenario="collision_threshold"
    )
    radius: float | None = setting(
        None, "of a round body, which says length, width and collision_threshold", unit="m", above=0
    )


@dataclass(frozen=True)
class RadarConfig:
    """A robot's range sensor."""

    range: float | None = setting(None, "how far it sees", unit="m", above=0, scenario="radar_range")
    fov: float = setting(2.0 * math.pi, "field of view", unit="rad", above=0)
    alpha1: float = setting(1e-3, "1 - cos of a beam's half width; 1e-3: 2.56 degrees", low=0, high=2)
    alpha2: float = setting(
        1e-6, "an obstacle point hides what is behind it, and before it what is nearer by less than this", unit="m"
    )
    obstacle_radius: float | Literal["auto"] = setting(
        "auto", "of an obstacle point; auto: its spacing / sqrt(2)", unit="m", low=0
    )
    missed: float = setting(
        0.0, "probability that a point in view gives no return in a step of 0.1 s", low=0, high=MOST_MISSED
    )
    noise: float = setting(
        0.0, "standard deviation of a range; returns off by half the points' spacing are dropped", unit="m", low=0
    )
    evidence: int = setting(1, "returns of a point after which a robot knows it", low=1, high=MOST_EVIDENCE)

    @property
    def perfect(self) -> bool:
        """Whether a robot knows at once all that is in view."""
        return self.missed == 0.0 and self.noise == 0.0 and self.evidence == 1


@dataclass(frozen=True)
class PlannerConfig:
    """How a robot drives to its goal (docs/planners.md)."""

    name: Literal["dwa", "wavefront", "direct"] = setting(
        "wavefront", "dwa: straight to the goal; wavefront: on a way through the known map; direct: the policy steers"
    )
    num_accel: int = setting(3, "DWA's candidates of the acceleration", low=1)
    num_steering: int | None = setting(
        None, "DWA's candidates of the steering angle", low=1, scenario="num_steering"
    )
    horizon: int = setting(3, "local steps that DWA looks ahead", low=1)
    clearance_factor: float | None = setting(
        None, "nearer than so many collision thresholds costs DWA; wavefront's paths keep as clear of walls", above=0
    )
    clearance_weight: float = setting(100.0, "how much that costs", above=0)
    replan_steps: int = setting(5, "local steps between two looks of wavefront for a path", low=1)


@dataclass(frozen=True)
class RewardConfig:
    """Weights of the reward (docs/concepts.md).

    ``points`` / |free| scales explore and overlap, ``events`` the other terms; ``events`` 0 takes
    ``points`` / |free| there too, as the paper does. ``time_on`` "uncovered" pays -(1 - coverage), "covered" pays
    -coverage as the paper prints. "gained" pays at once, for all the steps left, what is newly covered: over an
    episode that is the sum of "uncovered" and a constant, and a critic has less to explain. ``charge_rest``: when the
    last robot of a team has collided, the steps left in the episode are charged at once, as if it went on; else the
    team is spared them. ``unfinished`` adds to what is charged for time in every local step until the team is done:
    the last corners count then, too.
    """

    explore: float = setting(0.3, "for a point that no robot of the team had seen before", low=0)
    overlap: float = setting(0.0, "subtracted for a point that another robot sees at the same time", low=0)
    time: float = setting(1.0, "subtracted in every local step, times the share that is still unexplored", low=0)
    unfinished: float = setting(0.0, "added to that share until the team is done", low=0)
    success: float = setting(100.0, "once, when the coverage reaches scenario.success_coverage", low=0)
    collision: float = setting(200.0, "subtracted once, from the robot that collides", low=0)
    points: float = setting(60.0, "explore and overlap are multiplied by points / free points of the map", low=0)
    events: float = setting(
        60.0 / 7000.0, "what multiplies time, success and collision (60 / 7000); 0: points / free points", low=0
    )
    time_on: Literal["uncovered", "covered", "gained"] = setting(
        "uncovered", "covered: the time term grows with what is explored, as the paper prints; gained: paid at once"
    )
    charge_rest: bool = setting(True, "a team that has crashed pays the time that was left, as if the episode went on")


@dataclass(frozen=True)
class ObservationConfig:
    """What a robot sees; its frontier targets are those of `maexp.envs.target_view`."""

    map: Literal["seen", "known"] = setting(
        "seen", "what its picture shows: seen by itself, or known: through communication, too"
    )
    pictures: bool = setting(True, "false leaves them out: they are most of an observation's cost")
    targets: int = setting(
        0, "frontier targets that a robot is shown, to choose from; 0: none", low=0, high=MOST_TARGETS
    )


@dataclass(frozen=True)
class CommConfig:
    """Who hears whom (docs/conditions.md).

    Robots within ``range``, in line of sight if asked, and with ``signal`` those whose signal arrives
    (`maexp.kernels.radio`). ``strategy`` is what robots do to tell others what they know, whatever their policy
    (`maexp.envs.strategy`): nothing but to talk when they meet (``opportunistic``), or to report or meet every
    ``period`` decisions. A base station is a radio with a map of its own.
    """

    range: float = setting(math.inf, "of a radio; inf: everyone hears everyone", unit="m", low=0, infinite=True)
    line_of_sight: bool = setting(False, "walls between two robots part them")
    signal: bool = setting(False, "robots hear those whose signal arrives")
    power: float = setting(-20.0, "that signals are sent with", unit="dBm")
    threshold: float = setting(-70.0, "that has to arrive, and more, for a link", unit="dBm")
    cell: float | Literal["auto"] = setting(
        "auto", "edge of a cell of the signal's model; auto: an 80th of the greatest radar range", unit="m", above=0
    )
    noise: float = setting(
        0.0, "greatest fading of each part of the loss, drawn for every pair and moment", unit="dB", low=0
    )
    loss: float = setting(0.0, "probability that two radios miss each other in a step of 0.1 s", low=0, high=1)
    base_station: bool | tuple[float, float] = setting(
        False, "true: a radio with a map of its own where robot 0 starts; or a place [x, y]", unit="m"
    )
    strategy: Literal["opportunistic", "rendezvous", "relay", "return_to_base", "pursuit"] = setting(
        "opportunistic", "what robots do to tell others what they know (docs/conditions.md)"
    )
    period: int = setting(8, "decisions between two reports or meetings", low=1)

    @property
    def limited(self) -> bool:
        """Whether robots may know different things."""
        return self.line_of_sight or math.isfinite(self.range) or self.signal or self.loss > 0.0 or self.has_base

    @property
    def has_base(self) -> bool:
        """Whether there is a base station."""
        return self.base_station is not False


@dataclass(frozen=True)
class FaultsConfig:
    """Robots that fail (docs/conditions.md): they stop, see nothing, say nothing and stand in the way."""

    probability: float = setting(
        0.0, "that a robot fails in an episode, at a moment drawn evenly over it", low=0, high=1
    )
    at: tuple[tuple[int, float], ...] = setting(
        (), "failures at given moments: pairs of a robot and seconds, as [[0, 30], [2, 12.5]]"
    )
    duration: float = setting(
        math.inf, "how long a failure lasts; inf: for good", unit="s", low=0.1, infinite=True
    )

    @property
    def some(self) -> bool:
        """Whether any robot may fail."""
        return self.probability > 0.0 or bool(self.at)


@dataclass(frozen=True)
class OdometryConfig:
    """How far robots are from where they believe to be (docs/conditions.md): normal errors, whose spread grows with the
    root of the way driven, and jumps."""

    drift: float = setting(0.0, "spread of a robot's error along each axis after one metre", unit="m", low=0)
    turn: float = setting(0.0, "the same of its heading", unit="rad", low=0)
    jump: float = setting(0.0, "spread of a jump along each axis", unit="m", low=0)
    jump_rate: float = setting(0.0, "how often a robot jumps", unit="1/s", low=0, high=10)

    @property
    def some(self) -> bool:
        """Whether robots may be elsewhere than they believe."""
        return self.drift > 0.0 or self.turn > 0.0 or self.jump > 0.0


@dataclass(frozen=True)
class TargetsConfig:
    """How robots share targets out, with any policy that chooses among them."""

    distinct: bool = setting(
        True, "robots that hear each other go to different targets; else each goes where it likes best"
    )
    spare: Literal["wait", "home"] = setting(
        "wait", "where robots go for which no target is left: nowhere, or home to where they started"
    )


@dataclass(frozen=True)
class LookaheadConfig:
    """How `policy=lookahead` and the reference `clairvoyant` plan (docs/lookahead.md).

    Each robot tries ``candidates`` targets, its own choice among them, in a simulated future of ``horizon``
    decisions, the first among them, in which ``rollout_policy`` plays on. A branch is worth what it covers, on average
    over that time, and ``rest`` times what it has covered at its end; less ``loss`` for every robot lost; and ``prior``
    times what the target is worth to `cost_utility`, or to ``rollout_policy`` where that is a trained policy (by its
    name or folder; then `cost_utility` plays on). All of it counts in radar discs. The best branch is taken if it is
    worth ``margin`` more than the own choice. ``unknown`` says what is taken to stand where nobody has looked: ``free``
    ground, what the ``nearest`` known cell holds, or what the map predictor says (``predicted``).
    """

    rollout_policy: str = setting(
        "cost_utility",
        "chooses where no branch is better, and plays on; or a trained one, for which cost_utility plays on",
    )
    candidates: int = setting(
        5, "targets that each robot tries, its own choice among them", low=1, high=MOST_CANDIDATES
    )
    horizon: int = setting(1, "decisions that are played, the first among them", low=1, high=MOST_HORIZON)
    unknown: Literal["free", "nearest", "predicted"] = setting(
        "free", "what is taken to stand where nobody has looked; nearest: what the nearest known cell holds; predicted"
    )
    margin: float = setting(
        0.02, "how much more than the own choice a branch must be worth to be taken", unit="radar discs", low=0
    )
    loss: float = setting(1.0, "what a robot lost costs", unit="radar discs", low=0)
    rest: float = setting(1.0, "weight of what is covered at a branch's end beside the average over its time", low=0)
    prior: float = setting(
        0.7, "weight of what the target is worth to cost_utility beside what the branch covers", low=0
    )


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


ROBOT_KINDS = words_of(RobotConfig, "kind")
TIME_ON = words_of(RewardConfig, "time_on")  # numbered as in kernels/reward.py
STRATEGIES = words_of(CommConfig, "strategy")
DONE = words_of(EnvSettings, "done")
"""Whose coverage ends an episode, numbered as in kernels/radio.py: what the team has seen together, what the base
station knows, or what every robot knows that has neither collided nor failed."""
BODY = ("length", "width", "collision_threshold")
"""What a radius decides of a robot."""


def supplied(kind: type) -> list[str]:
    """Settings of a robot, radar or planner whose default is the scenario's value."""
    return [one.name for one in fields(kind) if one.default is None and one.name != "radius"]


def _complete(config, scenario: Scenario):
    """``config`` with what is None taken from the scenario, where that says it."""
    sources = {one.name: one.metadata.get("scenario") for one in fields(config) if getattr(config, one.name) is None}
    return replace(config, **{name: getattr(scenario, source) for name, source in sources.items() if source})


def complete_robot(config: RobotConfig, scenario: Scenario) -> RobotConfig:
    """Fill in what the radius or the scenario fixes and check every value."""
    if config.radius is not None:
        scenario = scenario.with_radius(_check_radius(config))
    config = _complete(config, scenario)
    check_settings(config, "robot")
    if config.wheelbase in (None, "width", "length"):
        config = replace(config, wheelbase=getattr(config, config.wheelbase or "width"))
    if config.max_steer >= math.pi / 2:
        raise ValueError(f"robot.max_steer={config.max_steer} must stay below pi/2 = 1.5708 rad")
    return config


def _check_radius(config: RobotConfig) -> float:
    """The radius, if it is one and agrees with what else is said of the body."""
    radius = config.radius
    metadata = {one.name: one.metadata for one in fields(config)}["radius"]
    check_value("robot.radius", radius, kinds(RobotConfig)["radius"], metadata)
    for name in BODY:
        value, round_one = getattr(config, name), radius if name == "collision_threshold" else 2 * radius
        if value is not None and value != round_one:
            raise ValueError(
                f"robot.radius={radius:g} makes robot.{name} {round_one:g} m, and {value} is given: leave one of the "
                "two out"
            )
    return radius


def complete_radar(config: RadarConfig, scenario: Scenario) -> RadarConfig:
    """Fill in the scenario's range and check every value."""
    config = _complete(config, scenario)
    check_settings(config, "radar")
    return config


def complete_planner(config: PlannerConfig, scenario: Scenario) -> PlannerConfig:
    """Fill in the scenario's candidates and the planner's clearance and check every value."""
    config = _complete(config, scenario)
    if config.clearance_factor is None:
        config = replace(config, clearance_factor=CLEARANCE.get(config.name, scenario.clearance_factor))
    check_settings(config, "planner")
    return config


def check_reward(config: RewardConfig) -> RewardConfig:
    """Every weight must be a finite number; signs are fixed by the meaning of the terms."""
    check_settings(config, "reward")
    if config.time_on == "gained" and not config.charge_rest:
        raise ValueError(
            "reward.charge_rest=False with reward.time_on='gained': nothing is charged, "
            "use true or reward.time_on=uncovered"
        )
    return config


def check_observation(config: ObservationConfig, planner: PlannerConfig) -> None:
    """The settings must be known, and targets need a planner that drives to goals."""
    check_settings(config, "observation")
    if config.targets and planner.name == "direct":
        raise ValueError(
            f"planner=direct takes controls, observation.targets={config.targets} shows goals: add action=regions"
        )


def check_comm(config: CommConfig) -> CommConfig:
    """Check every value, and make a place a tuple."""
    check_settings(config, "comm")
    if config.signal and config.threshold >= config.power - SIGNAL_LOSS:
        raise ValueError(
            f"comm.threshold={config.threshold:g} dBm is out of reach: of comm.power={config.power:g} dBm "
            f"{config.power - SIGNAL_LOSS:g} arrive at best, and nobody would ever hear anybody; lower the threshold, "
            "or use comm.range=0 if that is meant"
        )
    return replace(config, base_station=_check_base(config.base_station))


def check_strategy(config: CommConfig, num_robots: int, planner: PlannerConfig) -> None:
    """Raise ValueError if the team, its radios or its planner do not go with `comm.strategy`."""
    name = config.strategy
    if name == "opportunistic":
        return
    if planner.name != "wavefront":
        raise ValueError(f"comm.strategy={name} sends robots back: planner={planner.name} finds no way, use wavefront")
    if not config.limited:
        raise ValueError(f"comm.strategy={name} is for radios that do not reach: add comm=ir2, comm.range or the like")
    if name in ("relay", "return_to_base") and not config.has_base:
        raise ValueError(f"comm.strategy={name} needs a base station: add comm.base_station=true")
    if name == "relay" and num_robots < 2:
        raise ValueError(f"comm.strategy=relay needs an explorer and a relay: num_robots={num_robots}, give 2 or more")


def _check_base(base: bool | Sequence[float]) -> bool | tuple[float, float]:
    if isinstance(base, bool):
        return base
    place = list(base) if isinstance(base, Sequence) and not isinstance(base, str) else []
    if len(place) != 2 or not all(isinstance(x, int | float) and math.isfinite(x) for x in place):
        where = "true (where robot 0 starts), false or a place [x, y] in metres"
        raise ValueError(f"comm.base_station={base!r} must be {where}")
    return float(place[0]), float(place[1])


def check_faults(config: FaultsConfig, num_robots: int | None = None) -> FaultsConfig:
    """Check every value, robots where it is known how many there are, and make the pairs tuples."""
    check_settings(config, "faults")
    pairs = config.at if isinstance(config.at, Sequence) and not isinstance(config.at, str) else [config.at]
    found: dict[int, float] = {}
    for pair in pairs:
        if not isinstance(pair, Sequence) or isinstance(pair, str) or len(pair) != 2:
            raise ValueError(f"faults.at={config.at!r} must be pairs of a robot and seconds, as [[0, 30], [2, 12.5]]")
        robot, seconds = pair
        if isinstance(robot, bool) or not isinstance(robot, int) or robot < 0:
            raise ValueError(f"faults.at names robot {robot!r}: robots have numbers from 0 on")
        if num_robots is not None and robot >= num_robots:
            last = num_robots - 1
            raise ValueError(f"faults.at names robot {robot}: there are num_robots={num_robots}, from 0 to {last}")
        if robot in found:
            raise ValueError(f"faults.at names robot {robot} twice: it fails once in an episode")
        if isinstance(seconds, bool) or not isinstance(seconds, int | float) or not 0.0 <= seconds < math.inf:
            raise ValueError(f"faults.at: the moment of robot {robot}={seconds!r} must be 0 or more seconds")
        found[robot] = float(seconds)
    return replace(config, at=tuple(found.items()))


def check_odometry(config: OdometryConfig) -> OdometryConfig:
    """Check every value; jumps need a spread and a rate."""
    check_settings(config, "odometry")
    if (config.jump > 0.0) != (config.jump_rate > 0.0):
        raise ValueError(
            f"odometry.jump={config.jump:g} m and odometry.jump_rate={config.jump_rate:g} 1/s: jumps need both, "
            "or neither"
        )
    return config


def check_done(done: str, comm: CommConfig) -> str:
    """Whose coverage ends an episode must be there."""
    if done == "base" and not comm.has_base:
        raise ValueError("done='base' needs a base station: add comm.base_station=true")
    return done


def check_targets(config: TargetsConfig) -> TargetsConfig:
    """The settings must be known."""
    check_settings(config, "targets")
    return config


def check_lookahead(config: LookaheadConfig) -> LookaheadConfig:
    """Counts must be whole and within reason, weights finite. Whether the rollout policy is one, the planner checks."""
    check_settings(config, "lookahead")
    return config


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
