"""Learning curves of a run, of several seeds, or of several settings."""

import csv
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.ticker import EngFormatter, MaxNLocator

from maexp.agents.evaluation.plots import COLOURS, LOOK, MARKERS, STYLES, draw_coverage_lines, finish, panels, save

# title, unit, scale factor, [(column, label)]: a panel shows the columns that exist
CURVES = (
    ("Gain in coverage over time", "points, team - planner", 1, [("validation_gain", "gain")]),
    ("Steps to 95 % coverage, lower is sooner", "local steps, team - planner", 1, [("validation_steps_95", "steps")]),
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
PAIRED = ("validation_gain", "validation_steps_95")
"""Columns that are differences to the best planner, with their intervals under `_low` and `_high`."""
LEAST_CHANGE = {"%": 1.0}
"""Unit -> change below which a line is flat; of other units that is one which never changes."""


def draw_curves(runs, path, rival: str = "the best planner", ends: dict | None = None) -> Path:
    """Learning curves of one run, of several seeds, or of several algorithms; returns the path.

    Args:
        runs: a ``metrics.csv``, a run's folder, or a list of rows (dicts); a list of files or folders are seeds
            of one setting: mean and, shaded, standard deviation; a dict name -> any of these compares settings.
        path: picture to write.
        rival: the planner that gains are told over.
        ends: coverage over time after the training, as `plots.draw_coverage` takes it.

    Columns that are missing, never have a value, or are flat are left out. Single runs are shown as they are (faint)
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
    shown = [(*panel, moving) for *panel, columns in shown if (moving := _moving(tables, *panel[1:], columns))] or shown
    if not shown:
        known = sorted({name for table in tables for name in table})
        raise ValueError(f"{path}: none of the columns {', '.join(known) or '(none)'} is known or has values")
    with rc_context(LOOK):
        figure, axes = panels(len(shown) + bool(ends))
        if ends:
            place = sum(panel[3][0][0] in PAIRED for panel in shown)  # beside what leads there
            _draw_ends(axes.pop(place), ends)
        for ax, (title, unit, factor, columns) in zip(axes, shown, strict=True):
            lines = [(name, seeds, column, label) for column, label in columns for name, seeds in groups.items()]
            if len(groups) > 1:  # colours tell settings apart, so one column each
                lines = [line for line in lines if line[2] == columns[0][0]]
                title = f"{title}: {columns[0][1]}" if len(columns) > 1 else title
            for k, (name, seeds, column, label) in enumerate(lines):
                _draw_seeds(ax, seeds, column, factor, name or label, k)
            if columns[0][0] in PAIRED:
                _draw_rival(ax, rival)
            finish(ax, title, unit, legend=len(lines) > 1 and (len(groups) == 1 or ax is axes[0]))
            ax.set_xlabel(_x_label(tables))
            ax.xaxis.set_major_locator(MaxNLocator(5))
            ax.xaxis.set_major_formatter(EngFormatter(sep=""))
        return save(figure, path)


def _moving(tables: list[dict], unit: str, factor: float, columns: list) -> list:
    """The columns of a panel that are not flat; the gain always counts."""

    def moves(name: str) -> bool:
        lines = [
            _smooth(factor * table[name][np.isfinite(table[name])]) for table in tables if _has_values(table, name)
        ]
        return name == PAIRED[0] or any(np.ptp(line) > LEAST_CHANGE.get(unit, 0.0) for line in lines)

    return [entry for entry in columns if moves(entry[0])]


def _draw_rival(ax, name: str) -> None:
    """The planner, which is 0."""
    ax.axhline(0.0, color="#404040", linewidth=1.0, linestyle=(0, (4, 2)))
    box = {"facecolor": "white", "alpha": 0.7, "edgecolor": "none", "pad": 0.5}
    place = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points", "ha": "right"}
    ax.annotate(name, (1.0, 0.0), (0, 3), **place, fontsize=8, color="#404040", bbox=box)


def _draw_ends(ax, ends: dict) -> None:
    """Coverage over time after the training."""
    draw_coverage_lines(ax, ends)
    finish(ax, "Coverage over time, held-out episodes", "%", legend=False)
    ax.legend(loc="lower right")


def _read_seeds(source) -> list[dict[str, np.ndarray]]:
    """Tables, column -> float64 (rows,), of a file, a folder, a list of rows or a list of files and folders."""
    if isinstance(source, str | Path):
        return [_read_table(Path(source))]
    source = list(source)
    if source and isinstance(source[0], dict):
        return [_columns(source)]
    return [_read_table(Path(path)) for path in source]


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
    curves, seeds = [], [table for table in seeds if _has_values(table, column)]
    for table in seeds:
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
        if f"{column}_low" in seeds[0]:
            low, high = (factor * seeds[0][f"{column}_{end}"][good] for end in ("low", "high"))
            ax.fill_between(x, low, high, color=look["color"], alpha=0.2, linewidth=0)
        elif not sparse:
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
