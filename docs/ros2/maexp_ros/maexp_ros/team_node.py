"""The node: maps and frames in, goals for nav2 out. All thinking is in maexp.agents.runtime."""

from __future__ import annotations

from dataclasses import asdict
from functools import partial

import rclpy
from geometry_msgs.msg import Point
from map_msgs.msg import OccupancyGridUpdate
from nav2_msgs.action import NavigateToPose
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.action import ActionClient
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import Marker, MarkerArray

from maexp.agents.deploy.planner.drivers import RadioDriver, make_driver
from maexp.agents.deploy.planner.frames import fill_pose
from maexp.agents.deploy.planner.radio_features import USED
from maexp.agents.deploy.planner.team_driver import UPDATES, DriverSettings, Order, read_settings
from maexp.envs.config.comm import CommConfig

from . import conversion
from .mates import Mates

OWN = {"robots": ["robot1"], "map_topics": ["/map"], "robot_radius": [0.3], "radar_range": 5.0, "offsets": [0.0]}
COMM = asdict(CommConfig()) | {"cell": 0.0, "base_station": [0.0]}
PARAMETERS = {name: 0.0 if value is None else value for name, value in (asdict(DriverSettings()) | OWN).items()}
PARAMETERS |= {"action": "navigate_to_pose"} | {f"comm.{name}": COMM[name] for name in USED}
PARAMETERS.pop("comm")


def latched(depth: int) -> QoSProfile:
    """Who comes later gets the last ones."""
    kept = {"reliability": ReliabilityPolicy.RELIABLE, "durability": DurabilityPolicy.TRANSIENT_LOCAL}
    return QoSProfile(depth=depth, **kept)


class TeamNode(Node):
    """For the whole team, or for one robot of it or the base station; its parameters are those of config/team.yaml."""

    def __init__(self):
        super().__init__("team")
        for name, default in PARAMETERS.items():
            self.declare_parameter(name, default)
        values = {name: self.get_parameter(name).value for name in PARAMETERS}
        action = values.pop("action")
        radios = {name: values.pop(f"comm.{name}") for name in USED}
        given = {name: value for name, value in radios.items() if value != COMM[name]}
        self.driver = driver = make_driver(read_settings(values | {"comm": CommConfig(**given)}))
        self.frame = driver.settings.global_frame
        for topic in driver.listened:
            self.create_subscription(OccupancyGrid, topic, partial(driver.take_map, topic), latched(1))
            update = partial(self._take_update, topic)
            self.create_subscription(OccupancyGridUpdate, f"{topic}{UPDATES}", update, QoSProfile(depth=10))
        for robot in (None, *driver.driven):
            place = "" if robot is None else f"/{robot}"
            moving, still = (partial(driver.take_frames, robot=robot, still=fixed) for fixed in (False, True))
            self.create_subscription(TFMessage, f"{place}/tf", moving, QoSProfile(depth=100))
            self.create_subscription(TFMessage, f"{place}/tf_static", still, latched(100))
        for robot in driver.driven:
            take = partial(driver.take_odometry, robot)
            self.create_subscription(Odometry, f"/{robot}/odom", take, QoSProfile(depth=10))
        self.clients_of = {name: ActionClient(self, NavigateToPose, f"/{name}/{action}") for name in driver.driven}
        self.mates = Mates(self, driver, latched(1)) if isinstance(driver, RadioDriver) else None
        self.handles: dict[str, object] = {}  # of goals that nav2 has accepted
        self.markers = self.create_publisher(MarkerArray, "~/markers", 1)
        self.finished = False
        self.create_timer(driver.settings.period, self.decide)

    def _take_update(self, topic: str, message) -> None:
        """A part of a map that has changed."""
        try:
            self.driver.take_update(topic, message)
        except ValueError as error:
            self.get_logger().warning(f"{topic}{UPDATES}: {error}", throttle_duration_sec=10.0)

    def decide(self) -> None:
        """Plan and send each robot its goal, where that has changed."""
        now = self.get_clock().now()
        try:
            if self.mates is not None:
                self.mates.tell(now)
            decision = self.driver.decide(now.nanoseconds * 1e-9)
        except ValueError as error:
            self.get_logger().error(f"no plan: {error}", throttle_duration_sec=10.0)
            return
        for note in decision.notes:
            self.get_logger().info(note, throttle_duration_sec=10.0)
        for order in decision.orders:
            (self._cancel if order.stop else self._send)(order)
        if decision.plan is None:
            return
        self._draw(decision.plan)
        if decision.plan.done and not self.finished:
            self.get_logger().info("done: nothing that a robot could get to is left to be seen")
        self.finished = decision.plan.done

    def _send(self, order: Order) -> None:
        """A goal for one robot's nav2."""
        client = self.clients_of[order.name]
        if not client.server_is_ready():
            self.driver.forget(order.name, order.goal)
            self.get_logger().warning(f"{order.name}: nav2 is not there yet", throttle_duration_sec=10.0)
            return
        message = NavigateToPose.Goal()
        message.pose.header.frame_id = order.frame
        message.pose.header.stamp = self.get_clock().now().to_msg()
        fill_pose(message.pose.pose, *order.pose)
        client.send_goal_async(message).add_done_callback(partial(self._answered, order))

    def _answered(self, order: Order, future) -> None:
        handle = future.result()
        if not handle.accepted:
            self.driver.forget(order.name, order.goal)
        elif order.name not in self.driver.goals:  # it was cancelled in the meantime
            handle.cancel_goal_async()
        else:
            self.handles[order.name] = handle
            handle.get_result_async().add_done_callback(lambda _: self.driver.forget(order.name, order.goal))

    def _cancel(self, order: Order) -> None:
        """Stop a robot that has nothing to do any more, or is lost."""
        handle = self.handles.pop(order.name, None)
        if handle is not None:
            handle.cancel_goal_async()

    def _draw(self, plan) -> None:
        """Goals, ways and targets for RViz."""
        markers = [Marker(action=conversion.DELETE_ALL)]
        for number, (goal, way, active) in enumerate(zip(plan.goals, plan.ways, plan.active, strict=True)):
            if active:
                markers += [Marker(), Marker()]
                conversion.fill_way(markers[-2], Point, number, way)
                conversion.fill_goal(markers[-1], number, goal)
        markers.append(Marker())
        conversion.fill_targets(markers[-1], Point, plan.targets)
        for marker in markers:
            marker.header.frame_id = self.frame
            marker.header.stamp = self.get_clock().now().to_msg()
        self.markers.publish(MarkerArray(markers=markers))


def main() -> None:
    """The program `team`."""
    rclpy.init()
    node = TeamNode()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
