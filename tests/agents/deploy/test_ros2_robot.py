"""A ROS 2 team without a central planner: each robot drives itself, by what it has heard over DDS of the others."""

import json
import math
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from loopback import publish_robot, surroundings

pytest.importorskip("cyclonedds", reason="THE EXTRA maexp[ros2] IS NOT INSTALLED: DDS is not tested")
from small_suite import make_small_suite

from maexp.agents.cli import main
from maexp.agents.deploy.planner.drivers import RobotDriver
from maexp.agents.deploy.planner.frames import read_map
from maexp.agents.deploy.planner.messages import read_word, write_word
from maexp.agents.deploy.planner.radio_features import Contact, Memory
from maexp.agents.deploy.planner.team_driver import DriverSettings
from maexp.agents.deploy.ros2.dds import Wire
from maexp.agents.deploy.ros2.robot import Ros2Robot
from maexp.agents.errors import UserError
from maexp.agents.runtime import RobotPlanner, Word

MEMORY = Memory((1.0, 0.1 + 0.2), 3.0, 4.5, False, True, {"b": Contact(0.25, (1.0, 2.0), 3.0, 1.5)})
TIME = 1764057600.123456789
WORD = Word("a", (1.0, 2.0 / 3.0, -0.5), 0.25, TIME, memory=MEMORY, hears={"b": TIME - 0.1})
SETTINGS = {"robots": ("a", "b"), "radar_range": 3.0, "robot_radius": (0.2,), "offsets": (0.0,) * 6, "period": 0.2}


def test_words_are_told_to_the_last_bit():
    assert read_word(write_word(WORD)) == WORD and read_word(write_word(replace(WORD, memory=None))).memory is None


@pytest.mark.parametrize(
    "change",
    [
        {"pose": [1.0, 2.0]},
        {"pose": [1.0, 2.0, float("nan")]},
        {"speed": "fast"},
        {"time": True},
        {"name": 3},
        {"hears": ["b"]},
        {"hears": {"b": "lately"}},
        {"hears": {"b": float("inf")}},
        {"memory": {}},
        {"memory": {"at": [0, 0], "driven": 0, "known": 0, "linked": 1, "tells": False, "met": {}}},
        {"memory": {"at": [0, 0], "driven": 0, "known": 0, "linked": False, "tells": False, "met": {"b": 3}}},
    ],
)
def test_words_that_are_none(change):
    with pytest.raises(ValueError, match="no word of a robot"):
        read_word(json.dumps(json.loads(write_word(WORD)) | change))
    for text in ("garbage", "[1]", "3", "[" * 100_000, " " * 200_000):
        with pytest.raises(ValueError, match="no word of a robot"):
            read_word(text)


def test_bad_settings_are_named():
    with pytest.raises(ValueError, match="only=c is none of the team: robots=a,b"):
        RobotDriver(DriverSettings(**SETTINGS, only="c"))
    with pytest.raises(ValueError, match="only= must name"):
        RobotDriver(DriverSettings(**SETTINGS))
    with pytest.raises(ValueError, match="memory=0.0 must be a number above 0"):
        RobotDriver(DriverSettings(**SETTINGS, only="a", memory=0.0))
    driver = RobotDriver(DriverSettings(**SETTINGS, only="b"))
    assert driver.listened == ("/b/map",) and driver.mates == ("a",) and list(driver.own) == ["b"]
    assert not driver.hear(replace(WORD, name="stranger")) and driver.hear(WORD)
    assert isinstance(driver.planner, RobotPlanner) and driver.planner.mates == ("a",)


def test_what_was_told_before_an_episode_does_not_count():
    driver = RobotDriver(DriverSettings(**SETTINGS, only="b"))
    episode = {"robots": ["a", "b"], "seconds": 60.0, "radar_range": 5.0, "robot_radius": 0.3, "max_speed": 1.0}
    episode |= {"max_accel": 1.0, "decision_seconds": 2.0, "seed": 0}
    driver.hear(replace(WORD, time=5.0))
    driver.begin(episode, 10.0)
    assert not driver.planner.heard and not driver.has_heard("a", 10.0)
    driver.hear(replace(WORD, time=20.0))  # it has begun the next one before this robot has
    driver.begin(episode, 20.0)
    assert driver.planner.heard["a"].time == 0.0 and driver.has_heard("a", 20.0)


@pytest.mark.parametrize(
    "changes", [{"resolution": 0.0}, {"resolution": math.nan}, {"resolution": 1e-9}, {"x": math.inf}, {"x": 1e12}]
)
def test_a_map_that_is_none_is_refused(changes):
    driver = RobotDriver(DriverSettings(**SETTINGS, only="b"))
    with pytest.raises(ValueError, match="is none"):
        driver.take_known("a", grid_message(**changes))
    assert not driver.told


@pytest.mark.parametrize(
    "changes", [{"x": 1e6}, {"resolution": 1e-3, "x": 10.0}], ids=["far", "too fine to look around"]
)
def test_a_map_that_lies_too_far_away_is_left_out(changes):
    driver, notes = RobotDriver(DriverSettings(**SETTINGS, only="b")), []
    driver.take_known("a", grid_message(**changes))
    driver.take_map("/b/map", grid_message())
    assert driver.known(notes).values.shape == (4, 5)
    assert notes == ["the map of a is left out: it lies too far away, or has too small cells"]


def grid_message(resolution: float = 0.1, x: float = 0.0):
    place = SimpleNamespace(position=SimpleNamespace(x=x, y=0.0), orientation=SimpleNamespace(x=0, y=0, z=0.0, w=1.0))
    info = SimpleNamespace(resolution=resolution, width=5, height=4, origin=place)
    header = SimpleNamespace(frame_id="map", stamp=SimpleNamespace(sec=1, nanosec=0))
    return SimpleNamespace(header=header, info=info, data=[0] * 20)


class Places:
    """What two robots of nobody's simulation publish: each a map of its half, and where it is."""

    def __init__(self):
        self.wire = Wire()
        self.goals = {name: self.wire.reader(f"/{name}/goal_pose") for name in "ab"}
        self.cut = 30  # columns that a has seen

    def publish(self) -> None:
        for k, name in enumerate("ab"):
            values = np.full((60, 60), -1)
            values[5:40, 5:50] = 0
            hidden = slice(self.cut, None) if name == "a" else slice(None, self.cut)
            values[:, hidden] = -1
            publish_robot(self.wire, name, values, (1.5 + 3.0 * k, 1.5, 0.0))


def robot(name: str, **changes) -> Ros2Robot:
    told: list[str] = []
    made = Ros2Robot(RobotDriver(DriverSettings(**SETTINGS | {"only": name} | changes)), Wire(), 5.0, told.append)
    made.notes = told
    return made


def step_until(made: list[Ros2Robot], done, places: Places, seconds: float = 120.0) -> None:
    begin = last = time.monotonic()
    while not done():
        now = time.monotonic()
        assert now < begin + seconds, "it did not happen"
        if now > last + 0.5:
            places.publish()
            last = now
        for member in made:
            member.step()


@pytest.mark.slow
def test_robots_merge_what_they_hear_and_keep_it_when_they_part(own_domain):
    places, both = Places(), [robot("a", memory=2.0), robot("b", memory=2.0)]
    places.publish()

    def columns(member: Ros2Robot) -> int:
        known = member.driver.known([])
        return 0 if known is None else int((known.values >= 0).any(0).sum())

    step_until(both, lambda: [columns(member) for member in both] == [45, 45], places)
    step_until(
        both,
        lambda: all(member.driver.planner.heard for member in both) and all(member.driver.goals for member in both),
        places,
    )
    first = both[0]
    assert first.driver.planner.heard["b"].pose[:2] == pytest.approx((4.5, 1.5))
    heard = first.driver.words["b"].time
    step_until(both[:1], lambda: time.time() > heard + 4.0, places)  # b is out of reach: it says nothing more
    assert columns(first) == 45 and first.driver.words["b"].time < time.time() - 2.0
    asked = []
    plan, first.driver.planner.team.plan = first.driver.planner.team.plan, None

    def note(grid, resolution, origin, poses, **more):
        asked.append(list(poses))
        return plan(grid, resolution, origin, poses, **more)

    first.driver.planner.team.plan = note
    step_until(both[:1], lambda: asked, places)
    assert asked[-1] == ["a"], "its last word is too old"
    step_until(both, lambda: asked[-1] == ["a", "b"], places)


@pytest.mark.slow
def test_what_is_told_is_read_and_nonsense_is_noted(own_domain):
    places, member = Places(), robot("a")
    other = Wire()
    said, shown = other.reader("/a/maexp/word"), other.reader("/a/maexp/map")
    words, maps = other.writer("/b/maexp/word"), other.writer("/b/maexp/map")
    got: dict[str, list] = {"word": [], "map": []}

    def heard() -> bool:
        got["word"] += said.take()
        got["map"] += shown.take()
        odd = time.monotonic() % 1.0 < 0.5  # one after the other: only the last is kept
        words.write(words.make(data="\x1b[2J" if odd else write_word(replace(WORD, name="c"))))
        maps.write(maps.make())
        return bool(got["word"] and got["map"]) and all(any(part in note for note in member.notes) for part in notes)

    notes = (
        "/b/maexp/word: what came is no word of a robot",
        "/b/maexp/word: a word of 'c' came",
        "/b/maexp/map: a map in the frame  is not known",
    )

    places.publish()
    step_until([member], heard, places)
    word = read_word(got["word"][-1].data)
    assert (word.name, word.pose) == ("a", (1.5, 1.5, 0.0)) and abs(word.time - time.time()) < 120.0
    assert got["map"][-1].header.frame_id == "map" and read_map(got["map"][-1]).values.shape == (60, 60)
    assert not member.driver.told and not member.driver.words


@pytest.mark.slow
def test_a_map_that_is_not_aligned_is_refused(own_domain):
    places, member = Places(), robot("a", offsets=())
    places.publish()
    with pytest.raises(UserError, match="/a/map is in a frame called map.*give offsets="):
        step_until([member], lambda: False, places)


PROGRAM = "import sys; from maexp.agents.cli import main; sys.exit(main())"
CUT_OFF = """
import sys
from maexp.agents.cli import main
from maexp.agents.deploy.ros2.robot import Ros2Robot

hear, tell = Ros2Robot._hear, Ros2Robot._tell_mates

def away(robot):
    return robot.course.episodes in (2, 3)

def deaf(robot, *told):
    return None if away(robot) else hear(robot, *told)

def mute(robot, now):
    if away(robot):
        robot.told, robot.near = now, set()
    else:
        tell(robot, now)

Ros2Robot._hear, Ros2Robot._tell_mates = deaf, mute
sys.exit(main())
"""


def play_served(suite: Path, where: Path, programs: list[str]) -> list[tuple[int, str]]:
    """What the processes of the robots ended with and said, one for each."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in surroundings().items():
            patch.setenv(name, value)
        others = []
        for k, program in enumerate(programs):
            words = ["ros2", "team", "robots=robot1,robot2,robot3", f"only=robot{k + 1}", "answer=300"]
            command = [sys.executable, "-c", program, *words, "policy=cost_utility"]
            others.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=where.parent))
        try:
            words = [f"hydra.run.dir={where}", "answer=120", "stands=120"]
            assert main(["ros2", "serve", str(suite), *words]) == 0
            said = [other.communicate(timeout=120)[0] for other in others]
        finally:
            for other in others:
                other.kill()
    return [(other.returncode, text) for other, text in zip(others, said, strict=True)]


@pytest.mark.slow
def test_robots_that_drive_themselves_play_a_suite(tmp_path):
    """Three processes, a robot each: what a team does that is planned for inside, but where one was cut off."""
    suite = make_small_suite(tmp_path / "small.yaml")
    over, inside = tmp_path / "over", tmp_path / "inside"
    said = play_served(suite, over, [PROGRAM, PROGRAM, CUT_OFF])
    assert main(["suite", "run", str(suite), "policy=cost_utility", "num_envs=1", f"hydra.run.dir={inside}"]) == 0
    for code, text in said:
        assert code == 0 and "8 episodes of an arena" in text, text
    files = sorted(path.name for path in (over / "actions").iterdir())
    assert len(files) == 8 and files == sorted(path.name for path in (inside / "actions").iterdir())
    same = []
    for name in files:
        with np.load(over / "actions" / name) as ours, np.load(inside / "actions" / name) as theirs:
            assert not any(ours["reasons"])
            alike = ours["goal"].shape == theirs["goal"].shape
            same.append(alike and bool(np.abs(ours["goal"] - theirs["goal"]).max() < 1e-4))
    assert sum(same) >= 5 and not all(same), same
