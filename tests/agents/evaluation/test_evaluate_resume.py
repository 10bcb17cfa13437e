"""An evaluation that was stopped goes on where it was, to the bits of one that was not."""

import json
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from small_run import SMALL

from maexp.agents.cli import main
from maexp.agents.config.compose import compose_settings
from maexp.agents.evaluation.cache import FOLDER, EpisodeCache, digest_weights, identify
from maexp.agents.evaluation.evaluate import evaluate_recorded
from maexp.agents.models.actor import make_policy
from maexp.agents.policies import POLICIES
from maexp.agents.progress import Progress
from maexp.envs import ExplorationEnv, make_map

pytestmark = pytest.mark.slow  # evaluations that are stopped

TINY = [
    "scenario.held_out=[70,71]",
    "scenario.macro_steps=3",
    "scenario.local_steps=10",
    "num_envs=3",
    "episodes=8",
    "device=cpu",
]
PLAYERS = "policy=random,cost_utility,universal"


def stop_after(monkeypatch, batches: int) -> None:
    """Ctrl-C when so many batches have been played."""
    advance, played = Progress.advance, []

    def count(self, number):
        played.append(number)
        advance(self, number)
        if len(played) == batches:
            raise KeyboardInterrupt

    monkeypatch.setattr(Progress, "advance", count)


def without_seconds(folder: str) -> dict:
    content = json.loads((Path(folder) / "results.json").read_text())
    del content["run"]["seconds"]
    return content


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    folder = tmp_path_factory.mktemp("unbroken") / "run"
    assert main(["evaluate", *TINY, PLAYERS, "num_robots=2,3", f"hydra.run.dir={folder}"]) == 0
    assert not (folder / FOLDER).exists()
    return folder


@pytest.mark.parametrize("batches", [1, 5, 17])
def test_stopped_and_resumed_is_unbroken(unbroken, batches, tmp_path, monkeypatch, capsys):
    """Among the policies one draws at random; 17 of the 18 batches are played when it stops for the last time."""
    monkeypatch.chdir(tmp_path)
    with monkeypatch.context() as patch:
        stop_after(patch, batches)
        assert main(["evaluate", *TINY, PLAYERS, "num_robots=2,3", "hydra.run.dir=my run"]) == 130
    told = capsys.readouterr().out
    assert "Stopped. Go on with: maexp evaluate 'resume=my run'" in told
    played = sorted(Path("my run").rglob("*.npz"))
    assert len(played) == batches and not Path("my run/results.json").exists()
    with monkeypatch.context() as patch:
        stop_after(patch, batches + 2 if batches < 16 else 99)  # the kept ones are passed over first
        status = main(shlex.split(told.partition("Go on with: ")[2])[1:])
    if batches < 16:
        assert status == 130 and len(list(Path("my run").rglob("*.npz"))) == batches + 2
        monkeypatch.chdir("/")
        status = main(["evaluate", f"resume={tmp_path}/my run"])
        monkeypatch.chdir(tmp_path)
    assert status == 0
    assert without_seconds("my run") == without_seconds(unbroken)
    assert Path("my run/episodes.csv").read_bytes() == (unbroken / "episodes.csv").read_bytes()
    for name in ("coverage.png", "shares.png"):
        assert (Path("my run") / name).read_bytes() == (unbroken / name).read_bytes()
    assert not Path("my run", FOLDER).exists()


def test_what_cannot_go_on_is_a_sentence(unbroken, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with monkeypatch.context() as patch:
        stop_after(patch, 1)
        assert main(["evaluate", *TINY, "policy=random", "hydra.run.dir=run"]) == 130
    for words, told in [
        (["resume=run", "episodes=4"], "resume=run keeps what was played and where: leave episodes out."),
        (["resume=run", "hydra.run.dir=b"], "leave hydra.run.dir out"),
        (["resume=gone"], "resume=gone holds no evaluation that was stopped: give the folder of a maexp evaluate"),
        ([f"resume={unbroken}"], "is finished: give the folder of a maexp evaluate that did not come to its end"),
    ]:
        assert main(["evaluate", *words]) == 2
        assert told in capsys.readouterr().err
    Path("run", FOLDER, "evaluation.json").write_text("{}")
    assert main(["evaluate", "resume=run"]) == 2
    assert "evaluation.json is damaged, or not of the kind maexp-evaluation-1: evaluate" in capsys.readouterr().err


def test_a_checkpoint_that_was_trained_on_is_played_anew(tmp_path, monkeypatch, capsys):
    """The planner's episodes stay; a policy of two halves would be nobody's."""
    monkeypatch.chdir(tmp_path)
    training = [*SMALL, "total_frames=8", "episodes=0", "algorithm.branch_share=0.5", "hydra.run.dir=run"]
    assert main(["train", *training]) == 0
    with monkeypatch.context() as patch:
        stop_after(patch, 3)
        words = ["checkpoint=run", "policy=cost_utility", "num_envs=2", "episodes=4", "hydra.run.dir=e"]
        assert main(["evaluate", *words]) == 130
    assert main(["train", "resume=run", "total_frames=16"]) == 0
    capsys.readouterr()
    assert main(["evaluate", "resume=e"]) == 0
    err = capsys.readouterr().err
    assert "what trained_N2 was played with has changed since: its episodes are played again" in err
    assert "cost_utility_N2" not in err
    assert main(["evaluate", *words[:-1], "hydra.run.dir=f"]) == 0
    assert without_seconds("e") == without_seconds("f")


def test_ctrl_c_in_the_evaluation_after_a_training(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    small = [*SMALL, "total_frames=8", "episodes=4", "classical=[cost_utility]", "evaluate_every=0"]
    small += ["evaluate_episodes=2"]
    assert main(["train", *small, "hydra.run.dir=whole"]) == 0
    with monkeypatch.context() as patch:
        stop_after(patch, 3)
        assert main(["train", *small, "hydra.run.dir=my run"]) == 130
    told = capsys.readouterr().out
    assert "The training is done, its evaluation was stopped. Finish it with: maexp train 'resume=my run'" in told
    left = len(list(Path("my run").rglob("*.npz")))
    assert left == 2 and main(shlex.split(told.partition("Finish it with: ")[2])[1:]) == 0
    ours, theirs = (json.loads((Path(folder) / "summary.json").read_text()) for folder in ("my run", "whole"))
    for summary in (ours, theirs):
        for name in ("seconds", "training_seconds"):
            del summary["run"][name]
    assert ours == theirs and not Path("my run", FOLDER).exists()


def build(num_envs: int = 2) -> ExplorationEnv:
    return ExplorationEnv([make_map("maze_small", 70)], num_envs, 2, macro_steps=2, local_steps=5)


def test_damaged_batches_are_played_again(tmp_path):
    env = build()
    play = {"name": "random", "seed": 3}
    whole = evaluate_recorded(POLICIES["random"](env), env, 6, **play)
    kept = EpisodeCache(tmp_path, {})
    evaluate_recorded(POLICIES["random"](env), env, 6, kept=kept, **play)
    files = sorted(tmp_path.rglob("*.npz"))
    assert [file.name for file in files] == ["000000.npz", "000002.npz", "000004.npz"]
    files[1].write_bytes(files[1].read_bytes()[:100])
    files[2].write_bytes(b"")
    before = torch.get_rng_state()
    again = evaluate_recorded(POLICIES["random"](env), env, 6, kept=kept, **play)
    assert torch.equal(before, torch.get_rng_state())
    for metric, values in whole.episodes.items():
        np.testing.assert_array_equal(again.episodes[metric], values)
    np.testing.assert_array_equal(again.coverage, whole.coverage)
    np.testing.assert_array_equal(again.shares, whole.shares)
    assert again.maps.tolist() == whole.maps.tolist()


def test_batches_are_of_what_their_bits_follow_from(tmp_path):
    def settings(*words: str):
        return compose_settings("evaluate", ["policy=random", "scenario.held_out=[70]", *words])

    cfg, env, policy = settings(), build(), POLICIES["random"]
    base = identify(cfg, env, 6, policy, "random")
    assert base == identify(settings("num_threads=2"), env, 6, policy, "random")
    others = [
        identify(cfg, env, 7, policy, "random"),
        identify(cfg, build(3), 6, policy, "random"),
        identify(cfg, env, 6, policy, "other"),
        identify(cfg, env, 6, policy, "random", "changed"),
        identify(settings("radar.range=5"), env, 6, policy, "random"),
    ]
    assert all(other != base for other in others)
    EpisodeCache(tmp_path / "random", base).write(0, {"a": np.zeros(1)})
    assert (
        EpisodeCache(tmp_path / "random", base).read(0) is not None
        and EpisodeCache(tmp_path / "random", base).read(6) is None
    )
    with pytest.warns(UserWarning, match="what random was played with has changed since"):
        assert EpisodeCache(tmp_path / "random", others[0]).read(0) is None
    shutil.rmtree(tmp_path / "random")


def test_a_digest_changes_with_the_weights():
    env = build()
    policy = make_policy(env, compose_settings("evaluate", ["policy=random", "action=regions"]).model)
    before = digest_weights(policy)
    assert before == digest_weights(policy) != "" and digest_weights(POLICIES["random"]) == ""
    with torch.no_grad():
        next(policy.parameters()).flatten()[0] += 1.0
    assert digest_weights(policy) != before
