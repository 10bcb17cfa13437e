"""Tiny trainings: words, how they are started and resumed, and whether two came to the same."""

from pathlib import Path

import torch
from metrics_file import read_metrics

from maexp.agents.cli import main
from maexp.agents.training.checkpoint import find_checkpoint

TINY = [
    "scenario=maze_small",
    "action=regions",
    "scenario.maps=[0,1]",
    "scenario.held_out=[70]",
    "scenario.macro_steps=3",
    "scenario.local_steps=5",
    "num_envs=3",
    "num_robots=2",
    "collector.steps=2",
    "checkpoint_every=2",
    "episodes=0",
    "evaluate_every=0",
    "evaluate_episodes=4",
]
BATCH = 6
CLOCKS = (
    "seconds",
    "frames_per_second",
    "time_wait",
    "time_simulate",
    "time_policy",
    "time_advantage",
    "time_update",
    "time_validation",
)


def run(folder: str, iterations: int, *words: str) -> Path:
    assert main(["train", *TINY, f"hydra.run.dir={folder}", f"total_frames={iterations * BATCH}", *words]) == 0
    return Path(folder)


def resume(folder: Path, iterations: int, *words: str) -> Path:
    assert main(["train", f"resume={folder}", f"total_frames={iterations * BATCH}", *words]) == 0
    return folder


def assert_same(first, second, place="checkpoint") -> None:
    """The same bits everywhere, but for clocks and the words of the command line."""
    if isinstance(first, dict):
        assert first.keys() == second.keys(), place
        for name in first:
            if name not in ("seconds", "overrides"):
                assert_same(first[name], second[name], f"{place}/{name}")
    elif torch.is_tensor(first):
        assert first.dtype == second.dtype and torch.equal(first.nan_to_num(), second.nan_to_num()), place
    elif isinstance(first, list | tuple):
        assert len(first) == len(second), place
        for index, pair in enumerate(zip(first, second, strict=True)):
            assert_same(*pair, f"{place}/{index}")
    else:
        assert first == second or first != first, place


def assert_same_runs(first: Path, second: Path) -> None:
    assert_same(find_checkpoint(first)[1], find_checkpoint(second)[1])
    rows = [read_metrics(folder / "metrics.csv") for folder in (first, second)]
    assert len(rows[0]) == len(rows[1])
    for pair in zip(*rows, strict=True):
        assert_same(*({name: value for name, value in row.items() if name not in CLOCKS} for row in pair), "metrics")
