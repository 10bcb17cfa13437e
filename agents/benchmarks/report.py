"""The report of a benchmark: tables, summaries and pictures of the cells that are done, and their statistics."""

import csv
import io
from importlib import metadata
from pathlib import Path

import numpy as np

from maexp.agents.benchmarks.cell import VALIDATION, finished, read_result
from maexp.agents.benchmarks.paper_table import (
    Column,
    paper_value,
    pool_column,
    print_tables,
    table_csv,
    table_latex,
    table_markdown,
)
from maexp.agents.benchmarks.plan import SUITES, Cell, as_list, is_learned, training_cell
from maexp.agents.config.verbs import BenchmarkSettings
from maexp.agents.evaluation.comparison import find_best
from maexp.agents.evaluation.evaluate import EvaluationResult, join, pool
from maexp.agents.evaluation.metric_format import compared
from maexp.agents.files import short, write_json, write_text
from maexp.agents.policies.classical import CLASSICAL
from maexp.agents.tables import markdown_table
from maexp.agents.versions import PACKAGES, find_commit
from maexp.envs.metrics import LEAST_DISTINCT

RESAMPLES = 2000


def win_shares(x: np.ndarray, y: np.ndarray, counts_x: np.ndarray, counts_y: np.ndarray) -> np.ndarray:
    """P(X > Y) + P(X = Y) / 2 of weighted samples.

    Args:
        x, y: values, shapes [n] and [m]
        counts_x, counts_y: how often each counts in each resample, [resamples, n] and [resamples, m]

    Returns:
        [resamples]
    """
    wins = 0.5 * (np.sign(x[:, None] - y[None, :]) + 1.0)
    total = counts_x.sum(1) * counts_y.sum(1)
    return np.einsum("bm,bm->b", counts_x @ wins, counts_y) / total


Sample = dict[str, np.ndarray]  # scenario -> a number for each episode


def improvement(x: Sample, y: Sample, copies: tuple[Sample, Sample] | None = None, seed: int = 0) -> dict:
    """{mean, ci95, n}: how likely X has more than Y, over the scenarios that both have; no interval where one of the
    two has fewer than `LEAST_DISTINCT` distinct episodes.

    Args:
        x, y: scenario -> values of the episodes
        copies: of `label_copies`, of x and of y; None: there are none
        seed: of the resampling
    """
    rng = np.random.default_rng(seed)
    shares, once, distinct = [], [], np.zeros(2, dtype=int)
    for scenario in (name for name in x if name in y):
        first, second = (np.asarray(values, dtype=np.float64) for values in (x[scenario], y[scenario]))
        once.append(win_shares(first, second, np.ones((1, len(first))), np.ones((1, len(second))))[0])
        labels = (
            [np.arange(len(v)) for v in (first, second)] if copies is None else [group[scenario] for group in copies]
        )
        counts = [_draw(rng, group) for group in labels]
        distinct += [len(np.unique(group)) for group in labels]
        shares.append(win_shares(first, second, *counts))
    if not once:
        return {"mean": np.nan, "ci95": [np.nan, np.nan], "n": 0}
    ends = np.percentile(np.mean(shares, axis=0), [2.5, 97.5])
    ends = ends.tolist() if distinct.min() >= LEAST_DISTINCT else [np.nan, np.nan]
    return {"mean": float(np.mean(once)), "ci95": ends, "n": len(once)}


def _draw(rng: np.random.Generator, labels: np.ndarray) -> np.ndarray:
    """How often each episode counts in each resample, [RESAMPLES, episodes]."""
    distinct, group = np.unique(labels, return_inverse=True)
    drawn = rng.multinomial(len(distinct), np.full(len(distinct), 1 / len(distinct)), size=RESAMPLES)
    return drawn[:, group].astype(np.float64)


def compare_all(values: dict[str, Sample], copies: dict[str, Sample] | None = None) -> dict[tuple[str, str], dict]:
    """`improvement` of every ordered pair of policies.

    Args:
        values: policy -> scenario -> values of the episodes, of which more is better
        copies: the same of `label_copies`; None: there are none
    """
    names = list(values)
    pairs = {}
    for i, name in enumerate(names):
        for other in names[i + 1 :]:
            found = improvement(values[name], values[other], copies and (copies[name], copies[other]))
            low, high = found["ci95"]
            pairs[name, other] = found
            pairs[other, name] = found | {"mean": 1 - found["mean"], "ci95": [1 - high, 1 - low]}
    return pairs


def pairs_csv(pairs: dict[tuple[str, str], dict]) -> str:
    """A line per ordered pair."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["policy", "better_than", "probability", "ci95_low", "ci95_high", "scenarios"])
    for (policy, other), found in pairs.items():
        numbers = ["" if value != value else f"{value:.4f}" for value in (found["mean"], *found["ci95"])]
        writer.writerow([policy, other, *numbers, found["n"]])
    return text.getvalue()


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


Samples = dict[str, dict[str, np.ndarray]]  # policy -> scenario -> a number for each episode
SMOKE = "Smoke shows that everything runs; policies are hardly trained, so its figures are no result."


class Report:
    """Reads finished cells, each once, and writes what comes of them.

    Args:
        cfg: settings of maexp benchmark
        where: the folder
        cells: all cells, in their order
        suites: the sets of maps
    """

    def __init__(self, cfg: BenchmarkSettings, where: Path, cells: list[Cell], suites: list[str]):
        self.cfg, self.where, self.cells, self.suites = cfg, where, cells, suites
        self._results: dict[tuple[Cell, str], EvaluationResult] = {}
        self._columns: dict[tuple, Column] = {}
        self._written: set[tuple[int, str]] = set()

    def read_all(self) -> None:
        """Read every finished cell, so that a damaged one is named before hours go into the others.

        Raises:
            UserError: one is damaged.
        """
        for scenario, policy in dict.fromkeys((cell.scenario, cell.policy) for cell in self.cells):
            for suite in self.suites:
                self.results(scenario, policy, suite)

    def update(self, done: list[Cell]) -> None:
        """Write the tables when a scenario has been through all its policies with a seed."""
        blocks = {(cell.seed, cell.scenario) for cell in done}
        blocks = {block for block in blocks - self._written if self._is_whole(block)}
        if blocks:
            self._written |= blocks
            self.write_tables()

    def _is_whole(self, block: tuple[int, str]) -> bool:
        cells = [cell for cell in self.cells if (cell.seed, cell.scenario) == block]
        return all(finished(self.where, cell, suite) for cell in cells for suite in self.suites)

    def finish(self) -> None:
        """Everything, and the table on the terminal."""
        tables = self.write_tables()
        if not tables:
            print("No cell is done yet, so there is no table.")
            return
        written = ["table.csv", "table.md", "table.tex", "summary.json", *self.draw(tables)]
        goal = self.cfg.scenario.success_coverage
        print_tables(tables, goal=goal)
        for scenario, columns in tables.items():
            rival = self._rival(scenario)
            if rows := against(self.differences(scenario, columns), rival):
                print("\n".join(differences_text(scenario, rival, rows, goal)))
        if self.cfg.preset == "smoke":
            print(SMOKE)
        print(f"Written to {short(self.where)}: {', '.join(written)}")

    def results(self, scenario: str, policy: str, suite: str) -> list[tuple[Cell, EvaluationResult]]:
        """The finished cells of a policy in a scenario."""
        found = []
        for cell in self.cells:
            if (cell.scenario, cell.policy) == (scenario, policy) and finished(self.where, cell, suite):
                if (cell, suite) not in self._results:
                    self._results[cell, suite] = read_result(self.where, cell, suite)
                found.append((cell, self._results[cell, suite]))
        return found

    def tables(self) -> dict[str, list[Column]]:
        """Per scenario the columns of all policies that have finished cells."""
        tables: dict[str, list[Column]] = {}
        policies = list(dict.fromkeys(cell.policy for cell in self.cells))
        for scenario in dict.fromkeys(cell.scenario for cell in self.cells):
            columns = [self._column(scenario, policy, suite) for suite in self.suites for policy in policies]
            columns = [column for column in columns if column is not None]
            if columns:
                tables[scenario] = columns
        return tables

    def _column(self, scenario: str, policy: str, suite: str) -> Column | None:
        found = self.results(scenario, policy, suite)
        if not found:
            return None
        key = (scenario, policy, suite, *(cell for cell, _ in found))
        if key not in self._columns:
            self._columns[key] = pool_column(suite, [(cell.seed, result) for cell, result in found])
        return self._columns[key]

    def write_tables(self) -> dict[str, list[Column]]:
        """table.csv, table.md, table.tex and summary.json; returns the columns of each scenario."""
        tables = self.tables()
        if tables:
            goal = self.cfg.scenario.success_coverage
            write_text(self.where / "table.csv", table_csv(tables))
            rivals = {scenario: self._rival(scenario) for scenario in tables}
            apart = {scenario: self.differences(scenario, columns) for scenario, columns in tables.items()}
            below = {
                scenario: differences_markdown(rivals[scenario], rows, goal)
                for scenario in tables
                if (rows := against(apart[scenario], rivals[scenario]))
            }
            write_text(self.where / "table.md", table_markdown(tables, self.heading(), below, goal))
            write_text(self.where / "table.tex", table_latex(tables, self.heading(), goal))
            content = {}
            for scenario, columns in tables.items():
                named = {column.name: column.summary for column in columns}
                named |= {"difference": apart[scenario]} if apart[scenario] else {}
                content[scenario] = named
                run = self.describe([scenario]) | {"best_classical": rivals[scenario]}
                write_json(self.where / "summaries" / f"{scenario}.json", named | {"run": run})
            run = self.describe(list(tables)) | {"best_classical": rivals}
            write_json(self.where / "summary.json", content | {"run": run})
        return tables

    def _rival(self, scenario: str) -> str | None:
        """The best classical planner on the validation maps."""
        planners = [name for name in dict.fromkeys(cell.policy for cell in self.cells) if name in CLASSICAL]
        played = {name: self.results(scenario, name, VALIDATION) for name in planners}
        return find_best({name: [result for _, result in cells] for name, cells in played.items()})

    def differences(self, scenario: str, columns: list[Column]) -> dict[str, dict]:
        """{a: {b: {metric: {mean, std, ci95, n}}}} of a - b on the same maps, for every a that is learned or one's own
        and all others."""
        found: dict[str, dict] = {}
        for learned in (column for column in columns if is_learned(column.policy)):
            for other in (other for other in columns if other is not learned and other.suite == learned.suite):
                mine, theirs = (self.results(scenario, column.policy, learned.suite) for column in (learned, other))
                if apart := subtract(mine, theirs):
                    found.setdefault(learned.name, {})[other.name] = apart
        return found

    def heading(self) -> str:
        """A sentence on what the tables show."""
        cfg = self.cfg
        length = f"{cfg.total_frames:,} macro steps" if cfg.iterations is None else f"{cfg.iterations:,} iterations"
        seeds = ", ".join(str(seed) for seed in as_list(cfg.seeds))
        text = f"maexp benchmark, preset {cfg.preset}: {cfg.num_robots} robots, planner {cfg.planner.name}, "
        if cfg.planner.name == "dwa":
            text += f"clearance factor {cfg.planner.clearance_factor or 'of the scenario'}, "
        all_at_once = " on all scenarios at once" if cfg.together else ""
        text += f"{length} of training for each algorithm{all_at_once}, seeds {seeds}, {cfg.episodes} episodes each, "
        text += f"commit {find_commit()}."
        return text + (f" {SMOKE}" if cfg.preset == "smoke" else "")

    def describe(self, scenarios: list[str]) -> dict:
        """What was run, of the cells that are done."""
        known = {cell: result.run for (cell, _), result in self._results.items() if cell.scenario in scenarios}
        chosen = [(suite, result.run) for (cell, suite), result in self._results.items() if cell.scenario in scenarios]
        runs = [run for _, run in chosen]
        return {
            "preset": self.cfg.preset,
            "scenario": scenarios[0] if len(scenarios) == 1 else scenarios,
            "maps": sorted({name for suite, run in chosen if suite in self.suites for name in run["maps"]}),
            "maps_are": self.suites,
            "seeds": sorted({cell.seed for cell in known}),
            "episodes": self.cfg.episodes,
            "success_coverage": self.cfg.scenario.success_coverage,
            "num_robots": self.cfg.num_robots,
            "planner": self.cfg.planner.name,
            "cells": {"done": len(known), "all": sum(cell.scenario in scenarios for cell in self.cells)},
            "commit": find_commit(),
            "commits_of_cells": sorted({str(run["commit"]) for run in runs}),
            "versions": {name: metadata.version(name) for name in PACKAGES},
            "seconds": round(sum(run["seconds"] for run in runs), 2),
            "training_seconds": round(sum(self._trainings(known).values()), 2),
        }

    def _trainings(self, runs: dict[Cell, dict]) -> dict[Cell, float]:
        """Seconds of every training, each once."""
        return {training_cell(self.cfg, cell): run.get("training_seconds", 0.0) for cell, run in runs.items()}

    # Pictures

    def draw(self, tables: dict[str, list[Column]]) -> list[str]:
        """All pictures and the table behind the comparison; returns their names."""
        written = []
        for suite in self.suites:
            played = {name: [column for column in columns if column.suite == suite] for name, columns in tables.items()}
            played = {name: columns for name, columns in played.items() if columns}
            if played:
                written += self._draw_suite(suite, played)
        return written

    def _draw_suite(self, suite: str, played: dict[str, list[Column]]) -> list[str]:
        """Those of one set of maps; the training maps have a mark in the file's name."""
        from maexp.agents.benchmarks.plots import draw_coverage_panels, draw_improvement, draw_overview

        mark, paths = "" if suite == "held_out" else f"_{suite}", []
        for scenario, columns in played.items():
            title = f"{scenario.replace('_', ' ')}, {SUITES[suite]}"
            path = self.where / f"coverage_{scenario}{mark}.png"
            paths.append(draw_coverage_panels(self._curves(scenario, columns), title, path))
        points = {scenario: _points(scenario, columns) for scenario, columns in played.items()}
        paths.append(draw_overview(points, self.where / f"overview{mark}.png"))
        values = self._coverage(suite, played)
        if len(values[0]) > 1:
            pairs = compare_all(*values)
            paths.append(self.where / f"improvement{mark}.csv")
            write_text(paths[-1], pairs_csv(pairs))
            trained = [name for name in values[0] if is_learned(name)]
            listed = trained if len(trained) > 1 else list(values[0])[:6]
            paths.append(draw_improvement(pairs, listed, self.where / f"improvement{mark}.png"))
        return [path.name for path in paths]

    def _coverage(self, suite: str, played: dict[str, list[Column]]) -> tuple[Samples, Samples]:
        """Policy -> scenario -> final coverage of all episodes; and which of these are copies."""
        values: Samples = {}
        copies: Samples = {}
        for scenario, columns in played.items():
            for column in columns:
                pooled = join([result for _, result in self.results(scenario, column.policy, suite)])
                values.setdefault(column.policy, {})[scenario] = pooled.episodes["exploration_ratio"]
                copies.setdefault(column.policy, {})[scenario] = pooled.copies()
        return values, copies

    def _curves(self, scenario: str, columns: list[Column]) -> dict[str, dict]:
        """Panel -> policy -> times [s], coverage [episodes, times], maps [episodes]; `random` is in both panels."""
        curves = {}
        for column in columns:
            found = pool([result for _, result in self.results(scenario, column.policy, column.suite)])
            curves[column.policy] = (found.times, found.coverage, found.maps)
        trained = {name: curve for name, curve in curves.items() if is_learned(name)}
        classical = {name: curve for name, curve in curves.items() if not is_learned(name)}
        if trained and "random" in classical:
            trained["random"] = classical["random"]
        return {"trained": trained, "classical": classical}


def against(apart: dict[str, dict], rival: str | None) -> dict[str, dict]:
    """policy -> its difference to `rival` on the same maps, of what `Report.differences` found."""
    rows = {
        name: [found for other, found in others.items() if other.split(" (")[0] == rival]  # less the mark of its maps
        for name, others in apart.items()
    }
    return {name: found[0] for name, found in rows.items() if found}


def _points(scenario: str, columns: list[Column]) -> list[tuple]:
    """What `draw_overview` shows of a scenario."""
    points = []
    for column in columns:
        kind = "trained" if is_learned(column.policy) else "classical"
        found, published = (
            column.summary["exploration_ratio"],
            paper_value(scenario, column.policy, "exploration_ratio"),
        )
        points.append((column.policy, kind, found, published and published[0] / 100))
    return points
