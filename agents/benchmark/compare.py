"""How likely one policy does better than another: P(X > Y) + P(X = Y) / 2, scenario by scenario, with an interval.

The Mann-Whitney U statistic over n m, averaged over scenarios, as rliable's probability of improvement (Agarwal et al.
2021). The interval is a bootstrap over episodes, stratified by scenario; copies of an episode are drawn together.
"""

import csv
import io

import numpy as np

from maexp.envs.metrics import LEAST_DISTINCT

RESAMPLES = 2000


def win_shares(x: np.ndarray, y: np.ndarray, counts_x: np.ndarray, counts_y: np.ndarray) -> np.ndarray:
    """P(X > Y) + P(X = Y) / 2 of weighted samples.

    Args:
        x, y: values, shapes [n] and [m]
        counts_x, counts_y: how often each counts in each resample, [resamples, n] and [resamples, m]

    Returns:
        [resamples]
    """
    wins = 0.5 * (np.sign(x[:, None] - y[None, :]) + 1.0)
    total = counts_x.sum(1) * counts_y.sum(1)
    return np.einsum("bm,bm->b", counts_x @ wins, counts_y) / total


Sample = dict[str, np.ndarray]  # scenario -> a number for each episode


def improvement(x: Sample, y: Sample, copies: tuple[Sample, Sample] | None = None, seed: int = 0) -> dict:
    """{mean, ci95, n}: how likely X has more than Y, over the scenarios that both have; no interval where one of the
    two has fewer than `LEAST_DISTINCT` distinct episodes.

    Args:
        x, y: scenario -> values of the episodes
        copies: of `label_copies`, of x and of y; None: there are none
        seed: of the resampling
    """
    rng = np.random.default_rng(seed)
    shares, once, distinct = [], [], np.zeros(2, dtype=int)
    for scenario in (name for name in x if name in y):
        first, second = (np.asarray(values, dtype=np.float64) for values in (x[scenario], y[scenario]))
        once.append(win_shares(first, second, np.ones((1, len(first))), np.ones((1, len(second))))[0])
        labels = (
            [np.arange(len(v)) for v in (first, second)] if copies is None else [group[scenario] for group in copies]
        )
        counts = [_draw(rng, group) for group in labels]
        distinct += [len(np.unique(group)) for group in labels]
        shares.append(win_shares(first, second, *counts))
    if not once:
        return {"mean": np.nan, "ci95": [np.nan, np.nan], "n": 0}
    ends = np.percentile(np.mean(shares, axis=0), [2.5, 97.5])
    ends = ends.tolist() if distinct.min() >= LEAST_DISTINCT else [np.nan, np.nan]
    return {"mean": float(np.mean(once)), "ci95": ends, "n": len(once)}


def _draw(rng: np.random.Generator, labels: np.ndarray) -> np.ndarray:
    """How often each episode counts in each resample, [RESAMPLES, episodes]."""
    distinct, group = np.unique(labels, return_inverse=True)
    drawn = rng.multinomial(len(distinct), np.full(len(distinct), 1 / len(distinct)), size=RESAMPLES)
    return drawn[:, group].astype(np.float64)


def compare_all(values: dict[str, Sample], copies: dict[str, Sample] | None = None) -> dict[tuple[str, str], dict]:
    """`improvement` of every ordered pair of policies.

    Args:
        values: policy -> scenario -> values of the episodes, of which more is better
        copies: the same of `label_copies`; None: there are none
    """
    names = list(values)
    pairs = {}
    for i, name in enumerate(names):
        for other in names[i + 1 :]:
            found = improvement(values[name], values[other], copies and (copies[name], copies[other]))
            low, high = found["ci95"]
            pairs[name, other] = found
            pairs[other, name] = found | {"mean": 1 - found["mean"], "ci95": [1 - high, 1 - low]}
    return pairs


def pairs_csv(pairs: dict[tuple[str, str], dict]) -> str:
    """A line per ordered pair."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["policy", "better_than", "probability", "ci95_low", "ci95_high", "scenarios"])
    for (policy, other), found in pairs.items():
        numbers = ["" if value != value else f"{value:.4f}" for value in (found["mean"], *found["ci95"])]
        writer.writerow([policy, other, *numbers, found["n"]])
    return text.getvalue()
