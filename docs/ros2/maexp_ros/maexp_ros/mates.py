"""What the node of one robot tells its mates, and hears of them. All thinking is in maexp.agents.runtime."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from nav_msgs.msg import OccupancyGrid
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import String

from maexp.agents.runtime.frames import fill_grid
from maexp.agents.runtime.robot_driver import RobotDriver
from maexp.agents.runtime.words import write_word


class Mates:
    """Topics /NAME/maexp/map and /NAME/maexp/word of all robots of a team."""

    def __init__(self, node: Node, driver: RobotDriver, latched: QoSProfile):
        self.node, self.driver = node, driver
        for name in driver.mates:
            map_topic, word_topic = f"/{name}/maexp/map", f"/{name}/maexp/word"
            take = partial(self._take, map_topic, partial(driver.take_known, name))
            node.create_subscription(OccupancyGrid, map_topic, take, latched)
            take = partial(self._take, word_topic, lambda message, name=name: driver.take_word(name, message.data))
            node.create_subscription(String, word_topic, take, QoSProfile(depth=1))
        self.map = node.create_publisher(OccupancyGrid, f"/{driver.name}/maexp/map", latched)
        self.word = node.create_publisher(String, f"/{driver.name}/maexp/word", QoSProfile(depth=1))

    def _take(self, topic: str, take: Callable, message) -> None:
        try:
            take(message)
        except ValueError as error:
            self.node.get_logger().warning(f"{topic}: {error}", throttle_duration_sec=10.0)

    def tell(self, now) -> None:
        """What this robot knows and where it is, at a rclpy.time.Time.

        Raises:
            ValueError: where its map lies in the team's frame is not known.
        """
        known, word = self.driver.known([]), self.driver.word(now.nanoseconds * 1e-9)
        if known is not None:
            message = OccupancyGrid()
            fill_grid(message, self.driver.settings.global_frame, known)
            message.header.stamp = now.to_msg()
            self.map.publish(message)
        if word is not None:
            self.word.publish(String(data=write_word(word)))
