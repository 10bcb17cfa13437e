"""The node: grids and poses in, goals for nav2 out. All thinking is in maexp.agents.runtime."""

from __future__ import annotations

from functools import partial

import numpy as np
import rclpy
from geometry_msgs.msg import Point
from nav2_msgs.action import NavigateToPose
from nav_msgs.msg import OccupancyGrid
from rclpy.action import ActionClient
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from tf2_ros import Buffer, TransformException, TransformListener
from visualization_msgs.msg import Marker, MarkerArray

from maexp.agents.runtime import TeamPlanner

from . import conversion

PARAMETERS = {
    "robots": ["robot1"], "policy": "cost_utility", "map_topics": ["/map"], "global_frame": "map",
    "base_frame": "base_link", "action": "navigate_to_pose", "period": 2.0, "radar_range": 5.0, "robot_radius": 0.3,
    "occupied": 65.0, "bounded": False, "pose_age": 2.0, "goal_change": 0.5,
}  # fmt: skip
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class TeamNode(Node):
    """One node for the whole team; its parameters are those of config/team.yaml."""

    def __init__(self):
        super().__init__("team")
        for name, default in PARAMETERS.items():
            self.declare_parameter(name, default)
        self.robots = list(self._get("robots"))
        self.frame = self._get("global_frame")
        self.planner = TeamPlanner(
            self._get("policy"), radar_range=self._get("radar_range"), robot_radius=self._get("robot_radius"),
            occupied=self._get("occupied"), bounded=self._get("bounded"),
        )  # fmt: skip
        self.grids: dict[str, OccupancyGrid] = {}
        for topic in self._get("map_topics"):
            self.create_subscription(OccupancyGrid, topic, partial(self.grids.__setitem__, topic), LATCHED)
        self.buffer = Buffer()
        self.listener = TransformListener(self.buffer, self)
        action = self._get("action")
        self.clients_of = {name: ActionClient(self, NavigateToPose, f"/{name}/{action}") for name in self.robots}
        self.goals: dict[str, np.ndarray] = {}  # that nav2 is driving to
        self.markers = self.create_publisher(MarkerArray, "~/markers", 1)
        self.finished = False
        self.create_timer(self._get("period"), self.decide)

    def _get(self, name: str):
        return self.get_parameter(name).value

    def decide(self) -> None:
        """Plan for all and send each robot its goal, where that has changed."""
        grid = self._grid()
        if grid is None:
            return
        poses = {name: self._look_up(f"{name}/{self._get('base_frame')}") for name in self.robots}
        seconds = self.get_clock().now().nanoseconds * 1e-9
        try:
            plan = self.planner.plan(grid.values, grid.resolution, grid.origin, poses, now=seconds)
        except ValueError as error:
            self.get_logger().error(f"no plan: {error}")
            return
        for note in plan.notes:
            self.get_logger().info(note, throttle_duration_sec=10.0)
        for name, goal, way, active, waits in zip(
            plan.names, plan.goals, plan.ways, plan.active, plan.waits, strict=True
        ):
            if active or (waits and name in self.goals):  # who waits is to stop where it is
                self._send(name, goal, way)
        self._draw(plan)
        if plan.done and not self.finished:
            self.get_logger().info("done: nothing that a robot could get to is left to be seen")
        self.finished = plan.done

    def _grid(self) -> conversion.Grid | None:
        """The team's grid in the global frame; None until there is one."""
        placed = []
        for message in self.grids.values():
            pose = self._look_up(message.header.frame_id, still=True)
            if pose is not None:
                placed.append(conversion.place_grid(conversion.read_grid(message), pose))
        return conversion.merge_grids(placed) if placed else None

    def _look_up(self, frame: str, still: bool = False) -> tuple[float, float, float] | None:
        """Where a frame is in the global one; None where tf does not know, or has not for `pose_age`."""
        if frame == self.frame:
            return 0.0, 0.0, 0.0
        try:
            found = self.buffer.lookup_transform(self.frame, frame, Time())
        except TransformException as error:
            self.get_logger().warning(f"{frame}: {error}", throttle_duration_sec=10.0)
            return None
        age = self.get_clock().now() - Time.from_msg(found.header.stamp)
        if not still and age > Duration(seconds=self._get("pose_age")):
            self.get_logger().warning(f"{frame}: its pose is too old", throttle_duration_sec=10.0)
            return None
        return conversion.read_pose(found.transform)

    def _send(self, name: str, goal: np.ndarray, way: np.ndarray) -> None:
        """A goal for one robot's nav2, unless it drives there already."""
        last = self.goals.get(name)
        if last is not None and np.linalg.norm(last - goal) < self._get("goal_change"):
            return
        if not self.clients_of[name].server_is_ready():
            self.get_logger().warning(f"{name}: nav2 is not there yet", throttle_duration_sec=10.0)
            return
        message = NavigateToPose.Goal()
        message.pose.header.frame_id = self.frame
        message.pose.header.stamp = self.get_clock().now().to_msg()
        conversion.fill_pose(message.pose.pose, goal[0], goal[1], conversion.heading_of(way))
        self.goals[name] = goal.copy()
        self.clients_of[name].send_goal_async(message).add_done_callback(partial(self._answered, name, goal))

    def _answered(self, name: str, goal: np.ndarray, future) -> None:
        handle = future.result()
        if handle.accepted:
            handle.get_result_async().add_done_callback(lambda _: self._forget(name, goal))
        else:
            self._forget(name, goal)

    def _forget(self, name: str, goal: np.ndarray) -> None:
        """Reached, given up or refused: the next decision may send the same goal again."""
        if np.array_equal(self.goals.get(name), goal):
            del self.goals[name]

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
