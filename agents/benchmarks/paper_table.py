"""The table of a benchmark, in the layout of the paper's: pooled over seeds, bold computed, four ways of writing it."""

import csv
import io
from dataclasses import dataclass, field

import numpy as np
from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from maexp.agents.evaluation.evaluate import EvaluationResult, join
from maexp.agents.evaluation.metric_format import MEASURES, Evidence, Measure, describe_evidence
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

COLUMNS = (
    "exploration_ratio",
    "coverage_step_85",
    "coverage_step_95",
    "mutual_overlap_85",
    "mutual_overlap_95",
    "reward_variance",
)

PAPER: dict[str, dict[str, tuple]] = {
    "random_obstacles": {
        "itrpo": ((68.81, 5.71), None, None, None, None, (610.73, 79.25)),
        "ippo": ((63.07, 4.69), None, None, None, None, (711.56, 109.97)),
        "matrpo": ((61.12, 3.76), None, None, None, None, (825.65, 63.06)),
        "mappo": ((62.53, 3.38), None, None, None, None, (831.93, 94.97)),
        "vdppo": ((60.04, 4.54), None, None, None, None, (632.18, 83.41)),
        "vda2c": ((64.23, 3.43), None, None, None, None, (810.62, 76.26)),
    },
    "maze": {
        "itrpo": ((79.71, 7.32), (449, 63), (501, 77), (51.56, 6.49), (43.89, 4.76), (931.00, 104.18)),
        "ippo": ((93.17, 4.27), (377, 51), (441, 57), (45.52, 7.87), (42.38, 7.12), (970.43, 76.31)),
        "matrpo": ((86.29, 7.63), (376, 72), (472, 65), (48.21, 9.19), (43.91, 8.12), (910.37, 82.33)),
        "mappo": ((89.15, 5.07), (370, 67), (442, 44), (46.22, 9.46), (38.53, 2.95), (929.25, 89.14)),
        "vdppo": ((83.12, 5.08), (468, 45), (506, 35), (58.96, 5.03), (58.66, 4.02), (951.11, 82.10)),
        "vda2c": ((93.23, 3.54), (322, 59), (416, 54), (49.60, 5.65), (47.62, 5.91), (907.74, 60.99)),
    },
    "indoor_small": {
        "itrpo": ((90.46, 5.12), (268, 45), (437, 65), (51.37, 4.84), (48.90, 2.54), (871.78, 38.41)),
        "ippo": ((94.18, 0.76), (157, 5), (205, 41), (54.06, 3.55), (50.89, 4.59), (576.31, 8.84)),
        "matrpo": ((89.66, 0.79), (237, 13), (356, 92), (57.49, 4.59), (59.37, 4.29), (547.39, 45.81)),
        "mappo": ((93.23, 3.56), (206, 88), (284, 107), (60.78, 9.24), (59.14, 8.47), (602.14, 78.95)),
        "vdppo": ((91.85, 3.01), (236, 92), (358, 111), (64.03, 15.29), (66.83, 17.67), (541.55, 99.39)),
        "vda2c": ((93.59, 0.33), (170, 12), (235, 52), (77.14, 3.89), (77.32, 8.40), (496.54, 33.77)),
    },
    "indoor_medium": {
        "itrpo": ((79.38, 5.00), (400, 84), (557, 47), (49.60, 7.49), (44.77, 6.84), (347.76, 42.10)),
        "ippo": ((91.48, 4.36), (287, 54), (470, 61), (46.38, 3.35), (46.39, 4.36), (318.29, 50.87)),
        "matrpo": ((75.73, 8.91), (472, 44), (536, 67), (49.92, 8.45), (57.92, 8.39), (389.70, 89.74)),
        "mappo": ((87.01, 5.71), (356, 40), None, (38.22, 2.81), None, (385.22, 49.97)),
        "vdppo": ((89.97, 3.11), (308, 41), (447, 24), (36.58, 1.63), (42.38, 0.74), (309.89, 31.52)),
        "vda2c": ((76.93, 3.95), (320, 30), (449, 26), (45.20, 3.32), (40.45, 1.04), (445.24, 39.86)),
    },
    "indoor_large": {
        "itrpo": ((59.40, 3.95), None, None, None, None, (252.95, 104.43)),
        "ippo": ((71.32, 4.79), None, None, None, None, (257.30, 59.91)),
        "matrpo": ((77.31, 4.39), None, None, None, None, (280.52, 74.28)),
        "mappo": ((70.19, 4.94), None, None, None, None, (248.80, 87.86)),
        "vdppo": ((67.72, 4.96), None, None, None, None, (198.38, 78.41)),
        "vda2c": ((73.97, 2.86), None, None, None, None, (275.55, 37.27)),
    },
    "outdoor": {
        "itrpo": ((26.91, 4.12), None, None, None, None, (457.93, 84.23)),
        "ippo": ((33.06, 6.90), None, None, None, None, (534.92, 94.25)),
        "matrpo": ((32.72, 4.31), None, None, None, None, (433.80, 115.81)),
        "mappo": ((38.15, 7.24), None, None, None, None, (445.98, 118.32)),
        "vdppo": ((30.31, 5.48), None, None, None, None, (431.67, 103.54)),
        "vda2c": ((26.76, 4.38), None, None, None, None, (561.50, 114.43)),
    },
}


def paper_value(scenario: str, policy: str, metric: str) -> tuple[float, float] | None:
    """(mean, standard deviation) that the paper printed, None where it has none."""
    row = PAPER.get(scenario, {}).get(policy)
    return None if row is None or metric not in COLUMNS else row[COLUMNS.index(metric)]


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
