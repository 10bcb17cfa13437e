"""What a learned choice among frontier targets sees of each, for tensors of many teams as for NumPy arrays of one.

Lengths count in radar ranges and areas in radar discs, so that one policy fits every scenario and team size. The
features of a candidate contain what the classical planner `cost_utility` would think of it, and what others weigh: a
policy starts from there.

A feature is a row of `TABLE`: a name, what a function makes of the `FeatureInputs`, a unit and a line of meaning.
    Simulator
(`maexp.envs.targets.observation`) and robots (`maexp.agents.deploy.planner.features`) fill in the moment. Imports
neither torch nor Warp.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

from maexp.envs.config.comm import CommConfig
from maexp.envs.targets.heuristics import BETA, LEAST_GAIN, Array
from maexp.kernels.constants import BLOCKED_LOSS, CLEAR_CELLS, CLEAR_LOSS, LOSS

FAR = 4.0  # lengths between targets and robots count up to so many radar ranges
NEAR, AROUND = 1.0, 2.5  # radar ranges within which the gain of other candidates is added up
PACE = 0.7  # share of its greatest speed that a robot counts on for its way back
DETOUR = 1.5  # how much longer than the straight line it takes its way back to be
EDGE = 1e-4  # added to these: many points of a grid are just so far apart, and rounding must not decide
RANGES, DISCS, COSINE, SINE = "radar ranges", "radar discs", "cosine, from the heading", "sine, left of the heading"
FLAG = "0 or 1"
ZERO = ("gain", "gain_near", "gain_around", "size", "claimed", "planned")
FAR_AWAY = ("plan_gap", "own_last", "mates_last", "rival")
"""What the target to tell the base station has nothing of, and is far from."""


@dataclass(frozen=True)
class Contacts:
    """What robots know of who was connected when, by their own memory (`maexp.envs.comm.strategy`), and of the base
    station. Where there is none, or nobody else, its numbers are 0. Connected is also who is so over others.

    Attributes:
        tells: bool [..., N, M], the candidate that is no frontier: to go to the base station and tell it.
        untold: what the robot knows and the base station did not know when they were last connected [radar discs],
            this one and the following [..., N, 1].
        since: time since then, of the whole time; never counts from the decision before the first.
        linked: bool, whether they are connected now.
        way: to the base station [radar ranges].
        spare: time that is left when the robot gets there, of the whole time.
        mates_untold, mates_since: the same of the mate that lacks most, and of all mates on average.
        far: from the candidate to the base station [radar ranges], [..., N, M].
        signal: how much more than a link needs would arrive there from the base station, by what the robot knows, the
            unknown as walls [10 dB]; of radios without a signal 1 where they hear each other and -1 where not.
        mates_far: from the candidate to the nearest place where a mate was last heard [radar ranges], large for none.
    """

    tells: Array
    untold: Array
    since: Array
    linked: Array
    way: Array
    spare: Array
    mates_untold: Array
    mates_since: Array
    far: Array
    signal: Array
    mates_far: Array


@dataclass(frozen=True)
class FeatureInputs:
    """What is known when N robots of a team choose among M candidates each; `...` are the teams, where there are
    several, and D the coordinates of a point, 2 or 3. What stands for candidates that are absent is left to whoever
    fills it in.

    Attributes:
        xp: torch or numpy.
        reach: the radar's range [m].
        mask: bool [..., N, M], which candidates there are.
        travel: [..., N, M], length of the way [radar ranges], 0 for those that are absent.
        to: [..., N, M, D], from the robot to the candidate [m].
        way: [..., N, M, D], from the robot to a point near the beginning of its way [m].
        toward: [..., N, M, D], from the candidate to the middle of the unknown beyond it [m].
        gain: [..., N, M], what is to be seen from there [radar discs].
        gain_near, gain_around: [..., N, M], the same of all candidates within `NEAR` and `AROUND` of it, added up.
        size: [..., N, M], frontier cells.
        value: [..., N, M], of `value_targets`.
        score, claimed: [..., N, M], of `plan_in_turn`.
        planned: bool [..., N, M], the candidate that `plan_in_turn` takes.
        plan_gap, own_last, mates_last: [..., N, M], distance to the nearest candidate that another robot takes there,
            to the own latest target, to the nearest latest target of another [radar ranges], large where there is none.
        rival: [..., N, M], the shortest way of another robot [radar ranges], large where there is none.
        at: [..., N, D], where the robots are [m].
        heading, speed, max_speed: of the robots, [..., N, 1] [rad, m/s, m/s]; a limit that all share may be a number.
        drive: [..., N, 1], how far they get until the next decision [m].
        mates: bool [..., N, N], others that move and that a robot hears.
        time_left: share of the whole time, [..., 1, 1], or a number where there is one team.
        area: what the robots know [m^2], [..., 1 or N, 1] or a number; of a volume, that of as many radar discs.
        radio: what they know of who has heard what, where they are told (``observation.radio``).
    """

    xp: Any
    reach: float
    mask: Array
    travel: Array
    to: Array
    way: Array
    toward: Array
    gain: Array
    gain_near: Array
    gain_around: Array
    size: Array
    value: Array
    score: Array
    claimed: Array
    planned: Array
    plan_gap: Array
    own_last: Array
    mates_last: Array
    rival: Array
    at: Array
    heading: Array
    speed: Array
    max_speed: Array
    drive: Array
    mates: Array
    time_left: Array
    area: Array
    radio: Any = None  # `Contacts`

    @cached_property
    def table(self) -> dict[str, Feature]:
        """The features that are told."""
        return TABLE if self.radio is None else TABLE | RADIO_TABLE

    @cached_property
    def frontiers(self) -> Array:
        """The candidates that are frontier targets, bool [..., N, M]."""
        return self.mask if self.radio is None else self.mask & ~self.radio.tells

    @cached_property
    def distance(self) -> Array:
        """Straight to the candidate [radar ranges], [..., N, M]."""
        return self.length(self.to)

    @cached_property
    def ahead(self) -> Array:
        """Where robots look, [..., N, 1, 2]."""
        return self.xp.stack([self.xp.cos(self.heading), self.xp.sin(self.heading)], -1)

    @cached_property
    def bearings(self) -> tuple[tuple[Array, Array], ...]:
        """Cosine and sine of `to`, `way` and `toward` from the heading, [..., N, M] each."""
        return tuple(self._bearing(vector) for vector in (self.to, self.way, self.toward))

    def _bearing(self, vector: Array) -> tuple[Array, Array]:
        xp, ahead = self.xp, self.ahead
        unit = (vector / xp.clip(xp.linalg.norm(vector, axis=-1, keepdims=True), 1e-6, None))[..., :2]
        return xp.sum(unit * ahead, axis=-1), unit[..., 1] * ahead[..., 0] - unit[..., 0] * ahead[..., 1]

    def length(self, vectors: Array) -> Array:
        """[radar ranges]."""
        return self.xp.linalg.norm(vectors, axis=-1) / self.reach

    def near(self, ranges: Array) -> Array:
        """At most `FAR`."""
        return self.xp.clip(ranges, None, FAR)

    def count(self, flags: Array) -> Array:
        """How many of the last axis are true, [..., 1]."""
        return self.xp.sum(flags, -1, dtype=self.travel.dtype)[..., None]

    def features(self) -> Array:
        """[..., N, M, F], in the order of `feature_names`; 0 where there is no candidate."""
        xp = self.xp
        columns = [xp.asarray(feature.of(self), dtype=self.travel.dtype) for feature in self.table.values()]
        columns = [xp.broadcast_to(column, self.mask.shape) for column in columns]
        return xp.where(self.mask[..., None], xp.stack(columns, -1), 0.0)


class Feature(NamedTuple):
    """What it is made of, [..., N, M] or to be broadcast to that; its unit; its meaning."""

    of: Callable[[FeatureInputs], Array]
    unit: str
    meaning: str


TABLE: dict[str, Feature] = {
    # What cost_utility would do.
    "score": Feature(lambda now: now.score, DISCS, "value when it is the robot's turn"),
    "value": Feature(lambda now: now.xp.clip(now.value, -FAR, None), DISCS, "value without the others"),
    "planned": Feature(lambda now: 1.0 * now.planned, FLAG, "whether the robot takes it"),
    "claimed": Feature(lambda now: now.claimed, "share", "of the gain, that robots before it have claimed"),
    "plan_gap": Feature(lambda now: now.near(now.plan_gap), RANGES, "to the nearest target that another robot takes"),
    # The way.
    "travel": Feature(lambda now: now.xp.log1p(now.travel), f"log(1 + {RANGES})", "length of the way"),
    "nearness": Feature(lambda now: 1.0 / (1.0 + now.travel), f"1 / (1 + {RANGES})", "length of the way"),
    "distance": Feature(lambda now: now.distance, RANGES, "straight distance"),
    "detour": Feature(
        lambda now: now.near(now.travel / now.xp.clip(now.distance, 0.1, None)) - 1.0, "ratio - 1", "way over distance"
    ),
    # What is to be seen from there.
    "gain": Feature(lambda now: now.gain, DISCS, "unknown area in sight"),
    "size": Feature(lambda now: now.size / 10.0, "10 cells", "frontier cells"),
    "worth": Feature(lambda now: 1.0 * (now.gain >= LEAST_GAIN), FLAG, "whether it is worth going to at once"),
    "gain_near": Feature(lambda now: now.gain_near, DISCS, f"gain of the candidates within {NEAR:g} range"),
    "gain_around": Feature(lambda now: now.gain_around / 4.0, f"4 {DISCS}", f"the same within {AROUND:g} ranges"),
    # Where it lies.
    "ahead": Feature(lambda now: now.bearings[0][0], COSINE, "where it lies"),
    "aside": Feature(lambda now: now.bearings[0][1], SINE, "where it lies"),
    "way_ahead": Feature(lambda now: now.bearings[1][0], COSINE, "where the way begins"),
    "way_aside": Feature(lambda now: now.bearings[1][1], SINE, "where the way begins"),
    "unknown_ahead": Feature(lambda now: now.bearings[2][0], COSINE, "where the unknown beyond it lies"),
    "unknown_aside": Feature(lambda now: now.bearings[2][1], SINE, "where the unknown beyond it lies"),
    "unknown_far": Feature(lambda now: now.length(now.toward), RANGES, "to the middle of the unknown, from there"),
    # The others.
    "rival": Feature(lambda now: now.xp.clip(now.rival, None, 2 * FAR), RANGES, "shortest way of another robot"),
    "lead": Feature(lambda now: now.xp.clip(now.rival - now.travel, -FAR, FAR), RANGES, "that less the own way"),
    "nearest": Feature(lambda now: 1.0 * (now.travel <= now.rival), FLAG, "whether the own way is the shortest"),
    "own_last": Feature(lambda now: now.near(now.own_last), RANGES, "to the own latest target"),
    "mates_last": Feature(lambda now: now.near(now.mates_last), RANGES, "to the nearest latest target of another"),
    # The robot and its team, the same for all candidates.
    "count": Feature(lambda now: now.count(now.frontiers) / 10.0, "10 candidates", "how many there are"),
    "speed": Feature(lambda now: now.speed / now.max_speed, "of max_speed", "speed"),
    "drive": Feature(lambda now: now.drive / now.reach, RANGES, "way driven until the next decision"),
    "time_left": Feature(lambda now: now.time_left, "share of the whole time", "time left"),
    "known": Feature(
        lambda now: now.xp.log(1.0 + now.area / (math.pi * now.reach**2)), f"log(1 + {DISCS})", "area known"
    ),
    "mates": Feature(lambda now: now.count(now.mates) / 4.0, "4 robots", "others that move"),
}
FEATURES = tuple(TABLE)
"""Names of the last axis of the features."""


def _log_discs(name: str) -> Callable[[FeatureInputs], Array]:
    return lambda now: now.xp.log1p(now.xp.clip(getattr(now.radio, name), 0.0, None))


RADIO_TABLE: dict[str, Feature] = {
    "tells": Feature(lambda now: 1.0 * now.radio.tells, FLAG, "whether it is to go and tell the base station"),
    "untold": Feature(_log_discs("untold"), f"log(1 + {DISCS})", "area that the base station lacks"),
    "base_since": Feature(lambda now: now.radio.since, "share of the whole time", "since it was last connected"),
    "base_linked": Feature(lambda now: 1.0 * now.radio.linked, FLAG, "whether it is connected now"),
    "base_way": Feature(lambda now: now.xp.log1p(now.radio.way), f"log(1 + {RANGES})", "way of the robot to it"),
    "base_spare": Feature(lambda now: now.radio.spare, "share of the whole time", "left when the robot gets there"),
    "base_far": Feature(lambda now: now.xp.log1p(now.radio.far), f"log(1 + {RANGES})", "from the candidate to it"),
    "base_signal": Feature(
        lambda now: now.xp.clip(now.radio.signal, -FAR, FAR), "10 dB", "its signal at the candidate, beyond a link's"
    ),
    "mates_untold": Feature(_log_discs("mates_untold"), f"log(1 + {DISCS})", "area that a mate lacks at most"),
    "mates_since": Feature(lambda now: now.radio.mates_since, "share of the whole time", "since mates were connected"),
    "mates_far": Feature(lambda now: now.near(now.radio.mates_far), RANGES, "to where the nearest mate was heard"),
}
"""What is told besides with ``observation.radio``, after the others; where a policy was trained without it, it looks
at the others alone."""


def feature_names(radio: bool = False) -> tuple[str, ...]:
    """Names of the last axis of the features, with those of radios or without."""
    return (*TABLE, *RADIO_TABLE) if radio else FEATURES


def drive_until_next(xp: Any, speed: Array, max_accel: Array, max_speed: Array, seconds: float) -> Array:
    """How far robots get until the next decision [m], from their speeds [m/s]."""
    return xp.clip(speed * seconds + 0.5 * max_accel * seconds**2, None, max_speed * seconds)


def add_telling(inputs: FeatureInputs, can: Array, way: Array, begin: Array, to: Array) -> FeatureInputs:
    """The moment with one candidate more, [..., N, M + 1]: to go and tell the base station.

    Args:
        can: bool [..., N, 1], robots that have this choice.
        way: [..., N, 1], how far it is [m].
        begin, to: [..., N, 1, 2], from the robot to a point near the beginning of the way, and to the base station [m].
    """
    xp = inputs.xp
    way = xp.where(can, way / inputs.reach, 0.0)
    blank = xp.zeros_like(way)
    more = dict.fromkeys(ZERO, blank) | {name: xp.full_like(blank, xp.inf) for name in FAR_AWAY}
    more |= {"mask": can, "travel": way, "to": to, "way": begin, "toward": xp.zeros_like(to)}
    more |= {"value": -BETA * way, "score": -BETA * way}
    axis = can.ndim - 1
    wider = {name: xp.concatenate([getattr(inputs, name), columns], axis) for name, columns in more.items()}
    return replace(inputs, **wider)


def predict_margin(xp: Any, comm: CommConfig, cell: float, gap: Array, blocked: Array, edge: Array) -> Array:
    """How much more than a link needs would arrive over straight lines [10 dB], without fading; of radios without a
    signal 1 where they hear each other and -1 where not.

    Args:
        cell: edge of a cell of the signal's model [m].
        gap: length of the lines [m].
        blocked: cells along them that are no free ground; any where neither signal nor line of sight counts.
        edge: of these cells [m], a number or to be broadcast.
    """
    margin = xp.ones_like(gap)
    if comm.signal:
        walls = blocked * (edge / cell)
        clear = gap / cell - walls
        margin = xp.full_like(gap, comm.power - LOSS - comm.threshold)
        margin = margin - xp.where(walls > 0.0, BLOCKED_LOSS * xp.log10(xp.clip(walls, 1.0, None)), 0.0)
        margin = (margin - CLEAR_LOSS * xp.log10(xp.clip(clear / CLEAR_CELLS, 1.0, None))) / 10.0
    if comm.line_of_sight:
        margin = xp.where(blocked > 0, xp.clip(margin, None, -1.0), margin)
    if math.isfinite(comm.range):
        margin = xp.where(gap > comm.range, xp.clip(margin, None, -1.0), margin)
    return margin
