"""Settings of the env as dataclasses; every default that a scenario fixes comes from its row of the table."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Literal

from maexp.envs.scenarios import Scenario

STARTS = ("drawn", "together", "fixed")
"""Where robots start, besides poses that are given: drawn at every reset, each by itself or all beside each other, or
drawn once for each map and kept."""


@dataclass(frozen=True)
class RobotConfig:
    """One robot. Lengths in metres, speeds in m/s, angles in radians; None takes the scenario's value.

    ``max_yaw_rate`` [rad/s] is the turn limit of a differential drive, ``max_steer`` that of a car.
    ``wheelbase`` of a car is metres, or "width" (None, the default) or "length" of the body. ``radius`` makes the body
    round: length, width and collision threshold follow from it (`Scenario.with_radius`).
    """

    kind: Literal["ackermann", "differential", "omnidirectional"] = "ackermann"
    length: float | None = None
    width: float | None = None
    wheelbase: float | Literal["width", "length"] | None = None
    max_speed: float | None = None
    max_accel: float | None = None
    max_steer: float | None = None
    max_yaw_rate: float = math.pi / 2
    collision_threshold: float | None = None
    radius: float | None = None


@dataclass(frozen=True)
class RadarConfig:
    """A robot's range sensor. ``obstacle_radius`` "auto" is each obstacle's spacing / sqrt(2)."""

    range: float | None = None
    fov: float = 2.0 * math.pi
    alpha1: float = 1e-3
    alpha2: float = 1e-6
    obstacle_radius: float | Literal["auto"] = "auto"


@dataclass(frozen=True)
class PlannerConfig:
    """How a robot drives to its goal (docs/planners.md)."""

    name: Literal["dwa", "wavefront", "direct"] = "wavefront"
    num_accel: int = 3
    num_steering: int | None = None
    horizon: int = 3
    clearance_factor: float | None = None
    clearance_weight: float = 100.0
    replan_steps: int = 5


TIME_ON = ("uncovered", "covered", "gained")  # numbered as in kernels/reward.py


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

    explore: float = 0.3
    overlap: float = 0.0
    time: float = 1.0
    unfinished: float = 0.0
    success: float = 100.0
    collision: float = 200.0
    points: float = 60.0
    events: float = 60.0 / 7000.0
    time_on: Literal["uncovered", "covered", "gained"] = "uncovered"
    charge_rest: bool = True


@dataclass(frozen=True)
class ObservationConfig:
    """What a robot sees.

    ``map`` is what its picture shows: what it has ``seen`` itself, or ``known`` through communication. Without
    ``pictures`` those of the robots and of the team are left out: they are most of an observation's cost. ``targets``
    is how many frontier targets it is shown to choose from, 0 for none (`maexp.envs.target_view`).
    """

    map: Literal["seen", "known"] = "seen"
    pictures: bool = True
    targets: int = 0


@dataclass(frozen=True)
class CommConfig:
    """Who hears whom (docs/conditions.md).

    Robots within ``range`` [m], in line of sight if asked, and with ``signal`` those whose signal arrives with more
    than ``threshold`` [dBm] of the ``power`` [dBm] it is sent with (`maexp.kernels.radio`). ``cell`` is the edge of
    the cells that the signal's model counts [m], "auto" an 80th of the greatest radar range, as in IR2, where a sensor
    reaches 80 cells. ``noise`` [dB] is how much each part of the loss fades at most, drawn for every pair and moment.

    ``loss`` is the probability that two radios miss what they say to each other in a local step.

    ``base_station`` is a radio with a map of its own: True stands where robot 0 starts, or it is a place (x, y) [m].

    ``strategy`` is what robots do to tell others what they know, whatever their policy (`maexp.envs.strategy`):
    nothing but to talk when they meet (``opportunistic``), or to report or meet every ``period`` decisions.
    """

    range: float = math.inf
    line_of_sight: bool = False
    signal: bool = False
    power: float = -20.0
    threshold: float = -70.0
    cell: float | Literal["auto"] = "auto"
    noise: float = 0.0
    loss: float = 0.0
    base_station: bool | tuple[float, float] = False
    strategy: Literal["opportunistic", "rendezvous", "relay", "return_to_base", "pursuit"] = "opportunistic"
    period: int = 8

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
    """Robots that fail (docs/conditions.md): they stop, see nothing, say nothing and stand in the way.

    Each fails with ``probability`` in an episode, at a moment drawn evenly over it; those of ``at``, pairs of a robot's
    number and seconds into the episode, fail at that moment. ``duration`` [s] is how long; inf: for good.
    """

    probability: float = 0.0
    at: tuple[tuple[int, float], ...] = ()
    duration: float = math.inf

    @property
    def some(self) -> bool:
        """Whether any robot may fail."""
        return self.probability > 0.0 or bool(self.at)


STRATEGIES = ("opportunistic", "rendezvous", "relay", "return_to_base", "pursuit")
DONE = ("union", "base", "everyone")
"""Whose coverage ends an episode, numbered as in kernels/radio.py: what the team has seen together, what the base
station knows, or what every robot knows that has neither collided nor failed."""
CELLS_OF_RADAR = 80  # that IR2's sensor reaches


@dataclass(frozen=True)
class TargetsConfig:
    """How robots share targets out, with any policy that chooses among them.

    ``distinct``: robots that hear each other go to different targets, farther apart than their bodies; else each goes
    where it likes best. ``spare`` says what robots do for which no target is left then: ``wait`` where they are, or go
    ``home`` to where they started.
    """

    distinct: bool = True
    spare: Literal["wait", "home"] = "wait"


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

    rollout_policy: str = "cost_utility"
    candidates: int = 5
    horizon: int = 1
    unknown: Literal["free", "nearest", "predicted"] = "free"
    margin: float = 0.02
    loss: float = 1.0
    rest: float = 1.0
    prior: float = 0.7


MOST_CANDIDATES = 64
MOST_HORIZON = 100
MOST_TARGETS = 256  # that a robot is shown
CLEARANCE = {"wavefront": 2.0, "dwa": 3.0}  # clearance factors (measured in docs/notes.md)
SIGNAL_LOSS = 31.0  # of the nearest radio's signal [dB] (`maexp.kernels.radio`)
ROBOT_KINDS = ("ackermann", "differential", "omnidirectional")
BODY = {"length": "body_length", "width": "body_width", "collision_threshold": "collision_threshold"}
"""What a radius decides: settings of a robot, and what a scenario calls them."""


def supplied(kind: type) -> list[str]:
    """Settings of a robot, radar or planner whose default is the scenario's value."""
    return [one.name for one in fields(kind) if one.default is None and one.name != "radius"]


def _complete(config, **defaults):
    """``config`` with its None fields filled in."""
    return replace(config, **{k: v for k, v in defaults.items() if getattr(config, k) is None})


def complete_robot(config: RobotConfig, scenario: Scenario) -> RobotConfig:
    """Fill in what the radius or the scenario fixes and check every value."""
    if config.radius is not None:
        scenario = scenario.with_radius(_check_radius(config))
    config = _complete(
        config,
        length=scenario.body_length,
        width=scenario.body_width,
        max_speed=scenario.max_speed,
        max_accel=scenario.max_accel,
        max_steer=scenario.max_steer,
        collision_threshold=scenario.collision_threshold,
    )
    if config.wheelbase in (None, "width", "length"):
        config = replace(config, wheelbase=getattr(config, config.wheelbase or "width"))
    elif not isinstance(config.wheelbase, int | float):
        raise ValueError(f"robot.wheelbase={config.wheelbase!r} must be metres, width or length")
    _check_choice("robot.kind", config.kind, ROBOT_KINDS)
    _check_positive("robot", config, skip=("kind", "radius"))
    if config.max_steer >= math.pi / 2:
        raise ValueError(f"robot.max_steer={config.max_steer} must stay below pi/2 = 1.5708 rad")
    return config


def _check_radius(config: RobotConfig) -> float:
    """The radius, if it is one and agrees with what else is said of the body."""
    radius = config.radius
    if isinstance(radius, bool) or not isinstance(radius, int | float) or not 0.0 < radius < math.inf:
        raise ValueError(f"robot.radius={radius!r} must be a positive finite number of metres")
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
    config = _complete(config, range=scenario.radar_range)
    _check_positive("radar", config, skip=("obstacle_radius", "alpha1", "alpha2"))
    radius = config.obstacle_radius
    if radius != "auto" and not (isinstance(radius, int | float) and 0.0 <= radius < math.inf):
        raise ValueError(f'radar.obstacle_radius={radius!r} must be "auto" or a number of metres, 0 or more')
    if not 0.0 <= config.alpha1 <= 2.0 or not math.isfinite(config.alpha2):
        raise ValueError(f"radar.alpha1={config.alpha1} must lie in [0, 2] and radar.alpha2={config.alpha2} be finite")
    return config


def complete_planner(config: PlannerConfig, scenario: Scenario) -> PlannerConfig:
    """Fill in the scenario's candidates and the planner's clearance and check every value."""
    clearance = CLEARANCE.get(config.name, scenario.clearance_factor)
    config = _complete(config, num_steering=scenario.num_steering, clearance_factor=clearance)
    _check_choice("planner.name", config.name, ("dwa", "wavefront", "direct"))
    _check_positive("planner", config, skip=("name",))
    return config


def check_reward(config: RewardConfig) -> RewardConfig:
    """Every weight must be a finite number; signs are fixed by the meaning of the terms."""
    _check_choice("reward.time_on", config.time_on, TIME_ON)
    if not isinstance(config.charge_rest, bool):
        raise ValueError(f"reward.charge_rest={config.charge_rest!r} must be true or false")
    if config.time_on == "gained" and not config.charge_rest:
        raise ValueError(
            "reward.charge_rest=False with reward.time_on='gained': nothing is charged, "
            "use true or reward.time_on=uncovered"
        )
    for f in fields(config):
        value = getattr(config, f.name)
        number = isinstance(value, int | float) and 0.0 <= value < math.inf
        if f.name not in ("time_on", "charge_rest") and not number:
            raise ValueError(f"reward.{f.name}={value!r} must be a finite number, 0 or more")
    return config


def check_observation(config: ObservationConfig, planner: PlannerConfig) -> None:
    """The settings must be known, and targets need a planner that drives to goals."""
    _check_choice("observation.map", config.map, ("seen", "known"))
    if not isinstance(config.pictures, bool):
        raise ValueError(f"observation.pictures={config.pictures!r} must be true or false")
    count = config.targets
    if isinstance(count, bool) or not isinstance(count, int) or not 0 <= count <= MOST_TARGETS:
        raise ValueError(f"observation.targets={count!r} must be a whole number from 0 to {MOST_TARGETS}")
    if count and planner.name == "direct":
        raise ValueError(f"planner=direct takes controls, observation.targets={count} shows goals: add action=regions")


def check_comm(config: CommConfig) -> CommConfig:
    """Check every value, and make a place a tuple."""
    everyone = "0 or more metres (inf: everyone hears everyone)"
    _check_number("comm.range", config.range, everyone, least=0.0, finite=False)
    for name in ("line_of_sight", "signal"):
        if not isinstance(getattr(config, name), bool):
            raise ValueError(f"comm.{name}={getattr(config, name)!r} must be true or false")
    _check_number("comm.power", config.power, "a finite number of dBm")
    _check_number("comm.threshold", config.threshold, "a finite number of dBm")
    _check_number("comm.loss", config.loss, "a share from 0 to 1 (comm.range=0 parts all)", least=0.0, most=1.0)
    _check_number("comm.noise", config.noise, "a finite number of dB, 0 or more", least=0.0)
    if config.signal and config.threshold >= config.power - SIGNAL_LOSS:
        raise ValueError(
            f"comm.threshold={config.threshold:g} dBm is out of reach: of comm.power={config.power:g} dBm "
            f"{config.power - SIGNAL_LOSS:g} arrive at best, and nobody would ever hear anybody; lower the threshold, "
            "or use comm.range=0 if that is meant"
        )
    cell = config.cell
    number = isinstance(cell, int | float) and not isinstance(cell, bool)
    if cell != "auto" and not (number and 0.0 < cell < math.inf):
        raise ValueError(f'comm.cell={cell!r} must be "auto" or a number of metres above 0')
    _check_choice("comm.strategy", config.strategy, STRATEGIES)
    if isinstance(config.period, bool) or not isinstance(config.period, int) or config.period < 1:
        raise ValueError(f"comm.period={config.period!r} must be a whole number of decisions, 1 or more")
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
    _check_number("faults.probability", config.probability, "a share in [0, 1]", least=0.0, most=1.0)
    _check_number("faults.duration", config.duration, "0.1 or more seconds (inf: for good)", least=0.1, finite=False)
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
        _check_number(f"faults.at: the moment of robot {robot}", seconds, "0 or more seconds", least=0.0)
        found[robot] = float(seconds)
    return replace(config, at=tuple(found.items()))


def check_done(done: str, comm: CommConfig) -> str:
    """Whose coverage ends an episode must be known, and there."""
    _check_choice("done", done, DONE)
    if done == "base" and not comm.has_base:
        raise ValueError("done='base' needs a base station: add comm.base_station=true")
    return done


def check_targets(config: TargetsConfig) -> TargetsConfig:
    """The settings must be known."""
    if not isinstance(config.distinct, bool):
        raise ValueError(f"targets.distinct={config.distinct!r} must be true or false")
    _check_choice("targets.spare", config.spare, ("wait", "home"))
    return config


def check_lookahead(config: LookaheadConfig) -> LookaheadConfig:
    """Counts must be whole and within reason, weights finite. Whether the rollout policy is one, the planner checks."""
    for name, most in (("candidates", MOST_CANDIDATES), ("horizon", MOST_HORIZON)):
        value = getattr(config, name)
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= most:
            raise ValueError(f"lookahead.{name}={value!r} must be a whole number from 1 to {most}")
    for name in ("margin", "loss", "rest", "prior"):
        value = getattr(config, name)
        if not isinstance(value, int | float) or isinstance(value, bool) or not 0.0 <= value < math.inf:
            raise ValueError(f"lookahead.{name}={value!r} must be a finite number, 0 or more")
    _check_choice("lookahead.unknown", config.unknown, ("free", "nearest", "predicted"))
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


def _check_number(
    name: str, value, what: str, least: float = -math.inf, most: float = math.inf, finite: bool = True
) -> None:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not (number and least <= value <= most and (math.isfinite(value) or (not finite and value == math.inf))):
        raise ValueError(f"{name}={value!r} must be {what}")


def _check_choice(name: str, value, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise ValueError(f"{name}={value!r} is unknown: choose one of {', '.join(choices)}")


def _check_positive(group: str, config, skip: tuple[str, ...]) -> None:
    for f in fields(config):
        value = getattr(config, f.name)
        if f.name not in skip and not (isinstance(value, int | float) and 0.0 < value < math.inf):
            raise ValueError(f"{group}.{f.name}={value!r} must be a positive finite number")
