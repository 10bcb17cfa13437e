"""A team over DDS that plans for robots which are no simulation's."""

import json
import os
import subprocess
import sys
import time

import numpy as np
import pytest
from loopback import publish_robot, surroundings

pytest.importorskip("cyclonedds", reason="THE EXTRA maexp[ros2] IS NOT INSTALLED: DDS is not tested")

from maexp.agents.deploy.planner.team_driver import Decision, DriverSettings, Order, TeamDriver
from maexp.agents.deploy.ros2.dds import EPISODE, Wire
from maexp.agents.deploy.ros2.goals import (
    CANCELED,
    SUCCEEDED,
    NavigationServer,
)
from maexp.agents.deploy.ros2.team import NUMBERS, Ros2Team
from maexp.agents.errors import UserError

pytestmark = pytest.mark.slow  # processes, and waiting


def team(**changes) -> Ros2Team:
    settings = {"robots": ("a", "b"), "radar_range": 3.0, "robot_radius": (0.2,)} | changes
    told = []
    made = Ros2Team(TeamDriver(DriverSettings(**settings)), Wire(), answer=0.5, tell=told.append)
    made.told = told
    return made


class Publishers:
    """Two robots that are no simulation's: maps called map, and frames of their own."""

    def __init__(self):
        self.wire = Wire()
        self.goals = {name: self.wire.reader(f"/{name}/goal_pose") for name in "ab"}

    def publish(self) -> None:
        values = np.full((60, 60), -1)
        values[5:40, 5:40] = 0
        for name in "ab":
            publish_robot(self.wire, name, values, (1.0, 1.5, 0.0))


def step_until(made: Ros2Team, done, seconds: float = 60.0, again=None) -> None:
    """Step until `done()`; `again` is called once a second: who joins late on a busy machine misses a first message."""
    begin = last = time.monotonic()
    while not done():
        now = time.monotonic()
        assert now < begin + seconds, "it did not happen"
        if again is not None and now > last + 1.0:
            again()
            last = now
        made.step()


def test_a_team_of_other_robots(own_domain):
    robots, made = Publishers(), team(offsets=(0.0, 0.0, 0.0, 10.0, 0.0, 0.0), period=0.2)
    robots.publish()
    got = {name: [] for name in "ab"}

    def both() -> bool:
        for name, reader in robots.goals.items():
            got[name] += reader.take()
        return all(got.values())

    step_until(made, both, again=robots.publish)
    for name in "ab":
        pose = got[name][0]
        assert pose.header.frame_id == "map" and abs(pose.header.stamp.sec - time.time()) < 60.0
        assert 0.0 < pose.pose.position.x < 6.0, "in the robot's own map"
    assert made.driver.places["b"] == pytest.approx([11.0, 1.5])


def test_a_team_sends_goals_by_the_action_and_cancels_them(own_domain):
    robots = Publishers()
    servers = {name: NavigationServer(robots.wire, name) for name in "ab"}
    made = Ros2Team(
        TeamDriver(
            DriverSettings(
                robots=("a", "b"), radar_range=3.0, robot_radius=(0.2,), offsets=(0.0,) * 6, period=0.2, resend=0.1
            )
        ),
        Wire(),
        5.0,
        lambda text: None,
        "navigate_to_pose",
    )
    robots.publish()
    got = []

    def asked(count: int) -> bool:
        for server in servers.values():
            for request in server.take():
                server.accept(request, True, 0)
                got.append(request.goal.pose)
        return len(got) >= count

    step_until(made, lambda: asked(2))
    assert got[0].header.frame_id == "map" and 0.0 < got[0].pose.position.x < 6.0
    servers["a"].end(SUCCEEDED)
    step_until(made, lambda: "a" not in made.driver.goals)
    place = Order("b", np.zeros(2), "map", (0.0, 0.0, 0.0), stop=True)
    made._send(Decision([place], None, []), 0.0)
    step_until(made, lambda: servers["b"].cancel())
    assert next(reversed(servers["b"].goals.values())).status == CANCELED


def test_a_team_tells_that_nobody_navigates(own_domain):
    robots, told = Publishers(), []
    settings = DriverSettings(robots=("a", "b"), radar_range=3.0, robot_radius=(0.2,), offsets=(0.0,) * 6, period=0.2)
    made = Ros2Team(TeamDriver(settings), Wire(), 5.0, told.append, "navigate_to_pose")
    robots.publish()
    step_until(made, lambda: len(told) >= 2)
    assert any("a: nobody offers /a/navigate_to_pose yet" in sentence for sentence in told) and not made.driver.goals


@pytest.mark.parametrize("text", ["garbage", "[1]", '{"robots": ["a"]}', '{"begins": 0, "robots": 3}'])
def test_an_episode_that_is_none_ends_no_team(text, own_domain):
    robots, made = Publishers(), team(offsets=(0.0,) * 6, period=0.2)
    writer = robots.wire.writer(EPISODE)
    writer.write(writer.make(data=text))
    step_until(made, lambda: made.told)
    assert made.told == [f"{EPISODE}: what came is no episode of an arena"] and made.driver.episode is None
    robots.publish()
    step_until(made, lambda: made.course.plans, again=robots.publish)


def test_an_arena_of_other_robots_is_passed_over(own_domain):
    robots, made = Publishers(), team(offsets=(0.0,) * 6, period=0.2)
    writer = robots.wire.writer(EPISODE)
    episode = dict.fromkeys(NUMBERS, 1.0) | {"robots": ["robot1", "robot2"]}
    writer.write(writer.make(data=json.dumps(episode)))
    step_until(made, lambda: made.told)
    robots.publish()
    step_until(made, lambda: made.course.plans, again=robots.publish)
    assert len(made.told) == 1 and made.driver.episode is None
    assert f"{EPISODE}: an arena plays with robot1,robot2, and not with robots=a,b: give its robots" in made.told[0]
    writer.write(writer.make(data=json.dumps({"over": True})))
    plans = made.course.plans
    end = time.monotonic() + 3.0
    while time.monotonic() < end:
        assert not made.step(), "that it is over ends nothing either"
    robots.publish()
    step_until(made, lambda: made.course.plans > plans, again=robots.publish)


def test_an_episode_that_cannot_be_played_says_why(own_domain):
    robots, made = Publishers(), team(offsets=(0.0,) * 6)
    writer = robots.wire.writer(EPISODE)
    writer.write(writer.make(data=json.dumps(dict.fromkeys(NUMBERS, 1.5) | {"robots": ["a", "b"]})))
    with pytest.raises(UserError, match=f"{EPISODE}: this team cannot play it: seed=1.5 must be"):
        step_until(made, lambda: False)


HEAR = """
import sys, time
from maexp.agents.deploy.ros2.dds import EPISODE, Wire
heard = Wire().reader(EPISODE)
end = time.monotonic() + float(sys.argv[1])
while time.monotonic() < end and not heard.matched:
    time.sleep(0.05)
print(heard.matched)
"""


def test_tests_with_one_domain_do_not_hear_each_other(own_domain):
    wire, around = Wire(), dict(os.environ)
    assert wire.writer(EPISODE).matched == 0
    apart = around | {"CYCLONEDDS_URI": surroundings()["CYCLONEDDS_URI"]}
    hear = [sys.executable, "-c", HEAR]
    assert int(subprocess.run([*hear, "60"], env=around, capture_output=True, text=True, check=True).stdout) == 1
    assert int(subprocess.run([*hear, "3"], env=apart, capture_output=True, text=True, check=True).stdout) == 0


def test_maps_that_are_not_aligned_are_refused(own_domain):
    robots, made = Publishers(), team()
    robots.publish()
    with pytest.raises(UserError, match="both in a frame called map.*give offsets="):
        step_until(made, lambda: False)


def test_a_team_without_robots_ends(own_domain):
    made = team()
    with pytest.raises(UserError, match="Nobody publishes /a/map, /b/map in 0.5 s: start the robots"):
        step_until(made, lambda: False)
