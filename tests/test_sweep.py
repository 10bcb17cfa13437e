"""A sweep that was stopped goes on with the runs that are not done."""

import os
import shlex
import signal
from pathlib import Path

import pytest

from maexp.agents.cli import main
from maexp.agents.training.checkpoint import find_checkpoint
from maexp.agents.training.logs import MetricsLog, read_metrics

SWEEP = [
    "train", "-m", "seed=0,1,2", "scenario.maps=[0]", "scenario.held_out=[70]", "scenario.macro_steps=2",
    "scenario.local_steps=2", "num_envs=2", "num_robots=2", "collector.steps=2", "total_frames=16", "episodes=0",
    "model.channels=4", "evaluate_every=0", "checkpoint_every=1",
]  # fmt: skip


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


@pytest.mark.parametrize("words, told", [
    (["resume=sweep", "seed=3"], "resume=sweep with -m keeps all settings of a sweep: leave seed out."),
    (["resume=gone"], "resume=gone with -m: there is no sweep.json of a sweep that could be read (FileNotFoundError)"),
    (["resume=sweep"], "that could be read (JSONDecodeError). For a single run leave out -m."),
])  # fmt: skip
def test_what_cannot_go_on_is_a_sentence(words, told, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("sweep").mkdir()
    Path("sweep/sweep.json").write_text("{")
    assert main(["train", "-m", *words]) == 2
    assert told in capsys.readouterr().err
