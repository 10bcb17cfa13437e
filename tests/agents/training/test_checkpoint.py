"""Checkpoints: whole or absent, newest whole one found, random numbers continued."""

import random
import warnings

import numpy as np
import pytest
import torch

from maexp.agents.errors import UserError
from maexp.agents.training import checkpoint
from maexp.agents.training.checkpoint import (
    FORMAT,
    find_checkpoint,
    list_checkpoints,
    load_checkpoint,
    save_checkpoint,
)
from maexp.envs import atomic_write


def state(number: int) -> dict:
    settings = {"scenario": {"name": "maze"}, "planner": {"name": "dwa"}}
    words = {"overrides": ["seed=1"], "settings": settings, "followers": [], "maps": {}}
    return words | {"iteration": number, "policy": {"weights": torch.full((5,), float(number))}}


@pytest.fixture
def run(tmp_path):
    for number in (1, 2, 3):
        save_checkpoint(tmp_path / "checkpoints", state(number), number, keep=3, best=number == 2)
    return tmp_path


def test_keeps_the_newest_the_best_and_the_start(run):
    save_checkpoint(run / "checkpoints", state(0), 0, keep=9)
    save_checkpoint(run / "checkpoints", state(10), 10, keep=2)
    kept = [path.stem for path in list_checkpoints(run / "checkpoints")]
    assert kept == ["iteration_000010", "iteration_000003", "iteration_000000"]
    assert load_checkpoint(run / "checkpoints" / "best.pt")["iteration"] == 2


def test_finds_the_newest_of_a_run_a_folder_or_a_file(run):
    for place in (run, run / "checkpoints", run / "checkpoints" / "iteration_000003.pt"):
        path, found = find_checkpoint(place)
        assert (path.stem, found["iteration"]) == ("iteration_000003", 3)


@pytest.mark.parametrize("damage", ["truncate", "empty", "flip"])
def test_falls_back_from_a_damaged_one_with_a_warning(run, damage):
    newest = run / "checkpoints" / "iteration_000003.pt"
    content = bytearray(newest.read_bytes())
    if damage == "flip":
        content[:200] = bytes(200)
    newest.write_bytes(content if damage == "flip" else content[: len(content) // 2 if damage == "truncate" else 0])
    with pytest.warns(UserWarning, match="iteration_000003.pt is not a whole checkpoint"):
        assert find_checkpoint(run)[1]["iteration"] == 2


def test_a_write_that_dies_leaves_the_old_ones(run, monkeypatch):
    def die(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(atomic_write.os, "replace", die)
    with pytest.raises(KeyboardInterrupt):
        save_checkpoint(run / "checkpoints", state(4), 4, keep=3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert find_checkpoint(run)[1]["iteration"] == 3


def test_nothing_to_find(tmp_path):
    with pytest.raises(UserError, match="does not exist"):
        find_checkpoint(tmp_path / "nowhere")
    with pytest.raises(UserError, match="holds no whole checkpoint"):
        find_checkpoint(tmp_path)
    torch.save({"model": 1}, tmp_path / "other.pt")
    with pytest.raises(UserError, match=f"no checkpoint of the kind {FORMAT}"):
        find_checkpoint(tmp_path / "other.pt")


def test_one_of_another_format_is_a_sentence(tmp_path):
    path = save_checkpoint(tmp_path, state(1) | {"format": "maexp-checkpoint-0"}, 1, keep=1)
    with pytest.raises(UserError, match=f"no checkpoint of the kind {FORMAT}: train again"):
        load_checkpoint(path)


def test_code_in_a_file_is_never_run(tmp_path):
    class Evil:
        def __reduce__(self):
            return (open, (str(tmp_path / "proof"), "w"))

    torch.save({"overrides": [], "x": Evil()}, tmp_path / "evil.pt")
    with pytest.raises(UserError, match="not a whole checkpoint"):
        load_checkpoint(tmp_path / "evil.pt")
    assert not (tmp_path / "proof").exists()


def test_random_numbers_go_on(tmp_path):
    def draw():
        return torch.rand(3).tolist(), np.random.rand(3).tolist(), random.random(), random.gauss(0, 1)

    checkpoint.seed_everything(4)
    draw()
    path = save_checkpoint(tmp_path, state(1) | {"random": checkpoint.random_state()}, 1, keep=1)
    wanted = draw()
    checkpoint.seed_everything(5)
    checkpoint.set_random_state(load_checkpoint(path)["random"])
    assert draw() == wanted
