"""How far the trained policies of a benchmark are ahead of the best classical planner, on the same episodes."""

from maexp.agents.benchmark.plan import Cell
from maexp.agents.evaluation.evaluate import EvaluationResult, join
from maexp.agents.measures import compared
from maexp.agents.tables import markdown_table

Played = list[tuple[Cell, EvaluationResult]]


def subtract(played: Played, other: Played) -> dict[str, dict]:
    """{metric: {mean, std, ci95, n}} of a policy's episodes less the same episodes of another; {}: they share none."""
    theirs = {(cell.seed, cell.map): result for cell, result in other}
    pairs = [(mine, theirs[cell.seed, cell.map]) for cell, mine in played if (cell.seed, cell.map) in theirs]
    return join([mine for mine, _ in pairs]).minus(join([same for _, same in pairs])) if pairs else {}


def difference_cells(found: dict[str, dict], goal: float) -> dict[str, str]:
    """{words: +1.2 [0.3, 2.1]} of what is compared of episodes that end at the coverage `goal`."""
    return {measure.words: measure.difference(found[measure.metric]) for measure in compared(goal)}


def differences_markdown(rival: str, rows: dict[str, dict], goal: float = 0.95) -> str:
    """A table of trained policies less the best classical planner.

    Args:
        rival: that planner
        rows: policy -> its difference
        goal: coverage that ended an episode
    """
    cells = {name: difference_cells(found, goal) for name, found in rows.items()}
    titles = next(iter(cells.values()))
    head = f"Less {rival}, the best classical planner on the validation maps, episode by episode:"
    rows = [[name, *found.values()] for name, found in cells.items()]
    return "\n".join([head, "", *markdown_table(["", *titles], rows)])


def differences_text(scenario: str, rival: str, rows: dict[str, dict], goal: float = 0.95) -> list[str]:
    """The same as lines for the terminal."""
    lines = [f"{scenario}: less {rival}, the best classical planner on the validation maps, episode by episode"]
    for name, found in rows.items():
        parts = [f"{title} {text}" for title, text in difference_cells(found, goal).items()]
        lines.append(f"  {name}: {'; '.join(parts)}")
    return lines
