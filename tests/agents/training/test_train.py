"""Training: the files of a run, its teams and scenarios, its validation, and what it refuses."""

import json
import re
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from metrics_file import read_metrics
from small_run import PLACE
from tiny_training import BATCH, CLOCKS, TINY, assert_same, assert_same_runs, resume, run

from maexp.agents.build import load_maps, make_env, other_scenarios, title_scenario
from maexp.agents.cli import main
from maexp.agents.cli.train import draw_rollout
from maexp.agents.config.compose import compose_settings
from maexp.agents.training.checkpoint import find_checkpoint, list_checkpoints
from maexp.agents.training.logs import MetricsLog
from maexp.envs import make_map

# Trainings; a short one is among the README's commands.
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("somewhere", "no_pictures")]


def test_the_files_of_a_run(capsys):
    folder = run("a run", 3, "episodes=4", "checkpoint_keep=2", "evaluate_every=2")
    start, *rows = read_metrics(folder / "metrics.csv")
    assert start["iteration"] == start["frames"] == 0 and start["reward"] != start["reward"]
    assert [row["iteration"] for row in rows] == [1, 2, 3]
    assert [row["frames"] for row in rows] == [BATCH, 2 * BATCH, 3 * BATCH]
    assert all(row[name] > 0 for row in rows for name in CLOCKS[:-1])
    assert [row["time_validation"] > 0 for row in (start, *rows)] == [True, False, True, False]
    assert all(sum(row[name] for name in CLOCKS[3:]) < row["seconds"] for row in rows)
    assert all(row["time_simulate"] + row["time_policy"] <= row["time_wait"] + 2e-4 for row in rows)
    assert {row["policy_lag"] for row in rows} == {0}
    assert sum(row["episodes"] for row in rows) == 3 * 2  # 6 macro steps of 3 teams, 3 to an episode
    assert rows[1]["validation_coverage"] > 0 and rows[0]["validation_coverage"] != rows[0]["validation_coverage"]
    assert start["validation_coverage"] > 0
    assert [path.stem[-1] for path in list_checkpoints(folder / "checkpoints")] == ["3", "2", "0"]
    assert (folder / "checkpoints" / "best.pt").is_file()
    assert "num_robots: 2" in (folder / "config.yaml").read_text()
    summary = json.loads((folder / "summary.json").read_text())
    classical = {"cost_utility", "rrt_frontiers", "nearest_frontier"}
    assert set(summary) == {"trained", "untrained", "random", "difference", "run"} | classical
    assert set(summary["difference"]) == {"trained"}
    assert set(summary["difference"]["trained"]) == {"untrained", "random"} | classical
    for other in ("random", "cost_utility"):
        for metric, found in summary["difference"]["trained"][other].items():
            if metric in ("exploration_ratio", "coverage_auc", "path_length", "coverage_step_95_censored"):
                apart = summary["trained"][metric]["mean"] - summary[other][metric]["mean"]
                assert found["mean"] == pytest.approx(apart, abs=1e-6) and found["n"] == 4
    assert summary["run"]["best_classical"]["2"] in classical
    assert summary["trained"]["exploration_ratio"]["n"] == summary["random"]["exploration_ratio"]["n"] == 4
    assert summary["run"]["maps"] == ["maze_small_70"]
    printed = capsys.readouterr().out
    assert f"{summary['run']['best_classical']['2']}, the best classical planner on the validation maps" in printed
    assert "the untrained team: " in printed and "Next: maexp evaluate" in printed


def test_what_a_training_started_from_stands_beside_it():
    folder = run("run", 3, "episodes=3", "checkpoint_keep=1", "checkpoint_every=1", "classical=[]", "algorithm.lr=0.3")
    summary = json.loads((folder / "summary.json").read_text())
    words = [f"checkpoint={folder}/checkpoints/iteration_000000.pt", "episodes=3", "num_envs=3", "hydra.run.dir=start"]
    assert main(["evaluate", *words]) == 0
    assert json.loads(Path("start/results.json").read_text())["trained"] == summary["untrained"] != summary["trained"]
    (folder / "checkpoints" / "iteration_000000.pt").write_bytes(b"damaged")
    resume(folder, 4)
    assert "untrained" not in json.loads((folder / "summary.json").read_text())


def test_the_film_is_of_the_episode_that_stands_for_the_mean(monkeypatch):
    """Of those that are played first; what is filmed is what was evaluated, whoever draws actions."""
    seen = {}

    def film(cfg, env, teams, results, path):
        seen["results"] = results
        draw_rollout(cfg, env, teams, results, path)

    def draw_film(episodes, caption, columns):
        seen.update(episodes=episodes, caption=caption, columns=columns)
        return [np.zeros((8, 8, 3), dtype=np.uint8)]

    monkeypatch.setattr("maexp.agents.cli.train.draw_rollout", film)
    monkeypatch.setattr("maexp.agents.evaluation.video.draw_film", draw_film)
    run("run", 1, "episodes=5", "classical=[nearest_frontier]", "num_robots=2,3", "num_envs=6")
    known = {result.policy: result for result in seen["results"] if result.num_robots == 2}
    assert [episode.policy for episode in seen["episodes"]] == ["trained", "untrained", "nearest_frontier"]
    place, told = seen["caption"]
    number = int(re.search(r", episode (\d+) of seed 0$", place)[1])
    apart = known["trained"].episodes["coverage_auc"] - known["nearest_frontier"].episodes["coverage_auc"]
    away = abs(apart - apart.mean())
    assert away[number] == away.min() and away.max() > 0
    assert f"trained - nearest_frontier: {100 * apart[number]:+.1f} points" in told
    assert f"of 5 episodes the closest to the mean ({100 * apart.mean():+.1f})" in told
    for episode in seen["episodes"]:
        mine = known[episode.policy]
        assert episode.map.name == mine.maps[number] and episode.map.name in place
        assert episode.coverage[-1] == pytest.approx(mine.episodes["exploration_ratio"][number], abs=1e-6)


def test_a_metric_that_comes_late_is_an_error(tmp_path):
    """The first row's names are the columns of all; a run that goes on keeps those that are there."""
    cfg = compose_settings("train", []).logger
    for kept in (0, 1):
        with closing(MetricsLog(tmp_path, cfg, kept=kept, frames=kept, config={})) as log:
            log.write({"iteration": kept + 1, "coverage": 0.5})
            with pytest.raises(RuntimeError, match="late was not among"):
                log.write({"iteration": kept + 1, "late": 1.0})
    assert (tmp_path / "metrics.csv").read_text() == "iteration,coverage\n1,0.5\n2,0.5\n"


def test_a_checkpoint_and_classical_policies_play_the_same_episodes(capsys):
    run("team", 1)
    words = ["checkpoint=team", "policy=random,voronoi", "episodes=3", "num_envs=3", "num_robots=1,2"]
    assert main(["evaluate", *words, "hydra.run.dir=both"]) == 0
    told = json.loads(Path("both/results.json").read_text())
    found = told["difference"]["trained N=2"]["voronoi N=2"]["coverage_auc"]
    apart = told["trained N=2"]["coverage_auc"]["mean"] - told["voronoi N=2"]["coverage_auc"]["mean"]
    assert found["mean"] == pytest.approx(apart, abs=1e-6) and found["n"] == 3
    assert told["run"]["best_classical"] == {"1": "voronoi", "2": "voronoi"}
    printed = capsys.readouterr().out
    assert "The trained team N=1" in printed and "The trained team N=2" in printed


def test_teams_of_several_sizes_in_one_batch(capsys):
    """Resumed is uninterrupted; the teams are those that runs of one size would have; each size is evaluated."""
    words = ["num_robots=1,3", "num_envs=5", "classical=[]"]
    frames = [f"total_frames={count * 5 * 2}" for count in (6, 3)]
    for folder, count in (("whole", frames[0]), ("parts", frames[1])):
        assert main(["train", *TINY, *words, f"hydra.run.dir={folder}", count, "episodes=3"]) == 0
    summary = json.loads(Path("parts/summary.json").read_text())
    teams = {f"{policy} N={n}" for policy in ("trained", "untrained", "random") for n in (1, 3)}
    assert summary.keys() - {"run", "difference"} == teams
    assert summary["run"]["num_robots"] == [1, 3]
    assert "5 teams of 1 and 3 robots" in capsys.readouterr().out
    assert main(["train", "resume=parts", frames[0], "episodes=3"]) == 0
    assert_same_runs(Path("whole"), Path("parts"))
    assert main(["train", "resume=parts", "num_robots=1,2"]) == 2
    assert "num_robots=1,3, not num_envs=5 num_robots=1,2" in capsys.readouterr().err
    assert main(["train", *TINY, "num_envs=2", "num_robots=1,2,3", "hydra.run.dir=few"]) == 2
    assert "num_envs=2 is too few for 3 team sizes" in capsys.readouterr().err


def test_several_scenarios_in_one_batch(tmp_path, capsys):
    """Each with its own robots and episodes; resumed it goes on with all of them."""
    words = [
        "scenario=maze_small",
        "scenario.also=[indoor_small]",
        *PLACE,
        "num_envs=4",
        "episodes=0",
        "evaluate_every=0",
        "action=targets",
        "algorithm=mappo",
    ]
    batch = 2 * 2 + 2 * 60
    assert main(["train", *words, "hydra.run.dir=whole", f"total_frames={2 * batch}"]) == 0
    assert main(["train", *words, "hydra.run.dir=halves", f"total_frames={batch}"]) == 0
    assert main(["train", "resume=halves", f"total_frames={2 * batch}"]) == 0
    whole, halves = (read_metrics(Path(folder) / "metrics.csv") for folder in ("whole", "halves"))
    assert [row["frames"] for row in whole] == [row["frames"] for row in halves] == [batch, 2 * batch]
    assert [row["loss_critic"] for row in whole] == [row["loss_critic"] for row in halves]
    assert all(row["episodes"] >= 4 for row in whole)
    for word, told in (
        ("scenario.also=[nowhere]", "scenario.also=nowhere is no scenario"),
        ("scenario.also=[maze_small]", "names maze_small twice"),
        ("scenario.also=[{local_steps:5}]", "neither a scenario's name nor settings of one"),
        ("scenario.also=[{name:maze_small,steps:5}]", "scenario.also has no setting steps: choose among"),
        (
            "scenario.also=[{name:maze_small,local_steps:few}]",
            "of maze_small, local_steps='few' must be a whole number",
        ),
        ("scenario.also=[{name:maze_small,local_steps:0}]", "local_steps=0"),
        ("scenario.also=[pointcloud]", "or give {name: pointcloud, path: FILES}"),
        ("scenario.also=[{name:pointcloud,path:nowhere.yaml}]", "nowhere.yaml"),
    ):
        capsys.readouterr()
        assert main(["train", "scenario=maze_small", word, "hydra.run.dir=bad"]) == 2
        assert told in capsys.readouterr().err


def test_entries_of_several_scenarios_have_settings_of_their_own(tmp_path):
    """The same places with shorter decisions, beside a map of the user's."""
    make_map("maze_small", 3).save(tmp_path / "mine.npz")
    cfg = compose_settings(
        "train",
        [
            "scenario=maze_small",
            "num_robots=2",
            "action=targets",
            f"scenario.also=[{{name:maze_small,local_steps:5,maps:[1]}},{{name:pointcloud,path:{tmp_path}/mine.npz}}]",
        ],
    )
    short, mine = other_scenarios(cfg)
    env = make_env(short, load_maps(short.scenario).train, 2, 1)
    assert (env.local_steps, env.macro_steps) == (5, 15)
    assert [world.name for world in env.maps] == ["maze_small_1"]
    assert [world.name for world in load_maps(mine.scenario).train] == ["maze_small_3"]
    assert cfg.scenario.local_steps is None or cfg.scenario.local_steps == 20
    assert [title_scenario(entry) for entry in cfg.scenario.also] == [
        "maze_small local_steps=5 maps=[1]",
        "pointcloud path=1 file",
    ]


@pytest.mark.parametrize("steps, frames, ends", [("null", 9, 3), ("2", 6, 0)])
def test_a_batch_is_an_episode_of_every_team_unless_told_otherwise(steps, frames, ends):
    folder = run("whole", 1, f"collector.steps={steps}")
    (row,) = read_metrics(folder / "metrics.csv")
    assert (row["frames"], row["episodes"]) == (frames, ends)


def test_the_gain_is_the_paired_difference_to_the_best_planner(monkeypatch):
    """What metrics.csv says of a team equals what evaluate says of its checkpoint, on the validation maps."""
    words = ["scenario.validation=[5,6]", "classical=[nearest_frontier,cost_utility]"]
    folder = run("run", 2, *words, "evaluate_every=2", "evaluate_episodes=6")
    rows = read_metrics(folder / "metrics.csv")
    for name, row in (("000000", rows[0]), ("000002", rows[2])):
        where = ["scenario.held_out=[5,6]", "episodes=6", "num_envs=3", f"hydra.run.dir={name}"]
        place = f"checkpoint={folder}/checkpoints/iteration_{name}.pt"
        assert main(["evaluate", place, "policy=nearest_frontier,cost_utility", *where]) == 0
        told = json.loads(Path(name, "results.json").read_text())
        planners = ("nearest_frontier", "cost_utility")
        best = max(planners, key=lambda planner: told[planner]["coverage_auc"]["mean"])
        assert row["validation_coverage_auc"] == pytest.approx(told["trained"]["coverage_auc"]["mean"], abs=1e-6)
        found = told["difference"]["trained"][best]
        for column, metric, factor in (("gain", "coverage_auc", 100), ("steps_95", "coverage_step_95_censored", 1)):
            values = [found[metric]["mean"], *found[metric]["ci95"]]
            columns = [row[f"validation_{column}{end}"] for end in ("", "_low", "_high")]
            assert columns == pytest.approx([factor * value for value in values], abs=1e-4)
    assert rows[0]["validation_gain"] < 0, "a team that knows nothing is behind"


@pytest.mark.parametrize("words", [["classical=[]"], ["planner=direct"], ["classical=[random]"]])
def test_without_a_classical_planner_there_is_no_gain(words):
    row = read_metrics(run("run", 1, "evaluate_every=1", *words) / "metrics.csv")[1]
    assert row["validation_coverage_auc"] > 0 and row["validation_gain"] != row["validation_gain"]


def test_evaluations_in_between_change_nothing():
    assert_same(
        find_checkpoint(run("with", 4, "evaluate_every=1"))[1]["updater"],
        find_checkpoint(run("without", 4))[1]["updater"],
    )


def test_a_checkpoint_of_another_network_is_refused(capsys):
    folder = run("run", 1)
    capsys.readouterr()
    assert main(["evaluate", f"checkpoint={folder}", "model.channels=4", "episodes=1", "hydra.run.dir=e"]) == 2
    assert "another network" in capsys.readouterr().err
    assert not Path("e").exists()
    for words in (["evaluate", f"checkpoint={folder}", "hydra.run.dir=e"], ["train", f"resume={folder}"]):
        assert main([*words, "planner=direct", "episodes=1"]) == 2  # its tensors have the same shapes
        assert "planner=direct" in capsys.readouterr().err
    assert not Path("e").exists()
    assert main(["train", f"resume={folder}", "num_robots=3"]) == 2
    assert "num_robots" in capsys.readouterr().err


def test_evaluate_goes_by_the_runs_own_settings():
    folder = run("run", 1, "radar.range=6")
    assert main(["evaluate", f"checkpoint={folder}", "episodes=2", "num_robots=1,2,6,8", "hydra.run.dir=e"]) == 0
    config = Path("e/config.yaml").read_text()
    assert "range: 6.0" in config and "macro_steps: 3" in config
    results = json.loads(Path("e/results.json").read_text())
    assert set(results) == {"run", *(f"trained N={size}" for size in (1, 2, 6, 8))}
    assert all(results[name]["exploration_ratio"]["n"] == 2 for name in results if name != "run")


def test_a_loss_that_is_no_number_stops_the_run_and_is_named(monkeypatch, capsys):
    from maexp.agents.algorithms.updaters import GradientUpdater

    learn, calls = GradientUpdater.update, []

    def fail(self, *batches, **settings):
        calls.append(1)
        if len(calls) == 3:
            raise ArithmeticError("loss_critic became nan.")
        return learn(self, *batches, **settings)

    monkeypatch.setattr(GradientUpdater, "update", fail)
    assert main(["train", *TINY, "hydra.run.dir=run", f"total_frames={5 * BATCH}"]) == 2
    message = capsys.readouterr().err
    assert "iteration 3" in message and "loss_critic" in message
    assert find_checkpoint("run")[1]["iteration"] == 2


def test_too_much_memory_is_refused_before_the_run(capsys):
    assert main(["train", *TINY, "collector.steps=100000000", "hydra.run.dir=run"]) == 2
    assert "lower num_envs or collector.steps" in capsys.readouterr().err
