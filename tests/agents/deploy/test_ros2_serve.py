"""Robots of an arena over DDS: what is published, who is waited for, when they drive."""

import json
import math
import time

import numpy as np
import pytest
from loopback import QUICK
from mazes import make_env

pytest.importorskip("cyclonedds", reason="THE EXTRA maexp[ros2] IS NOT INSTALLED: DDS is not tested")

from maexp.agents.deploy.planner.frames import read_map
from maexp.agents.deploy.ros2.dds import EPISODE, Wire
from maexp.agents.deploy.ros2.messages import look, read_nanoseconds
from maexp.agents.deploy.ros2.serve import GAP, Ros2Player, Serving
from maexp.agents.errors import UserError
from maexp.envs import CommConfig

pytestmark = pytest.mark.slow  # processes, and waiting


class Robots:
    """Whoever is on the other end, in this process: hears all and sends what a test says."""

    def __init__(self, *names: str):
        self.wire = Wire()
        self.topics = ["/clock", "/tf", "/tf_static", EPISODE]
        self.topics += [f"/{name}/{topic}" for name in names for topic in ("map", "odom", "scan", "tf", "tf_static")]
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
def served(own_domain):
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
        still = {
            transform.child_frame_id: transform.header.frame_id for transform in heard["/tf_static"][-1].transforms
        }
        assert still["robot1/map"] == "map" and still["robot2/odom"] == "robot2/map"
        assert still["robot1/base_scan"] == "robot1/base_link"
        first = heard["/tf"][0].transforms
        assert [transform.child_frame_id for transform in first] == ["robot1/base_link", "robot2/base_link"]
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
    times = [read_nanoseconds(message.clock) for message in heard["/clock"]]
    assert times == sorted(times) and times[-1] == env.local_steps * 10**8
    stamps = [read_nanoseconds(message.header.stamp) for message in heard["/robot1/odom"]]
    assert stamps[-1] == times[-1] and len(heard["/tf"]) == env.local_steps + 1
    moved = heard["/tf"][-1].transforms[0].transform.translation
    assert math.hypot(moved.x - at[0, 0], moved.y - at[0, 1]) > 0.1
    fastest = max(
        math.hypot(message.twist.twist.linear.x, message.twist.twist.linear.y) for message in heard["/robot1/odom"]
    )
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
    assert any("/robot1/goal_pose: a goal in the frame camera is not known" in sentence for sentence in served.told)
    assert any("/robot2/goal_pose: x=nan" in sentence for sentence in served.told)


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
    told = [sentence for sentence in served.told if "a goal in the frame" in sentence]
    assert 0 < len(told) < 30 and all(sentence.isprintable() and len(sentence) < 500 for sentence in told)


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
    assert [transform.child_frame_id for transform in heard["/tf"][-1].transforms] == ["robot1/base_link"]
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
        assert [transform.child_frame_id for transform in heard[f"/{name}/tf"][0].transforms] == ["base_link"]
        still = [
            (transform.header.frame_id, transform.child_frame_id)
            for transform in heard[f"/{name}/tf_static"][0].transforms
        ]
        assert still == [("map", "odom"), ("base_link", "base_scan")]
        assert heard[f"/{name}/map"][0].header.frame_id == "map"
        assert heard[f"/{name}/odom"][0].header.frame_id == "odom"


def test_nobody_there(own_domain):
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


def test_too_few_names_and_limited_radios(own_domain):
    with pytest.raises(UserError, match="robots=a names 1, and the suite has 2"):
        Serving(("a",)).names(2)
    with pytest.raises(UserError, match="limited radios cannot be served"):
        Ros2Player("x", Wire(), Serving()).open(make_env(1, num_robots=2, comm=CommConfig(range=5.0)))
