"""A suite over DDS and a team on the other end: what is published, who is waited for, the same choices as inside."""

import json
import math
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from loopback import surroundings
from mazes import make_env

pytest.importorskip("cyclonedds", reason="THE EXTRA maexp[ros2] IS NOT INSTALLED: DDS is not tested")
from small_suite import make_small_suite

from maexp.agents.cli import main
from maexp.agents.errors import UserError
from maexp.agents.ros2.convert import look, read_nanoseconds, transform
from maexp.agents.ros2.dds import EPISODE, Wire
from maexp.agents.ros2.goals import (
    ABORTED,
    CANCELED,
    EXECUTING,
    ID,
    INFO,
    SUCCEEDED,
    NavigationClient,
    NavigationServer,
)
from maexp.agents.ros2.serve import GAP, Ros2Player, Serving
from maexp.agents.ros2.team import Ros2Team
from maexp.agents.runtime.driver import Decision, DriverSettings, Order, TeamDriver
from maexp.agents.runtime.frames import read_map
from maexp.agents.suites.verify import verify
from maexp.envs import CommConfig

pytestmark = pytest.mark.slow  # processes, and waiting
QUICK = {"stands": 0.2, "limit": 0.5, "answer": 20.0}


@pytest.fixture
def alone(monkeypatch):
    """This process, and those that it starts, in a domain of their own on this machine."""
    for name, value in surroundings().items():
        monkeypatch.setenv(name, value)


class Robots:
    """Whoever is on the other end, in this process: hears all and sends what a test says."""

    def __init__(self, *names: str):
        self.wire = Wire()
        self.topics = ["/clock", "/tf", "/tf_static", EPISODE]
        self.topics += [f"/{name}/{one}" for name in names for one in ("map", "odom", "scan", "tf", "tf_static")]
        self.readers = {topic: self.wire.reader(topic) for topic in self.topics}
        self.goals = {name: self.wire.writer(f"/{name}/goal_pose") for name in names}
        self.heard = {topic: [] for topic in self.topics}

    def listen(self) -> dict:
        for topic, reader in self.readers.items():
            self.heard[topic] += reader.take()
        return self.heard

    def send(self, name: str, x: float, y: float, frame: str = "map", now: int = 0) -> None:
        message = self.goals[name].make()
        message.header.frame_id = frame
        message.header.stamp.sec = now
        message.pose.position.x, message.pose.position.y = x, y
        self.goals[name].write(message)
        assert self.goals[name].settle(5.0)


@pytest.fixture
def served(alone):
    """A policy of two robots of an env, the other end, and what was told."""
    told, env = [], make_env(1, num_robots=2, macro_steps=3)

    def serve(**changes):
        serving = Serving(**QUICK | {"tell": told.append} | changes)
        robots = Robots(*serving.names(2))
        player = Ros2Player("ros2", Wire(), serving)
        policy = player.open(env)
        while not all(writer.matched for writer in robots.goals.values()):
            time.sleep(0.05)
        return env, policy, robots

    serve.told = told
    return serve


def test_what_a_robot_tells(served):
    env, policy, robots = served()
    with policy:
        state = env.reset()
        robots.send("robot1", 1.0, 2.0)  # before the episode: nobody heeds it
        acted = policy(state)
        seen = policy.sight.observation(0)
        heard = robots.listen()
        assert not heard["/robot1/tf"] and read_nanoseconds(heard["/robot2/map"][-1].header.stamp) == 0
        read = read_map(heard["/robot2/map"][-1])
        assert np.array_equal(read.values, seen["grid"][1]) and read.resolution == pytest.approx(seen["resolution"])
        assert heard["/robot2/map"][-1].header.frame_id == "robot2/map" and read.origin[:2] == seen["origin"]
        still = {one.child_frame_id: one.header.frame_id for one in heard["/tf_static"][-1].transforms}
        assert still["robot1/map"] == "map" and still["robot2/odom"] == "robot2/map"
        assert still["robot1/base_scan"] == "robot1/base_link"
        first = heard["/tf"][0].transforms
        assert [one.child_frame_id for one in first] == ["robot1/base_link", "robot2/base_link"]
        place = first[1].transform.translation
        assert (place.x, place.y) == pytest.approx(tuple(seen["poses"][0, 1, :2]))
        told = json.loads(heard[EPISODE][-1].data)
        assert told == {"begins": 0, "robots": ["robot1", "robot2"], **policy.sight.episode(0)}
        scan, pose = heard["/robot1/scan"][0], tuple(seen["poses"][0, 0])
        assert scan.range_max == 10.0 and scan.angle_min == pytest.approx(-math.pi) and len(scan.ranges) == 360
        assert np.allclose(scan.ranges, look(policy.floors[int(policy.sight.now["map_id"][0])], pose, 10.0))
        assert acted["lost"].item() and policy.reasons == ["no goal came within 0.5 s of simulated time"]


def test_a_beam_ends_at_the_first_wall(served):
    env, policy, _ = served()
    floor = policy.floors[0]
    free = np.argwhere(floor.free)
    at = floor.centre(free[len(free) // 2])
    for yaw in (0.0, 2.0):
        ranges = look(floor, (*at, yaw), 7.0, beams=8)
        for k, length in enumerate(ranges):
            angle = yaw - math.pi + k * math.pi / 4
            steps = np.arange(0.0, min(length, 7.0) - 0.1 * floor.cell - 1e-6, 0.1)
            cells = floor.index(at + steps[:, None] * [math.cos(angle), math.sin(angle)])
            assert floor.free[cells[:, 0], cells[:, 1]].mean() > 0.9
            if math.isfinite(length):
                end = floor.index(at + length * np.array([math.cos(angle), math.sin(angle)]))
                assert not floor.free[end[0], end[1]]
    assert np.isfinite(look(floor, (*at, 0.0), 1e3)).all()


def test_robots_drive_while_the_clock_runs(served):
    env, policy, robots = served()
    with policy:
        state = env.reset()
        policy.sight.look()
        at = policy.sight.observation(0)["poses"][0, :, :2]
        listen = policy.robots[0].listen

        def answer(*given) -> None:  # as soon as it is asked
            if not policy.robots[0].answered:
                robots.send("robot1", *at[0] + 3.0)
                robots.send("robot2", *at[1] + 3.0)
            listen(*given)

        policy.robots[0].listen = answer
        state = env.step(policy(state))
    assert not policy.reasons[0]
    heard = robots.listen()
    times = [read_nanoseconds(one.clock) for one in heard["/clock"]]
    assert times == sorted(times) and times[-1] == env.local_steps * 10**8
    stamps = [read_nanoseconds(one.header.stamp) for one in heard["/robot1/odom"]]
    assert stamps[-1] == times[-1] and len(heard["/tf"]) == env.local_steps + 1
    moved = heard["/tf"][-1].transforms[0].transform.translation
    assert math.hypot(moved.x - at[0, 0], moved.y - at[0, 1]) > 0.1
    fastest = max(math.hypot(one.twist.twist.linear.x, one.twist.twist.linear.y) for one in heard["/robot1/odom"])
    assert 0.1 < fastest < 20.0


def test_goals_that_are_none_are_told(served):
    env, policy, robots = served()
    with policy:
        env.reset()
        policy.sight.look()
        policy._begin()
        robots.send("robot1", 1.0, 1.0, frame="camera")
        robots.send("robot2", math.nan, 1.0)
        policy._decide()
    assert policy.reasons[0]
    assert any("/robot1/goal_pose: a goal in the frame camera is not known" in one for one in served.told)
    assert any("/robot2/goal_pose: x=nan" in one for one in served.told)


def test_who_sends_nonsense_without_end_is_told_for_a_while_and_cannot_paint_the_terminal(served):
    env, policy, robots = served()
    with policy:
        env.reset()
        policy.sight.look()
        policy._begin()
        for count in range(6):
            for k in range(10):
                robots.send("robot1", 1.0, 1.0, frame=f"\x1b[2J{count}{k}" + "x" * 1000)
            policy.robots[0].listen(0, 0, policy._refuse)
    told = [one for one in served.told if "a goal in the frame" in one]
    assert 0 < len(told) < 30 and all(one.isprintable() and len(one) < 500 for one in told)


def test_a_clock_that_waits_runs_on_and_then_goes_on_with_what_there_is(served):
    env, policy, robots = served()
    with policy:
        env.reset()
        policy.sight.look()
        policy._begin()
        robots.send("robot1", 1.0, 1.0)
        goals = policy._decide()
        assert goals[0].tolist() == [1.0, 1.0] and np.isnan(goals[1]).all() and not policy.reasons[0]
        assert policy.idle == pytest.approx(0.5e9)
        assert read_nanoseconds(robots.listen()["/clock"][-1].clock) == 5 * 10**8
        assert read_nanoseconds(robots.heard["/tf"][-1].transforms[0].header.stamp) == 5 * 10**8
        policy._begin()
        assert policy.begin == 5 * 10**8 + GAP and policy.robots[0].goal is None, "time never goes back"


def test_a_robot_that_has_collided_is_silent_and_not_waited_for(served):
    env, policy, robots = served()
    with policy:
        env.reset()
        env.simulation.tensors["collided"][0, 1] = 1
        policy.sight.look()
        policy._begin()
        robots.send("robot1", 1.0, 1.0)
        goals = policy._decide()
    assert policy.idle == 0 and goals[0].tolist() == [1.0, 1.0] and np.isnan(goals[1]).all()
    heard = robots.listen()
    assert [one.child_frame_id for one in heard["/tf"][-1].transforms] == ["robot1/base_link"]
    assert heard["/robot1/odom"] and not heard["/robot2/odom"]


def test_robots_that_drive_are_not_waited_for_where_idle_ones_are(served):
    env, policy, robots = served(wait_for="idle")
    with policy:
        env.reset()
        policy.sight.look()
        policy._begin()
        robots.send("robot1", 1.0, 1.0)
        robots.send("robot2", 1.0, 1.0)
        policy._decide()
        begin = time.monotonic()
        goals = policy._decide()  # nobody answers, and nobody has to
        assert policy.idle == 0 and goals.tolist() == [[1.0, 1.0]] * 2 and time.monotonic() - begin < 5.0
        policy.robots[1].goal = env.simulation.tensors["center"][0, 1, :2].numpy().astype(float)  # it is there
        policy._decide()
        assert policy.idle == pytest.approx(0.5e9)


def test_frames_of_each_robots_own(served):
    env, policy, robots = served(own_tf=True, robots=("a", "b"))
    with policy:
        env.reset()
        policy.sight.look()
        policy._begin()
        policy._decide()
    heard = robots.listen()
    assert not heard["/tf"] and not heard["/tf_static"]
    for name in ("a", "b"):
        assert [one.child_frame_id for one in heard[f"/{name}/tf"][0].transforms] == ["base_link"]
        still = [(one.header.frame_id, one.child_frame_id) for one in heard[f"/{name}/tf_static"][0].transforms]
        assert still == [("map", "odom"), ("base_link", "base_scan")]
        assert heard[f"/{name}/map"][0].header.frame_id == "map"
        assert heard[f"/{name}/odom"][0].header.frame_id == "odom"


def test_nobody_there(alone):
    env = make_env(1, num_robots=2)
    told = []
    policy = Ros2Player("ros2", Wire(), Serving(answer=0.3, tell=told.append)).open(env)
    with (
        policy,
        pytest.raises(
            UserError, match="Nobody sends goals to /robot1, /robot2, by goal_pose or navigate_to_pose, in 0.3 s:"
        ),
    ):
        policy(env.reset())
    assert told == ["Waiting for somebody who sends goals to /robot1, /robot2 ..."]


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
        return {one.seq: (one.status, one.result.error_msg) for one in self.results.take()}

    def statuses(self) -> list[int]:
        """Of all goals, as was told last."""
        time.sleep(0.1)
        last = list(self.status.take())[-1].status_list
        assert [one.goal_info.goal_id.uuid for one in last] == self.mine
        return [one.status for one in last]


@pytest.fixture
def navigated(alone):
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
    assert [one.return_code for one in other.client.cancels.take()] == [2, 0, 3]


def test_too_few_names_and_limited_radios(alone):
    with pytest.raises(UserError, match="robots=a names 1, and the suite has 2"):
        Serving(("a",)).names(2)
    with pytest.raises(UserError, match="limited radios cannot be served"):
        Ros2Player("x", Wire(), Serving()).open(make_env(1, num_robots=2, comm=CommConfig(range=5.0)))


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
        now = int(time.time())
        for name in "ab":
            message = self.wire.writer(f"/{name}/map").make()
            message.header.frame_id, message.header.stamp.sec = "map", now
            message.info.resolution, message.info.width, message.info.height = 0.1, 60, 60
            message.info.origin.orientation.w = 1.0
            values = np.full((60, 60), -1)
            values[5:40, 5:40] = 0
            message.data = values.ravel().tolist()
            self.wire.writer(f"/{name}/map").write(message)
            frames = self.wire.writer(f"/{name}/tf")
            frames.write(frames.make(transforms=[transform("map", "base_link", now * 10**9, (1.0, 1.5, 0.0))]))


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


def test_a_team_of_other_robots(alone):
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


def test_a_team_sends_goals_by_the_action_and_cancels_them(alone):
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


def test_a_team_tells_that_nobody_navigates(alone):
    robots, told = Publishers(), []
    settings = DriverSettings(robots=("a", "b"), radar_range=3.0, robot_radius=(0.2,), offsets=(0.0,) * 6, period=0.2)
    made = Ros2Team(TeamDriver(settings), Wire(), 5.0, told.append, "navigate_to_pose")
    robots.publish()
    step_until(made, lambda: len(told) >= 2)
    assert any("a: nobody offers /a/navigate_to_pose yet" in one for one in told) and not made.driver.goals


@pytest.mark.parametrize("text", ["garbage", "[1]", '{"robots": ["a"]}', '{"begins": 0, "robots": 3}'])
def test_an_episode_that_is_none_ends_no_team(text, alone):
    robots, made = Publishers(), team(offsets=(0.0,) * 6, period=0.2)
    writer = robots.wire.writer(EPISODE)
    writer.write(writer.make(data=text))
    step_until(made, lambda: made.told)
    assert made.told == [f"{EPISODE}: what came is no episode of an arena"] and made.driver.episode is None
    robots.publish()
    step_until(made, lambda: made.course.plans, again=robots.publish)


def test_maps_that_are_not_aligned_are_refused(alone):
    robots, made = Publishers(), team()
    robots.publish()
    with pytest.raises(UserError, match="both in a frame called map.*give offsets="):
        step_until(made, lambda: False)


def test_a_team_without_robots_ends(alone):
    made = team()
    with pytest.raises(UserError, match="Nobody publishes /a/map, /b/map in 0.5 s: start the robots"):
        step_until(made, lambda: False)


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
    files = sorted(one.name for one in (over / "actions").iterdir())
    assert len(files) == 8 and files == sorted(one.name for one in (inside / "actions").iterdir())
    for name in files:
        with np.load(over / "actions" / name) as one, np.load(inside / "actions" / name) as other:
            assert np.array_equal(one["region"], other["region"]) and not any(one["reasons"])
            assert np.abs(one["offset"] - other["offset"]).max() < 1e-5
            assert np.array_equal(one["metrics"], other["metrics"], equal_nan=True)
            assert (one["seconds"] > 0).all()


def test_the_action_has_the_bits_of_the_topic(folders):
    one, other = (folders[1] / goals / "actions" for goals in ("goal_pose", "navigate_to_pose"))
    for file in one.iterdir():
        with np.load(file) as here, np.load(other / file.name) as there:
            for name in ("region", "offset", "metrics", "decisions"):
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
