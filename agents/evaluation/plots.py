"""Plots of evaluations: coverage over time, metrics, share of each robot."""

import json
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from maexp.agents.evaluation.metric_format import MEASURES
from maexp.envs.atomic_write import whole_file
from maexp.envs.metrics import LEAST_DISTINCT, has_interval, in_reach, label_copies, resample_weights, resampled_means

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8C6D1F")
STYLES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 3)), "-", "--")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
LOOK = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#E0E0E0",
    "axes.axisbelow": True,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "lines.linewidth": 1.6,
}
WIDE = 3.6  # inches of a panel


def panels(count: int, height: float = 2.5) -> tuple[Figure, list]:
    """A figure with ``count`` panels in rows of up to three."""
    columns = min(count, 3)
    rows = -(-count // columns)
    figure = Figure(figsize=(WIDE * columns, height * rows), layout="constrained")
    axes = list(np.ravel(figure.subplots(rows, columns, squeeze=False)))
    for ax in axes[count:]:
        ax.set_axis_off()
    return figure, axes[:count]


def finish(ax, title: str, unit: str, legend: bool) -> None:
    """Title, unit of the y axis, and a legend that does not cover the lines."""
    ax.set_title(title, loc="left")
    ax.set_ylabel(unit)
    entries = len(ax.get_legend_handles_labels()[0]) if legend else 0
    if entries > 3:  # room above the lines
        low, high = ax.get_ylim()
        ax.set_ylim(low, high + 0.12 * -(-entries // 2) * (high - low))
        ax.legend(loc="upper left", ncols=2)
    elif entries:
        ax.legend()


def reach(found: dict, factor: float = 1.0) -> list[list[float]] | None:
    """How far the interval of a mean {mean, ci95, n} goes to both sides, matplotlib's `xerr`; None: there is none."""
    if not has_interval(found):
        return None
    mean, (low, high) = found["mean"], found["ci95"]
    return [[factor * max(mean - low, 0)], [factor * max(high - mean, 0)]]


def save(figure: Figure, path) -> Path:
    """Write the picture; returns its path."""
    path = Path(path)
    with whole_file(path) as part:
        figure.savefig(part, dpi=150, format=path.suffix[1:])
    return path


METRICS = (
    "exploration_ratio",
    "coverage_auc",
    "success_rate",
    "coverage_step_85",
    "coverage_step_95",
    "coverage_step_95_censored",
    "coverage_step_99",
    "coverage_step_99_censored",
    "mutual_overlap_85",
    "mutual_overlap_95",
    "collisions",
    "path_length",
    "longest_path",
    "reward_variance",
)
UNITS = {"steps": "local steps of 0.1 s"}
"""As axes have room for them."""

SHADES = (COLOURS[0], "#A6CEE3")  # of neighbouring shares: dark and light, in grey, too


# Coverage over time


def draw_coverage(curves: dict, path) -> Path:
    """Mean coverage over time with the 95 % interval of the mean, one line a policy; returns the path.

    Args:
        curves: name -> (seconds (records,), coverage (episodes, records) in [0, 1]), as
            ``CoverageRecorder.curves`` returns them; third, where known, the map of each episode: the interval
            then resamples maps, too. Where too few episodes are distinct there is none.
        path: picture to write.

    Raises:
        ValueError: no curves, or shapes that do not fit (named).
    """
    if not curves:
        raise ValueError("curves is empty; give at least one policy")
    with rc_context(LOOK):
        figure = Figure(figsize=(6.4, 3.6 + 0.17 * -(-len(curves) // 2)), layout="constrained")
        ax = figure.subplots()
        draw_coverage_lines(ax, curves)
        finish(ax, "Coverage over time, mean and its 95 % interval", "coverage [%]", legend=False)
        figure.legend(loc="outside lower center", ncols=2)
        return save(figure, path)


def draw_coverage_lines(ax, curves: dict, looks: dict[str, int] | None = None) -> None:
    """The lines, bands and marks at 85 and 95 % of `draw_coverage`.

    Args:
        ax: where to
        curves: as there
        looks: number of the colour and line style of a name; default: in order

    Raises:
        ValueError: shapes that do not fit (named).
    """
    for k, (name, (seconds, coverage, *maps)) in enumerate(curves.items()):
        seconds, coverage = np.asarray(seconds, dtype=float), np.atleast_2d(np.asarray(coverage, dtype=float))
        if coverage.shape[1:] != seconds.shape:
            raise ValueError(
                f"curves[{name!r}]: coverage has shape {coverage.shape}, which must be (episodes, {len(seconds)})"
            )
        mean = 100 * coverage.mean(axis=0)
        k = k if looks is None else looks[name]
        colour, style = COLOURS[k % len(COLOURS)], STYLES[(k + k // len(COLOURS)) % len(STYLES)]
        ax.plot(seconds, mean, label=f"{name} (n = {len(coverage)})", color=colour, linestyle=style)
        if (band := _band(coverage, *maps)) is not None:
            ax.fill_between(seconds, *np.clip(band, 0, 100), color=colour, alpha=0.2, linewidth=0)
    for mark in (85, 95):
        ax.axhline(mark, color="#808080", linewidth=0.8, linestyle=(0, (2, 2)))
    ax.set_ylim(0, 101)
    ax.set_xlim(left=0)
    ax.set_xlabel("time [s]")


def _band(coverage: np.ndarray, maps: np.ndarray | None = None) -> np.ndarray | None:
    """95 % interval of the mean at each record [%], shape [2, records]; None where too few episodes are distinct."""
    maps = np.zeros(len(coverage)) if maps is None else maps
    copies = label_copies(maps, dict(enumerate(coverage.T)))
    if len(np.unique(copies)) < LEAST_DISTINCT:
        return None
    drawn = resampled_means(coverage, resample_weights(maps, copies=copies))
    return 100 * np.percentile(drawn, [2.5, 97.5], axis=0)


# Metrics


def draw_summary(summary, path) -> Path:
    """Metrics of each policy as bars with 95 % intervals; returns the path.

    Args:
        summary: a ``summary.json`` or ``results.json``, or its content ``{policy: {metric: {mean, ci95, n}}}``.
        path: picture to write.

    A coverage that not every episode reached says by how many it was: the mean is over those.

    Raises:
        ValueError: no policy with a known metric.
    """
    if isinstance(summary, str | Path):
        summary = json.loads(Path(summary).read_text())
    policies = {
        name: figures for name, figures in summary.items() if isinstance(figures, dict) and figures.keys() & {*METRICS}
    }
    goal = summary.get("run", {}).get("success_coverage", 1.0)
    shown = [name for name in METRICS if any(_mean(figures, name) is not None for figures in policies.values())]
    shown = [MEASURES[name] for name in shown if in_reach(name, goal)]
    if not shown:
        raise ValueError(
            f"the summary has no metric that can be drawn; found {', '.join(map(str, summary)) or 'nothing'}"
        )
    with rc_context(LOOK):
        figure, axes = panels(len(shown), height=2.1 + 0.1 * len(policies))
        for ax, metric in zip(axes, shown, strict=True):
            _draw_bars(ax, policies, metric.metric, metric.factor)
            ax.set_title(metric.title, loc="left")
            ax.set_xlabel(UNITS.get(metric.unit, metric.unit))
        return save(figure, path)


def _mean(metrics: dict, name: str) -> float | None:
    value = metrics.get(name, {}).get("mean")
    return None if value is None or not np.isfinite(value) else float(value)


def _draw_bars(ax, policies: dict, metric: str, factor: float) -> None:
    """A horizontal bar a policy, the first on top, with its value; and of how many episodes where some are missing."""
    total = max((figures.get("exploration_ratio", {}).get("n") or 0) for figures in policies.values())
    partial = False
    for row, metrics in enumerate(policies.values()):
        mean, value = _mean(metrics, metric), metrics.get(metric, {})
        count = value.get("n", 0)
        if mean is None:
            ax.text(0, row, f" never reached (0 of {total})" if total else " no value", va="center", fontsize=8)
            continue
        ax.barh(row, factor * mean, height=0.62, color=COLOURS[row % len(COLOURS)], alpha=0.85)
        high = factor * mean
        if has_interval(value):
            high = factor * value["ci95"][1]
            ax.errorbar(factor * mean, row, xerr=reach(value, factor), color="black", capsize=3, linewidth=1.2)
        partial |= 0 < count < total
        label = f"{factor * mean:.3g}" + (f" ({count} of {total})" if 0 < count < total else "")
        ax.annotate(label, (max(high, factor * mean), row), (5, 0), textcoords="offset points", va="center", fontsize=8)
    ax.set_yticks(range(len(policies)), list(policies))
    ax.set_ylim(len(policies) - 0.4, -0.6)
    ax.set_xlim(0, ax.dataLim.xmax * (1.75 if partial else 1.3) or 1.0)
    ax.grid(False, axis="y")


def draw_contributions(contributions: dict, path) -> Path:
    """Share of each robot in what its team discovered, a bar of 100 % per policy; returns the path.

    Args:
        contributions: policy -> (episodes, robots), as ``CoverageRecorder.contributions`` returns them. Robots
            are ranked within each episode (the busiest first), since their numbers mean nothing.
        path: picture to write.

    Raises:
        ValueError: no policies.
    """
    if not contributions:
        raise ValueError("contributions is empty; give at least one policy")
    with rc_context(LOOK):
        figure = Figure(figsize=(6.4, 1.3 + 0.36 * len(contributions)), layout="constrained")
        ax = figure.subplots()
        for row, shares in enumerate(contributions.values()):
            ranked = -np.sort(-np.asarray(shares, dtype=float), axis=1)
            mean = 100 * ranked.sum(axis=0) / max(ranked.sum(), 1e-9)  # episodes that found nothing new do not count
            _draw_shares(ax, row, mean)
            ax.plot(100 * np.arange(1, len(mean)) / len(mean), np.full(len(mean) - 1, row + 0.4), "k^", markersize=4)
        ax.set_yticks(range(len(contributions)), list(contributions))
        ax.set_ylim(len(contributions) - 0.4, -0.6)
        ax.set_xlim(0, 100)
        ax.grid(False)
        ax.set_xlabel("share [%], the busiest robot of each episode first\n▲ where equal shares would end")
        ax.set_title("Share of each robot in what its team discovered", loc="left")
        return save(figure, path)


def _draw_shares(ax, row: int, mean: np.ndarray) -> None:
    """The bar of one policy; shades alternate between neighbours, and a share that has room for it says its value."""
    for rank, (left, width) in enumerate(zip(np.cumsum(mean) - mean, mean, strict=True)):
        dark = rank % 2 == 0
        ax.barh(row, width, left=left, height=0.7, color=SHADES[rank % 2], edgecolor="white", linewidth=0.8)
        if width >= 4:
            colour = "white" if dark else "black"
            ax.text(left + width / 2, row, f"{width:.0f}", ha="center", va="center", fontsize=8, color=colour)
