"""The benchmark: its cells, and one from end to end."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from metrics_file import read_metrics
from omegaconf import OmegaConf
from tiny_benchmark import CELLS, TINY, settings

from maexp.agents.benchmarks import cell as cells
from maexp.agents.benchmarks.cell import EnvShelf, read_result, run_cell
from maexp.agents.benchmarks.plan import (
    Cell,
    cell_config,
    cell_folder,
    check_unchanged,
    compose_settings,
    list_cells,
    write_plan,
)
from maexp.agents.cli import main
from maexp.agents.errors import UserError
from maexp.agents.files import lock

pytestmark = pytest.mark.slow  # trainings

# Cells


def test_seeds_are_outermost_and_classical_policies_first():
    assert list_cells(settings(*TINY)) == CELLS
    two = [f"{cell.seed} {cell.scenario}" for cell in list_cells(settings(*TINY, "scenarios=maze,outdoor"))]
    assert list(dict.fromkeys(two)) == ["0 maze", "0 outdoor", "1 maze", "1 outdoor"]


def test_the_papers_preset_has_its_288_runs():
    cfg = settings("preset=paper")
    trained = [cell for cell in list_cells(cfg) if cell.trains]
    assert len(trained) == 6 * 16 * 3
    maps = {(cell.scenario, cell.map) for cell in trained}
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
        "scenario=maze,indoor_small",
        "algorithm=mappo",
        "policies=[]",
        "seed=3",
        "planner=dwa",
        "radar.range=7",
        "train_maps=2",
        "test_maps=1",
        "robot.team=[{kind: differential, radar: {range: 3}}]",
        "algorithm.lr=0.5",
    )
    assert [cell.name for cell in list_cells(cfg)] == ["maze/mappo/seed_3", "indoor_small/mappo/seed_3"]
    run, _ = cell_config(cfg, list_cells(cfg)[1])
    assert (run.planner.name, run.radar.range, run.algorithm.lr, run.seed) == ("dwa", 7.0, 0.5, 3)
    assert list(run.scenario.maps) == [0, 1] and run.scenario.held_out_count == 1
    assert run.robot.team[0]["radar"]["range"] == 3


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


def test_files_and_summaries(whole_run):
    for name in (
        "table.csv",
        "table.md",
        "table.tex",
        "config.yaml",
        "coverage_maze_small.png",
        "overview.png",
        "improvement.png",
        "improvement.csv",
    ):
        assert (whole_run / name).stat().st_size > 200, name
    summary = json.loads((whole_run / "summary.json").read_text())
    flat = json.loads((whole_run / "summaries" / "maze_small.json").read_text())
    assert set(flat) == {"voronoi", "random", "mappo", "difference", "run"}
    assert summary["maze_small"]["mappo"] == flat["mappo"]
    pooled = np.concatenate(
        [read_result(whole_run, cell, "held_out").episodes["exploration_ratio"] for cell in CELLS[2::3]]
    )
    coverage = flat["mappo"]["exploration_ratio"]
    assert coverage["n"] == 6 == len(pooled)
    np.testing.assert_allclose([coverage["mean"], coverage["std"]], [pooled.mean(), pooled.std()])
    assert coverage["ci95"][0] < coverage["mean"] < coverage["ci95"][1]
    for cell in CELLS:  # each says what it ran
        shown = OmegaConf.load(cell_folder(whole_run, cell) / "config.yaml")
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


def test_every_policy_meets_the_same_maps_and_starts(whole_run):
    """The first point of a coverage curve is the scan at the start, before anyone has moved."""
    for seed in (0, 1):
        starts = [read_result(whole_run, cell, "held_out").coverage[:, 0] for cell in CELLS if cell.seed == seed]
        assert all((start == starts[0]).all() for start in starts)
        assert len(set(starts[0])) == 3
    assert (read_result(whole_run, CELLS[0], "held_out").coverage[:, 0] != starts[0]).any()


def test_curves_end_where_the_metric_says(whole_run):
    for cell in CELLS:
        result = read_result(whole_run, cell, "held_out")
        np.testing.assert_allclose(result.coverage[:, -1], result.episodes["exploration_ratio"], atol=1e-6)
        assert (np.diff(result.coverage, axis=1) >= 0).all()


def test_a_trained_cell_is_a_run_of_its_own(whole_run, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    run = cell_folder(whole_run, CELLS[2])
    assert [row["iteration"] for row in read_metrics(run / "metrics.csv")] == [1, 2, 3, 4]
    assert main(["evaluate", f"checkpoint={run}", "episodes=3", "num_envs=2", "hydra.run.dir=e"]) == 0
    found = json.loads(Path("e/results.json").read_text())["trained"]["path_length"]["mean"]
    assert found == pytest.approx(read_result(whole_run, CELLS[2], "held_out").episodes["path_length"].mean())


def test_a_finished_benchmark_runs_nothing_again(run_copy, capsys):
    shutil.rmtree(run_copy / "cells" / "maze_small" / "mappo" / "seed_0" / "checkpoints")  # nothing to train from
    (run_copy / "table.csv").unlink()
    assert main(["benchmark", f"resume={run_copy}"]) == 0
    assert (run_copy / "table.csv").is_file() and "maze_small: 6 episodes a policy" in capsys.readouterr().out


def test_other_settings_are_refused_by_name(run_copy, capsys):
    (run_copy / "cells" / "maze_small" / "random" / "seed_0" / "held_out.json").unlink()
    assert main(["benchmark", f"resume={run_copy}", "episodes=5", "radar.range=4"]) == 2
    message = capsys.readouterr().err
    assert "episodes (was 3, now 5)" in message and "radar.range (was left open, now 4.0)" in message
    assert main(["benchmark", *TINY, f"hydra.run.dir={run_copy}"]) == 2
    assert f"resume={run_copy}" in capsys.readouterr().err
    assert main(["benchmark", f"resume={run_copy}", "report=true", "seeds=0"]) == 0  # fewer are still comparable
    assert "maze_small: 3 episodes a policy" in capsys.readouterr().out


def test_two_at_once_are_refused(run_copy, capsys):
    with lock(run_copy, "maexp benchmark"):
        assert main(["benchmark", f"resume={run_copy}"]) == 2
    assert f"is in use by maexp benchmark, process {os.getpid()} on " in capsys.readouterr().err


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


def test_planners_play_validation_maps_and_the_report_says_who_is_best(whole_run):
    voronoi, random = CELLS[0], CELLS[1]
    assert {voronoi.policy, random.policy} == {"voronoi", "random"}
    voronoi, random = sorted((voronoi, random), key=lambda result: result.policy != "voronoi")
    assert set(read_result(whole_run, voronoi, "validation").maps) <= {f"maze_small_{k}" for k in range(51, 64)}
    assert not (cell_folder(whole_run, random) / "validation.json").exists()
    flat = json.loads((whole_run / "summaries" / "maze_small.json").read_text())
    assert flat["run"]["best_classical"] == "voronoi" and set(flat["difference"]["mappo"]) == {"voronoi", "random"}
    apart = flat["mappo"]["coverage_auc"]["mean"] - flat["voronoi"]["coverage_auc"]["mean"]
    assert flat["difference"]["mappo"]["voronoi"]["coverage_auc"]["mean"] == pytest.approx(apart)
    assert "Less voronoi, the best classical planner on the validation maps" in (whole_run / "table.md").read_text()
