"""Plots of runs and evaluations: learning curves, coverage over time, metrics, share of each robot."""

import csv
import json
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

from maexp.agents.evaluation.figures import COLOURS, LOOK, MARKERS, STYLES, finish, panels, reach, save
from maexp.envs.metrics import LEAST_DISTINCT, has_interval, in_reach, label_copies, resample_weights, resampled_means

# title, unit, scale factor, [(column, label)]: a panel shows the columns that exist
CURVES = (
    ("Coverage at the end of an episode", "%", 100, [("coverage", "training"), ("validation_coverage", "validation")]),
    ("Reward of a robot", "per decision", 1, [("reward", "total"), ("return", "return")]),
    (
        "Reward by term",
        "per decision",
        1,
        [(f"reward_{term}", term) for term in ("explore", "overlap", "time", "success", "collision")],
    ),
    ("Success rate", "%", 100, [("success_rate", "95 % coverage reached")]),
    ("Collisions", "robots per episode", 1, [("collisions", "collided robots")]),
    ("Path of a robot", "m per episode", 1, [("path_length", "path length")]),
    ("Critic loss", "reward²", 1, [("loss_critic", "critic")]),
    (
        "Policy loss",
        "",
        1,
        [("loss_objective", "objective"), ("loss_entropy", "entropy bonus"), ("loss_kl", "KL penalty")],
    ),
    ("Entropy of the policy", "nat", 1, [("entropy", "both heads")]),
    ("Change of the policy per update", "nat", 1, [("kl", "KL divergence")]),
    ("Explained variance of the critic", "share", 1, [("explained_variance", "explained")]),
    ("Speed", "macro steps / s", 1, [("frames_per_second", "speed")]),
)

# metric, title, unit, scale factor
METRICS = (
    ("exploration_ratio", "Coverage at the end", "%", 100),
    ("coverage_auc", "Mean coverage over the episode", "%", 100),
    ("success_rate", "Success rate", "%", 100),
    ("coverage_step_85", "Time to 85 % coverage", "local steps of 0.1 s", 1),
    ("coverage_step_95", "Time to 95 % coverage", "local steps of 0.1 s", 1),
    ("coverage_step_95_censored", "Time to 95 % or the limit", "local steps of 0.1 s", 1),
    ("coverage_step_99", "Time to 99 % coverage", "local steps of 0.1 s", 1),
    ("coverage_step_99_censored", "Time to 99 % or the limit", "local steps of 0.1 s", 1),
    ("mutual_overlap_85", "Overlap at 85 % coverage", "%", 100),
    ("mutual_overlap_95", "Overlap at 95 % coverage", "%", 100),
    ("collisions", "Collisions", "robots per episode", 1),
    ("path_length", "Path of a robot", "m per episode", 1),
    ("longest_path", "Longest path in a team", "m per episode", 1),
    ("reward_variance", "Spread of reward over robots", "reward, unscaled", 1),
)

SHADES = (COLOURS[0], "#A6CEE3")  # of neighbouring shares: dark and light, in grey, too


# Learning curves


def draw_curves(runs, path) -> Path:
    """Learning curves of one run, of several seeds, or of several algorithms; returns the path.

    Args:
        runs: a ``metrics.csv``, a run's folder, or a list of rows (dicts); a list of files or folders are seeds
            of one setting: mean and, shaded, standard deviation; a dict name -> any of these compares settings.
        path: picture to write.

    Columns that are missing, or never have a value, are left out. Single runs are shown as they are (faint)
    and as a moving average.

    Raises:
        ValueError: no rows, or none of the known columns has a value (named).
    """
    groups = runs if isinstance(runs, dict) else {"": runs}
    groups = {str(name): _read_seeds(seeds) for name, seeds in groups.items()}
    tables = [table for seeds in groups.values() for table in seeds]
    if not tables:
        raise ValueError("runs is empty; give at least one metrics.csv")
    shown = [
        (title, unit, factor, [entry for entry in columns if any(_has_values(table, entry[0]) for table in tables)])
        for title, unit, factor, columns in CURVES
    ]
    shown = [panel for panel in shown if panel[3]]
    if not shown:
        known = sorted({name for table in tables for name in table})
        raise ValueError(f"{path}: none of the columns {', '.join(known) or '(none)'} is known or has values")
    with rc_context(LOOK):
        figure, axes = panels(len(shown))
        for ax, (title, unit, factor, columns) in zip(axes, shown, strict=True):
            lines = [(name, seeds, column, label) for column, label in columns for name, seeds in groups.items()]
            if len(groups) > 1:  # colours tell settings apart, so one column each
                lines = [line for line in lines if line[2] == columns[0][0]]
                title = f"{title}: {columns[0][1]}" if len(columns) > 1 else title
            for k, (name, seeds, column, label) in enumerate(lines):
                _draw_seeds(ax, seeds, column, factor, name or label, k)
            finish(ax, title, unit, legend=len(lines) > 1 and (len(groups) == 1 or ax is axes[0]))
            ax.set_xlabel(_x_label(tables))
            ax.xaxis.set_major_locator(MaxNLocator(5))
            ax.xaxis.set_major_formatter(EngFormatter(sep=""))
        return save(figure, path)


def _read_seeds(source) -> list[dict[str, np.ndarray]]:
    """Tables, column -> float64 (rows,), of a file, a folder, a list of rows or a list of files and folders."""
    if isinstance(source, str | Path):
        return [_read_table(Path(source))]
    source = list(source)
    if source and isinstance(source[0], dict):
        return [_columns(source)]
    return [_read_table(Path(one)) for one in source]


def _read_table(path: Path) -> dict[str, np.ndarray]:
    path = path / "metrics.csv" if path.is_dir() else path
    if not path.is_file():
        raise ValueError(f"{path} does not exist; give a run's metrics.csv or its folder")
    with open(path, newline="") as file:
        rows = [row for row in csv.DictReader(file) if None not in row.values()]  # a torn last line is left out
    if not rows:
        raise ValueError(f"{path} has no rows; the run has not finished an iteration yet")
    return _columns(rows)


def _columns(rows: list[dict]) -> dict[str, np.ndarray]:
    names = {name: None for row in rows for name in row if name}
    return {name: np.array([_number(row.get(name)) for row in rows]) for name in names}


def _number(value) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        return float("nan")


def _has_values(table: dict, column: str) -> bool:
    return column in table and bool(np.isfinite(table[column]).any())


def _x_label(tables: list[dict]) -> str:
    return "macro steps of teams" if all("frames" in table for table in tables) else "iteration"


def _x_values(table: dict, length: int) -> np.ndarray:
    for name in ("frames", "iteration"):
        if name in table:
            return table[name]
    return np.arange(1, length + 1, dtype=float)


def _draw_seeds(ax, seeds: list[dict], column: str, factor: float, label: str, k: int) -> None:
    """One line: a run and its moving average, or the mean of several seeds and their standard deviation."""
    curves = []
    for table in seeds:
        if _has_values(table, column):
            y = factor * table[column]
            good = np.isfinite(y)
            curves.append((_x_values(table, len(y))[good], y[good]))
    if not curves:
        return
    look = {"color": COLOURS[k % len(COLOURS)], "linestyle": STYLES[k % len(STYLES)]}
    if len(curves) == 1:
        (x, y), sparse = curves[0], len(curves[0][0]) < 8
        ax.plot(
            x,
            _smooth(y),
            label=label,
            **look,
            **({"marker": MARKERS[k % len(MARKERS)], "markersize": 4} if sparse else {}),
        )
        if not sparse:
            ax.plot(x, y, color=look["color"], alpha=0.25, linewidth=0.8)
        return
    start, stop = max(x[0] for x, _ in curves), min(x[-1] for x, _ in curves)
    grid = np.linspace(start, stop, max(len(x) for x, _ in curves)) if stop > start else np.array([start])
    values = np.stack([np.interp(grid, x, _smooth(y)) for x, y in curves])
    mean, spread = values.mean(axis=0), values.std(axis=0)
    ax.plot(grid, mean, label=f"{label} ({len(curves)} seeds)", **look)
    ax.fill_between(grid, mean - spread, mean + spread, color=look["color"], alpha=0.2, linewidth=0)


def _smooth(values: np.ndarray) -> np.ndarray:
    """Moving average over a twentieth of the run, shorter at its ends."""
    half = len(values) // 40
    sums = np.concatenate([[0.0], np.cumsum(values)])
    first = np.maximum(np.arange(len(values)) - half, 0)
    last = np.minimum(np.arange(len(values)) + half + 1, len(values))
    return (sums[last] - sums[first]) / (last - first)


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
    known = {metric for metric, *_ in METRICS}
    policies = {name: one for name, one in summary.items() if isinstance(one, dict) and known & one.keys()}
    goal = summary.get("run", {}).get("success_coverage", 1.0)
    shown = [row for row in METRICS if any(_mean(one, row[0]) is not None for one in policies.values())]
    shown = [row for row in shown if in_reach(row[0], goal)]
    if not shown:
        raise ValueError(
            f"the summary has no metric that can be drawn; found {', '.join(map(str, summary)) or 'nothing'}"
        )
    with rc_context(LOOK):
        figure, axes = panels(len(shown), height=2.1 + 0.1 * len(policies))
        for ax, (metric, title, unit, factor) in zip(axes, shown, strict=True):
            _draw_bars(ax, policies, metric, factor)
            ax.set_title(title, loc="left")
            ax.set_xlabel(unit)
        return save(figure, path)


def _mean(metrics: dict, name: str) -> float | None:
    value = metrics.get(name, {}).get("mean")
    return None if value is None or not np.isfinite(value) else float(value)


def _draw_bars(ax, policies: dict, metric: str, factor: float) -> None:
    """A horizontal bar a policy, the first on top, with its value; and of how many episodes where some are missing."""
    total = max((one.get("exploration_ratio", {}).get("n") or 0) for one in policies.values())
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
