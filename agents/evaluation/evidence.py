"""What a mean, an interval and a comparison rest on, and how that is said."""

from collections.abc import Sequence
from typing import NamedTuple

from maexp.envs.metrics import LEAST_DISTINCT, has_interval

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
