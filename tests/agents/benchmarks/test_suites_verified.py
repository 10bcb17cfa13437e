"""Runs of suites are believed only as far as their actions carry them."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from mazes import OFFSET, REGION

from maexp.agents.benchmarks.suites import run_files
from maexp.agents.benchmarks.suites.play import (
    Batch,
    SuitePolicy,
    build_env,
    build_maps,
    build_replay,
    play_batch,
    replay_batch,
)
from maexp.agents.benchmarks.suites.suite import load_suite
from maexp.agents.benchmarks.suites.verify import verify
from maexp.agents.cli import main
from maexp.agents.errors import UserError
from maexp.envs import ObservationConfig

pytestmark = pytest.mark.slow  # whole runs of suites


def test_a_run_is_believed(suite_run, small_suite, capsys):
    capsys.readouterr()
    assert main(["suite", "verify", str(suite_run), f"suite={small_suite}"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["verified"] and json.loads(out)["same_platform"] and "follows from its actions" in err
    content = json.loads((suite_run / "results.json").read_text())
    assert content["policy"] == "nearest_frontier" and content["suite"]["frozen_maps"]
    assert len(content["suite"]["checksum"]) == 64 and content["run"]["machine"]["cores"] >= 1
    assert [len(rows["coverage_auc"]) for rows in content["episodes"].values()] == [4, 4]
    parts = ("indoor_small", "maze_small")
    assert sorted(content["files"]) == [f"actions/{part}-000{k}.npz" for part in parts for k in (0, 3)]
    mean = np.mean([x for rows in content["episodes"].values() for x in rows["coverage_auc"]])
    assert content["score"]["mean"] == pytest.approx(mean, abs=1e-12)
    low, high = content["random"]["score"], content["reference"]["score"]
    assert content["score"]["normalised"] == pytest.approx((mean - low) / (high - low))
    assert content["decisions"]["count"] > 20 and content["decisions"]["mean_seconds"] > 0


def test_actions_give_the_same_bits_played_in_other_batches(suite_run, small_suite):
    """Also those of a policy that chooses among targets."""
    suite = load_suite(str(small_suite))
    part, player = suite.parts["maze_small"], SuitePolicy("small_mazes")
    env = build_env(part, build_maps(part), 2, suite.seed, player.observation(), device="cpu")
    with player.open(env) as policy:
        noted = [play_batch(suite, env, policy, first) for first in (0, 2)]
    whole = build_env(part, build_maps(part), 4, suite.seed, ObservationConfig(pictures=False), device="cpu")
    rows = {name: np.concatenate([getattr(batch, name) for batch in noted]) for name in run_files.ARRAYS}
    goal = np.concatenate([batch.sent["goal"] for batch in noted])
    metrics = {name: np.concatenate([batch.metrics[name] for batch in noted]) for name in suite.metrics}
    again = replay_batch(suite, whole, Batch(0, sent={"goal": goal}, metrics=metrics, **rows))
    for name, values in metrics.items():
        assert np.array_equal(values, again.metrics[name], equal_nan=True), name
    assert np.array_equal(goal, again.sent["goal"]) and (goal != 0).any() and np.array_equal(rows["maps"], again.maps)


def test_a_run_that_noted_regions_and_offsets_plays_again(small_suite, tmp_path):
    """As those did that were made before goals were noted in metres."""
    suite = load_suite(str(small_suite))
    part, said = suite.parts["maze_small"], []
    shape, draw = (4, part.num_robots), np.random.default_rng(0)

    def policy(state):
        said.append((draw.integers(0, 64, shape), draw.uniform(-1.2, 1.2, (*shape, 2)).astype(np.float32)))
        state[REGION], state[OFFSET] = (torch.from_numpy(array) for array in said[-1])
        return state

    maps = build_maps(part)
    noted = play_batch(suite, build_replay(part, maps, 4, suite.seed), policy, 0)
    region, offset = (np.stack([choice[k] for choice in said], 1) for k in (0, 1))
    earlier = replace(noted, sent={"region": region.astype(np.uint8), "offset": offset})
    run_files.write_batch(tmp_path, suite, part.name, earlier)
    read = run_files.read_batch(tmp_path, suite, part.name, 0)
    assert list(read.sent) == ["region", "offset"]
    again = replay_batch(suite, build_replay(part, maps, 4, suite.seed), read)
    assert all(np.array_equal(values, again.metrics[name], equal_nan=True) for name, values in noted.metrics.items())
    assert np.array_equal(noted.sent["goal"], again.sent["goal"])
    earlier.sent["region"][0, 0] = 64
    run_files.write_batch(tmp_path, suite, part.name, earlier)
    with pytest.raises(UserError, match="is damaged or holds something else"):
        run_files.read_batch(tmp_path, suite, part.name, 0)


def edit_json(change):
    def edit(where: Path) -> None:
        content = json.loads((where / "results.json").read_text())
        change(content)
        (where / "results.json").write_text(json.dumps(content))

    return edit


def edit_actions(change, name: str = "maze_small-0003"):
    """Changes the arrays of a file of actions, and the checksum that `results.json` gives for it."""

    def change_file(where: Path) -> None:
        path = where / "actions" / f"{name}.npz"
        with np.load(path) as file:
            arrays = dict(file)
        change(arrays)
        np.savez_compressed(path, **arrays)

    return edit_files(change_file)


def edit_files(change):
    """Changes files of actions, and the checksums that `results.json` gives for them."""

    def edit(where: Path) -> None:
        change(where)
        edit_json(lambda content: content["files"].update(run_files.list_files(where)))(where)

    return edit


def pick(episodes: list[int]):
    """What a file has of these episodes, in this order."""
    return lambda arrays: arrays.update({name: array[episodes] for name, array in arrays.items()})


def swap_files(where: Path) -> None:
    first, second = (where / "actions" / f"{part}-0000.npz" for part in ("maze_small", "indoor_small"))
    kept = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(kept)


def other_action(arrays: dict) -> None:
    arrays["goal"][0, 0] = arrays["goal"][0, 0, ::-1] + 5.0


def set_metric(content: dict) -> None:
    content["episodes"]["maze_small"]["coverage_auc"][1] += 1e-7


def set_map(content: dict) -> None:
    content["maps"]["maze_small"]["1000"] = "0" * 16


def cut_off(where: Path) -> None:
    path = where / "actions" / "indoor_small-0000.npz"
    path.write_bytes(path.read_bytes()[:900])


EDITS = {
    "a metric": (edit_json(set_metric), "results.json", "episodes.maze_small.coverage_auc[1]"),
    "an action": (edit_actions(other_action), "actions/maze_small-0003.npz", "episode 3: coverage_auc"),
    "an action, its file as it was told": (
        lambda where: edit_json(lambda results: results["files"].update({"actions/maze_small-0003.npz": "0" * 64}))(
            where
        ),
        "actions/maze_small-0003.npz",
        "SHA-256: the file was changed",
    ),
    "a metric in the file of actions": (
        edit_actions(lambda arrays: arrays["metrics"].__iadd__(0.01)),
        "actions/maze_small-0003.npz",
        "episode 3: coverage_auc",
    ),
    "an episode that ends earlier": (
        edit_actions(lambda arrays: arrays["decisions"].__isub__(1)),
        "actions/maze_small-0003.npz",
        "episode 3: coverage_auc",
    ),
    "another map": (edit_json(set_map), "results.json", "maps.maze_small.1000"),
    "another map of an episode": (
        edit_json(lambda results: results["episodes"]["maze_small"]["map"].reverse()),
        "results.json",
        "episodes.maze_small.map",
    ),
    "another version of the suite": (
        edit_json(lambda results: results["suite"].update(version=2)),
        "results.json",
        "suite.version",
    ),
    "another checksum": (
        edit_json(lambda results: results["suite"].update(checksum="0" * 64)),
        "results.json",
        "suite.checksum",
    ),
    "another seed": (edit_json(lambda results: results["suite"].update(seed=5)), "results.json", "suite.seed"),
    "a score": (edit_json(lambda results: results["score"].update(mean=0.99)), "results.json", "score.mean"),
    "an interval": (edit_json(lambda results: results["score"]["ci95"].reverse()), "results.json", "score.ci95[0]"),
    "a mean of a part": (
        edit_json(lambda results: results["parts"]["maze_small"]["path_length"].update(mean=1.0)),
        "results.json",
        "parts.maze_small.path_length.mean",
    ),
    "a difference": (
        edit_json(lambda results: results["reference"]["difference"]["coverage_auc"].update(mean=0.1)),
        "results.json",
        "reference.difference.coverage_auc.mean",
    ),
    "a profile": (
        edit_json(lambda results: results["profile"]["policy"].__setitem__(3, 0.5)),
        "results.json",
        "profile.policy[3]",
    ),
    "a time": (
        edit_json(lambda results: results["decisions"].update(mean_seconds=1e-9)),
        "results.json",
        "decisions.mean_sec",
    ),
    "a reference": (
        edit_json(lambda results: results["reference"].update(score=0.1)),
        "results.json",
        "reference.score",
    ),
    "a part left out": (
        edit_json(lambda results: results["parts"].pop("maze_small")),
        "results.json",
        "parts.maze_small",
    ),
    "a damaged file": (cut_off, "actions/indoor_small-0000.npz", "is damaged or holds something else"),
    "a missing file": (
        lambda where: (where / "actions" / "maze_small-0000.npz").unlink(),
        "actions/maze_small-0000.npz",
        "not in both",
    ),
    "a file more": (
        lambda where: shutil.copy(where / "actions" / "maze_small-0000.npz", where / "actions" / "x.npz"),
        "actions/x.npz",
        "not in both",
    ),
    "a file more, which is told": (
        edit_files(lambda where: shutil.copy(where / "actions" / "maze_small-0000.npz", where / "actions" / "x.npz")),
        "actions/x.npz",
        "no episode of the suite is in it",
    ),
    "two episodes in each other's place": (
        edit_actions(pick([1, 0, 2]), "maze_small-0000"),
        "actions/maze_small-0000.npz",
        "episode 0: ",
    ),
    "two files in each other's place": (edit_files(swap_files), "actions/maze_small-0000.npz", "episode 0: map"),
    "an episode more": (
        edit_actions(pick([0, 0])),
        "actions/maze_small-0003.npz",
        "holds episodes after the last, 3",
    ),
    "a seed that is none": (
        edit_json(lambda results: results["suite"].update(seed="x", frozen_maps=False)),
        "results.json",
        "an entry is missing or of another kind",
    ),
    "a seed below 0": (
        edit_json(lambda results: results["suite"].update(seed=-1, frozen_maps=False)),
        "results.json",
        "an entry is missing or of another kind",
    ),
    "no JSON": (lambda where: (where / "results.json").write_text("{"), "results.json", "is missing, damaged"),
    "an entry of another kind": (edit_json(lambda results: results.update(episodes=3)), "results.json", "episodes"),
}


@pytest.mark.parametrize("kind", EDITS)
def test_an_edited_run_is_not_believed_and_what_differs_is_named(copied_run, small_suite, kind, capsys):
    edit, file, where = EDITS[kind]
    edit(copied_run)
    assert main(["suite", "verify", str(copied_run), f"suite={small_suite}"]) == 1
    out, err = capsys.readouterr()
    report = json.loads(out)
    assert not report["verified"] and err.count("\n") == 1 and "is not what it says" in err
    assert any(difference["file"] == file and where in difference["where"] for difference in report["differences"]), (
        report["differences"]
    )


def test_other_maps_and_starts_are_told_and_verified(small_suite, tmp_path, capsys):
    where = tmp_path / "other"
    assert main(["suite", "run", str(small_suite), "policy=random", "seed=7", f"hydra.run.dir={where}"]) == 0
    assert "Other maps and starts, of seed 7: not the score of small." in capsys.readouterr().out
    content = json.loads((where / "results.json").read_text())
    assert not content["suite"]["frozen_maps"]
    assert content["score"]["normalised"] == 0.0  # `random` was played there, too
    assert verify(where, str(small_suite))["verified"]
