"""The tables of a benchmark: means, what is best, and differences from the best classical planner."""

import csv
from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from maexp.agents.benchmarks.paper_table import (
    ROWS,
    best,
    best_columns,
    evidence_of,
    pool_column,
    print_tables,
    table_csv,
    table_latex,
    table_markdown,
)
from maexp.agents.benchmarks.plan import Cell
from maexp.agents.benchmarks.report import differences_markdown, differences_text, subtract
from maexp.agents.evaluation.comparison import find_best
from maexp.agents.evaluation.evaluate import EvaluationResult
from maexp.agents.evaluation.metric_format import MEASURES


def column(policy: str, seed: int = 0, **values: list[float]):
    """Each value in three episodes, which differ in the metrics that are not given."""
    names = [row.metric for row in ROWS]
    episodes = {name: np.repeat(np.array(values.get(name, [0.5, 0.7]), dtype=float), 3) for name in names}
    episodes["path_length"] = np.arange(6.0)
    return pool_column("held_out", [(seed, EvaluationResult(policy, 3, episodes, 0.0, np.repeat(["a", "b"], 3)))])


ZERO = {"mean": 0.0, "ci95": [0.0, 0.0]}
APART = {"ippo": {row.metric: ZERO for row in ROWS} | {"collisions": ZERO}}
ER, CS = MEASURES["exploration_ratio"], MEASURES["coverage_step_85"]


def test_best_goes_by_direction_and_by_what_is_printed():
    assert best({"a": 0.9, "b": 0.5}, ER) == {"a"} and best({"a": 90.0, "b": 50.0}, CS) == {"b"}
    assert best({"a": 0.9001, "b": 0.9004, "c": 0.1}, ER) == {"a", "b"}  # both print as 90.0
    assert best({"a": float("nan"), "b": 412.0}, CS) == {"b"} and best({"a": float("nan")}, CS) == set()
    assert best({"a": float("nan"), "b": None}, CS) == set() and best({"a": 0.9}, ER) == set()


@pytest.fixture
def tables() -> dict:
    nan = np.nan
    columns = [
        column("random", exploration_ratio=[0.5, 0.7], coverage_step_85=[nan, nan], coverage_step_95=[nan, nan]),
        column("ippo", exploration_ratio=[0.9, 0.97], coverage_step_85=[300, 350], coverage_step_95=[nan, 400]),
    ]
    return {"maze": columns, "maze_small": [column("random"), column("voronoi", exploration_ratio=[0.6, 0.6])]}


def test_csv_has_a_row_for_every_scenario_policy_and_metric(tables):
    rows = list(csv.DictReader(StringIO(table_csv(tables))))
    assert len(rows) == 4 * (len(ROWS) + 1)
    found = {(row["scenario"], row["policy"], row["metric"]): row for row in rows}
    row = found["maze", "ippo", "coverage_step_95"]
    assert (float(row["mean"]), row["reached"], row["episodes"], row["best"]) == (400, "3", "6", "1")
    assert float(row["paper_mean"]) == 441
    assert found["maze", "random", "coverage_step_95"]["mean"] == ""
    assert float(found["maze", "ippo", "exploration_ratio"]["paper_mean"]) == pytest.approx(0.9317)
    ties = [found["maze_small", name, "exploration_ratio"]["best"] for name in ("random", "voronoi")]
    assert ties == ["1", "1"]


def test_markdown_and_latex_mark_the_best(tables):
    text = table_markdown(tables)
    row = next(line for line in text.splitlines() if line.startswith("| CS95"))
    assert row.split("|")[2].strip() == "-<br>(0/6)"
    assert row.split("|")[3].strip() == "**400 ± 0**<br>(3/6)<br>paper 441 ± 57"  # three: too few
    rows = [line for line in text.splitlines() if line.startswith("| ER")]
    assert "93.5 ± 3.5**<br>[90.0, 97.0]<br>" in rows[0]
    assert rows[1].count("**60.0 ±") == 2 and rows[0].count("**") == 2
    latex = table_latex(tables)
    assert r"$\mathbf{93.5} \pm 3.5$" in latex and r"$93.17 \pm 4.27$" in latex
    widths = {line.count("&") for line in latex.splitlines() if line.endswith(r"\\")}
    assert len(widths) == 1 and latex.count("{tabular}") == 2


def test_rows_of_99_percent_stand_where_episodes_go_on_until_then(tables):
    for goal, count in ((0.95, 0), (0.99, 1)):
        text, latex, out = table_markdown(tables, goal=goal), table_latex(tables, goal=goal), StringIO()
        print_tables(tables, Console(file=out, width=80), goal)
        assert text.count("\n| CS99") == text.count("\n| to 99") == 2 * count
        assert (" CS99 " in out.getvalue()) == bool(count)
        assert latex.count("& CS99") == 2 * count and rf"\multirow{{{3 * (8 + 2 * count)}}}" in latex
        assert ("steps to 99 %" in differences_markdown("voronoi", APART, goal)) == bool(count)
        assert ("steps to 99 %" in differences_text("maze", "voronoi", APART, goal)[1]) == bool(count)


def test_the_terminals_table_fits_100_columns(tables):
    wide = [1400.0, 2999.0]
    tables["maze"].append(column("potential_field", reward_variance=wide, coverage_step_85=wide, coverage_step_95=wide))
    out = StringIO()
    print_tables(tables, Console(file=out, width=80))
    text = out.getvalue()
    assert max(map(len, text.splitlines())) <= 100
    assert "2200 ± 800" in text.replace("  ", " ") and "441 ± 57" in text and "…" not in text


# Less the best classical planner


def played(policy: str, coverage: list, seed: int = 0, maps: list = ("a", "b")) -> tuple[Cell, EvaluationResult]:
    values = np.array(coverage)
    episodes = {"coverage_auc": values, "coverage_step_95_censored": -100 * values, "collisions": 0 * values}
    cell = Cell("maze", policy, seed)
    seeds = np.full(len(maps), seed) if cell.trains else None
    return cell, EvaluationResult(policy, 3, episodes, 0.0, np.array(maps), trainings=seeds)


def test_differences_are_of_the_same_episodes_and_resample_the_seeds_of_training():
    maps = ["a", "a", "b", "b", "b"]
    planner = [played("voronoi", [0.1, 0.2, 0.6, 0.9, 0.8], seed, maps) for seed in (0, 1, 2)]
    alike = [played("ippo", [0.2, 0.3, 0.7, 1.0, 0.9], seed, maps) for seed in (2, 0)]
    found = subtract(alike, planner)["coverage_auc"]
    assert (found["n"], found["mean"]) == (10, pytest.approx(0.1)) and found["ci95"] == [pytest.approx(0.1)] * 2
    unlike = [alike[1], played("ippo", [0.0, 0.1, 0.5, 0.8, 0.7], 1, maps)]
    found = subtract(unlike, planner)["coverage_auc"]
    assert found["mean"] == pytest.approx(0.0) and found["ci95"] == [pytest.approx(-0.1), pytest.approx(0.1)]
    assert subtract([played("ippo", [0.5, 0.5], 7)], planner) == {}
    text = differences_markdown("voronoi", {"ippo": subtract(alike, planner)})
    assert "| ippo | +10.0 [+10.0, +10.0] | -10 [-10, -10] | +0.000 [+0.000, +0.000] |" in text


def test_copies_of_an_episode_are_told_and_give_no_interval():
    """Three seeds of a planner that draws nothing, from one start: nine episodes are one."""
    values = {name: np.full(3, 0.5) for name in (row.metric for row in ROWS)}
    played_thrice = [(seed, EvaluationResult("voronoi", 3, values, 0.0, np.repeat("a", 3))) for seed in (0, 1, 2)]
    columns = [pool_column("held_out", played_thrice)]
    (told,) = evidence_of(columns)
    assert told == "Of 9 episodes 1 is distinct, the rest copies: too few for an interval, which takes 5."
    text = table_markdown({"maze": columns})
    assert "| 50.0 ± 0.0 |" in text and "1 is distinct" in text and "50.0, 50.0" not in text
    assert ",0.5,0,,,9,9," in table_csv({"maze": columns})
    means = {"one": 0.6, "two": 0.5}
    pairs = [[played(name, [mean] * 3, seed, ["a"] * 3) for seed in (0, 1)] for name, mean in means.items()]
    text = differences_markdown("two", {"one": subtract(*pairs)})
    assert "| one | +10.0 | -10 | +0.000 |" in text


def test_the_best_planner_is_the_one_that_saw_most_over_time_on_validation_maps():
    voronoi, hungarian = (
        [played("voronoi", [0.5, 0.7])],
        [played("hungarian", [0.9, 0.1]), played("hungarian", [0.9, 0.4], 1)],
    )
    found = {"voronoi": voronoi, "hungarian": hungarian, "rrt_frontiers": []}
    found = {name: [result for _, result in cells] for name, cells in found.items()}
    assert find_best(found) == "voronoi" and find_best({}) is None


def test_what_knows_the_map_is_never_the_best():
    columns = [column("oracle", exploration_ratio=[0.99, 0.99]), column("ippo"), column("random")]
    assert best_columns(columns, ER) == {"ippo", "random"}
