"""Metrics of finished episodes and their summary (design 4.6; paper, section III-C)."""

import numpy as np
from scipy.stats import bootstrap
from tensordict import TensorDictBase

RESAMPLES = 5000


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
        the scales w and v, ``reward_variance_scaled`` with them. Lengths are means over robots [m].
    """
    info = {name: final[name].cpu().numpy().astype(np.float64) for name in final.keys()}
    metrics = {
        "exploration_ratio": info["coverage"][:, 0],
        "coverage_auc": info["coverage_auc"][:, 0],
        "reward_variance": info["episode_reward_raw"].std(axis=1),
        "reward_variance_scaled": info["episode_reward"].std(axis=1),
        "success_rate": (info["coverage"][:, 0] >= np.float32(success_coverage)).astype(np.float64),
        "collisions": info["collided"].sum(axis=1),
        "path_length": info["path_length"].mean(axis=1),
    }
    for mark in ("85", "95"):
        steps = info[f"coverage_step_{mark}"][:, 0]
        reached = steps >= 0
        metrics[f"coverage_step_{mark}"] = np.where(reached, steps, np.nan)
        metrics[f"mutual_overlap_{mark}"] = np.where(reached, info[f"mutual_overlap_{mark}"][:, 0], np.nan)
        metrics[f"path_length_{mark}"] = np.where(reached, info[f"path_length_{mark}"].mean(axis=1), np.nan)
        if limit is not None:
            metrics[f"coverage_step_{mark}_censored"] = np.where(reached, steps, float(limit))
    return metrics


def summarise(values: np.ndarray) -> dict:
    """Mean, standard deviation and bootstrap 95 % interval of the mean over the episodes that have a value.

    Returns:
        ``{mean, std, ci95: [low, high], n}``; NaN where no episode has a value.
    """
    kept = np.asarray(values, dtype=np.float64)
    kept = kept[~np.isnan(kept)]
    if not len(kept):
        return {"mean": np.nan, "std": np.nan, "ci95": [np.nan, np.nan], "n": 0}
    low = high = float(kept.mean())
    if np.ptp(kept) > 0.0:
        found = bootstrap(
            (kept,), np.mean, n_resamples=RESAMPLES, batch=500, method="percentile", rng=np.random.default_rng(0)
        )
        low, high = (float(x) for x in found.confidence_interval)
    return {"mean": float(kept.mean()), "std": float(kept.std()), "ci95": [low, high], "n": len(kept)}
