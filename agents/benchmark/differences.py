"""How far the trained policies of a benchmark are ahead of the best classical planner, on the same episodes."""

import numpy as np

from maexp.agents.benchmark.cell import CellResult
from maexp.agents.benchmark.plan import Cell
from maexp.agents.benchmark.table import pool_episodes, weigh
from maexp.agents.evaluation.comparison import DECIDES
from maexp.agents.evaluation.evidence import brackets
from maexp.envs.metrics import in_reach, label_copies, summarise

Played = list[tuple[Cell, CellResult]]
SHOWN = (("coverage_auc", "AUC, points", 100, 1), ("coverage_step_95_censored", "to 95, steps", 1, 0),
         ("coverage_step_99_censored", "to 99, steps", 1, 0), ("collisions", "robots lost", 1, 2))  # fmt: skip
"""Metric, title, scale and digits of what is shown of a difference."""


def subtract(policy: str, one: Played, other: Played) -> dict[str, dict]:
    """{metric: {mean, std, ci95, n}} of a policy's episodes less the same episodes of another; {}: they share none."""
    theirs = {(cell.seed, cell.map): result for cell, result in other}
    pairs = [(cell.seed, mine, theirs[cell.seed, cell.map]) for cell, mine in one if (cell.seed, cell.map) in theirs]
    if not pairs:
        return {}
    maps, counts = [mine.maps for _, mine, _ in pairs], [len(mine.coverage) for _, mine, _ in pairs]
    ours, theirs = (pool_episodes([pair[k].episodes for pair in pairs]) for k in (1, 2))
    copies = label_copies(np.concatenate(maps), ours, theirs)
    weights = weigh(policy, [seed for seed, _, _ in pairs], counts, maps, copies)
    return {name: summarise(values - theirs[name], weights, copies) for name, values in ours.items()}


def find_best(played: dict[str, Played]) -> str | None:
    """The policy that saw most over time; None where there is none.

    Args:
        played: policy -> what it played on validation maps
    """
    scores = {
        policy: np.mean([result.episodes[DECIDES].mean() for _, result in cells])
        for policy, cells in played.items()
        if cells
    }
    return max(scores, key=scores.get, default=None)


def difference_cells(found: dict[str, dict], goal: float) -> dict[str, str]:
    """{title: +1.2 [0.3, 2.1]} of the metrics in `SHOWN` that episodes reach which end at the coverage `goal`."""
    shown = [row for row in SHOWN if in_reach(row[0], goal)]
    return {title: _cell(found[metric], scale, digits) for metric, title, scale, digits in shown}


def _cell(one: dict, scale: float, digits: int) -> str:
    return f"{scale * one['mean']:+.{digits}f}{brackets(one, lambda end: f'{scale * end:+.{digits}f}')}"


def differences_markdown(rival: str, rows: dict[str, dict], goal: float = 0.95) -> str:
    """A table of trained policies less the best classical planner.

    Args:
        rival: that planner
        rows: policy -> its difference
        goal: coverage that ended an episode
    """
    cells = {name: difference_cells(found, goal) for name, found in rows.items()}
    titles = next(iter(cells.values()))
    lines = [f"Less {rival}, the best classical planner on the validation maps, episode by episode:", ""]
    lines += ["| | " + " | ".join(titles) + " |", "| --- |" + " --- |" * len(titles)]
    lines += [f"| {name} | {' | '.join(found.values())} |" for name, found in cells.items()]
    return "\n".join(lines)


def differences_text(scenario: str, rival: str, rows: dict[str, dict], goal: float = 0.95) -> list[str]:
    """The same as lines for the terminal."""
    lines = [f"{scenario}: less {rival}, the best classical planner on the validation maps, episode by episode"]
    for name, found in rows.items():
        parts = [f"{title} {text}" for title, text in difference_cells(found, goal).items()]
        lines.append(f"  {name}: {'; '.join(parts)}")
    return lines
