"""A suite over DDS and a team in another process on the other end: the same choices as inside."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from loopback import surroundings

pytest.importorskip("cyclonedds", reason="THE EXTRA maexp[ros2] IS NOT INSTALLED: DDS is not tested")
from small_suite import make_small_suite

from maexp.agents.benchmarks.suites.verify import verify
from maexp.agents.cli import main

pytestmark = pytest.mark.slow  # processes, and waiting


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A small suite, runs of it over DDS with `maexp ros2 team` in another process, and a run inside."""
    place = tmp_path_factory.mktemp("ros2")
    suite = make_small_suite(place / "small.yaml")
    said = {goals: play_served(suite, place / goals, goals) for goals in ("goal_pose", "navigate_to_pose")}
    words = ["policy=cost_utility", "num_envs=1", f"hydra.run.dir={place / 'inside'}"]
    assert main(["suite", "run", str(suite), *words]) == 0
    return suite, place, said


def play_served(suite: Path, where: Path, goals: str) -> tuple[int, str]:
    """What the team's process ended with and said."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in surroundings().items():
            patch.setenv(name, value)
        words = ["ros2", "team", "robots=robot1,robot2,robot3", "policy=cost_utility", "answer=300", f"goals={goals}"]
        program = "import sys; from maexp.agents.cli import main; sys.exit(main())"
        command = [sys.executable, "-c", program, *words]
        other = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=where.parent)
        try:
            words = [f"hydra.run.dir={where}", "answer=120", "stands=120"]
            assert main(["ros2", "serve", str(suite), *words]) == 0
            said, _ = other.communicate(timeout=60)
        finally:
            other.kill()
    return other.returncode, said


@pytest.mark.parametrize("goals", ["goal_pose", "navigate_to_pose"])
def test_the_same_choices_as_inside(folders, goals):
    over, inside = folders[1] / goals, folders[1] / "inside"
    files = sorted(path.name for path in (over / "actions").iterdir())
    assert len(files) == 8 and files == sorted(path.name for path in (inside / "actions").iterdir())
    for name in files:
        with np.load(over / "actions" / name) as ours, np.load(inside / "actions" / name) as theirs:
            assert np.abs(ours["goal"] - theirs["goal"]).max() < 1e-4 and not any(ours["reasons"])
            assert np.array_equal(ours["metrics"], theirs["metrics"], equal_nan=True)
            assert (ours["seconds"] > 0).all()


def test_the_action_has_the_bits_of_the_topic(folders):
    by_topic, by_action = (folders[1] / goals / "actions" for goals in ("goal_pose", "navigate_to_pose"))
    for file in by_topic.iterdir():
        with np.load(file) as here, np.load(by_action / file.name) as there:
            for name in ("goal", "metrics", "decisions"):
                assert np.array_equal(here[name], there[name], equal_nan=True), name


def test_a_run_over_dds_is_verified(folders):
    suite, over = folders[0], folders[1] / "navigate_to_pose"
    found = verify(over, str(suite))
    assert found["verified"] and found["policy"] == "ros2"
    assert json.loads((over / "run.json").read_text())["settings"]["policy"] == "ros2"


def test_the_team_ends_with_the_arena(folders):
    for status, said in folders[2].values():
        assert status == 0 and "32 decisions" in said and "8 episodes of an arena." in said


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["serve"], "maexp ros2 serve needs a suite after it: minival"),
        (["serve", "minivall"], "minivall is no suite: choose one of minival"),
        (["serve", "minival", "tf=both"], "tf=both is unknown: choose shared or own"),
        (["serve", "minival", "wait_for=none"], "wait_for=none is unknown: choose all or idle"),
        (["serve", "minival", "limit=0"], "limit=0.0 must be a finite number above 0 [s]"),
        (["serve", "minival", "domain=300"], "domain=300 must be a whole number from 0 to 232"),
        (["team", "robots=a", "goals=action"], "goals=action is unknown: choose goal_pose or navigate_to_pose"),
        (["team"], "No robots: name those of the team"),
        (["team", "minival"], "maexp ros2 team takes no name: leave minival out"),
        (["team", "robots=a,a"], "robots=a,a must name the robots of the team, each once"),
        (["team", "robots=a", "policy=universl"], "universl"),
        (["team", "robots=[a,b c]"], "robots: 'b c' is no name in ROS"),
        (["team", "robots=a", "map_topics=/über"], "map_topics: 'über' is no name in ROS"),
        (["team", "robots=a", "period=fast"], "period='fast' must be a finite number above 0 [s]"),
        (["serve", "minival", "robots=1,2,3"], "robots: '1' is no name in ROS"),
        (["team", "robots=a,b", "offsets=1,2"], "offsets holds 2 numbers: give 6"),
        (["team", "robots=a,b", "robot_radius=0.2,big"], "robot_radius: 'big' is no number"),
    ],
)
def test_words_that_cannot_be(words, told, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["ros2", *words]) == 2
    assert told in capsys.readouterr().err and not list(Path(tmp_path).rglob("run.json"))


def test_without_dds_it_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert main(["ros2", "team", "robots=a"]) == 2
    assert 'pip install "maexp[ros2]"' in capsys.readouterr().err
