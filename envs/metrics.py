"""Metrics of finished episodes and their summary (docs/concepts.md, Metrics; paper, section III-C)."""

import re
from functools import lru_cache

import numpy as np
import torch
from scipy.stats import bootstrap
from tensordict import TensorDictBase

from maexp.kernels.reward import MARKS

RADIO = ("base_coverage", "base_coverage_auc", "worst_coverage", "worst_coverage_auc")
"""What the base station knows, and the robot that knows least."""
RESAMPLES = 5000
GROUPED_RESAMPLES = 2000  # of maps, seeds and episodes: each takes a weight for every episode
LEAST_DISTINCT = 5
"""Distinct episodes that an interval takes: of two or three, a bootstrap's 95 % interval is their range, which holds
the true mean in half or three quarters of all cases."""


def succeeded(info: TensorDictBase, success_coverage: float) -> torch.Tensor:
    """Whether episodes that ended with `info` are successes, bool [..., 1]: rounded as in the kernels."""
    coverage = info["counted_coverage" if "counted_coverage" in info.keys() else "coverage"]
    return coverage >= coverage.new_tensor(success_coverage)


def episode_metrics(
    final: TensorDictBase, limit: int | None = None, success_coverage: float = 0.95
) -> dict[str, np.ndarray]:
    """Metrics of episodes from ``info`` [episodes] at their last step.

    Args:
        final: entries of shape [episodes, 1] and [episodes, N] (`envs.specs`).
        limit: local steps after which an episode is truncated; adds ``*_censored``, which counts episodes
            that never reached a coverage with this number instead of leaving them out.
        success_coverage: coverage that makes an episode a success.

    Returns:
        float64 [episodes] per metric; NaN where an episode has no value (a coverage it never reached).
        ``reward_variance`` is the population standard deviation over robots of the episode's reward without
        the scales w and v, ``reward_variance_scaled`` with them. Lengths are means over robots [m],
        ``longest_path`` the way of the robot that drove farthest. Where communication is limited: `RADIO`,
        ``connected``, ``told_step_95`` and ``bytes_sent``, by all radios; where robots may fail: ``failed``, how many
        have at the end; in volumes: ``surface_coverage``; where odometry drifts: ``odometry_error`` [m], how far robots
        then are from where they believe to be, on average; where maps have errors: ``map_error`` [m], how far known
        ground then is from where it is drawn, on average over points, then over maps.
        Which marks an episode can reach: `in_reach`.
    """
    info = {name: final[name].cpu().numpy().astype(np.float64) for name in final.keys()}
    metrics = {
        "exploration_ratio": info["coverage"][:, 0],
        "coverage_auc": info["coverage_auc"][:, 0],
        "reward_variance": info["episode_reward_unscaled"].std(axis=1),
        "reward_variance_scaled": info["episode_reward"].std(axis=1),
        "success_rate": succeeded(final, success_coverage)[:, 0].double().cpu().numpy(),
        "collisions": info["collided"].sum(axis=1),
        "path_length": info["path_length"].mean(axis=1),
        "longest_path": info["path_length"].max(axis=1),
    }
    metrics |= {name: info[name][:, 0] for name in (*RADIO, "surface_coverage") if name in info}
    if "failed" in info:
        metrics["failed"] = info["failed"].sum(axis=1)
    if "odometry_error" in info:
        metrics["odometry_error"] = info["odometry_error"].mean(axis=1)
    if "map_error" in info:
        metrics["map_error"] = info["map_error"][:, 0]
    if "connected" in info:
        metrics["connected"] = info["connected"].mean(axis=1)
        metrics["bytes_sent"] = info["bytes_sent"][:, 0]
        steps = info["told_step_95"][:, 0]
        metrics["told_step_95"] = np.where(steps >= 0, steps, np.nan)
        if limit is not None:
            metrics["told_step_95_censored"] = np.where(steps >= 0, steps, float(limit))
    for mark in MARKS:
        steps = info[f"coverage_step_{mark}"][:, 0]
        reached = steps >= 0
        metrics[f"coverage_step_{mark}"] = np.where(reached, steps, np.nan)
        metrics[f"mutual_overlap_{mark}"] = np.where(reached, info[f"mutual_overlap_{mark}"][:, 0], np.nan)
        metrics[f"path_length_{mark}"] = np.where(reached, info[f"path_length_{mark}"].mean(axis=1), np.nan)
        if limit is not None:
            metrics[f"coverage_step_{mark}_censored"] = np.where(reached, steps, float(limit))
    return metrics


def in_reach(metric: str, success_coverage: float) -> bool:
    """Whether an episode can tell a metric of `episode_metrics`: at `success_coverage` it is over, and no mark beyond
    is reached but by chance."""
    mark = re.search(r"_(\d+)(_|$)", metric)
    return mark is None or int(mark[1]) <= round(100 * success_coverage, 6)


def label_copies(maps: np.ndarray, *tables: dict[str, np.ndarray]) -> np.ndarray:
    """A number for each episode, the same for copies: the same map, and the same metrics to the last bit.

    Where all episodes begin alike and nothing is drawn in them, many say no more than one.

    Args:
        maps: of each episode, labels [episodes]
        tables: the metrics [episodes] of each policy that played them; copies are the same in all

    Returns:
        int [episodes], counted from 0 in the order of the first of each.
    """
    columns = [np.unique(maps, return_inverse=True)[1].ravel()]
    for values in (column for table in tables for column in table.values()):
        values = np.asarray(values, dtype=np.float64) + 0.0  # -0 is 0
        columns.append(np.where(np.isnan(values), np.nan, values).view(np.int64))
    _, first, inverse = np.unique(np.stack(columns, 1), axis=0, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[inverse.ravel()]


def resample_weights(*factors: np.ndarray, copies: np.ndarray | None = None, seed: int = 0) -> np.ndarray:
    """How often each episode counts in each resample of a bootstrap of groups, float32 [GROUPED_RESAMPLES, episodes].

    Args:
        factors: what each episode belongs to, labels [episodes] each: its map, the seed of the training. Every factor
            is resampled with replacement by itself, and the episodes within each combination (Owen 2007). One label
            for all changes nothing.
        copies: of `label_copies`: copies are drawn together; None: there are none.
        seed: of the drawing: what is drawn apart from something else needs another one.
    """
    codes = [np.unique(labels, return_inverse=True)[1] for labels in factors]
    codes.append(np.arange(len(factors[0])) if copies is None else copies)
    return _resample_weights(seed, *(tuple(code.ravel().tolist()) for code in codes))


@lru_cache(maxsize=32)
def _resample_weights(seed: int, *codes: tuple[int, ...]) -> np.ndarray:
    rng = np.random.default_rng(seed)
    labels, copies = np.array(codes[:-1]), np.array(codes[-1])
    counts = [max(code) + 1 for code in codes[:-1]]
    often = [rng.multinomial(count, np.full(count, 1 / count), size=GROUPED_RESAMPLES) for count in counts]
    weights = np.zeros((GROUPED_RESAMPLES, labels.shape[1]), dtype=np.float32)
    for combination in np.unique(labels, axis=1).T:
        episodes = np.flatnonzero((labels == combination[:, None]).all(0))
        count = np.prod([times[:, code] for times, code in zip(often, combination, strict=True)], axis=0)
        distinct, group = np.unique(copies[episodes], return_inverse=True)
        drawn = rng.multinomial(count * len(distinct), np.full(len(distinct), 1 / len(distinct)))
        weights[:, episodes] = drawn[:, group]
    return weights


def resampled_means(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Mean of `values` [episodes, ...] in each resample of `weights` [resamples, episodes], where it has one."""
    total = weights.sum(1, keepdims=True).reshape(-1, *(1,) * (values.ndim - 1))
    middle = values.mean(0)  # small numbers lose less in float32
    sums = np.tensordot(weights, (values - middle).astype(np.float32), axes=1)
    return middle + (sums[total.ravel() > 0] / total[total.ravel() > 0]).astype(np.float64)


def summarise(values: np.ndarray, weights: np.ndarray | None = None, copies: np.ndarray | None = None) -> dict:
    """Mean, standard deviation and bootstrap 95 % interval of the mean over the episodes that have a value.

    Args:
        values: one for each episode; NaN: it has none.
        weights: of `resample_weights`; None: episodes alone are resampled.
        copies: of `label_copies`; None: there are none.

    Returns:
        ``{mean, std, ci95: [low, high], n}``; NaN where no episode has a value, and for the ends where fewer than
        `LEAST_DISTINCT` distinct episodes have one.
    """
    kept = np.asarray(values, dtype=np.float64)
    have = ~np.isnan(kept)
    distinct = have.sum() if copies is None else len(np.unique(copies[have]))
    kept = kept[have]
    if not len(kept):
        return {"mean": np.nan, "std": np.nan, "ci95": [np.nan, np.nan], "n": 0}
    ends = [np.nan, np.nan]
    if distinct >= LEAST_DISTINCT:
        ends = _interval(kept, None if weights is None else weights[:, have])
    return {"mean": float(kept.mean()), "std": float(kept.std()), "ci95": ends, "n": len(kept)}


def has_interval(found: dict) -> bool:
    """Whether a mean {mean, ci95, n} has an interval."""
    return all(end is not None and end == end for end in found.get("ci95", [None]))


def _interval(values: np.ndarray, weights: np.ndarray | None) -> list[float]:
    if np.ptp(values) == 0.0:
        return [float(values.mean())] * 2
    if weights is not None:
        return np.percentile(resampled_means(values, weights), [2.5, 97.5]).tolist()
    rng = np.random.default_rng(0)
    found = bootstrap((values,), np.mean, n_resamples=RESAMPLES, batch=500, method="percentile", rng=rng)
    return [float(end) for end in found.confidence_interval]
