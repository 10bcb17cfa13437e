"""Policies that ship: listed, shown, found by name everywhere, and refused in a sentence where they are damaged."""

import json
import shutil

import numpy as np
import pytest

from maexp.agents.cli import main
from maexp.agents.deploy.planner.bundle import SHIPPED, shipped_names
from maexp.agents.errors import UserError
from maexp.agents.policies.model_card import describe_results


def test_the_list_names_one_a_line(capsys):
    assert main(["policies", "list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == shipped_names() and len(lines) >= 2
    assert sum(file.stat().st_size for file in SHIPPED.rglob("*")) < 4e6


def test_one_is_shown(capsys):
    assert main(["policies", "show", "universal"]) == 0
    told = capsys.readouterr().out
    assert told.startswith("# universal") and f"Folder: {SHIPPED / 'universal'}" in told and "## Training" in told


@pytest.mark.parametrize(
    "specs",
    [
        ["policies", "show", "universl"],
        ["evaluate", "policy=universl"],
        ["view", "policy=universl"],
        ["irsim", "floor.yaml", "policy=universl"],
        ["train", "warm_start=universl"],
    ],
)
def test_a_name_that_is_none_is_a_sentence_with_the_near_ones(specs, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(specs) == 2
    told = capsys.readouterr().err
    assert "universl is " in told and "did you mean universal" in told and told.count("\n") == 1
    assert not list(tmp_path.iterdir())


def write_floor(path, width: int, height: int) -> None:
    """A hall with two pillars as map_server has it, cells of 0.25 m."""
    free = np.full((height, width), 254, np.uint8)
    free[[0, -1]], free[:, [0, -1]] = 0, 0
    free[height // 2, width // 3 :: width // 3] = 0
    path.with_suffix(".pgm").write_bytes(f"P5 {width} {height} 255\n".encode() + free.tobytes())
    path.write_text(
        f"image: {path.stem}.pgm\nresolution: 0.25\norigin: [0, 0, 0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.2\n"
    )


def test_it_plays_on_several_floors_with_teams_of_every_size(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_floor(tmp_path / "hall.yaml", 60, 40)
    write_floor(tmp_path / "yard.yaml", 48, 56)
    done = main(
        [
            "evaluate",
            "policy=universal,cost_utility",
            "scenario=pointcloud",
            "scenario.path=hall.yaml,yard.yaml",
            "num_robots=2,3,6,8",
            "episodes=2",
            "scenario.macro_steps=2",
            "device=cpu",
            "hydra.run.dir=all",
        ]
    )
    found = json.loads((tmp_path / "all" / "results.json").read_text())
    assert done == 0
    for size in (2, 3, 6, 8):
        for policy in ("universal", "cost_utility"):
            whole, *floors = (
                found[f"{policy}{place} N={size}"]["exploration_ratio"] for place in ("", " on hall", " on yard")
            )
            assert [results["n"] for results in (whole, *floors)] == [4, 2, 2]
            assert whole["mean"] == pytest.approx((floors[0]["mean"] + floors[1]["mean"]) / 2)
        assert f"cost_utility N={size}" in found["difference"][f"universal N={size}"]
    seen = [found[f"universal N={size}"]["exploration_ratio"]["mean"] for size in (2, 8)]
    assert 0.05 < seen[0] < seen[1] <= 1.0


@pytest.mark.parametrize(
    ("file", "change", "part"),
    [
        ("weights.safetensors", lambda data: data[:-1] + b"x", "is not the file that its contract names"),
        ("weights.safetensors", None, "No such file"),
        ("policy.onnx", lambda data: data[:100], "is not the file that its contract names"),
        (
            "contract.json",
            lambda data: data.replace(b"maexp-policy-2", b"maexp-policy-9"),
            "of the kind maexp-policy-2",
        ),
    ],
)
@pytest.mark.parametrize("specs", [["evaluate", "policy=mine"], ["view", "policy=mine"], ["train", "warm_start=mine"]])
def test_a_damaged_folder_is_a_sentence(file, change, part, specs, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(SHIPPED / "universal", "mine")
    data = (tmp_path / "mine" / file).read_bytes()
    (tmp_path / "mine" / file).unlink()
    if change is not None:
        (tmp_path / "mine" / file).write_bytes(change(data))
    assert main(specs) == 2
    told = capsys.readouterr().err
    assert part in told and told.count("\n") == 1


def test_a_foreign_folder_and_two_of_one_name_are_sentences(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("")
    shutil.copytree(SHIPPED / "universal", "mine/universal")
    for policy, part in (
        ("empty", "policy=empty is a folder without a policy: it holds neither the contract.json of maexp export"),
        ("file", "policy=file is a file and no checkpoint: give a run's folder, or that of an exported policy"),
        ("universal,universal", "names universal twice"),
    ):
        assert main(["evaluate", f"policy={policy}"]) == 2
        told = capsys.readouterr().err
        assert part in told and told.count("\n") == 1


SMALL = ("scenario.macro_steps=2", "scenario.local_steps=5", "num_envs=2", "device=cpu", "num_threads=1")


def test_trained_and_classical_policies_play_the_same_episodes(tmp_path, monkeypatch, capsys):
    """By name and by folder; the classical one plays as it would alone, and the card of an export tells the results."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(SHIPPED / "small_mazes", "mine")
    specs = ["evaluate", *SMALL, "episodes=2", "num_robots=2"]
    assert main([*specs, "policy=universal,mine,nearest_frontier", "hydra.run.dir=all"]) == 0
    assert "nearest_frontier, the best classical planner" in capsys.readouterr().out
    assert main([*specs, "policy=nearest_frontier", "hydra.run.dir=alone"]) == 0
    results, alone = (json.loads((tmp_path / name / "results.json").read_text()) for name in ("all", "alone"))
    assert set(results) == {"universal", "mine", "nearest_frontier", "difference", "run"}
    assert results["nearest_frontier"] == alone["nearest_frontier"] and results["universal"] != results["mine"]
    assert set(results["difference"]["universal"]) == {"mine", "nearest_frontier"}
    told = "\n".join(describe_results(tmp_path / "all" / "results.json"))
    assert "`maze_small`, 16 held-out maps, 2 episodes, teams of 2" in told
    assert f"| universal | {results['universal']['exploration_ratio']['mean']:.3g} |" in told  # no interval from two
    assert "mine less nearest_frontier, the best classical planner on the validation maps" in told
    (tmp_path / "all" / "results.json").write_text("{}")
    with pytest.raises(UserError, match="is not the results of an evaluation"):
        describe_results(tmp_path / "all" / "results.json")


def test_a_team_is_viewed_and_imitated(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    view = ("renderer=painter", "size=200", "num_envs=1", *SMALL[:2], "hydra.run.dir=seen")
    assert main(["view", "policy=universal", *view]) == 0
    assert "universal, 3 robots" in capsys.readouterr().out and (tmp_path / "seen" / "episodes").is_dir()
    train = (
        "total_frames=8",
        "warm_start_frames=16",
        "episodes=0",
        "evaluate_every=0",
        "model.target_width=8",
        "hydra.run.dir=pupil",
    )
    assert main(["train", "warm_start=universal", *SMALL, *train]) == 0
    log = (tmp_path / "pupil" / "warm_start.csv").read_text().splitlines()
    assert "nll_target" in log[0] and len(log) == 5


def test_what_does_not_fit_is_a_sentence(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(SHIPPED / "universal", "wide")
    contract = tmp_path / "wide" / "contract.json"
    whole = json.loads(contract.read_text())
    for specs, change, part in (
        (["train", "warm_start=universal", "action=regions"], {}, "universal chooses targets, which a policy with"),
        (["train", "warm_start=universal", "observation.targets=9"], {}, "different numbers of targets"),
        (["evaluate", "policy=universal", "planner=direct"], {}, "planner=direct takes controls, and universal pick"),
        (["evaluate", "policy=wide", *SMALL], {"model": {"target_width": 24}}, "holds another network"),
        (["evaluate", "policy=wide", *SMALL], {"model": {"target_width": "a"}}, "holds no network that"),
        (["evaluate", "policy=universal,wide", *SMALL], {"candidates": 9}, "different numbers of targets"),
    ):
        contract.write_text(json.dumps(whole | change))
        assert main(specs) == 2
        told = capsys.readouterr().err
        assert part in told and told.count("\n") == 1, told
