"""A base station of a ROS 2 team without a central planner, and policies that go to tell it."""

import math
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from loopback import publish_robot

pytest.importorskip("cyclonedds", reason="THE EXTRA maexp[ros2] IS NOT INSTALLED: DDS is not tested")
from radio_policy import export_told, make_told_policy
from test_ros2_maps import PERSON, look, message, seen
from test_ros2_robot import PROGRAM

from maexp.agents.cli import main
from maexp.agents.deploy.planner.drivers import BaseDriver, RadioDriver, RobotDriver, make_driver
from maexp.agents.deploy.planner.frames import read_map, read_time
from maexp.agents.deploy.planner.messages import read_word, write_word
from maexp.agents.deploy.planner.radio_features import BASE
from maexp.agents.deploy.planner.team_driver import DriverSettings, TeamDriver
from maexp.agents.deploy.ros2.dds import Wire
from maexp.agents.deploy.ros2.robot import Ros2Base, make_team
from maexp.agents.deploy.ros2.team import Outing
from maexp.agents.errors import UserError
from maexp.agents.runtime import Word
from maexp.envs import CommConfig

NAMES = ("a", "b")
PLACE = (1.5, 1.5)
COMM = CommConfig(range=2.0, base_station=PLACE)
SETTINGS = {"robots": NAMES, "radar_range": 3.0, "robot_radius": (0.2,), "offsets": (0.0,) * 6}


def base(**changes) -> BaseDriver:
    return BaseDriver(DriverSettings(**SETTINGS | {"only": BASE, "comm": COMM} | changes))


def robots() -> dict[str, RadioDriver]:
    """Two robots that look at no radios, and the base station."""
    return {name: RobotDriver(DriverSettings(**SETTINGS, only=name)) for name in NAMES} | {BASE: base()}


def tell(each: dict[str, RadioDriver], now: float, links: tuple) -> None:
    """All who are linked hear what the others tell, as it is written."""
    said = {}
    for name, driver in each.items():
        if name != BASE:
            driver.own[name].put("base_link", "map", (1.0, 1.5, 0.0), now)
        own = driver.tell_own(now)
        maps = {} if own is None else {name: message(own[1].values, own[0])}
        said[name] = maps | driver.pass_on(now), write_word(driver.word(now))
    for speaker, listener in links:
        each[listener].take_word(speaker, said[speaker][1])
        for source, what in said[speaker][0].items():
            if source != listener:
                each[listener].take_known(source, what)


def test_drivers_are_of_the_team_a_robot_or_the_base_station():
    kinds = {"": TeamDriver, "a": RobotDriver, BASE: BaseDriver}
    for only, kind in kinds.items():
        comm = COMM if only == BASE else CommConfig()
        assert type(make_driver(DriverSettings(**SETTINGS, only=only, comm=comm))) is kind
    driver = base()
    assert driver.mates == driver.speakers == NAMES and not driver.driven and not driver.listened
    assert list(driver.map_topics()) == ["/a/maexp/map", "/a/maexp/heard/b/map", "/b/maexp/heard/a/map", "/b/maexp/map"]
    assert driver.word(3.0) == Word(BASE, (*PLACE, 0.0), 0.0, 3.0) and driver.known([]) is None
    assert driver.decide(3.0).orders == [] and driver.decide(3.0).plan is None


def test_a_base_station_keeps_and_passes_on_what_robots_know():
    """b is out of its reach, but a passes on what they tell, until b falls silent."""
    each, line = robots(), (("a", BASE), (BASE, "a"), ("a", "b"), ("b", "a"))
    look(each["a"], seen(slice(5, 10)), 0.0)
    look(each["b"], seen(slice(20, 30), person=True), 0.0)
    linked = []
    for now in range(5):
        tell(each, float(now), line if now < 4 else line[:2])
        linked.append({name: set(driver._take_linked()) for name, driver in each.items()})
    assert each[BASE].known([]).values[PERSON].max() == 100
    assert linked[0] == {"a": {"b", BASE}, "b": {"a"}, BASE: {"a"}}
    assert linked[1] == {"a": {"b", BASE}, "b": {"a", BASE}, BASE: {"a", "b"}}
    tell(each, 5.0, line[:2])
    assert BASE not in each["b"]._take_linked() and each["a"]._take_linked() == {BASE}
    assert each[BASE].pass_on(6.0) == {} and set(each[BASE].passed) == {"a", "b"}


def test_strangers_and_times_that_have_not_come_connect_nobody():
    driver = robots()["a"]
    look(driver, seen(slice(5, 30)), 1.0)
    word = Word("b", (1.0, 2.0, 0.0), 0.0, 1.0, hears={"stranger": 1.0, "a": 1.0, BASE: 1e9})
    assert driver.take_word("b", write_word(word)) and not driver.hear(replace(word, name="stranger"))
    driver.decide(1.0)
    assert driver.beats.times == {"b": 1.0}
    driver.take_word("b", write_word(replace(word, time=2.0, hears={BASE: 1.5})))
    linked = [driver._take_linked() for _ in range(3)]
    assert linked == [{"b", BASE}, {"b", BASE}, set()], "one decision may lie between two words"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([f"only={BASE}"], "only=base_station needs its place: comm.base_station=[x,y]"),
        ([f"only={BASE}", "comm.base_station=true"], "comm.base_station=True says no place"),
        ([f"only={BASE}", "comm.base_station=[1]"], "comm.base_station=[1] must be"),
        ([f"only={BASE}", "comm.base_station=[1,2]", "comm.range=-1"], "comm.range=-1.0 must be"),
        ([f"only={BASE}", "comm.base_station=[1,2]", "memory=-1"], "memory=-1.0 must be a number above 0 [s], or inf"),
        (["comm.range=8"], "comm.* is for robots that plan for themselves: give only=NAME"),
        (["only=a", "comm.range=8"], "comm= is for policies trained with observation.radio=true, and cost_utility"),
        (["only=a", "comm.reach=8"], "comm.reach is not a setting of maexp ros2"),
        (["only=a", "time_limit=-1"], "time_limit=-1.0 must be above 0"),
    ],
)
def test_words_that_cannot_be(words, told, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["ros2", "team", "robots=a,b", *words]) == 2
    assert told in capsys.readouterr().err


def test_the_base_station_is_no_robot():
    with pytest.raises(ValueError, match="'base_station' names the base station, and no robot"):
        RobotDriver(DriverSettings(robots=("a", BASE), only="a"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return export_told(make_told_policy(), tmp_path_factory.mktemp("policies") / "told")


def test_a_policy_that_looks_at_radios_needs_to_know_them(folder, capsys):
    words = ["ros2", "team", "robots=a,b", f"policy={folder}", "only=a"]
    for more in ([], ["comm.range=8"], ["time_limit=60"]):
        assert main([*words, *more]) == 2
        assert "only=NAME comm.range=8 comm.base_station=[0,0] time_limit=600" in capsys.readouterr().err


def test_a_base_station_ends_with_the_arena(monkeypatch, capsys):
    """It has made no decisions."""
    monkeypatch.setattr(Ros2Base, "run", lambda made: Outing(plans=0, episodes=2))
    assert main(["ros2", "team", "robots=a,b", f"only={BASE}", "comm.base_station=[1,2]"]) == 0
    assert "0 decisions; 2 episodes of an arena." in capsys.readouterr().out


@pytest.mark.slow
def test_a_base_station_that_nobody_is_near_ends(own_domain):
    made = make_team(base(period=0.2), Wire(), 0.5, print, "goal_pose")
    assert isinstance(made, Ros2Base)
    with pytest.raises(UserError, match="Nobody speaks on /a/maexp/word, /b/maexp/word in 0.5 s: start the robots"):
        made.run()


@pytest.mark.slow
def test_a_base_station_outlasts_those_that_it_has_heard(own_domain):
    made, other = make_team(base(period=0.2), Wire(), 0.5, print, "goal_pose"), Wire()
    words, heard, got = other.writer("/a/maexp/word"), other.reader("/base_station/maexp/word"), []
    end = time.monotonic() + 60.0
    while not (made.driver.words and got):
        assert time.monotonic() < end
        words.write(words.make(data=write_word(Word("a", (1.0, 2.0, 0.0), 0.0, time.time()))))
        made.step()
        got += [word for message in heard.take() if "a" in (word := read_word(message.data)).hears]
    assert (got[-1].name, got[-1].pose) == (BASE, (*PLACE, 0.0))
    del words, heard, other
    end = time.monotonic() + 2.0
    while time.monotonic() < end:
        assert not made.step(), "it waits for them to come back"


FAR = f"""
import math, sys, time
from maexp.agents.cli import main
from maexp.agents.deploy.ros2.robot import Ros2Robot

hear, tell = Ros2Robot._hear, Ros2Robot._tell_mates

def far(robot):
    place = robot.driver.places.get("a")
    return place is None or math.dist(place, {PLACE}) > {COMM.range}

def deaf(robot, *told):
    return None if far(robot) else hear(robot, *told)

def mute(robot, now):
    robot.told, robot.since = now, time.monotonic()
    far(robot) or tell(robot, now)

Ros2Robot._hear, Ros2Robot._tell_mates = deaf, mute
sys.exit(main())
"""


class Place:
    """A room in which b stands beside the base station, and a drives straight to its goals from the other side."""

    def __init__(self):
        self.wire, self.at, self.goals = Wire(), np.array((4.0, 2.5)), []
        self.asked, self.shown = (self.wire.reader(name) for name in ("/a/goal_pose", f"/{BASE}/maexp/known"))
        self.base = np.full((1, 1), -1)  # what it knows

    def step(self, seconds: float) -> None:
        for order in self.asked.take():
            self.goals.append(np.array((order.pose.position.x, order.pose.position.y)))
        if self.goals and self.base.size > 1:  # all are there
            way = self.goals[-1] - self.at
            self.at = self.at + way * min(1.0, 0.8 * seconds / max(np.linalg.norm(way), 1e-6))
        for shown in self.shown.take():
            self.base = read_map(shown).values
            assert read_time(shown.header.stamp) > time.time() - 120.0
        publish_robot(self.wire, "a", seen(slice(15, 50)), (*self.at, 0.0))
        publish_robot(self.wire, "b", seen(slice(5, 15)), (1.0, 1.0, 0.0))

    def far(self) -> list[float]:
        """Of all goals of a, from the base station [m]."""
        return [math.dist(goal, PLACE) for goal in self.goals]


@pytest.mark.slow
def test_a_robot_goes_to_tell_the_base_station(own_domain, folder, tmp_path):
    """Three processes. What a has seen the base station does not know until a is there; then a goes on exploring."""
    place, processes = Place(), []
    words = ["radar_range=3", "robot_radius=0.2", "offsets=0,0,0,0,0,0", "period=0.5", "pose_age=20", "patience=100"]
    words += [
        "answer=300",
        f"policy={folder}",
        "comm.range=2",
        "comm.base_station=[1.5,1.5]",
        "time_limit=600",
        "robots=a,b",
    ]
    for name, program in (("a", FAR), ("b", PROGRAM), (BASE, PROGRAM)):
        command = [sys.executable, "-c", program, "ros2", "team", *words, f"only={name}"]
        said = (tmp_path / f"{name}.txt").open("w")
        processes.append(subprocess.Popen(command, stdout=said, stderr=said, cwd=tmp_path))

    def go_on(done) -> None:
        end, last = time.monotonic() + 240.0, time.monotonic()
        while not done():
            assert time.monotonic() < end, [file.read_text() for file in tmp_path.glob("*.txt")]
            assert all(process.poll() is None for process in processes), "one has ended"
            place.step(time.monotonic() - last)
            last = time.monotonic()
            time.sleep(0.3)

    try:
        go_on(lambda: place.base.shape == (60, 60) and place.goals)
        assert (place.base[:, 15:] < 0).all() and math.dist(place.at, PLACE) > 2.0, "only what b has seen"
        go_on(lambda: (place.base[5:40, 15:50] == 0).all())
        assert min(place.far()) < 0.6, "it came to tell"
        go_on(lambda: place.far()[-1] > 0.6)
        assert "gave up" not in (tmp_path / "a.txt").read_text(), "it knows that it has told"
    finally:
        for process in processes:
            process.kill()
            process.wait()
