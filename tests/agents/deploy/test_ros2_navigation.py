"""The action navigate_to_pose of an arena's robots: goals that win, end, are given up and cancelled."""

import math
import time

import numpy as np
import pytest
from loopback import QUICK
from mazes import make_env

pytest.importorskip("cyclonedds", reason="THE EXTRA maexp[ros2] IS NOT INSTALLED: DDS is not tested")

from maexp.agents.deploy.planner.team_driver import Order
from maexp.agents.deploy.ros2.dds import Wire
from maexp.agents.deploy.ros2.goals import (
    ABORTED,
    CANCELED,
    EXECUTING,
    ID,
    INFO,
    SUCCEEDED,
    NavigationClient,
)
from maexp.agents.deploy.ros2.messages import read_nanoseconds
from maexp.agents.deploy.ros2.serve import Ros2Player, Serving

pytestmark = pytest.mark.slow  # processes, and waiting


def order(x: float, y: float, stop: bool = False) -> Order:
    return Order("robot1", np.array([x, y]), "map", (x, y, 0.0), stop)


class Navigator:
    """A client of navigate_to_pose of robot1 that asks for results, too, as those of ROS do."""

    def __init__(self):
        self.wire = Wire()
        self.client = NavigationClient(self.wire, "robot1")
        self.results = self.wire.client("/robot1/navigate_to_pose/_action/get_result")
        self.progress = self.wire.reader("/robot1/navigate_to_pose/_action/feedback")
        self.status = self.wire.reader("/robot1/navigate_to_pose/_action/status")
        self.mine: list[bytes] = []

    def send(self, x: float, y: float) -> None:
        while not (self.client.ready and self.results.matched and self.progress.matched):
            time.sleep(0.02)
        self.client.send(order(x, y), 0.0)
        self.mine.append(self.client.uuid)
        self.results.ask(goal_id=ID(uuid=self.client.uuid))
        time.sleep(0.1)

    def told(self) -> dict[int, tuple[int, str]]:
        """By the number of the goal: how it has ended, and why."""
        time.sleep(0.1)
        return {result.seq: (result.status, result.result.error_msg) for result in self.results.take()}

    def statuses(self) -> list[int]:
        """Of all goals, as was told last."""
        time.sleep(0.1)
        last = list(self.status.take())[-1].status_list
        assert [status.goal_info.goal_id.uuid for status in last] == self.mine
        return [status.status for status in last]


@pytest.fixture
def navigated(own_domain):
    """A served policy of one robot in its episode, and a client of its navigate_to_pose."""
    env = make_env(1, num_robots=1, macro_steps=3)
    policy, other = Ros2Player("ros2", Wire(), Serving(**QUICK)).open(env), Navigator()
    with policy:
        env.reset()
        policy.sight.look()
        other.client.ready or time.sleep(1.0)
        policy._begin()
        yield policy, policy.robots[0], other


def pose_of(policy) -> tuple[float, float, float]:
    return tuple(policy.sight.observation(0)["poses"][0, 0].tolist())


def test_the_newest_goal_of_the_action_wins(navigated):
    policy, robot, other = navigated
    other.send(1.0, 2.0)
    assert policy._decide().tolist() == [[1.0, 2.0]] and policy.idle == 0, "it is an answer to the decision"
    assert other.statuses() == [EXECUTING] and not other.client.ended() and not other.told()
    other.send(3.0, 4.0)
    assert policy._decide().tolist() == [[3.0, 4.0]]
    assert other.statuses() == [ABORTED, EXECUTING] and other.told() == {1: (ABORTED, "a newer goal has come")}
    assert not other.client.ended(), "the last one goes on"
    goals = Wire().writer("/robot1/goal_pose")
    while not goals.matched:
        time.sleep(0.02)
    message = goals.make()
    message.pose.position.x = message.pose.position.y = 5.0
    goals.write(message)
    time.sleep(0.1)
    assert policy._decide().tolist() == [[5.0, 5.0]] and other.told() == {2: (ABORTED, "a newer goal has come")}


def test_goals_of_the_action_that_cannot_be_are_refused(navigated):
    policy, robot, other = navigated
    other.send(math.nan, 1.0)
    policy._decide()
    assert policy.reasons[0] and other.client.ended() and not other.client.ended(), "told once"
    assert other.told() == {1: (0, "")}, "of a goal that was not accepted nothing is known"
    assert not list(other.status.take())


def test_how_far_the_goal_is_and_that_it_is_reached(navigated):
    policy, robot, other = navigated
    x, y, yaw = pose_of(policy)
    other.send(x + 3.0, y + 4.0)
    policy._decide()
    robot.drive((x, y, yaw), 5 * 10**8, 5 * 10**8, policy.near)
    robot.drive((x + 2.9, y + 4.0, yaw), 6 * 10**8, 6 * 10**8, policy.near)
    time.sleep(0.1)
    (told,) = other.progress.take()
    assert told.feedback.distance_remaining == pytest.approx(5.0) and told.goal_id.uuid == other.mine[0]
    assert told.feedback.current_pose.pose.position.x == pytest.approx(x)
    assert read_nanoseconds(told.feedback.navigation_time) == 5 * 10**8
    assert other.told() == {1: (SUCCEEDED, "")} and other.client.ended()
    assert robot.goal is not None, "it stays there"


def test_a_goal_that_a_robot_does_not_come_nearer_to_is_given_up(navigated):
    policy, robot, other = navigated
    x, y, yaw = pose_of(policy)
    other.send(x + 9.0, y)
    policy._decide()
    for second in range(26):
        at = x + min(second, 15) * 0.1  # stands from the 15th second on
        robot.drive((at, y, yaw), second * 10**9, second * 10**9, policy.near)
        assert (robot.goal is None) == (second == 25), second
    assert other.told() == {1: (ABORTED, "the robot moved less than 0.5 m in 10 s")}


def test_a_robot_that_collides_gives_its_goal_up(navigated):
    policy, robot, other = navigated
    other.send(1.0, 1.0)
    policy._decide()
    robot.drive(None, 10**8, 10**8, policy.near)
    assert other.told() == {1: (ABORTED, "the robot has collided")}


def test_an_episode_that_ends_aborts_its_goal(navigated):
    policy, robot, other = navigated
    other.send(1.0, 1.0)
    policy._decide()
    policy._begin()
    assert other.told() == {1: (ABORTED, "the episode is over")} and robot.goal is None


@pytest.mark.parametrize(("until", "code", "stops"), [(0, 0, True), (7, 2, False), (10**12, 0, True)])
def test_goals_are_cancelled_by_time(navigated, until, code, stops):
    """Nothing given: all; a time: those that were accepted until then."""
    policy, robot, other = navigated
    policy.begin = 10**10
    other.send(1.0, 1.0)
    policy._decide()
    info = INFO()
    info.stamp.sec, info.stamp.nanosec = divmod(until, 10**9)
    other.client.cancels.ask(goal_info=info)
    time.sleep(0.1)
    policy._wait(policy._now(), [])
    assert (robot.goal is None) == stops and other.statuses() == [CANCELED if stops else EXECUTING]
    time.sleep(0.1)
    (answer,) = other.client.cancels.take()
    assert answer.return_code == code and len(answer.goals_canceling) == stops


def test_a_goal_that_has_ended_cannot_be_cancelled(navigated):
    policy, robot, other = navigated
    other.send(1.0, 1.0)
    policy._decide()
    other.client.cancels.ask(goal_info=INFO(goal_id=ID(uuid=b"another goal.   ")))
    time.sleep(0.1)
    policy._wait(policy._now(), [])
    assert robot.goal is not None
    other.client.stop(order(0.0, 0.0), 0.0)
    time.sleep(0.1)
    policy._wait(policy._now(), [])
    assert robot.goal is None and other.told() == {1: (CANCELED, "")}
    other.client.uuid = other.mine[0]
    other.client.stop(order(0.0, 0.0), 0.0)
    time.sleep(0.1)
    policy._wait(policy._now(), [])
    time.sleep(0.1)
    assert [answer.return_code for answer in other.client.cancels.take()] == [2, 0, 3]
