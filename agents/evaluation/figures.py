"""The look that all plots share.

Okabe-Ito colours with a line style or marker each, so that they can be told apart in grey and by the colour-blind.
Figures are drawn without pyplot: no display, no global state. The file's ending chooses the format (png, pdf, svg).
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from maexp.envs.metrics import has_interval
from maexp.envs.whole_file import whole_file

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
