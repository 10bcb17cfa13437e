"""Comparison on the same episodes: paired differences, the best classical planner, a sentence that sums them up."""

import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from typing import Any

import numpy as np

from maexp.agents.build import MapSuite, make_env
from maexp.agents.config.verbs import EpisodeSettings
from maexp.agents.evaluation.evaluate import EvaluationResult, evaluate
from maexp.agents.evaluation.metric_format import compared, verdict
from maexp.agents.evaluation.results import result_names
from maexp.agents.policies.classical import CLASSICAL, PLANAR, POLICIES
from maexp.agents.progress import Progress
from maexp.envs import ExplorationEnv

_kept: ContextVar[dict[tuple, EvaluationResult] | None] = ContextVar("kept", default=None)


@contextmanager
def keeping_episodes() -> Iterator[None]:
    """Within it what `play_once` played is not played again in an equal env."""
    token = _kept.set({})
    try:
        yield
    finally:
        _kept.reset(token)


def play_once(name: str, env: ExplorationEnv, play: Callable[[], EvaluationResult], *played: Any) -> EvaluationResult:
    """What a policy that learns nothing does in an env.

    Args:
        name: of the policy.
        env: where `play` plays it.
        played: all else that its episodes depend on, as their number and seed.
    """
    kept = _kept.get()
    if kept is None:
        return play()
    starts = env.simulation.tensors["starts"].cpu().numpy()
    clouds = (env.starts, *(points for m in env.maps for points in (m.name, m.free, m.boundary)))
    content = zlib.crc32(starts.tobytes())
    for cloud in clouds:
        content = zlib.crc32(cloud.encode() if isinstance(cloud, str) else cloud.tobytes(), content)
    key = (name, repr(env.settings), content, *played)
    if key not in kept:
        kept[key] = play()
    return kept[key]


CHOOSING = 64  # episodes on validation maps that tell which classical planner is the best
DECIDES = "coverage_auc"
STARTS = {"untrained": "the untrained team", "warm_start": "the warm start"}
"""Name of what a training started from -> what sentences call it."""


def choose_best(cfg: EpisodeSettings, suite: MapSuite, names: Sequence[str], num_robots: int) -> str | None:
    """The classical planner among `names` that sees most over time on the validation maps; None where there is none."""
    planners = [name for name in names if name in CLASSICAL]
    if len(planners) < 2:
        return next(iter(planners), None)
    count = min(CHOOSING, cfg.episodes)
    env = make_env(cfg, suite.validation, num_robots, min(cfg.num_envs, count))
    return play_best(env, planners, count, cfg.seed).policy


def play_best(env: ExplorationEnv, planners: Sequence[str], count: int, seed: int) -> EvaluationResult:
    """The episodes 0 .. `count` - 1 of the classical planner that sees most over time in them."""
    planners = [name for name in planners if env.space.DIMENSIONS == 2 or name not in PLANAR]
    with Progress("best classical planner on validation maps", count * len(planners)) as progress:

        def play(name: str) -> EvaluationResult:
            return evaluate(POLICIES[name](env), env, count, name=name, seed=seed, advance=progress.advance)

        played = {name: [play_once(name, env, partial(play, name), count, seed)] for name in planners}
    return played[find_best(played)][0]


def find_best(played: dict[str, Sequence[EvaluationResult]]) -> str | None:
    """The policy that saw most over time, the first of equals; None where there is none.

    Args:
        played: policy -> its results, each of the same weight, on validation maps.
    """
    scores = {
        name: np.mean([result.episodes[DECIDES].mean() for result in results])
        for name, results in played.items()
        if results
    }
    return max(scores, key=scores.get, default=None)


def describe_differences(results: list[EvaluationResult], best: dict[int, str | None]) -> list[str]:
    """A sentence for each learned team on all maps: how far it is ahead of the best classical planner of its size.

    Args:
        best: team size -> its name
    """
    whole = [result for result in results if not result.place]
    rivals = {result.num_robots: result for result in whole if result.policy == best.get(result.num_robots)}
    return [
        _describe(
            name,
            f"{rivals[result.num_robots].policy}, the best classical planner on the validation maps",
            result.minus(rivals[result.num_robots]),
            result.success_coverage,
        )
        for name, result in zip(result_names(whole), whole, strict=True)
        if result.learned and result.num_robots in rivals
    ]


def describe_training(results: list[EvaluationResult]) -> list[str]:
    """A sentence for each size of the trained team: how far it is ahead of what it started from."""
    starts = {result.num_robots: result for result in results if result.policy in STARTS}
    return [
        _describe(name, STARTS[start.policy], result.minus(start), result.success_coverage)
        for name, result in zip(result_names(results), results, strict=True)
        if result.policy == "trained" and (start := starts.get(result.num_robots))
    ]


def find_typical(result: EvaluationResult, other: EvaluationResult | None, among: int) -> tuple[int, float, float]:
    """The episode that stands for the mean: of the first `among`, the one whose difference in coverage over time is
    closest to the mean of all.

    Args:
        other: less whom, on the same episodes; None: nobody

    Returns:
        Its number, its difference and the mean.
    """
    apart = result.episodes[DECIDES] - (0.0 if other is None else other.episodes[DECIDES])
    number = int(np.abs(apart[:among] - apart.mean()).argmin())
    return number, float(apart[number]), float(apart.mean())


def _describe(name: str, rival: str, found: dict[str, dict], goal: float) -> str:
    apart = ", ".join(
        measure.describe_difference(found[measure.metric])
        for measure in compared(goal)
        if measure.metric != "collisions"
    )
    name = name.replace("trained", "The trained team", 1)
    return f"{name} {verdict(found[DECIDES])} {rival}: {apart}."
