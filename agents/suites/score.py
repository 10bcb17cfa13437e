"""The score of a suite: mean over its episodes, beside `random` (0) and the reference planner (1), with intervals.

Intervals resample the maps of each part and the episodes on each, copies together. Differences are paired: the same
episodes.
"""

from typing import Any

import numpy as np

from maexp.agents.benchmark.compare import improvement
from maexp.agents.evaluation.evaluate import EvaluationResult
from maexp.agents.suites.suite import SCORE, Suite
from maexp.agents.tables import NONE, POINTS, brackets, estimate, fixed
from maexp.envs.metrics import LEAST_DISTINCT, resample_weights, resampled_means

Results = dict[str, EvaluationResult]  # part -> its episodes
RANDOM = "random"
SCORED = {
    "coverage_auc": "the share of the place that the team has seen",
    "base_coverage_auc": "the share of the place that the base station knows",
    "worst_coverage_auc": "the share of the place that the robot knows that knows least",
}
"""What scores are in words."""
LEVELS = 101  # of a performance profile, from 0 to 1


def to_result(suite: Suite, policy: str, part: str, episodes: dict[str, np.ndarray], maps: Any) -> EvaluationResult:
    """The episodes of a part: each metric's values [episodes], and `SCORE` where parts have different scores."""
    own = {SCORE: episodes[suite.scores[part]]} if suite.score == SCORE else {}
    return EvaluationResult(policy, suite.parts[part].num_robots, episodes | own, 0.0, maps)


def describe_score(scores: dict[str, str]) -> str:
    """What is scored, of the metric of each part: "mean coverage_auc, the share of ... seen, on average over time"."""
    parts: dict[str, list[str]] = {}
    for part, metric in scores.items():
        parts.setdefault(metric, []).append(part)
    told = [f"{metric}, {SCORED[metric]}" if metric in SCORED else metric for metric in parts]
    if len(parts) > 1:
        told = [f"{metric} ({', '.join(names)})" for metric, names in zip(told, parts.values(), strict=True)]
    return f"mean {'; '.join(told)}{', on average over the time' * any(metric in SCORED for metric in parts)}"


def summarise_suite(suite: Suite, mine: Results, frozen: dict[str, Results]) -> dict[str, Any]:
    """All that follows from the episodes of a policy.

    Args:
        mine: its episodes
        frozen: those of `random` and of the reference planner, by name
    """
    name, theirs, worst = suite.score, frozen[suite.reference], frozen[RANDOM]
    own, zero, reference = (_values(name, results) for results in (mine, worst, theirs))
    ends = {part: (zero[part].mean(), reference[part].mean()) for part in own}
    overall = mean_over_parts(own, mine)
    copies = tuple({part: result.copies() for part, result in results.items()} for results in (mine, theirs))
    return {
        "score": overall | {"normalised": place_between(overall["mean"], mean_of(zero), mean_of(reference))},
        "parts": {
            part: result.summary() | {"normalised": place_between(own[part].mean(), *ends[part])}
            for part, result in mine.items()
        },
        RANDOM: {"score": mean_of(zero), "parts": {part: float(scores.mean()) for part, scores in zero.items()}},
        "reference": {
            "policy": suite.reference,
            "score": mean_of(reference),
            "parts": {part: float(values.mean()) for part, values in reference.items()},
            "difference": {metric: subtract(mine, theirs, metric) for metric in dict.fromkeys((*suite.metrics, name))},
            "differences": {part: result.minus(theirs[part])[name] for part, result in mine.items()},
            "improvement": improvement(own, reference, copies),
        },
        "profile": {
            name: np.linspace(0.0, 1.0, LEVELS).round(3).tolist(),
            "policy": profile(own),
            RANDOM: profile(zero),
            "reference": profile(reference),
        },
    }


def mean_of(values: dict[str, np.ndarray]) -> float:
    """Mean over parts of the means of their episodes."""
    return float(np.mean([value.mean() for value in values.values()]))


def mean_over_parts(values: dict[str, np.ndarray], *results: Results) -> dict[str, Any]:
    """{mean, ci95, n} of values [episodes] of each part; NaN where an episode has none.

    Args:
        values: part -> a value for each episode
        results: what they are of: one's episodes, or those of two that played the same
    """
    kept = {part: ~np.isnan(value) for part, value in values.items()}
    have = {part: value for part, value in values.items() if kept[part].any()}
    if not have:
        return {"mean": np.nan, "ci95": [np.nan, np.nan], "n": 0}
    means, distinct = [], 0
    for number, (part, value) in enumerate(have.items()):
        first, *others = (played[part] for played in results)
        copies = first.copies(*others)
        distinct += len(np.unique(copies[kept[part]]))
        weights = resample_weights(first.maps, copies=copies, seed=number)[:, kept[part]]
        drawn = resampled_means(value[kept[part]], weights)
        means.append(np.resize(drawn, len(weights)))  # a resample without any value is left out: others stand for it
    ends = np.percentile(np.mean(means, axis=0), [2.5, 97.5])
    ends = ends.tolist() if distinct >= LEAST_DISTINCT else [np.nan, np.nan]
    middle = mean_of({part: value[kept[part]] for part, value in have.items()})
    return {"mean": middle, "ci95": ends, "n": int(sum(value.sum() for value in kept.values()))}


def subtract(mine: Results, theirs: Results, metric: str) -> dict[str, Any]:
    """`mean_over_parts` of the paired differences."""
    pairs = {part: result.episodes[metric] - theirs[part].episodes[metric] for part, result in mine.items()}
    return mean_over_parts(pairs, mine, theirs)


def place_between(value: float, zero: float, reference: float) -> float | None:
    """Where a score lies between that of `random` (0) and that of the reference (1); None where these are the same."""
    return None if reference == zero else float((value - zero) / (reference - zero))


def profile(values: dict[str, np.ndarray]) -> list[float]:
    """Performance profile (Agarwal et al. 2021): the share of episodes above each level, every part counting alike."""
    levels = np.linspace(0.0, 1.0, LEVELS)
    shares = [(value[:, None] > levels).mean(0) for value in values.values()]
    return np.mean(shares, axis=0).round(6).tolist()


def _values(metric: str, results: Results) -> dict[str, np.ndarray]:
    return {part: result.episodes[metric] for part, result in results.items()}


def score_cells(
    score: dict[str, Any], normalised: float | None, less: dict[str, Any], ends: tuple[float, ...] = ()
) -> list[str]:
    """What tables show of a score {mean, ci95, n}: with `ends`, the scores of `random` and the reference, before where
    it lies between them, and `less`, in points how far it is from the reference."""
    share, between = fixed(3), NONE if normalised is None else fixed(2)(normalised)
    interval = brackets(score, share).strip() or NONE
    return [share(score["mean"]), interval, *map(share, ends), between, estimate(less, POINTS)]
