"""What the node of a robot or the base station tells others, and hears. All thinking is in maexp.agents.runtime."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from nav_msgs.msg import OccupancyGrid
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.time import Time
from std_msgs.msg import String

from maexp.agents.deploy.planner.drivers import RadioDriver, map_topic
from maexp.agents.deploy.planner.frames import fill_grid
from maexp.agents.deploy.planner.messages import write_word


class Mates:
    """Topics /NAME/maexp/... of all robots of a team, and of the base station."""

    def __init__(self, node: Node, driver: RadioDriver, latched: QoSProfile):
        self.node, self.driver = node, driver
        for name in driver.speakers:
            topic = f"/{name}/maexp/word"
            take = partial(self._take, topic, lambda message, name=name: driver.take_word(name, message.data))
            node.create_subscription(String, topic, take, QoSProfile(depth=1))
        for topic, source in driver.map_topics().items():
            take = partial(self._take, topic, partial(driver.take_known, source))
            node.create_subscription(OccupancyGrid, topic, take, latched)
        self.maps = {
            name: node.create_publisher(OccupancyGrid, map_topic(driver.name, name), latched)
            for name in (driver.name, *driver.mates)
        }
        self.known = node.create_publisher(OccupancyGrid, f"/{driver.name}/maexp/known", latched)
        self.word = node.create_publisher(String, f"/{driver.name}/maexp/word", QoSProfile(depth=1))

    def _take(self, topic: str, take: Callable, message) -> None:
        try:
            take(message)
        except ValueError as error:
            self.node.get_logger().warning(f"{topic}: {error}", throttle_duration_sec=10.0)

    def tell(self, now) -> None:
        """What it has seen and heard, and where it is, at a rclpy.time.Time; to who looks on, all that in one map.

        Raises:
            ValueError: where its map lies in the team's frame is not known.
        """
        seconds = now.nanoseconds * 1e-9
        own, word = self.driver.tell_own(seconds), self.driver.word(seconds)
        if own is not None:
            self._publish(self.maps[self.driver.name], Time(nanoseconds=round(own[0] * 1e9)), own[1])
        if self.known.get_subscription_count() and (known := self.driver.known([])) is not None:
            self._publish(self.known, now, known)
        for source, message in self.driver.pass_on(seconds).items():
            self.maps[source].publish(message)
        if word is not None:
            self.word.publish(String(data=write_word(word)))

    def _publish(self, publisher: Publisher, time: Time, grid) -> None:
        message = OccupancyGrid()
        fill_grid(message, self.driver.settings.global_frame, grid)
        message.header.stamp = time.to_msg()
        publisher.publish(message)
