"""A ROS 2 team from messages to orders: frames of several robots, maps that are not aligned, cancelled goals."""

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="THE EXTRA maexp[rosbag] IS NOT INSTALLED: messages of ROS are not tested")
from bag_writer import STORE, grid, header, kind, transforms, turn

from maexp.agents.deploy.planner.arena_policy import TeamAgent
from maexp.agents.deploy.planner.frames import compose, invert
from maexp.agents.deploy.planner.team_driver import DriverSettings, TeamDriver, read_settings
from maexp.agents.runtime import TeamPlanner

TEAM = {"robots": ("a", "b"), "radar_range": 3.0, "robot_radius": (0.2,), "map_topics": ("/map",)}


def floor(open_door: bool = True) -> np.ndarray:
    """Two rooms of which the right one is unknown; rows along y."""
    values = np.full((60, 100), -1, np.int8)
    values[5:55, 5:60] = 0
    values[5:55, [4, 60]] = 100
    values[[4, 55], 4:61] = 100
    values[25:35, 60:64] = 0 if open_door else 100
    return values


def drive(**changes) -> TeamDriver:
    """A driver that has a map and sees both robots."""
    driver = TeamDriver(DriverSettings(**TEAM | changes))
    driver.take_map("/map", grid(floor(), 0.1))
    place(driver, 0.0)
    return driver


def place(driver: TeamDriver, now: float, a=(1.0, 1.5, 0.0), b=(1.0, 4.0, 0.0)) -> None:
    seen = [(name, at) for name, at in (("a", a), ("b", b)) if at is not None]
    driver.take_frames(transforms([("map", f"{name}/base_link", now, (*at[:2], 0.0), at[2]) for name, at in seen]))


def odometry(frame: str, child: str, at=(0.0, 0.0, 0.0), speed=(0.0, 0.0), now: float = 0.0):
    """A nav_msgs/Odometry."""
    point, vector = kind("geometry_msgs/msg/Point"), kind("geometry_msgs/msg/Vector3")
    pose = kind("geometry_msgs/msg/Pose")(position=point(x=at[0], y=at[1], z=0.0), orientation=turn(at[2]))
    twist = kind("geometry_msgs/msg/Twist")(
        linear=vector(x=speed[0], y=speed[1], z=0.0), angular=vector(x=0.0, y=0.0, z=0.0)
    )
    unsure = np.zeros(36)
    return STORE.types["nav_msgs/msg/Odometry"](
        header=header(frame, now),
        child_frame_id=child,
        pose=kind("geometry_msgs/msg/PoseWithCovariance")(pose=pose, covariance=unsure),
        twist=kind("geometry_msgs/msg/TwistWithCovariance")(twist=twist, covariance=unsure),
    )


def goals(decision) -> dict:
    return {order.name: order.goal for order in decision.orders if not order.stop}


def test_goals_are_those_of_the_planner():
    decision = drive().decide(1.0)
    poses = {"a": (1.0, 1.5, 0.0), "b": (1.0, 4.0, 0.0)}
    wanted = TeamPlanner(radar_range=3.0, robot_radius=0.2, occupied=65.0).plan(
        floor(), 0.1, (0.0, 0.0, 0.0), poses, now=0.0
    )
    assert {order.name for order in decision.orders} == {n for n, on in zip("ab", wanted.active, strict=True) if on}
    for order in decision.orders:
        assert np.array_equal(order.goal, wanted.goals["ab".index(order.name)]) and not order.stop


def test_frames_without_a_prefix_in_a_robots_own_tf():
    """As nav2's bringup of several robots has them: /a/tf with map, odom, base_link."""
    driver = TeamDriver(DriverSettings(**TEAM))
    driver.take_map("/map", grid(floor(), 0.1))
    for name, y in (("a", 1.5), ("b", 4.0)):
        driver.take_frames(transforms([("map", "odom", 0.0, (1.0, y, 0.0), 0.0)]), name)
        driver.take_frames(transforms([("odom", "base_link", 0.0, (0.0, 0.0, 0.0), 0.0)]), name)
    wanted, got = goals(drive().decide(0.0)), goals(driver.decide(0.0))
    assert got.keys() == wanted.keys() and all(np.array_equal(got[name], wanted[name]) for name in got)


def test_a_frame_without_a_prefix_in_the_shared_tf_is_nobodys():
    driver = TeamDriver(DriverSettings(**TEAM))
    driver.take_map("/map", grid(floor(), 0.1))
    driver.take_frames(transforms([("map", "base_link", 0.0, (1.0, 1.5, 0.0), 0.0)]))
    decision = driver.decide(0.0)
    assert not decision.orders and decision.notes[0] == "a: tf does not say where a/base_link is in map"


def parts(driver: TeamDriver, names=("map", "map")) -> None:
    """The floor in two maps, whose origins lie where their robots began."""
    values = floor()
    for name, part, frame in (("a", values[:30], names[0]), ("b", values[30:], names[1])):
        message = grid(part, 0.1)
        message.header.frame_id = frame
        driver.take_map(f"/{name}/map", message)


def test_maps_called_alike_are_refused_unless_offsets_are_given():
    driver = TeamDriver(DriverSettings(**TEAM | {"map_topics": ()}))
    parts(driver)
    with pytest.raises(ValueError, match="/a/map and /b/map are both in a frame called map.*offsets=x,y,yaw"):
        driver.decide(0.0)
    driver = TeamDriver(DriverSettings(**TEAM | {"map_topics": (), "offsets": (0.0, 0.0, 0.0, 0.0, 3.0, 0.0)}))
    parts(driver)
    driver.take_frames(transforms([("map", "base_link", 0.0, (1.0, 1.5, 0.0), 0.0)]), "a")
    driver.take_frames(transforms([("map", "base_link", 0.0, (1.0, 1.0, 0.0), 0.0)]), "b")
    decision = driver.decide(0.0)
    wanted, got = goals(drive().decide(0.0)), goals(decision)
    for order in decision.orders:  # each robot knows its own map alone
        assert order.frame == "map" and order.pose[:2] == pytest.approx(order.goal - (0.0, 3.0 * (order.name == "b")))
    assert got.keys() == wanted.keys() and all(np.allclose(got[name], wanted[name], atol=0.051) for name in got)
    assert driver.places["b"] == pytest.approx([1.0, 4.0])


def test_maps_whose_frames_tf_knows():
    driver = TeamDriver(DriverSettings(**TEAM | {"map_topics": ()}))
    parts(driver, ("a/map", "b/map"))
    assert driver.decide(0.0).plan is None
    for name, shift in (("a", 0.0), ("b", 3.0)):
        driver.take_frames(transforms([("map", f"{name}/map", 0.0, (0.0, shift, 0.0), 0.0)]), still=True)
        driver.take_frames(transforms([(f"{name}/map", f"{name}/base_link", 9.0, (1.0, 1.5, 0.0), 0.0)]))
    decision = driver.decide(9.0)
    assert np.array_equal(driver._merge([]).values, floor()) and decision.orders
    assert driver.places["b"] == pytest.approx([1.0, 4.5])


def test_odometry_counts_where_tf_says_nothing():
    driver = TeamDriver(DriverSettings(**TEAM))
    driver.take_map("/map", grid(floor(), 0.1))
    driver.take_odometry("a", odometry("map", "base_footprint", (1.0, 1.5, 0.3)))
    driver.decide(0.0)
    assert driver.places.keys() == {"a"} and driver.places["a"] == pytest.approx([1.0, 1.5])
    place(driver, 0.0, a=(2.0, 1.5, 0.0))
    driver.take_odometry("a", odometry("map", "a/base_link", (9.0, 9.0, 0.0)))
    driver.decide(0.0)
    assert driver.places["a"] == pytest.approx([2.0, 1.5])


def test_speeds_and_time_left_reach_the_policy(monkeypatch):
    driver, told = drive(time_limit=100.0), []
    plan = driver.planner.plan
    monkeypatch.setattr(driver.planner, "plan", lambda *a, **b: told.append(b) or plan(*a, **b))
    driver.take_odometry("b", odometry("odom", "b/base_link", speed=(0.3, 0.4)))
    driver.decide(50.0)
    place(driver, 75.0)
    driver.decide(75.0)
    assert told[0]["velocities"] == [0.0, 0.5]
    assert [inputs["time_left"] for inputs in told] == [1.0, 0.75] and [inputs["now"] for inputs in told] == [0.0, 25.0]


def test_settings_reach_the_planner():
    driver = drive(robot_radius=(0.2, 0.4), patience=7.0, pause=33.0, clearance_factor=1.5, max_speed=0.7)
    planner = driver.planner
    assert planner.robot_radius == {"a": 0.2, "b": 0.4} and planner.clearance_factor == 1.5
    assert (planner.watch.patience, planner.watch.pause) == (7.0, 33.0) and planner.motion.max_speed == 0.7


def test_a_goal_is_sent_again_when_it_moved_was_ended_or_long_ago():
    driver = drive(resend=4.0)
    first = goals(driver.decide(0.0))
    assert first and not driver.decide(1.0).orders
    place(driver, 4.0)
    assert goals(driver.decide(4.0)).keys() == first.keys()
    name = next(iter(first))
    driver.forget(name, first[name] + 1.0)  # another one's end
    assert not driver.decide(5.0).orders
    driver.forget(name, driver.goals[name])
    assert goals(driver.decide(5.0)).keys() == {name}


def test_a_robot_that_is_lost_or_has_nothing_to_do_is_stopped_once():
    driver = drive()
    first = goals(driver.decide(0.0))
    assert first.keys() == {"a", "b"}
    place(driver, 3.0, a=None)
    (order,) = driver.decide(3.0).orders
    assert order.name == "a" and order.stop and order.goal == pytest.approx([1.0, 1.5])
    driver.take_map("/map", grid(floor(open_door=False), 0.1))
    (order,) = driver.decide(3.0).orders
    assert order.name == "b" and order.stop and order.goal == pytest.approx([1.0, 4.0])
    assert not driver.decide(4.0).orders


@pytest.mark.parametrize("policy", ["cost_utility", "universal"])
def test_an_episode_of_the_arena_is_played_as_inside(policy):
    episode = {
        "num_robots": 2,
        "radar_range": 3.0,
        "robot_radius": 0.2,
        "max_speed": 1.0,
        "max_accel": 1.0,
        "seconds": 40.0,
        "decision_seconds": 2.0,
        "seed": 3,
        "robots": ["a", "b"],
    }
    driver, agent = TeamDriver(DriverSettings(robots=("a", "b"), policy=policy)), TeamAgent(policy)
    driver.begin(episode)
    agent.reset(episode)
    rng = np.random.default_rng(1)
    values = np.full((60, 100), -1, np.int8)
    for step in range(6):
        now = 100.0 + 2.0 * step
        values[:, : 20 + 10 * step] = floor()[:, : 20 + 10 * step]
        poses = np.array([[1.0 + 0.5 * step, 1.5, rng.uniform(-3, 3)], [1.0 + 0.3 * step, 4.0, rng.uniform(-3, 3)]])
        speed = rng.uniform(0, 1, 2)
        driver.take_map("/a/map", grid(values, 0.1, time=now))
        place(driver, now, *poses)
        for k, name in enumerate("ab"):
            driver.take_odometry(name, odometry("odom", f"{name}/base_link", speed=(speed[k], 0.0)))
        orders = {order.name: order for order in driver.decide(now).orders}
        wanted = agent.act(
            {
                "grid": np.stack([values] * 2),
                "resolution": 0.1,
                "origin": (0.0, 0.0),
                "poses": np.stack([poses] * 2),
                "velocities": np.stack([np.stack([speed, np.zeros(2)], -1)] * 2),
                "heard": np.ones((2, 2), bool),
                "alive": np.ones(2, bool),
                "time": 2.0 * step,
                "time_left": 1.0 - step / 20,
            }
        )
        assert orders.keys() == {"a", "b"}, "each is answered for"
        for k, name in enumerate("ab"):
            stays = np.isnan(wanted[k, 0])
            assert orders[name].stop == stays
            assert np.allclose(orders[name].goal, poses[k, :2] if stays else wanted[k], rtol=0.0, atol=1e-9)


def test_a_pose_and_its_inverse():
    pose = (1.0, -2.0, 0.7)
    assert compose(invert(pose), pose) == pytest.approx((0.0, 0.0, 0.0))
    assert compose(pose, invert(pose)) == pytest.approx((0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"robots": ()}, "robots= must name the robots"),
        ({"robots": ("a", "a")}, "robots=a,a must name the robots of the team, each once"),
        ({"map_topics": ("/x", "/y", "/z")}, "map_topics=/x,/y,/z must be one for the team, or one for each"),
        ({"offsets": (1.0, 2.0)}, "offsets holds 2 numbers: give 3"),
        ({"robot_radius": (0.1, 0.2, 0.3)}, "robot_radius holds 3 numbers: give 1 or 2"),
        ({"policy": "universl"}, "universl"),
        ({"patience": 0.0}, "patience"),
    ],
)
def test_settings_that_cannot_be(change, told):
    with pytest.raises(ValueError, match=told):
        TeamDriver(DriverSettings(**TEAM | change))


def test_parameters_of_ros_that_stand_for_nothing():
    read = read_settings({"robots": ["a"], "offsets": [0.0], "radar_range": 0.0, "robot_radius": [0.3], "period": 1.0})
    assert (read.robots, read.offsets, read.radar_range, read.robot_radius) == (("a",), (), None, (0.3,))
    assert read_settings({"offsets": [0.0, 0.0, 0.0]}).offsets == (0.0, 0.0, 0.0)
