"""The benchmark: its cells, its table, what a kill leaves."""

import contextlib
import csv
import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf
from rich.console import Console

from maexp.agents.benchmark import cell as cells
from maexp.agents.benchmark.cell import CellResult, EnvShelf, read_result, run_cell
from maexp.agents.benchmark.differences import differences_markdown, find_best, subtract
from maexp.agents.benchmark.plan import (
    Cell,
    cell_config,
    cell_folder,
    check_unchanged,
    compose_settings,
    list_cells,
    write_plan,
)
from maexp.agents.benchmark.pool import WorkerPool
from maexp.agents.benchmark.table import (
    ROWS,
    best,
    best_columns,
    pool_column,
    print_tables,
    table_csv,
    table_latex,
    table_markdown,
)
from maexp.agents.cli import main
from maexp.agents.commands.benchmark import prepare
from maexp.agents.errors import UserError
from maexp.agents.settings.overrides import make_overrides
from maexp.agents.training.logs import read_metrics

TINY = [
    "preset=smoke", "scenarios=maze_small", "policies=voronoi,random", "algorithms=mappo", "seeds=0,1", "episodes=3",
    "num_envs=2", "num_robots=2", "scenario.local_steps=5", "iterations=4", "checkpoint_every=1", "workers=1",
    "estimate=false", "device=cpu", "model.channels=4",
]  # fmt: skip
CELLS = [Cell("maze_small", policy, seed) for seed in (0, 1) for policy in ("voronoi", "random", "mappo")]


def settings(*words: str):
    return compose_settings("benchmark", prepare(make_overrides("benchmark", list(words))).words)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A tiny benchmark in one go."""
    folder = tmp_path_factory.mktemp("benchmark") / "whole"
    assert main(["benchmark", *TINY, f"hydra.run.dir={folder}"]) == 0
    return folder


@pytest.fixture
def copy(whole, tmp_path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "copy"))


# Cells


def test_seeds_are_outermost_and_classical_policies_first():
    assert list_cells(settings(*TINY)) == CELLS
    two = [f"{one.seed} {one.scenario}" for one in list_cells(settings(*TINY, "scenarios=maze,outdoor"))]
    assert list(dict.fromkeys(two)) == ["0 maze", "0 outdoor", "1 maze", "1 outdoor"]


def test_the_papers_preset_has_its_288_runs():
    cfg = settings("preset=paper")
    trained = [one for one in list_cells(cfg) if one.trains]
    assert len(trained) == 6 * 16 * 3
    maps = {(one.scenario, one.map) for one in trained}
    assert sorted(name for name, _ in maps).count("outdoor") == 3 and len(maps) == 16
    run, words = cell_config(cfg, Cell("maze", "itrpo", 2, map=3))
    assert (run.scenario.name, run.algorithm.name, run.seed, list(run.scenario.maps)) == ("maze", "itrpo", 2, [3])
    assert (run.num_envs, run.collector.steps, run.total_frames) == (2, 30, 10_000 * 2 * 30)
    assert (run.tuning, run.model.stem, run.reward.events) == ("reference", "conv", 0.0)
    assert run.algorithm.max_kl == 0.06, "the original platform's"
    assert (run.planner.name, settings("preset=cpu").planner.name) == ("dwa", "wavefront")
    assert settings("preset=paper", "planner=wavefront").planner.name == "wavefront"
    assert cell_config(cfg, Cell("outdoor", "itrpo", 2, map=0))[0].collector.steps == 20
    assert compose_settings("train", words) == run


def test_every_setting_reaches_every_cell():
    cfg = settings(
        "scenario=maze,indoor_small", "algorithm=mappo", "policies=[]", "seed=3", "planner=dwa", "radar.range=7",
        "train_maps=2", "test_maps=1", "robot.team=[{kind: differential, radar: {range: 3}}]", "algorithm.lr=0.5",
    )  # fmt: skip
    assert [one.name for one in list_cells(cfg)] == ["maze/mappo/seed_3", "indoor_small/mappo/seed_3"]
    run, _ = cell_config(cfg, list_cells(cfg)[1])
    assert (run.planner.name, run.radar.range, run.algorithm.lr, run.seed) == ("dwa", 7.0, 0.5, 3)
    assert list(run.scenario.maps) == [0, 1] and run.scenario.held_out_count == 1
    assert run.robot.team[0].radar.range == 3


def test_benchmark_json_holds_no_null_and_yet_all_that_must_stay(tmp_path):
    usual, other = settings("scenario=maze"), settings("scenario=maze", "radar.range=7")
    (tmp_path / "cells" / "maze" / "random" / "seed_0").mkdir(parents=True)
    for before, after, change in ((usual, other, "was left open, now 7.0"), (other, usual, "was 7.0, now left open")):
        write_plan(tmp_path, before, [])
        written = json.loads((tmp_path / "benchmark.json").read_text())
        assert None not in written["settings"].values() and "robot.length" in written["left_open"]
        check_unchanged(tmp_path, before)
        with pytest.raises(UserError, match=rf"radar.range \({change}\)"):
            check_unchanged(tmp_path, after)


# A benchmark from end to end


def test_files_and_summaries(whole):
    for name in ("table.csv", "table.md", "table.tex", "config.yaml", "coverage_maze_small.png", "overview.png",
                 "improvement.png", "improvement.csv"):  # fmt: skip
        assert (whole / name).stat().st_size > 200, name
    summary = json.loads((whole / "summary.json").read_text())
    flat = json.loads((whole / "summaries" / "maze_small.json").read_text())
    assert set(flat) == {"voronoi", "random", "mappo", "difference", "run"}
    assert summary["maze_small"]["mappo"] == flat["mappo"]
    pooled = np.concatenate([read_result(whole, one, "held_out").episodes["exploration_ratio"] for one in CELLS[2::3]])
    coverage = flat["mappo"]["exploration_ratio"]
    assert coverage["n"] == 6 == len(pooled)
    np.testing.assert_allclose([coverage["mean"], coverage["std"]], [pooled.mean(), pooled.std()])
    assert coverage["ci95"][0] < coverage["mean"] < coverage["ci95"][1]
    for cell in CELLS:  # each says what it ran
        shown = OmegaConf.load(cell_folder(whole, cell) / "config.yaml")
        assert shown.radar.range == 10.0 and ("algorithm" in shown) == cell.trains
    run = flat["run"]
    assert (run["scenario"], run["seeds"], run["episodes"]) == ("maze_small", [0, 1], 3)
    assert run["maps"] == ["maze_small_64", "maze_small_65"] and run["cells"] == {"done": 6, "all": 6}


def test_a_planners_cell_says_the_episodes_of_its_result(tmp_path, monkeypatch):
    """It is chosen by fewer episodes on validation maps first: `CHOOSING`."""
    monkeypatch.setattr(cells, "CHOOSING", 1)
    cell = Cell("maze_small", "voronoi", 0)
    assert run_cell(settings(*TINY), tmp_path, cell, EnvShelf(), ["held_out"])
    assert len(read_result(tmp_path, cell, "validation").episodes["path_length"]) == 1
    assert OmegaConf.load(cell_folder(tmp_path, cell) / "config.yaml").episodes == 3


def test_every_policy_meets_the_same_maps_and_starts(whole):
    """The first point of a coverage curve is the scan at the start, before anyone has moved."""
    for seed in (0, 1):
        starts = [read_result(whole, one, "held_out").coverage[:, 0] for one in CELLS if one.seed == seed]
        assert all((one == starts[0]).all() for one in starts)
        assert len(set(starts[0])) == 3
    assert (read_result(whole, CELLS[0], "held_out").coverage[:, 0] != starts[0]).any()


def test_curves_end_where_the_metric_says(whole):
    for cell in CELLS:
        result = read_result(whole, cell, "held_out")
        np.testing.assert_allclose(result.coverage[:, -1], result.episodes["exploration_ratio"], atol=1e-6)
        assert (np.diff(result.coverage, axis=1) >= 0).all()


def test_a_trained_cell_is_a_run_of_its_own(whole, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    run = cell_folder(whole, CELLS[2])
    assert [row["iteration"] for row in read_metrics(run / "metrics.csv")] == [1, 2, 3, 4]
    assert main(["evaluate", f"checkpoint={run}", "episodes=3", "num_envs=2", "hydra.run.dir=e"]) == 0
    found = json.loads(Path("e/results.json").read_text())["trained"]["path_length"]["mean"]
    assert found == pytest.approx(read_result(whole, CELLS[2], "held_out").episodes["path_length"].mean())


def test_a_finished_benchmark_runs_nothing_again(copy, capsys):
    shutil.rmtree(copy / "cells" / "maze_small" / "mappo" / "seed_0" / "checkpoints")  # nothing to train from
    (copy / "table.csv").unlink()
    assert main(["benchmark", f"resume={copy}"]) == 0
    assert (copy / "table.csv").is_file() and "maze_small: 6 episodes a policy" in capsys.readouterr().out


def test_other_settings_are_refused_by_name(copy, capsys):
    (copy / "cells" / "maze_small" / "random" / "seed_0" / "held_out.json").unlink()
    assert main(["benchmark", f"resume={copy}", "episodes=5", "radar.range=4"]) == 2
    message = capsys.readouterr().err
    assert "episodes (was 3, now 5)" in message and "radar.range (was left open, now 4.0)" in message
    assert main(["benchmark", *TINY, f"hydra.run.dir={copy}"]) == 2
    assert f"resume={copy}" in capsys.readouterr().err
    assert main(["benchmark", f"resume={copy}", "report=true", "seeds=0"]) == 0  # fewer are still comparable
    assert "maze_small: 3 episodes a policy" in capsys.readouterr().out


def test_two_at_once_are_refused(copy, capsys):
    handle = os.open(copy, os.O_RDONLY)
    fcntl.flock(handle, fcntl.LOCK_EX)
    assert main(["benchmark", f"resume={copy}"]) == 2
    os.close(handle)
    assert "Another maexp benchmark is running" in capsys.readouterr().err


BAD = {
    "a scenario": (["scenarios=labyrinth"], "scenarios=labyrinth"),
    "a policy": (["policies=clever"], "policies=clever"),
    "an algorithm": (["algorithms=clever"], "algorithms=clever"),
    "a preset": (["preset=huge"], "cpu, paper, smoke"),
    "no seeds": (["seeds=[]"], "seeds=[]"),
    "a seed": (["seeds=a"], "seeds=a"),
    "a seed twice": (["seeds=1,1"], "seeds=1,1 names 1 twice"),
    "no episodes": (["episodes=0"], "episodes=0"),
    "no workers": (["workers=0"], "workers=0"),
    "no policies": (["policies=[]", "algorithms=[]"], "nothing to compare"),
    "a set of maps": (["maps=mine"], "maps=mine"),
    "no folder": (["resume=nowhere"], "nowhere does not exist"),
    "another folder": (["resume=."], "holds no benchmark.json"),
    "a setting": (["episode=3"], "episodes"),
    "policies per map": (["policy_per_map={maze: 0}"], "policy_per_map={'maze': 0}"),
    "a map for each": (["scenarios=outdoor", "policy_per_map={maze: 1}"], "policy_per_map has no outdoor"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_gets_one_sentence(case, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words, named = BAD[case]
    assert main(["benchmark", *words]) == 2
    out, err = capsys.readouterr()
    assert err.startswith("maexp: ") and err.count("\n") == 1 and named in err, err
    assert not out and not list(tmp_path.rglob("*.*"))


def test_longer_than_a_day_needs_a_yes(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = [word for word in TINY if word != "estimate=false"]
    assert main(["benchmark", *words, "iterations=null", "total_frames=200000000000", "hydra.run.dir=b"]) == 2
    out, err = capsys.readouterr()
    assert "estimated time: " in out and "years" in err and "confirm=true" in err
    assert not Path("b").exists()


# Kills


def start(folder: Path, *words: str) -> subprocess.Popen:
    command = [sys.executable, "-c", "import sys; from maexp.agents.cli import main; sys.exit(main())", "benchmark"]
    return subprocess.Popen([*command, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def wait_for(path: Path, process: subprocess.Popen, lines: int = 1) -> None:
    while process.poll() is None and (not path.is_file() or len(path.read_text().splitlines()) < lines):
        time.sleep(0.02)
    assert process.poll() is None


def workers_of(process: subprocess.Popen) -> list[int]:
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    return [int(one) for one in children if "benchmark.worker" in Path(f"/proc/{one}/cmdline").read_text()]


@contextlib.contextmanager
def held(workers: list[int]):
    """Processes stand still until each has been sent SIGTERM."""
    for one in workers:
        os.kill(one, signal.SIGSTOP)
    yield
    end = time.monotonic() + 60
    while not all(asked_to_end(one) for one in workers) and time.monotonic() < end:
        time.sleep(0.02)
    for one in workers:
        os.kill(one, signal.SIGCONT)
    assert time.monotonic() < end, "the workers were not told to stop"


def asked_to_end(process: int) -> bool:
    status = Path(f"/proc/{process}/status").read_text()
    pending = [int(line.split()[1], 16) for line in status.splitlines() if line.startswith(("SigPnd", "ShdPnd"))]
    return any(mask >> (signal.SIGTERM - 1) & 1 for mask in pending)


def assert_same_cells(first: Path, second: Path) -> None:
    for cell in CELLS:
        one, other = (read_result(folder, cell, "held_out") for folder in (first, second))
        assert one.episodes.keys() == other.episodes.keys()
        for name, values in one.episodes.items():
            np.testing.assert_array_equal(values, other.episodes[name], err_msg=f"{cell.name} {name}")
        np.testing.assert_array_equal(one.coverage, other.coverage)
    assert (first / "table.csv").read_text() == (second / "table.csv").read_text()


@pytest.mark.slow
def test_killed_and_resumed_is_uninterrupted(whole, tmp_path, capsys):
    folder = tmp_path / "killed"
    log = cell_folder(folder, CELLS[2]) / "metrics.csv"
    process = start(folder, *TINY, f"hydra.run.dir={folder}")
    wait_for(log, process, lines=3)
    process.kill()
    process.wait()
    time.sleep(1.0)
    left, first = len(log.read_text().splitlines()), log.read_text().splitlines()[1]
    time.sleep(1.0)
    assert len(log.read_text().splitlines()) == left < 5  # its worker went with it
    process = start(folder, f"resume={folder}")
    wait_for(cell_folder(folder, CELLS[5]) / "metrics.csv", process, lines=2)
    with held(workers_of(process)):  # however long it is at a picture, no cell ends before the signal
        process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 130 and "maexp benchmark resume=" in out and "Traceback" not in err
    assert "maze_small: 6 episodes" in out  # what was done is in the table already
    assert main(["benchmark", f"resume={folder}"]) == 0
    assert log.read_text().splitlines()[1] == first  # clocks and all: it went on, it did not start again
    assert_same_cells(whole, folder)


@pytest.mark.slow
def test_a_cell_that_ends_while_stopping_counts(copy):
    """Ctrl-C while the last worker is about to say that it is done: nothing is left, nothing was interrupted."""
    (cell_folder(copy, CELLS[0]) / "held_out.json").unlink()
    words = json.loads((copy / "benchmark.json").read_text())["overrides"]
    stop = []

    def ask(pool: WorkerPool) -> None:
        while not (cell_folder(copy, CELLS[0]) / "held_out.json").is_file():
            time.sleep(0.02)
        time.sleep(0.5)  # its answer is in the pipe
        stop.append(signal.SIGINT)

    outcome = WorkerPool(copy, words, ["held_out"], workers=1).run(CELLS[:1], stop, ask)
    assert outcome.done == CELLS[:1] and not outcome.interrupted


@pytest.mark.slow
def test_a_worker_that_dies_is_named_and_the_rest_goes_on(copy):
    for cell in CELLS[:3]:
        (cell_folder(copy, cell) / "held_out.json").unlink()
    words = json.loads((copy / "benchmark.json").read_text())["overrides"]
    killed = []

    def kill_first(pool: WorkerPool) -> None:
        if not killed and pool.running():
            killed.append(pool.workers[0].process.pid)
            os.kill(killed[0], signal.SIGKILL)

    outcome = WorkerPool(copy, words, ["held_out"], workers=1).run(CELLS[:3], [], kill_first)
    assert list(outcome.failed) == CELLS[:1] and outcome.done == CELLS[1:3]
    assert "SIGKILL" in outcome.failed[CELLS[0]] and "evaluating on held_out" in outcome.failed[CELLS[0]]


# The table


def column(policy: str, seed: int = 0, **values: list[float]):
    names = [row.metric for row in ROWS]
    episodes = {name: np.array(values.get(name, [0.5, 0.7]), dtype=float) for name in names}
    return pool_column(policy, "held_out", [(seed, episodes)])


ER, CS = (next(row for row in ROWS if row.label == label) for label in ("ER", "CS85"))


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
    assert len(rows) == 4 * len(ROWS)
    found = {(row["scenario"], row["policy"], row["metric"]): row for row in rows}
    one = found["maze", "ippo", "coverage_step_95"]
    assert (float(one["mean"]), one["reached"], one["episodes"], one["best"]) == (400, "1", "2", "1")
    assert float(one["paper_mean"]) == 441
    assert found["maze", "random", "coverage_step_95"]["mean"] == ""
    assert float(found["maze", "ippo", "exploration_ratio"]["paper_mean"]) == pytest.approx(0.9317)
    ties = [found["maze_small", name, "exploration_ratio"]["best"] for name in ("random", "voronoi")]
    assert ties == ["1", "1"]


def test_markdown_and_latex_mark_the_best(tables):
    text = table_markdown(tables)
    row = next(line for line in text.splitlines() if line.startswith("| CS95"))
    assert row.split("|")[2].strip() == "-<br>(0/2)"
    assert row.split("|")[3].strip() == "**400 ± 0**<br>[400, 400] (1/2)<br>paper 441 ± 57"
    rows = [line for line in text.splitlines() if line.startswith("| ER")]
    assert rows[1].count("**60.0 ±") == 2 and rows[0].count("**") == 2
    latex = table_latex(tables)
    assert r"$\mathbf{93.5} \pm 3.5$" in latex and r"$93.17 \pm 4.27$" in latex
    widths = {line.count("&") for line in latex.splitlines() if line.endswith(r"\\")}
    assert len(widths) == 1 and latex.count("{tabular}") == 2


def test_the_terminals_table_fits_100_columns(tables):
    wide = [1400.0, 2999.0]
    tables["maze"].append(column("potential_field", reward_variance=wide, coverage_step_85=wide, coverage_step_95=wide))
    out = StringIO()
    print_tables(tables, Console(file=out, width=80))
    text = out.getvalue()
    assert max(map(len, text.splitlines())) <= 100
    assert "2200 ± 800" in text.replace("  ", " ") and "441 ± 57" in text and "…" not in text


# Less the best classical planner


def played(policy: str, coverage: list, seed: int = 0, maps: list | None = None) -> tuple[Cell, CellResult]:
    values = np.array(coverage)
    episodes = {"coverage_auc": values, "coverage_step_95_censored": -100 * values, "collisions": 0 * values}
    names = None if maps is None else np.array(maps)
    return Cell("maze", policy, seed), CellResult(episodes, np.zeros(1), values[:, None], {}, names)


def test_differences_are_of_the_same_episodes_and_resample_the_seeds_of_training():
    maps = ["a", "a", "b", "b"]
    planner = [played("voronoi", [0.1, 0.2, 0.6, 0.9], seed, maps) for seed in (0, 1, 2)]
    alike = [played("ippo", [0.2, 0.3, 0.7, 1.0], seed, maps) for seed in (2, 0)]
    found = subtract("ippo", alike, planner)["coverage_auc"]
    assert (found["n"], found["mean"]) == (8, pytest.approx(0.1)) and found["ci95"] == [pytest.approx(0.1)] * 2
    unlike = [alike[1], played("ippo", [0.0, 0.1, 0.5, 0.8], 1, maps)]
    found = subtract("ippo", unlike, planner)["coverage_auc"]
    assert found["mean"] == pytest.approx(0.0) and found["ci95"] == [pytest.approx(-0.1), pytest.approx(0.1)]
    assert subtract("ippo", [played("ippo", [0.5], 7)], planner) == {}
    text = differences_markdown("voronoi", {"ippo": subtract("ippo", alike, planner)})
    assert "| ippo | +10.0 [+10.0, +10.0] | -10 [-10, -10] | +0.00 [+0.00, +0.00] |" in text


def test_the_best_planner_is_the_one_that_saw_most_over_time_on_validation_maps():
    one, other = [played("voronoi", [0.5, 0.7])], [played("hungarian", [0.9, 0.1]), played("hungarian", [0.9, 0.4], 1)]
    assert find_best({"voronoi": one, "hungarian": other, "rrt_frontiers": []}) == "voronoi" and find_best({}) is None


def test_planners_play_validation_maps_and_the_report_says_who_is_best(whole):
    voronoi, random = CELLS[0], CELLS[1]
    assert {voronoi.policy, random.policy} == {"voronoi", "random"}
    voronoi, random = sorted((voronoi, random), key=lambda one: one.policy != "voronoi")
    assert set(read_result(whole, voronoi, "validation").maps) <= {f"maze_small_{k}" for k in range(51, 64)}
    assert not (cell_folder(whole, random) / "validation.json").exists()
    flat = json.loads((whole / "summaries" / "maze_small.json").read_text())
    assert flat["run"]["best_classical"] == "voronoi" and set(flat["difference"]["mappo"]) == {"voronoi", "random"}
    apart = flat["mappo"]["coverage_auc"]["mean"] - flat["voronoi"]["coverage_auc"]["mean"]
    assert flat["difference"]["mappo"]["voronoi"]["coverage_auc"]["mean"] == pytest.approx(apart)
    assert "Less voronoi, the best classical planner on the validation maps" in (whole / "table.md").read_text()


def test_what_knows_the_map_is_never_the_best():
    columns = [column("oracle", exploration_ratio=[0.99, 0.99]), column("ippo"), column("random")]
    assert best_columns(columns, ER) == {"ippo", "random"}
