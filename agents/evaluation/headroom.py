"""How much of what there is to win a policy wins: its share of the lead of a search that knows the true map."""

import numpy as np

from maexp.agents.evaluation.evaluate import EvaluationResult
from maexp.envs.metrics import LEAST_DISTINCT, resample_weights, resampled_means

BASE, CEILING = "cost_utility", "clairvoyant"
"""The planner that leads are measured from, and the reference whose lead is the headroom."""


def headroom_shares(results: list[EvaluationResult], names: list[str]) -> dict[str, dict]:
    """The lead over `BASE` in coverage over time as a share of the lead of `CEILING`, on the same episodes.

    Args:
        results: of all policies.
        names: what each is called.

    Returns:
        {name: {mean, ci95: [low, high], n}} of the others, where both were played in the same place with a team of the
        same size and `CEILING` is ahead in all resamples of maps and of at least `LEAST_DISTINCT` distinct episodes.
    """
    groups: dict[tuple, list[tuple[str, EvaluationResult]]] = {}
    for name, result in zip(names, results, strict=True):
        groups.setdefault((result.place, result.num_robots), []).append((name, result))
    found = {}
    for group in groups.values():
        known = {result.policy: result for _, result in group}
        if BASE in known and CEILING in known:
            others = {name: result for name, result in group if result.policy not in (BASE, CEILING)}
            found |= _shares(others, known[BASE], known[CEILING])
    return found


def describe_shares(results: list[EvaluationResult], names: list[str]) -> list[str]:
    """A sentence for each share."""
    sentences = []
    for name, figures in headroom_shares(results, names).items():
        mean, low, high = (f"{100 * share:.0f}" for share in (figures["mean"], *figures["ci95"]))
        lead = f"the lead of {CEILING} over {BASE} in coverage over time"
        sentences.append(f"{name} wins {mean} % [{low}, {high}] of the headroom, {lead}.")
    return sentences


def _shares(others: dict[str, EvaluationResult], base: EvaluationResult, ceiling: EvaluationResult) -> dict[str, dict]:
    headroom, found = _lead(ceiling, base), {}
    for name, result in others.items():
        copies = base.copies(ceiling, result)
        weights = resample_weights(base.maps, copies=copies)
        drawn = resampled_means(headroom, weights)
        if headroom.mean() <= 0.0 or drawn.min() <= 0.0 or len(np.unique(copies)) < LEAST_DISTINCT:
            continue
        lead = _lead(result, base)
        low, high = np.percentile(resampled_means(lead, weights) / drawn, [2.5, 97.5])
        found[name] = {"mean": float(lead.mean() / headroom.mean()), "ci95": [float(low), float(high)], "n": len(lead)}
    return found


def _lead(result: EvaluationResult, base: EvaluationResult) -> np.ndarray:
    return result.episodes["coverage_auc"] - base.episodes["coverage_auc"]
