"""Trainings that were stopped, killed or damaged: resumed, they come to the bits of one go."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from metrics_file import read_metrics
from tiny_training import BATCH, TINY, assert_same_runs, resume, run

from maexp.agents.cli import main
from maexp.agents.training.checkpoint import find_checkpoint, list_checkpoints

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("somewhere", "no_pictures")]  # trainings


@pytest.mark.parametrize("algorithm", ["mappo", "matrpo"])
def test_resumed_is_uninterrupted(algorithm):
    """On maps on which the coverage falls, too: the best is never where a run happened to stop."""
    words = [f"algorithm={algorithm}", "scenario=indoor_medium"]
    whole = run("whole", 6, *words)
    parts = resume(run("parts", 3, *words), 6)
    assert_same_runs(whole, parts)


def test_rows_after_the_checkpoint_are_dropped_and_a_damaged_one_passed_over(capsys):
    whole = run("whole", 6)
    broken = run("broken", 5)
    newest = list_checkpoints(broken / "checkpoints")[0]
    newest.write_bytes(newest.read_bytes()[:1000])
    resume(broken, 6)
    assert "warning" in capsys.readouterr().err
    assert_same_runs(whole, broken)


def test_resumed_the_planners_need_not_play_again(monkeypatch, capsys):
    """The columns of the validation, too, are those of a run in one go; other settings let the planners play anew."""
    from maexp.agents.training import validation

    played, play_best = [], validation.play_best
    monkeypatch.setattr(validation, "play_best", lambda *args: played.append(1) or play_best(*args))
    whole = run("whole", 5, "evaluate_every=2")
    parts = run("parts", 3, "evaluate_every=2")
    assert len(played) == 2
    assert_same_runs(whole, resume(parts, 5))
    assert len(played) == 2
    assert "gain over" in capsys.readouterr().err
    resume(parts, 6, "evaluate_episodes=2")
    assert len(played) == 3


PROGRAM = """
import sys, torch
torch.set_num_threads(1)
from maexp.agents.cli import train
train.draw_rollout = train.draw_curves = lambda *args: None
from maexp.agents.cli import main
sys.exit(main(sys.argv[1:]))
"""


def start(*words: str) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, "-c", PROGRAM, "train", *words], stderr=subprocess.PIPE, text=True)


def wait_for_rows(folder: Path, count: int, process: subprocess.Popen) -> None:
    path = folder / "metrics.csv"
    while process.poll() is None and (not path.is_file() or len(path.read_text().splitlines()) <= count):
        time.sleep(0.005)


def test_ctrl_c_ends_with_a_checkpoint():
    process = start(*TINY, "hydra.run.dir=run", "total_frames=600000", "checkpoint_every=100000")
    wait_for_rows(Path("run"), 2, process)
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=60) == 130
    assert find_checkpoint("run")[1]["iteration"] >= 2
    assert "Traceback" not in process.stderr.read()


def test_a_signal_after_an_iteration_was_kept_loses_none(monkeypatch):
    """Ctrl-C between the look at the signals and the end of the iteration: the next one ends the run, and is saved."""
    shown = []

    def show(self, done, note=""):
        shown.append(done)
        if len(shown) == 2:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr("maexp.agents.training.train.Progress.show", show)
    words = [*TINY, "hydra.run.dir=run", "total_frames=600000", "checkpoint_every=100000"]
    assert main(["train", *words]) == 130
    rows = [int(row["iteration"]) for row in read_metrics(Path("run/metrics.csv"))]
    assert find_checkpoint("run")[1]["iteration"] == rows[-1] == 3


def test_killed_at_random_moments_and_resumed(tmp_path):
    """kill -9 while the run trains, logs or saves; after each, resume; at the end the bits of one go."""
    attempts = int(os.environ.get("MAEXP_KILLS", 4))
    iterations, rng, kills = 8 * attempts, random.Random(os.environ.get("MAEXP_KILL_SEED", 0)), 0
    whole = run("whole", iterations, "checkpoint_every=1")
    words = [*TINY, "hydra.run.dir=killed", f"total_frames={iterations * BATCH}", "checkpoint_every=1"]
    folder = tmp_path / "killed"
    for attempt in range(attempts):
        process = start(*words) if attempt == 0 else start(f"resume={folder}")
        done = find_checkpoint(folder)[1]["iteration"] if attempt else 0
        wait_for_rows(folder, min(done + 2, iterations - 1), process)
        time.sleep(rng.random() * 0.2)
        kills += process.poll() is None
        process.kill()
        process.wait()
    print(f"killed {kills} times")
    assert kills >= attempts // 2
    resume(folder, iterations)
    assert_same_runs(whole, folder)
