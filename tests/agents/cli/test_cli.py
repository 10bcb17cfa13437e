"""The command line: what it prints, how it refuses, where it writes."""

import json
import logging
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from maexp.agents.cli import VERBS, main
from maexp.agents.cli.run_folder import claim_folder
from maexp.agents.policies import POLICIES
from maexp.envs import make_map

TINY = [
    "action=regions",
    "scenario.maps=[0]",
    "scenario.held_out=[70]",
    "num_envs=2",
    "collector.steps=2",
    "scenario.macro_steps=2",
]


pytestmark = pytest.mark.usefixtures("somewhere")


def refuse(capsys, *words: str) -> str:
    """The one sentence on stderr of a command that must be refused, and leave nothing behind."""
    before = sorted(Path().rglob("*"))
    assert main(list(words)) == 2
    out, err = capsys.readouterr()
    assert err.startswith("maexp: ") and err.count("\n") == 1, err
    assert "Traceback" not in err and not out
    left = [path for path in Path().rglob("*") if path not in before and path.is_file()]
    assert not left, left
    return err


def test_alone_it_lists_the_verbs_with_examples(capsys):
    assert main([]) == 0
    text = capsys.readouterr().out
    for name, verb in VERBS.items():
        assert name in text and all(example in text for example in verb.examples)


@pytest.mark.parametrize("verb", VERBS)
def test_help_names_settings_and_choices(verb, capsys):
    assert main([verb, "--help"]) == 0
    text = capsys.readouterr().out
    assert "num_robots=" in text or verb in ("policies", "suite", "ros2", "leaderboard")
    if verb not in ("maps", "irsim", "export", "policies", "suite", "ros2", "leaderboard"):
        assert "maze_small" in text and "wavefront" in text and "camera" in text


@pytest.mark.parametrize("verb", VERBS)
def test_help_waits_for_no_heavy_library(verb):
    program = (
        f"import sys; from maexp.agents.cli import main; main([{verb!r}, '--help']); "
        "print([name for name in ('torch', 'torchrl', 'warp', 'open3d') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]" and verb in done.stdout


@pytest.mark.parametrize(
    "words",
    [
        ["train", "scenario=labyrinth"],
        ["train", "-m", "algorithm=ippo,mapo"],
        ["train", "num_robots=0"],
        ["train", "robot.radius=0.3", "robot.length=1"],
        ["evaluate", "policy=clever"],
        ["benchmark", "scenario=labyrinth"],
        ["evaluate", "checkpoint=gone", "polcy=random"],
        ["maps", "import", "x.png", "impoting.up=y"],
        ["ros2", "serve", "minivall"],
    ],
)
def test_a_wrong_word_waits_for_no_heavy_library(words):
    program = (
        f"import sys; from maexp.agents.cli import main; print(main({words!r})); "
        "print([name for name in ('torch', 'torchrl', 'warp', 'open3d', 'skimage') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["2", "[]"] and done.stderr.startswith("maexp: ")


def test_help_shows_what_is_taken_without_a_word(capsys):
    assert main(["train", "--help"]) == 0
    text = capsys.readouterr().out
    assert "  num_envs=64 " in text and "\n  time (default) " in text and "\n  targets (default) " in text
    assert "\n  default (default) " in text.partition("tuning=")[2] and "\naction=CHOICE\n" in text
    assert main(["evaluate", "--help"]) == 0
    text = capsys.readouterr().out
    assert "  num_envs=32 " in text and "\n  regions (default) " in text


@pytest.mark.parametrize("verb", VERBS)
def test_help_names_each_setting_once(verb, capsys):
    main([verb, "--help"])
    names = re.findall(r"^(?:  )?(\w+)=", capsys.readouterr().out, re.MULTILINE)
    assert len(names) == len(set(names))


def test_help_names_the_classical_policies_there_are(capsys):
    assert main(["evaluate", "--help"]) == 0
    assert f"{', '.join(POLICIES)}, a trained one" in capsys.readouterr().out


def test_the_installed_command_prints_no_noise():
    command = [sys.executable, "-c", "import sys; from maexp.agents.cli import main; sys.exit(main())"]
    done = subprocess.run([*command, "maps", "list"], capture_output=True, text=True)
    assert done.returncode == 0 and "maze_small" in done.stdout
    assert done.stderr == ""


def test_cfg_prints_the_settings_and_runs_nothing(capsys):
    assert main(["train", "--cfg", "job", "scenario=maze", "seed=5"]) == 0
    text = capsys.readouterr().out
    assert "name: maze" in text and "seed: 5" in text
    assert not Path("outputs").exists()


BAD = {
    "a verb": (["trane"], "train"),
    "an option": (["train", "--fast"], "--fast"),
    "a scenario": (["train", "scenario=labyrinth"], "maze_small"),
    "an override": (["train", "num_robos=2"], "num_robots"),
    "no robots": (["train", "num_robots=0"], "num_robots=0"),
    "a word for a number": (["train", "num_robots=three"], "num_robots=three"),
    "negative frames": (["train", "total_frames=-5"], "total_frames=-5"),
    "a device": (["train", "device=abacus"], "device=abacus"),
    "a missing map": (["train", "scenario=pointcloud", "scenario.path=no such (map).yaml"], "no such (map).yaml"),
    "no map": (["train", "scenario=pointcloud"], "scenario.path"),
    "a path without pointcloud": (["train", "scenario.path=x.npz"], "scenario=pointcloud"),
    "a robot that cannot be": (["train", "robot.kind=boat"], "boat"),
    "a negative radar": (["train", "radar.range=-1"], "radar.range"),
    "no room": (["train", "num_robots=4000"], "num_robots=4000"),
    "an algorithm's setting": (["train", "algorithm=ippo", "algorithm.max_kl=0.1"], "max_kl"),
    "a run to resume": (["train", "resume=nowhere"], "nowhere"),
    "nothing to evaluate": (["evaluate"], "checkpoint=RUN"),
    "a policy": (["evaluate", "policy=clever"], "nearest_frontier"),
    "a checkpoint": (["evaluate", "checkpoint=nowhere"], "nowhere"),
    "goals for controls": (["evaluate", "policy=random", "planner=direct"], "random picks goals: use planner=dwa"),
    "goals for controls to compare": (["benchmark", "planner=direct"], "planner=direct takes controls"),
    "team sizes": (["evaluate", "policy=random", "num_robots=1,0"], "num_robots=[1, 0]"),
    "no action": (["maps"], "list, make"),
    "a scenario to make": (["maps", "make", "labyrinth"], "maze_small"),
    "a file to check": (["maps", "check", "gone.npz"], "gone.npz"),
    "a folder for a map": (["maps", "make", "maze_small", "out=gone/m.npz"], "make gone first"),
    "a picture's name": (["maps", "show", "maze_small", "out=m.txt"], ".png"),
    "a seed below 0": (["train", "seed=-1"], "seed=-1 must be a whole number from 0 to 2147483647"),
    "a seed too large": (["evaluate", "policy=random", "seed=2147483648"], "seed=2147483648"),
    "a seed to view with": (["view", "maze_small", "policy=random", "seed=-1"], "seed=-1"),
    "a seed to measure with": (["bench", "env", "seed=-1"], "seed=-1"),
    "a seed among several": (["bench", "env", "seed=0,-1"], "seed=-1"),
    "a seed to compare with": (["benchmark", "seeds=0,-1"], "seeds=-1"),
    "a policy twice": (["evaluate", "policy=random,random"], "policy=random,random names random twice"),
    "a team twice": (["evaluate", "policy=random", "num_robots=2,2"], "num_robots=2,2 names 2 twice"),
    "a team twice to train": (["train", "num_robots=2,3,2"], "names 2 twice"),
    "a policy twice to compare": (["benchmark", "policies=random,random"], "names random twice"),
    "an axis twice": (["bench", "scale", "axes=envs,envs"], "names envs twice"),
    "the end of a setting's name": (["bench", "scale", "robots=0"], "did you mean num_robots."),
    "a setting of two groups": (["train", "steps=3"], "did you mean scenario.local_steps or scenario.macro_steps or"),
    "a setting twice": (["evaluate", "policy=random", "policy=voronoi"], "policy is given twice, policy=random and"),
    "a word too many": (["maps", "check", "a.npz", "b.npz"], "b.npz"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_gets_one_sentence(case, capsys):
    words, named = BAD[case]
    assert named in refuse(capsys, *words)


@pytest.mark.parametrize("damage", ["truncated", "empty file", "no points", "nan", "infinite", "no room"])
def test_maps_that_cannot_be_used(damage, capsys, tmp_path):
    path = tmp_path / "map.npz"
    make_map("maze_small", 0).save(path)
    content = path.read_bytes()
    if damage == "truncated":
        path.write_bytes(content[: len(content) // 2])
    elif damage == "empty file":
        path.write_bytes(b"")
    else:
        arrays = dict(np.load(path))
        free = arrays["free"]
        if damage == "no points":
            arrays["free"] = free[:0]
        elif damage == "no room":
            arrays = {name: value for name, value in arrays.items() if "spacing" not in name and name != "boundary"}
            arrays["free"] = free[:3]
        else:
            free[3, 1] = np.nan if damage == "nan" else np.inf
        np.savez(path, **arrays)
    assert "map" in refuse(capsys, "train", "scenario=pointcloud", f"scenario.path={path}")


def test_a_run_folder_is_created_exclusively(tmp_path):
    first, second = (claim_folder(str(tmp_path / "run"), chosen=False) for _ in range(2))
    assert (first.name, second.name) == ("run", "run-2")


def test_earlier_results_and_read_only_folders_are_left_alone(capsys, tmp_path):
    old = tmp_path / "old"
    old.mkdir()
    (old / "metrics.csv").write_text("mine")
    assert "already holds files" in refuse(capsys, "train", *TINY, f"hydra.run.dir={old}")
    assert (old / "metrics.csv").read_text() == "mine"
    assert "is a file" in refuse(capsys, "train", *TINY, f"hydra.run.dir={old}/metrics.csv/run")
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o555)
    assert "read-only" in refuse(capsys, "train", *TINY, f"hydra.run.dir={locked}/run")


def test_maps_make_import_check_show(capsys, tmp_path):
    target = tmp_path / "my maze (1)=x.npz"
    assert main(["maps", "make", "maze_small", "index=3", f"out={target}"]) == 0
    assert "verdict" in capsys.readouterr().out
    assert "exists already" in refuse(capsys, "maps", "make", "maze_small", f"out={target}")
    assert main(["maps", "check", str(target), f"hydra.run.dir={tmp_path}/a b=c (d)"]) == 0
    assert (tmp_path / "a b=c (d)" / "report.txt").read_text().startswith("map")
    picture = tmp_path / "look.png"
    assert main(["maps", "show", str(target), f"out={picture}"]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_maps_import_of_a_real_floor(capsys, data_dir, tmp_path):
    assert main(["maps", "import", str(data_dir / "maps2d" / "rail_lab.yaml"), f"out={tmp_path}/lab.npz"]) == 0
    assert (tmp_path / "lab.npz").is_file()
    assert "maexp train scenario=pointcloud" in capsys.readouterr().out


def test_evaluate_writes_results_for_every_team_size(capsys, tmp_path):
    words = ["policy=random,nearest_frontier", "num_robots=1,2", "episodes=5", f"hydra.run.dir={tmp_path}/e"]
    assert main(["evaluate", *[word for word in TINY if "collector" not in word], *words]) == 0
    results = json.loads((tmp_path / "e" / "results.json").read_text())
    assert set(results) == {"random N=1", "random N=2", "nearest_frontier N=1", "nearest_frontier N=2", "run"}
    coverage = results["random N=2"]["exploration_ratio"]
    assert coverage["n"] == 5 and coverage["ci95"][0] <= coverage["mean"] <= coverage["ci95"][1]
    assert results["run"]["num_robots"] == [1, 2] and results["run"]["episodes"] == 5
    for name in ("picture.png", "coverage.png", "metrics.png", "shares.png"):
        assert (tmp_path / "e" / name).stat().st_size > 5000
    printed = capsys.readouterr().out
    assert "results.json, episodes.csv, coverage.png, metrics.png, shares.png, picture.png, config.yaml" in printed
    assert "nearest_frontier N=2" in printed and "maze_small: 5 held-out episodes, for each team size" in printed


def test_a_sweep_leaves_the_loggers_of_the_program_around_it_alone(tmp_path, monkeypatch):
    log = logging.getLogger("maexp.runtime")
    monkeypatch.chdir(tmp_path)
    assert main(["train", "-m", "seed=0,1", "num_envs=-1"]) == 2
    assert not log.disabled
