"""`maexp train -m`: one table over the runs, the same episodes for all, planners that play them once; a sweep that was
stopped goes on with the runs that are not done."""

import csv
import json
import os
import shlex
import signal
from pathlib import Path

import numpy as np
import pytest
import small_run
from metrics_file import read_metrics

from maexp.agents.cli import evaluate as command
from maexp.agents.cli import main
from maexp.agents.evaluation import comparison
from maexp.agents.evaluation.comparison import keeping_episodes, play_once
from maexp.agents.training.checkpoint import find_checkpoint
from maexp.agents.training.logs import MetricsLog
from maexp.envs import ExplorationEnv, make_map

pytestmark = pytest.mark.slow  # trainings

SMALL = [
    *small_run.PLACE,
    "scenario.validation=[1]",
    "num_envs=3",
    "total_frames=6",
    "model.channels=4",
    "episodes=5",
    "evaluate_episodes=2",
    "device=cpu",
    "classical=[cost_utility,nearest_frontier]",
    "hydra.sweep.dir=all",
]


@pytest.fixture
def played(monkeypatch) -> list[str]:
    """The policies that play, each time that they do."""
    names = []
    for module, name in ((command, "evaluate_recorded"), (comparison, "evaluate")):
        plays = getattr(module, name)

        def count(*words, plays=plays, **settings):
            names.append(settings["name"])
            return plays(*words, **settings)

        monkeypatch.setattr(module, name, count)
    return names


def test_a_sweep_ends_with_one_table_and_planners_play_once(tmp_path, monkeypatch, capsys, played):
    monkeypatch.chdir(tmp_path)
    assert main(["train", "-m", "seed=3,4", *SMALL]) == 0
    assert played.count("trained") == played.count("untrained") == 2
    assert sorted(name for name in played if "trained" not in name) == sorted(
        ["random", "cost_utility", "nearest_frontier"] + ["cost_utility", "nearest_frontier"]  # held out, validation
    )
    summaries = [json.loads(Path("all", str(k), "summary.json").read_text()) for k in range(2)]
    assert [summary["run"]["seed"] for summary in summaries] == [3, 3], (
        "of the episodes, which differences are told from"
    )
    assert summaries[0]["cost_utility"] == summaries[1]["cost_utility"]
    assert "evaluation_seed: 3" in Path("all/1/config.yaml").read_text()
    table = capsys.readouterr().out.partition("2 runs, 5 held-out episodes each")[2]
    rows = [line.split()[0] for line in table.splitlines() if line.startswith(" ") and line.split()[1:]]
    assert rows[0] == "policy"
    assert [row for row in rows if row in ("seed=3", "seed=4", "random", "cost_utility", "nearest_frontier")] == [
        "seed=3",
        "seed=4",
        "random",
        "cost_utility",
        "nearest_frontier",
    ]
    with open("all/runs.csv", newline="") as file:
        means = {row["run"]: row for row in csv.DictReader(file)}
    assert [*means] == ["seed=3", "seed=4", "random", "cost_utility", "nearest_frontier"]
    best = summaries[0]["run"]["best_classical"]["3"]
    lead = summaries[1]["difference"]["trained"][best]["coverage_auc"]["mean"]
    assert float(means["seed=4"]["ahead_coverage_auc"]) == lead and means["random"]["ahead_coverage_auc"] == ""
    assert float(means["seed=4"]["exploration_ratio"]) == summaries[1]["trained"]["exploration_ratio"]["mean"]


def test_only_what_would_be_the_same_is_not_played_again():
    maps, calls = [make_map("maze_small", k) for k in range(2)], []

    def ask(number: int, *, name: str = "random", world=maps[0], seed: int = 0, episodes: int = 4, starts="drawn"):
        env = ExplorationEnv(world, 1, 2, seed=seed, starts=starts)
        return play_once(name, env, lambda: calls.append(number), episodes)

    ask(0), ask(1)
    assert calls == [0, 1], "outside of a sweep"
    calls.clear()
    with keeping_episodes():
        ask(0), ask(1), ask(2, name="oracle"), ask(3, world=maps[1]), ask(4, seed=1), ask(5, episodes=5)
        ask(6, starts="fixed"), ask(7)
        env = ExplorationEnv(maps[0], 1, 2)
        env.reset()
        now = env.snapshot()
        env.set_starts(np.concatenate([now["center"], now["pose"][:, 3:4]], axis=1))
        play_once("random", env, lambda: calls.append(8), 4)
    assert calls == [0, 2, 3, 4, 5, 6, 8]


SWEEP = [
    "train",
    "-m",
    "seed=0,1,2",
    *small_run.SMALL,
    "total_frames=16",
    "episodes=0",
    "evaluate_every=0",
    "checkpoint_every=1",
]


def numbers(run: str) -> list[dict]:
    rows = read_metrics(Path(run) / "metrics.csv")
    timed = {name for row in rows for name in row if "second" in name or name.startswith("time_")}
    return [{name: x for name, x in row.items() if name not in timed and x == x} for row in rows]


def test_stopped_and_resumed_is_unbroken(tmp_path, monkeypatch, capsys):
    """Ctrl-C in the second of three runs: the first is passed over, the second goes on, the third begins."""
    monkeypatch.chdir(tmp_path)
    assert main([*SWEEP, "hydra.sweep.dir=whole"]) == 0
    write, rows = MetricsLog.write, []

    def interrupt(self, row):
        write(self, row)
        rows.append(row)
        if len(rows) == 6:
            os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(MetricsLog, "write", interrupt)
        assert main([*SWEEP, "hydra.sweep.dir=my sweep"]) == 130
    told = capsys.readouterr().err.splitlines()[-1]
    assert told.endswith("Go on with: maexp train -m 'resume=my sweep'")
    assert find_checkpoint("my sweep/1")[1]["iteration"] == 2 and not Path("my sweep/2").exists()
    first = Path("my sweep/0/metrics.csv").stat().st_mtime_ns
    assert main(shlex.split(told.partition("Go on with: ")[2])[1:]) == 0
    out = capsys.readouterr().out
    assert out.count("(done before)") == 1 and "curves.png" in out
    assert Path("my sweep/0/metrics.csv").stat().st_mtime_ns == first
    for run in "012":
        assert numbers(f"my sweep/{run}") == numbers(f"whole/{run}") and len(numbers(f"whole/{run}")) == 4


@pytest.mark.parametrize(
    "words, told",
    [
        (["resume=sweep", "seed=3"], "resume=sweep with -m keeps all settings of a sweep: leave seed out."),
        (
            ["resume=gone"],
            "resume=gone with -m: there is no sweep.json of a sweep that could be read (FileNotFoundError)",
        ),
        (["resume=sweep"], "that could be read (JSONDecodeError). For a single run leave out -m."),
    ],
)
def test_what_cannot_go_on_is_a_sentence(words, told, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("sweep").mkdir()
    Path("sweep/sweep.json").write_text("{")
    assert main(["train", "-m", *words]) == 2
    assert told in capsys.readouterr().err
