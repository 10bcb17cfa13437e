"""The ROS 2 package: its messages against the real definitions, its node against stand-ins for rclpy and nav2."""

import ast
import importlib
import sys
import xml.etree.ElementTree as xml
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import yaml
from paths import ROOT

from maexp.agents.deploy.planner import frames
from maexp.agents.deploy.planner.messages import read_word, write_word
from maexp.agents.runtime import TeamPlanner, Word
from maexp.envs.quaternions import read_yaw

pytest.importorskip("rosbags", reason="THE EXTRA maexp[rosbag] IS NOT INSTALLED: messages of ROS are not tested")
from bag_writer import GRID, STORE, TF, grid, transforms
from rosbags.interfaces import Nodetype

PACKAGE = ROOT / "docs" / "ros2" / "maexp_ros"
ZERO = {"string": "", "bool": False, "float32": 0.0, "float64": 0.0}


def blank(name: str):
    """A message with the values that ROS gives it at first."""

    def value(kind, about):
        if kind == Nodetype.NAME:
            return blank(about)
        if kind == Nodetype.BASE:
            return ZERO.get(about[0], 0)
        inner, count = about
        plain = inner[0] == Nodetype.BASE and inner[1][0] != "string"
        return np.zeros(count, inner[1][0]) if plain else []

    return STORE.types[name](**{field: value(*about) for field, about in STORE.fielddefs[name][1]})


def passed_on(message):
    """The message as another program would get it: written out and read again."""
    raw = STORE.serialize_cdr(message, message.__msgtype__)
    return STORE.deserialize_cdr(raw, message.__msgtype__)


def made(name: str):
    """What stands for a message's class."""

    def make(**fields):
        message = blank(name)
        for field, value in fields.items():
            setattr(message, field, value)
        return message

    return make


def floor() -> np.ndarray:
    """Two rooms of which the right one is unknown; rows along y."""
    values = np.full((60, 100), -1, np.int8)
    values[5:55, 5:60] = 0
    values[5:55, [4, 60]] = 100
    values[[4, 55], 4:61] = 100
    values[25:35, 60:64] = 0
    return values


@pytest.fixture()
def conversion(monkeypatch):
    monkeypatch.syspath_prepend(str(PACKAGE))
    yield importlib.import_module("maexp_ros.conversion")
    for name in [name for name in sys.modules if name.startswith("maexp_ros")]:
        del sys.modules[name]


def test_maps_and_poses():
    values = floor()
    read = frames.read_map(passed_on(grid(values, 0.1, (-2.0, 3.0), yaw=0.4)))
    assert np.array_equal(read.values, values) and read.resolution == 0.1
    assert read.origin == pytest.approx((-2.0, 3.0, 0.4))
    tree = frames.Frames()
    tree.take(passed_on(transforms([("map", "robot1/base_link", 3.0, (1.0, 2.0, 0.0), -2.5)])))
    root, pose, time = tree.find("robot1/base_link", {"map"})
    assert (root, time) == ("map", 3.0) and pose == pytest.approx((1.0, 2.0, -2.5))
    placed = frames.place_grid(read, (5.0, 1.0, np.pi / 2))
    assert placed.origin == pytest.approx((5.0 - 3.0, 1.0 - 2.0, 0.4 + np.pi / 2))
    message = grid(values, 0.1)
    message.data = message.data[:-1]
    with pytest.raises(ValueError, match="a map of 100 x 60 cells came with 5999 of them"):
        frames.read_map(message)


def test_frames_hang_from_each_other():
    tree = frames.Frames()
    tree.take(transforms([("map", "/odom", 9.0, (1.0, 0.0, 0.0), np.pi / 2)]))
    tree.take(transforms([("odom", "base_footprint", 5.0, (2.0, 0.0, 0.0), 0.0)]))
    tree.take(transforms([("base_footprint", "base_link", 0.0, (0.0, 0.5, 0.0), 0.0)]), still=True)
    root, pose, time = tree.find("base_footprint", {"map"})
    assert pose == pytest.approx((1.0, 2.0, np.pi / 2)) and time == 5.0
    assert tree.find("base_link", {"map"})[1] == pytest.approx((0.5, 2.0, np.pi / 2))
    assert tree.find("base_link", {"odom", "map"})[0] == "odom"
    assert tree.find("base_link", {"world"}) is None and tree.find("map", {"map"})[1] == (0.0, 0.0, 0.0)
    tree.put("map", "base_link", (0.0, 0.0, 0.0), 0.0)  # a ring
    assert tree.find("base_link", {"world"}) is None


def test_grids_of_several_robots_are_merged():
    values = floor()
    left, right = values.copy(), values.copy()
    left[:, 40:], right[:, :30] = -1, -1
    part = frames.OccupancyGrid(right[:, 30:], 0.1, (3.0, 0.0, 0.0))
    merged = frames.merge_grids([frames.OccupancyGrid(left, 0.1, (0.0, 0.0, 0.0)), part])
    assert np.array_equal(merged.values, values) and merged.origin == pytest.approx((0.0, 0.0, 0.0))
    turned = frames.OccupancyGrid(
        np.rot90(values, k=-1).copy(), 0.1, (0.0, 6.0, -np.pi / 2)
    )  # the same seen from its side
    again = frames.merge_grids([turned, frames.OccupancyGrid(np.full((1, 1), -1, np.int8), 0.1, (0.0, 0.0, 0.0))])
    assert np.array_equal(again.values, values)
    walls = frames.OccupancyGrid(np.full((2, 2), 100, np.int8), 0.1, (1.0, 1.0, 0.0))
    over = frames.merge_grids([frames.OccupancyGrid(values, 0.1, (0.0, 0.0, 0.0)), walls]).values
    assert (over[10:12, 10:12] == 100).all() and (over == 100).sum() == (values == 100).sum() + 4
    alike = frames.merge_grids([frames.OccupancyGrid(cells, 0.07, (0.03, 0.01, 0.0)) for cells in (left, right)])
    assert np.array_equal(alike.values, values) and alike.origin == (0.03, 0.01, 0.0)


@pytest.mark.parametrize("cell", [0.05, 0.1, 0.07])
def test_grids_that_go_to_and_fro_do_not_grow(cell):
    """Robots merge what others have merged, again and again: rounding must not add a row each time."""
    low, high = -2.5 * cell, 23 * cell
    own = [frames.OccupancyGrid(floor(), cell, (low, high, 0.0)), frames.OccupancyGrid(floor(), cell, (high, low, 0.0))]
    told, sizes = list(own), set()
    for _ in range(30):
        told = [frames.merge_grids([grid, other]) for grid, other in zip(own, told[::-1], strict=True)]
        sizes.add(told[0].values.shape)
    assert len(sizes) == 1 and (told[0].values >= 0).sum() > (floor() >= 0).sum()


def test_goals_and_markers_are_real_messages(conversion):
    way = np.array([[1.0, 1.0], [2.0, 1.0], [2.0, 3.0]])
    pose = blank("geometry_msgs/msg/PoseStamped")
    frames.fill_pose(pose.pose, *way[-1], frames.heading_of(way))
    got = passed_on(pose).pose
    assert (got.position.x, got.position.y) == (2.0, 3.0)
    assert read_yaw(got.orientation) == pytest.approx(np.pi / 2)
    point, array = made("geometry_msgs/msg/Point"), blank("visualization_msgs/msg/MarkerArray")
    array.markers = [blank("visualization_msgs/msg/Marker") for _ in range(3)]
    conversion.fill_way(array.markers[0], point, 1, way)
    conversion.fill_goal(array.markers[1], 1, way[-1])
    conversion.fill_targets(array.markers[2], point, way)
    line, ball, targets = passed_on(array).markers
    assert (line.type, ball.type, targets.type) == (4, 2, 7)
    assert [(p.x, p.y) for p in line.points] == [tuple(corner) for corner in way] and len(targets.points) == 3
    assert (line.ns, ball.ns, ball.id) == ("ways", "goals", 1) and ball.color.a > 0 and ball.scale.x == 0.3


class FeatureInputs:
    """rclpy.time.Time [s]."""

    def __init__(self, seconds: float = 0.0):
        self.nanoseconds = int(seconds * 1e9)

    def to_msg(self):
        time = blank("builtin_interfaces/msg/Time")
        time.sec, time.nanosec = divmod(self.nanoseconds, 10**9)
        return time


class StandIn:
    """What the node sees of ROS: parameters, topics, actions; `told` is its log."""

    def __init__(self, **parameters):
        self.parameters, self.now, self.told = parameters, 100.0, []
        self.topics, self.sent, self.published, self.cancelled = {}, [], [], []
        self.told_mates, self.watched = {}, 0
        self.waiting, self.ready, self.accepts = [], True, True

    def place(self, name: str, x: float, y: float, yaw: float = 0.0) -> None:
        """As one localisation for the whole team tells it."""
        entry = ("map", f"{name}/base_link", self.now, (x, y, 0.0), yaw)
        self.topics["/tf"](passed_on(transforms([entry])))

    def node_class(ros):
        class Node:
            def __init__(self, name):
                self.name = name

            def declare_parameter(self, name, default):
                ros.parameters.setdefault(name, default)

            def get_parameter(self, name):
                return SimpleNamespace(value=ros.parameters[name])

            def create_subscription(self, kind, topic, call, qos):
                ros.topics[topic] = call

            def create_publisher(self, kind, topic, depth):
                kept = ros.published if topic == "~/markers" else ros.told_mates.setdefault(topic, [])
                return SimpleNamespace(publish=kept.append, get_subscription_count=lambda: ros.watched)

            def create_timer(self, period, call):
                ros.timer = (period, call)

            def get_clock(self):
                return SimpleNamespace(now=lambda: FeatureInputs(ros.now))

            def get_logger(self):
                def log(text, **_):
                    ros.told.append(text)

                return SimpleNamespace(info=log, warning=log, error=log)

            def destroy_node(self):
                pass

        return Node

    def action_class(ros):
        class ActionClient:
            def __init__(self, node, kind, name):
                self.name = name

            def server_is_ready(self):
                return ros.ready

            def send_goal_async(self, message):
                ros.sent.append((self.name, message))
                ended = SimpleNamespace(add_done_callback=ros.waiting.append)
                handle = SimpleNamespace(
                    accepted=ros.accepts,
                    get_result_async=lambda: ended,
                    cancel_goal_async=lambda: ros.cancelled.append(self.name),
                )
                return SimpleNamespace(add_done_callback=lambda call: call(SimpleNamespace(result=lambda: handle)))

        return ActionClient

    def modules(self) -> dict[str, ModuleType]:
        def module(**names):
            found = ModuleType("stand-in")
            found.__dict__.update(names)
            return found

        goal = SimpleNamespace(Goal=lambda: SimpleNamespace(pose=blank("geometry_msgs/msg/PoseStamped")))
        words = SimpleNamespace(RELIABLE=1, TRANSIENT_LOCAL=1)
        return {
            "rclpy": module(init=lambda: None, spin=lambda node: None, try_shutdown=lambda: None),
            "rclpy.action": module(ActionClient=self.action_class()),
            "rclpy.node": module(Node=self.node_class()),
            "rclpy.publisher": module(Publisher=object),
            "rclpy.time": module(Time=lambda nanoseconds: FeatureInputs(nanoseconds / 1e9)),
            "rclpy.qos": module(QoSProfile=lambda **_: None, DurabilityPolicy=words, ReliabilityPolicy=words),
            "tf2_msgs.msg": module(TFMessage=STORE.types[TF]),
            "geometry_msgs.msg": module(Point=made("geometry_msgs/msg/Point")),
            "std_msgs.msg": module(String=made("std_msgs/msg/String")),
            "map_msgs.msg": module(OccupancyGridUpdate=type("OccupancyGridUpdate", (), {})),
            "nav_msgs.msg": module(OccupancyGrid=made(GRID), Odometry=made("nav_msgs/msg/Odometry")),
            "nav2_msgs.action": module(NavigateToPose=goal),
            "visualization_msgs.msg": module(
                Marker=made("visualization_msgs/msg/Marker"), MarkerArray=made("visualization_msgs/msg/MarkerArray")
            ),
        }


@pytest.fixture()
def team(conversion, monkeypatch):
    """A node of two robots, and what it sees of ROS."""
    ros = StandIn(robots=["a", "b"], radar_range=3.0, robot_radius=[0.2])
    for name, stand_in in ros.modules().items():
        monkeypatch.setitem(sys.modules, name, stand_in)
    return importlib.import_module("maexp_ros.team_node").TeamNode(), ros


def test_the_node_sends_goals(team):
    node, ros = team
    node.decide()
    assert not ros.sent  # no map yet
    ros.topics["/map"](passed_on(grid(floor(), 0.1)))
    ros.place("a", 1.0, 1.5)
    ros.place("b", 1.0, 4.0)
    node.decide()
    assert {name for name, _ in ros.sent} <= {"/a/navigate_to_pose", "/b/navigate_to_pose"} and ros.sent
    expected = TeamPlanner("cost_utility", radar_range=3.0, robot_radius=0.2, occupied=65.0).plan(
        floor(), 0.1, (0.0, 0.0, 0.0), {"a": (1.0, 1.5, 0.0), "b": (1.0, 4.0, 0.0)}, now=0.0
    )
    for name, message in ros.sent:
        at = message.pose.pose.position
        goal = expected.goals[expected.names.index(name.split("/")[1])]
        assert (at.x, at.y) == pytest.approx(tuple(goal)) and message.pose.header.frame_id == "map"
        assert passed_on(message.pose).header.stamp.sec == 100
    assert len(passed_on(ros.published[-1]).markers) == 2 + 2 * len(ros.sent)
    before = len(ros.sent)
    node.decide()
    assert len(ros.sent) == before  # on their way there
    while ros.waiting:
        ros.waiting.pop()(None)
    node.decide()
    assert len(ros.sent) == 2 * before  # nav2 ended them: sent anew


def node_of(name: str, monkeypatch, **parameters):
    """The node of one radio of two robots, and what it sees of ROS."""
    maps = ["/a/map", "/b/map"]
    ros = StandIn(robots=["a", "b"], only=name, radar_range=3.0, robot_radius=[0.2], map_topics=maps, **parameters)
    ros.parameters["offsets"] = [0.0] * 6
    for module, stand_in in ros.modules().items():
        monkeypatch.setitem(sys.modules, module, stand_in)
    for module in [name for name in sys.modules if name.startswith("maexp_ros.")]:
        del sys.modules[module]
    return importlib.import_module("maexp_ros.team_node").TeamNode(), ros


def test_a_node_of_the_base_station_hears_and_passes_on(conversion, monkeypatch):
    node, ros = node_of("base_station", monkeypatch, **{"comm.base_station": [1.0, 2.0]})
    assert not node.clients_of and "/a/map" not in ros.topics
    ros.watched = 1
    node.decide()
    assert not ros.told_mates["/base_station/maexp/known"]
    ros.topics["/a/maexp/map"](passed_on(grid(floor(), 0.1)))
    ros.topics["/a/maexp/word"](SimpleNamespace(data=write_word(Word("a", (1.0, 1.5, 0.0), 0.0, 100.0))))
    node.decide()
    for topic in ("known", "heard/a/map"):
        shown = ros.told_mates[f"/base_station/maexp/{topic}"][-1]
        shown.data = np.array(shown.data, np.int8)
        assert np.array_equal(frames.read_map(passed_on(shown)).values, floor())
    word = read_word(ros.told_mates["/base_station/maexp/word"][-1].data)
    assert word == Word("base_station", (1.0, 2.0, 0.0), 0.0, 100.0, hears={"a": 100.0}) and not ros.told


def test_a_node_of_one_robot_tells_its_mates_and_hears_them(conversion, monkeypatch):
    (node, ros), (other, others) = (node_of(name, monkeypatch) for name in "ab")
    assert "/b/map" not in ros.topics and "/b/odom" not in ros.topics and list(node.clients_of) == ["a"]
    half = floor()
    half[:, 30:] = -1
    ros.topics["/a/map"](passed_on(grid(half, 0.1)))
    others.topics["/b/map"](passed_on(grid(floor(), 0.1)))
    for here, name, y in ((ros, "a", 1.5), (others, "b", 4.0)):
        here.place(name, 1.0, y)
    other.decide()
    shown = others.told_mates["/b/maexp/map"][-1]
    shown.data = np.array(shown.data, np.int8)  # as rosbags has it
    ros.topics["/b/maexp/map"](passed_on(shown))
    ros.topics["/b/maexp/word"](passed_on(others.told_mates["/b/maexp/word"][-1]))
    node.decide()
    own, heard = (ros.told_mates[f"/a/maexp/{topic}"][-1] for topic in ("map", "heard/b/map"))
    assert np.array_equal(frames.read_map(own).values, half) and own.header.stamp.sec == 100
    assert np.array_equal(frames.read_map(heard).values, floor())
    assert not ros.told_mates["/a/maexp/known"], "nobody looks on"
    ros.watched = 1
    node.decide()
    assert np.array_equal(frames.read_map(ros.told_mates["/a/maexp/known"][-1]).values, floor())
    assert len(ros.told_mates["/a/maexp/heard/b/map"]) == 1, "nothing new"
    assert node.driver.planner.heard["b"].pose == pytest.approx((1.0, 4.0, 0.0))
    assert [name for name, _ in ros.sent + others.sent] == ["/a/navigate_to_pose", "/b/navigate_to_pose"]
    ros.topics["/b/maexp/word"](SimpleNamespace(data="nonsense"))
    assert "/b/maexp/word: what came is no word of a robot" in ros.told


def test_what_is_missing_is_said(team):
    node, ros = team
    ros.topics["/map"](grid(floor(), 0.1))
    ros.place("a", 1.0, 1.5)
    node.decide()
    assert [name for name, _ in ros.sent] == ["/a/navigate_to_pose"]
    assert any("b: tf does not say where b/base_link is in map" in sentence for sentence in ros.told)
    ros.now += 10.0
    node.decide()
    assert any("a: its pose is too old" in sentence for sentence in ros.told)
    assert ros.cancelled == ["/a/navigate_to_pose"], "nobody knows where it drives"
    ros.place("a", 1.0, 1.5)
    ros.ready = False
    node.decide()
    assert "a: nav2 is not there yet" in ros.told and len(ros.sent) == 1
    ros.ready, ros.accepts = True, False
    node.decide()
    assert len(ros.sent) == 2 and not node.driver.goals  # refused: may be sent again


def test_goals_are_cancelled_once_nothing_is_left(team):
    node, ros = team
    ros.topics["/map"](grid(floor(), 0.1))
    ros.place("a", 1.0, 1.5)
    ros.place("b", 1.0, 4.0)
    node.decide()
    driving = [name for name, _ in ros.sent]
    values = floor()
    values[25:35, 60:64] = 100
    ros.topics["/map"](grid(values, 0.1))
    node.decide()
    assert driving and ros.cancelled == driving and not node.driver.goals
    node.decide()
    assert ros.cancelled == driving


def test_done_is_said_once(team):
    node, ros = team
    values = floor()
    values[25:35, 60:64] = 100
    ros.topics["/map"](grid(values, 0.1))
    ros.place("a", 1.0, 1.5)
    ros.place("b", 1.0, 4.0)
    node.decide(), node.decide()
    assert not ros.sent and sum("done: nothing" in sentence for sentence in ros.told) == 1


def test_the_package_is_whole():
    described = xml.parse(PACKAGE / "package.xml").getroot()
    assert described.find("name").text == "maexp_ros" and described.find("license").text == "MIT"
    wanted = {element.text for element in described.findall("exec_depend")}
    setup = (PACKAGE / "setup.py").read_text()
    calls = [node for node in ast.walk(ast.parse(setup)) if isinstance(node, ast.Constant)]
    for part in ("launch/team.launch.py", "config/team.yaml", "rviz/team.rviz"):
        assert (PACKAGE / part).is_file() and any(node.value == part for node in calls), part
    assert (PACKAGE / "resource" / "maexp_ros").is_file() and "team = maexp_ros.team_node:main" in setup
    for name in ("maexp_ros/team_node.py", "maexp_ros/mates.py", "launch/team.launch.py"):
        tree = ast.parse((PACKAGE / name).read_text())
        modules = [node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module]
        ours = {"__future__", "collections", "dataclasses", "functools", "pathlib", "mates", "maexp"}
        assert {module.split(".")[0] for module in modules} - ours <= wanted, name
    yaml.safe_load((PACKAGE / "rviz" / "team.rviz").read_text())


def test_parameters_are_those_of_the_file(team):
    module = sys.modules["maexp_ros.team_node"]
    written = yaml.safe_load((PACKAGE / "config" / "team.yaml").read_text())["team"]["ros__parameters"]
    written |= {f"comm.{name}": value for name, value in written.pop("comm").items()}
    assert set(written) == set(module.PARAMETERS)
    assert {name: type(value) for name, value in written.items()} == {
        name: type(value) for name, value in module.PARAMETERS.items()
    }
