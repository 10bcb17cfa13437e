"""Pictures of a benchmark: coverage over time, every policy in every scenario, who does better than whom."""

from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from maexp.agents.evaluation.plots import COLOURS, LOOK, MARKERS, draw_coverage_lines, finish, reach, save

KINDS = {"trained": (COLOURS[0], MARKERS[0]), "classical": (COLOURS[1], MARKERS[1]), "paper": ("#606060", MARKERS[3])}
REFERENCE, BLACK = "random", COLOURS.index("#000000")  # looks the same in all panels
PAIRS = 15  # drawn with intervals at most: those of six


def draw_coverage_panels(curves: dict[str, dict], title: str, path) -> Path:
    """Coverage over time of one scenario, trained and classical policies side by side; returns the path.

    Args:
        curves: panel's title -> {policy: (seconds (records,), coverage (episodes, records) in [0, 1], maps of these)}
        title: of the whole
        path: picture to write

    Raises:
        ValueError: no curves.
    """
    curves = {name: lines for name, lines in curves.items() if lines}
    if not curves:
        raise ValueError("curves is empty; give at least one policy")
    with rc_context(LOOK):
        figure = Figure(figsize=(4.2 * len(curves), 4.4), layout="constrained")
        axes = figure.subplots(1, len(curves), sharey=True, squeeze=False)[0]
        for ax, (name, lines) in zip(axes, curves.items(), strict=True):
            others = [name for name in lines if name != REFERENCE]
            draw_coverage_lines(ax, lines, {name: k for k, name in enumerate(others)} | {REFERENCE: BLACK})
            finish(ax, name, "coverage [%], mean and its 95 % interval" if ax is axes[0] else "", legend=False)
            ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)
        figure.suptitle(title, x=0.01, ha="left", fontsize=11)
        return save(figure, path)


def draw_overview(coverage: dict[str, list], path) -> Path:
    """Coverage at the end of every policy in every scenario; returns the path.

    Args:
        coverage: scenario -> [(policy, kind, {mean, ci95}, paper's mean or None)] in [0, 1], kind `trained` or
            `classical`.
        path: picture to write

    Raises:
        ValueError: no scenarios.
    """
    if not coverage:
        raise ValueError("coverage is empty; give at least one scenario")
    names = list(dict.fromkeys(row[0] for rows in coverage.values() for row in rows))
    columns = min(len(coverage), 4)
    lines = -(-len(coverage) // columns)
    with rc_context(LOOK):
        figure = Figure(figsize=(1.6 + 2.1 * columns, (0.9 + 0.19 * len(names)) * lines + 0.5), layout="constrained")
        axes = np.ravel(figure.subplots(lines, columns, sharey=True, squeeze=False))
        for ax, (scenario, rows) in zip(axes, coverage.items(), strict=False):
            for policy, kind, found, published in rows:
                colour, marker = KINDS[kind]
                _draw_point(ax, names.index(policy), found, colour, marker)
                if published is not None:
                    colour, marker = KINDS["paper"]
                    ax.plot(100 * published, names.index(policy), marker, color=colour, mfc="none", markersize=5)
            ax.set_title(scenario.replace("_", " "), loc="left")
            ax.set_xlim(0, 100)
            ax.set_xticks(range(0, 101, 25))
            ax.set_yticks(range(len(names)), names)
            ax.set_ylim(len(names) - 0.5, -0.5)
        for ax in axes[len(coverage) :]:
            ax.set_axis_off()
        figure.supxlabel("final coverage [%], 95 % interval", fontsize=9)
        figure.legend(handles=_kinds(coverage), loc="outside upper right", ncols=3, fontsize=8)
        return save(figure, path)


def _draw_point(ax, row: int, found: dict, colour: str, marker: str) -> None:
    """A mean {mean, ci95} in per cent with its interval."""
    look = {"fmt": marker, "color": colour, "markersize": 4, "capsize": 2, "linewidth": 1.2}
    ax.errorbar(100 * found["mean"], row, xerr=reach(found, 100), **look)


def _kinds(coverage: dict[str, list]) -> list:
    from matplotlib.lines import Line2D

    have = {row[1] for rows in coverage.values() for row in rows}
    have |= {"paper"} if any(row[3] is not None for rows in coverage.values() for row in rows) else set()
    labels = {"paper": "paper (same map trained and tested)", "trained": "networks and policies of your own"}
    return [
        Line2D(
            [],
            [],
            linestyle="none",
            marker=marker,
            color=colour,
            markersize=5,
            label=labels.get(kind, kind),
            mfc="none" if kind == "paper" else colour,
        )
        for kind, (colour, marker) in KINDS.items()
        if kind in have
    ]


def draw_improvement(pairs: dict[tuple[str, str], dict], listed: list[str], path) -> Path:
    """Probability that a policy does better than another, all as a map and some with intervals; returns the path.

    Args:
        pairs: (policy, other) -> {mean, ci95}, both orders of every pair
        listed: the policies whose pairs are drawn with intervals
        path: picture to write

    Raises:
        ValueError: no pairs.
    """
    if not pairs:
        raise ValueError("pairs is empty; give at least two policies")
    names = list(dict.fromkeys(policy for policy, _ in pairs))
    chosen = [(a, b) for i, a in enumerate(listed) for b in listed[i + 1 :]][:PAIRS]
    side = 1.9 + 0.42 * len(names)
    with rc_context(LOOK):
        wide = 4.2 if chosen else 0.0
        figure = Figure(figsize=(side + 0.6 + wide, max(side, 1.4 + 0.27 * len(chosen))), layout="constrained")
        axes = np.ravel(figure.subplots(1, 2 if chosen else 1, width_ratios=[side + 0.6, wide] if chosen else None))
        _draw_matrix(figure, axes[0], pairs, names)
        if chosen:
            _draw_pairs(axes[1], pairs, chosen)
        return save(figure, path)


def _draw_matrix(figure: Figure, ax, pairs: dict, names: list[str]) -> None:
    """P(row > column) in per cent, bold where the interval leaves out one half."""
    size = len(names)
    values = np.full((size, size), np.nan)
    for (policy, other), found in pairs.items():
        values[names.index(policy), names.index(other)] = found["mean"]
    image = ax.imshow(100 * values, vmin=0, vmax=100, cmap="PuOr_r")
    for (policy, other), found in pairs.items():
        mean, (low, high) = found["mean"], found["ci95"]
        if mean == mean:
            ax.text(
                names.index(other),
                names.index(policy),
                f"{100 * mean:.0f}",
                ha="center",
                va="center",
                fontsize=8,
                color="white" if abs(mean - 0.5) > 0.38 else "black",
                fontweight="bold" if low > 0.5 or high < 0.5 else "normal",
            )
    ax.set_xticks(range(size), names, rotation=90)
    ax.set_yticks(range(size), names)
    ax.grid(False)
    ax.set_title("P(row covers more than column) [%]\nbold: the 95 % interval leaves out 50", loc="left")
    figure.colorbar(image, ax=ax, shrink=0.7)


def _draw_pairs(ax, pairs: dict, chosen: list[tuple[str, str]]) -> None:
    for row, (policy, other) in enumerate(chosen):
        _draw_point(ax, row, pairs[policy, other], COLOURS[0], "o")
    ax.axvline(50, color="#606060", linewidth=1, linestyle=(0, (4, 2)))
    ax.set_yticks(range(len(chosen)), [f"{policy} > {other}" for policy, other in chosen])
    ax.set_ylim(len(chosen) - 0.5, -0.5)
    ax.set_xlim(0, 100)
    ax.set_xlabel("probability [%], 95 % interval")
    ax.set_title("Probability of improvement", loc="left")
