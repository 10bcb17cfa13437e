"""The table of a benchmark, in the layout of the paper's: pooled over seeds, bold computed, four ways of writing it."""

import csv
import io
from dataclasses import dataclass, field

import numpy as np
from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from maexp.agents.benchmark.paper_results import paper_value
from maexp.agents.evaluation.evaluate import EvaluationResult, join
from maexp.agents.evaluation.evidence import Evidence, describe_evidence
from maexp.agents.measures import MEASURES, Measure
from maexp.agents.tables import (
    NONE,
    TableCell,
    brackets,
    fixed,
    latex_row,
    latex_small,
    latex_text,
    markdown_table,
    reached,
    terminal_table,
)
from maexp.envs.metrics import in_reach

ROWS = [measure for measure in MEASURES.values() if measure.symbol]
SHOWN = ("ER", "AUC", "CS85", "CS95", "to 95", "MO85")  # on the terminal, where there is room for six
SHOWN_TO_THE_END = ("ER", "AUC", "CS95", "to 95", "CS99", "to 99")
ORACLE = "oracle"
SHORT = {"held_out": "", "trained": " (training maps)"}
NOTES = (
    "ER: exploration ratio; AUC: mean coverage over all local steps of a full episode; more is better. CS85, CS95: "
    "local steps until 85, 95 % coverage; to 95: the same with the limit for episodes that did not get there (CS99, to "
    "99: of 99 %, where episodes go on until then); MO85, MO95: share of the seen points that two or more robots saw, "
    "at that moment; RV: spread of the reward over robots; less is better.",
    "Mean ± standard deviation over episodes, [bootstrap 95 % interval of the mean; maps, the episodes on each and the "
    "seeds of training are resampled]. CS and MO: over the episodes that got there, (how many/of all); a policy that "
    "seldom gets there shows its luckiest episodes.",
    "oracle knows what is truly to be seen from each target: a reference, no competitor, never bold.",
    "Bold: the best mean of a row as printed; several where they tie. paper: Table II, trained and tested on the same "
    "map; its indoor and outdoor maps are scans, ours are generated.",
)


def rows_for(goal: float) -> list[Measure]:
    """The rows of a table of episodes that end at the coverage `goal`."""
    return [row for row in ROWS if in_reach(row.metric, goal)]


def shown_for(goal: float) -> list[Measure]:
    """Those that the terminal has room for."""
    rows = rows_for(goal)
    labels = SHOWN_TO_THE_END if any(row.symbol == "CS99" for row in rows) else SHOWN
    return [row for row in rows if row.symbol in labels]


@dataclass
class Column:
    """A policy on one set of maps in one scenario, pooled over its cells.

    Attributes:
        summary: {metric: {mean, std, ci95, n}}
        evidence: what that rests on
        seeds: {seed: mean of each metric}, to see how far trainings differ
    """

    policy: str
    suite: str
    summary: dict[str, dict]
    evidence: Evidence
    seeds: dict[int, dict[str, float]] = field(default_factory=dict)

    @property
    def name(self) -> str:
        return self.policy + SHORT[self.suite]

    @property
    def total(self) -> int:
        """Episodes."""
        return self.evidence.episodes


def pool_column(suite: str, cells: list[tuple[int, EvaluationResult]]) -> Column:
    """The column of a policy from the (seed, result) of its cells."""
    pooled = join([result for _, result in cells])
    seeds: dict[int, dict[str, float]] = {}
    for seed in dict.fromkeys(seed for seed, _ in cells):
        same = join([result for cell_seed, result in cells if cell_seed == seed])
        seeds[seed] = {name: _mean(values) for name, values in same.episodes.items()}
    evidence = pooled.evidence._replace(policy=pooled.policy + SHORT[suite])
    return Column(pooled.policy, suite, pooled.summary(), evidence, seeds)


def _mean(values: np.ndarray) -> float:
    kept = values[~np.isnan(values)]
    return float(kept.mean()) if len(kept) else float("nan")


def best(means: dict[str, float | None], row: Measure) -> set[str]:
    """Names with the best mean as printed: several where they tie, none where there is no value or only one name."""
    printed = {name: float(row.write(mean)) for name, mean in means.items() if mean is not None and mean == mean}
    if len(means) < 2 or not printed:
        return set()
    top = max(row.better * number for number in printed.values())
    return {name for name, number in printed.items() if row.better * number == top}


def best_columns(columns: list[Column], row: Measure) -> set[str]:
    """Names of the columns that are bold in a row; each set of maps is compared by itself."""
    found: set[str] = set()
    for suite in dict.fromkeys(column.suite for column in columns):
        rivals = [column for column in columns if column.suite == suite and column.policy != ORACLE]
        found |= best({rival.name: rival.summary[row.metric]["mean"] for rival in rivals}, row)
    return found


def evidence_of(columns: list[Column]) -> list[str]:
    """Sentences on what the figures rest on, where that is little."""
    return describe_evidence([column.evidence for column in columns])


# Parts of a cell


def value_text(column: Column, row: Measure) -> str:
    """68.8 ± 5.7, or - where no episode got there."""
    summary = column.summary[row.metric]
    return f"{row.write(summary['mean'])} ± {row.write(summary['std'])}" if summary["n"] else NONE


def interval_text(column: Column, row: Measure) -> str:
    """[67.2, 70.1], and of how many episodes where it can be fewer than all; "" where there is neither."""
    summary = column.summary[row.metric]
    counted = row.symbol.startswith(("CS", "MO")) or not summary["n"]
    return f"{brackets(summary, row.write)} {reached(summary, column.total) * counted}".strip()


def paper_text(scenario: str, column: Column, row: Measure, digits: int | None = None) -> str | None:
    """The paper's value of the same scenario and algorithm, to the digits it was printed with or to `digits`."""
    value = paper_value(scenario, column.policy, row.metric)
    digits = (0 if row.symbol.startswith("CS") else 2) if digits is None else digits
    return None if value is None else " ± ".join(map(fixed(digits), value))


# Terminal


def print_tables(tables: dict[str, list[Column]], console: Console | None = None, goal: float = 0.95) -> None:
    """A table per scenario, policies as rows, and one of the coverage in all of them; fits 100 columns.

    Args:
        goal: coverage that ended an episode
    """
    console = console or Console()
    console = Console(file=console.file, width=max(100, console.width), force_terminal=console.is_terminal)
    for scenario, columns in tables.items():
        console.print(draw_table(scenario, columns, shown_for(goal)))
        for sentence in evidence_of(columns):
            console.print(Text(sentence))
    if len(tables) > 1:
        console.print(draw_overview(tables))
    console.print(Group(*(Text(note, style="dim") for note in NOTES)))


def draw_table(scenario: str, columns: list[Column], rows: list[Measure]) -> Table:
    """The table of one scenario."""
    lines = []
    bold = {row.metric: best_columns(columns, row) for row in rows}
    for column in columns:
        cells = [
            TableCell(value_text(column, row), column.name in bold[row.metric], (_narrow(column, row),)).terminal()
            for row in rows
        ]
        lines.append([column.name.replace(" (", "\n("), *cells])
        published = [paper_text(scenario, column, row, row.digits) for row in rows]
        if any(published):
            lines.append([Text(text or NONE, style="dim") for text in ("  paper", *published)])
    title = f"{scenario}: {columns[0].total} episodes a policy"
    return terminal_table(title, ["policy", *(row.heading.replace(" steps", "") for row in rows)], lines)


def draw_overview(tables: dict[str, list[Column]]) -> Table:
    """Exploration ratio of every policy in every scenario."""
    row = ROWS[0]
    lines = []
    for name in dict.fromkeys(column.name for columns in tables.values() for column in columns):
        cells = []
        for columns in tables.values():
            bold = best_columns(columns, row)
            found = next((column for column in columns if column.name == name), None)
            cells.append(TableCell(value_text(found, row) if found else "", name in bold).terminal())
        lines.append([name.replace(" (", "\n("), *cells])
    heads = ["policy", *(scenario.replace("_", "\n", 1) for scenario in tables)]
    return terminal_table(f"all scenarios: {row.heading}", heads, lines)


def _narrow(column: Column, row: Measure) -> str:
    """How many got there for CS, else the interval: there is no room for both."""
    summary = column.summary[row.metric]
    if row.symbol.startswith("CS") or not summary["n"]:
        return reached(summary, column.total)
    return brackets(summary, row.write).strip()


# Files


def table_csv(tables: dict[str, list[Column]]) -> str:
    """A line per scenario, policy, set of maps and metric, all metrics; empty where there is no value."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        [
            "scenario",
            "policy",
            "maps",
            "metric",
            "mean",
            "std",
            "ci95_low",
            "ci95_high",
            "reached",
            "episodes",
            "best",
            "paper_mean",
            "paper_std",
            "seed_means",
        ]
    )
    rows = {row.metric: row for row in ROWS}
    for scenario, columns in tables.items():
        bold = {row.metric: best_columns(columns, row) for row in ROWS}
        for column in columns:
            for metric, summary in column.summary.items():
                row = rows.get(metric)
                published = paper_value(scenario, column.policy, metric) or ("", "")
                scale = row.factor if row else 1.0
                published = [value / scale if value != "" else "" for value in published]
                numbers = [summary["mean"], summary["std"], *summary["ci95"]]
                seeds = " ".join(f"{seed}:{means[metric]:.6g}" for seed, means in column.seeds.items())
                is_best = int(column.name in bold[metric]) if row else ""
                writer.writerow(
                    [
                        scenario,
                        column.policy,
                        column.suite,
                        metric,
                        *map(_csv_number, numbers),
                        summary["n"],
                        column.total,
                        is_best,
                        *map(_csv_number, published),
                        seeds,
                    ]
                )
    return text.getvalue()


def _csv_number(value) -> str:
    return "" if value == "" or value != value else f"{value:.6g}"


def table_markdown(
    tables: dict[str, list[Column]], heading: str = "", below: dict[str, str] | None = None, goal: float = 0.95
) -> str:
    """A table per scenario as in the paper: metrics as rows, policies as columns.

    Args:
        heading: what was run
        below: scenario -> what stands below its table
        goal: coverage that ended an episode
    """
    parts = [heading] if heading else []
    for scenario, columns in tables.items():
        lines = [f"### {scenario}", "", f"{columns[0].total} episodes a policy.", ""]
        lines += [f"{sentence}\n" for sentence in evidence_of(columns)]
        rows = []
        for row in rows_for(goal):
            bold = best_columns(columns, row)
            rows.append([row.heading, *(_markdown_cell(scenario, column, row, bold) for column in columns)])
        lines += markdown_table(["", *(column.name for column in columns)], rows)
        if scenario in (below or {}):
            lines += ["", below[scenario]]
        parts.append("\n".join(lines))
    return "\n\n".join([*parts, *NOTES]) + "\n"


def _markdown_cell(scenario: str, column: Column, row: Measure, bold: set[str]) -> str:
    published = paper_text(scenario, column, row)
    below = filter(None, (interval_text(column, row), published and f"paper {published}"))
    return TableCell(value_text(column, row), column.name in bold, tuple(below)).markdown()


def table_latex(tables: dict[str, list[Column]], heading: str = "", goal: float = 0.95) -> str:
    """One tabular for \\input: scenarios and metrics as rows, policies as columns; needs booktabs and multirow."""
    names = list(dict.fromkeys(column.name for columns in tables.values() for column in columns))
    rows = rows_for(goal)
    lines = [f"% {heading}", r"% \usepackage{booktabs,multirow}"]
    lines += [rf"\begin{{tabular}}{{ll{'c' * len(names)}}}", r"\toprule"]
    lines.append(latex_row(["", "", *map(latex_text, names)]))
    for scenario, columns in tables.items():
        lines.append(r"\midrule")
        have = [next((column for column in columns if column.name == name), None) for name in names]
        published = any(paper_text(scenario, column, ROWS[0]) for column in columns)
        height = len(rows) * (3 if published else 2)
        for k, row in enumerate(rows):
            head = rf"\multirow{{{height}}}{{*}}{{{latex_text(scenario)}}}" if k == 0 else ""
            bold = best_columns(columns, row)
            cells = [column and TableCell(value_text(column, row), column.name in bold).latex() for column in have]
            intervals = [column and latex_small(interval_text(column, row)) for column in have]
            lines += [latex_row([head, latex_text(row.heading), *cells]), latex_row(["", "", *intervals])]
            if published:
                texts = [column and paper_text(scenario, column, row) for column in have]
                papers = [text and latex_small(TableCell(text).latex()) for text in texts]
                lines.append(latex_row(["", latex_small("paper"), *papers]))
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", *("% " + note for note in NOTES)]) + "\n"
