"""How metrics of episodes are written: headings, units, digits, and what a mean and its interval rest on."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from maexp.agents.tables import Write, brackets, estimate, fixed
from maexp.envs.metrics import LEAST_DISTINCT, has_interval, in_reach


@dataclass(frozen=True)
class Measure:
    """How a metric is told.

    Attributes:
        metric: its name
        column: heading of a column
        title: of a plot
        unit: "%": of a share, which is told times 100
        digits: of a mean in that unit
        better: 1: more is better, -1: less
        symbol: heading in the paper's table
        words: what a difference is of, after its number
    """

    metric: str
    column: str
    title: str
    unit: str
    digits: int
    better: int = -1
    symbol: str = ""
    words: str = ""

    @property
    def factor(self) -> float:
        return {"%": 100.0, "kB": 1e-3}.get(self.unit, 1.0)

    @property
    def write(self) -> Write:
        """In its unit."""
        return fixed(self.digits, self.factor)

    @property
    def plain(self) -> Write:
        """As files have it: a share in [0, 1]."""
        return fixed(self.digits + 2 * (self.unit == "%"))

    @property
    def heading(self) -> str:
        """Symbol, unit, and an arrow to the better."""
        return " ".join(filter(None, (self.symbol, self.unit, "↑" if self.better > 0 else "↓")))

    def difference(self, found: dict) -> str:
        """+1.2 [+0.3, +2.1] of {mean, ci95, n}."""
        return estimate(found, fixed(self.digits, self.factor, "+"))

    def describe_difference(self, found: dict, digits: int | None = None) -> str:
        """+1.2 points of coverage over time [+0.3, +2.1]."""
        write = fixed(self.digits if digits is None else digits, self.factor, "+")
        return f"{write(found['mean'])} {self.words}{brackets(found, write)}"


MEASURES = {
    measure.metric: measure
    for measure in (
        Measure("exploration_ratio", "coverage", "Coverage at the end", "%", 1, 1, "ER"),
        Measure(
            "coverage_auc",
            "over time",
            "Mean coverage over the episode",
            "%",
            1,
            1,
            "AUC",
            "points of coverage over time",
        ),
        Measure("success_rate", "success", "Success rate", "%", 1, 1),
        Measure("coverage_step_85", "85 % at step", "Time to 85 % coverage", "steps", 0, symbol="CS85"),
        Measure("coverage_step_85_censored", "85 % censored", "Time to 85 % or the limit", "steps", 0),
        Measure("coverage_step_95", "95 % at step", "Time to 95 % coverage", "steps", 0, symbol="CS95"),
        Measure(
            "coverage_step_95_censored",
            "95 % censored",
            "Time to 95 % or the limit",
            "steps",
            0,
            symbol="to 95",
            words="steps to 95 %",
        ),
        Measure("coverage_step_99", "99 % at step", "Time to 99 % coverage", "steps", 0, symbol="CS99"),
        Measure(
            "coverage_step_99_censored",
            "99 % censored",
            "Time to 99 % or the limit",
            "steps",
            0,
            symbol="to 99",
            words="steps to 99 %",
        ),
        Measure("mutual_overlap_85", "overlap", "Overlap at 85 % coverage", "%", 1, symbol="MO85"),
        Measure("mutual_overlap_95", "overlap at 95 %", "Overlap at 95 % coverage", "%", 1, symbol="MO95"),
        Measure("collisions", "collisions", "Collisions", "robots", 3, words="robots lost"),
        Measure("path_length", "path [m]", "Path of a robot", "m", 0),
        Measure("longest_path", "longest path [m]", "Longest path in a team", "m", 0),
        Measure("reward_variance", "spread", "Spread of unscaled reward over robots", "", 0, symbol="RV"),
        Measure("base_coverage_auc", "base over time", "Coverage of the base station over the episode", "%", 1, 1),
        Measure("worst_coverage_auc", "worst over time", "Coverage of the robot that knows least", "%", 1, 1),
        Measure("told_step_95_censored", "told 95 %", "Time until all know 95 % or the limit", "steps", 0),
        Measure("connected", "connected", "Steps in which a robot is connected", "%", 0, 1),
        Measure("bytes_sent", "sent", "What all radios send", "kB", 0),
        Measure("odometry_error", "off", "Distance from where robots believe to be", "m", 2),
        Measure("map_error", "maps off", "Distance of known ground from where it is drawn", "m", 2),
    )
}
"""Metric of `envs.metrics.episode_metrics` -> how it is told; the order is that of tables and plots."""


def compared(goal: float) -> list[Measure]:
    """What differences of episodes that end at the coverage `goal` are told in."""
    return [measure for measure in MEASURES.values() if measure.words and in_reach(measure.metric, goal)]


FEW_MAPS = 5
"""Fewer maps than these are named: an interval that resamples them is too narrow for others."""


class Evidence(NamedTuple):
    """What the figures of a policy rest on: episodes, those that are no copies, maps."""

    policy: str
    episodes: int
    distinct: int
    maps: int


def describe_evidence(found: Sequence[Evidence]) -> list[str]:
    """Sentences on copies, few episodes and few maps; none where there is enough of all."""
    sentences = []
    for kind in dict.fromkeys((evidence.episodes, evidence.distinct) for evidence in found):
        names = [evidence.policy for evidence in found if (evidence.episodes, evidence.distinct) == kind]
        sentences += _describe_episodes(*kind, names if len(names) < len(found) else [])
    some = [evidence.maps for evidence in found if evidence.distinct >= LEAST_DISTINCT]
    if some and min(some) < FEW_MAPS:
        count = min(some)
        sentences.append(f"The intervals rest on {_count(count, 'map')}: they tell little of others.")
    return sentences


def _describe_episodes(episodes: int, distinct: int, names: list[str]) -> list[str]:
    """Of the policies `names`, or of all."""
    whose = f" of {', '.join(names)}" if names else ""
    if distinct == episodes:
        told = f"{_count(episodes, 'episode')}{whose}"
    else:
        verb = "is" if distinct == 1 else "are"
        told = f"Of {_count(episodes, 'episode')}{whose} {distinct} {verb} distinct, the rest copies"
    if distinct < LEAST_DISTINCT:
        return [f"{told}: too few for an interval, which takes {LEAST_DISTINCT}."]
    return [] if distinct == episodes else [f"{told}: the intervals count each once."]


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"


def verdict(found: dict) -> str:
    """What a difference {mean, ci95, n}, of which more is better, says of one policy and another."""
    if not has_interval(found):
        return "has played too few distinct episodes to be compared with"
    low, high = found["ci95"]
    return "is ahead of" if low > 0 else "is behind" if high < 0 else "cannot be told from"
