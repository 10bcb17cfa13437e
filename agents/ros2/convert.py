"""From arrays and numbers to the messages that are sent."""

from __future__ import annotations

import math

import numpy as np

from maexp.agents.irsim.floor import FloorCells
from maexp.agents.ros2.ros_types import CLASSES
from maexp.agents.runtime.frames import NOWHERE, OccupancyGrid, Pose, fill_grid, fill_pose
from maexp.envs.quaternions import fill_turn

SECOND = 10**9
BEAMS = 360
STEP = 0.1  # cells between two looks along a beam
TRANSFORM = CLASSES["geometry_msgs/msg/TransformStamped"]


def fill_header(header, frame: str, now: int) -> None:
    """Frame and time [ns]."""
    header.frame_id = frame
    fill_time(header.stamp, now)


def fill_time(stamp, now: int) -> None:
    """Time [ns] into a builtin_interfaces/Time."""
    stamp.sec, stamp.nanosec = divmod(now, SECOND)


def read_nanoseconds(stamp) -> int:
    """Of a builtin_interfaces/Time, exactly."""
    return stamp.sec * SECOND + stamp.nanosec


def transform(parent: str, child: str, now: int, pose: Pose = NOWHERE):
    """A geometry_msgs/TransformStamped."""
    made = TRANSFORM()
    fill_header(made.header, parent, now)
    made.child_frame_id = child
    made.transform.translation.x, made.transform.translation.y = float(pose[0]), float(pose[1])
    fill_turn(made.transform.rotation, pose[2])
    return made


def fill_map(message, frame: str, now: int, values: np.ndarray, resolution: float, origin: tuple) -> None:
    """A nav_msgs/OccupancyGrid of int8 [H, W]."""
    fill_grid(message, frame, OccupancyGrid(values, resolution, (*origin, 0.0)[:3]))
    fill_time(message.header.stamp, now)
    message.info.map_load_time = message.header.stamp


def fill_odometry(message, frames: tuple[str, str], now: int, pose: Pose, velocity: tuple[float, float]) -> None:
    """A nav_msgs/Odometry; the velocity [m/s] is that of the frame of the pose, and goes out in the robot's own."""
    fill_header(message.header, frames[0], now)
    message.child_frame_id = frames[1]
    fill_pose(message.pose.pose, *pose)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    speed = message.twist.twist.linear
    speed.x, speed.y = float(c * velocity[0] + s * velocity[1]), float(c * velocity[1] - s * velocity[0])


def fill_scan(message, frame: str, now: int, ranges: np.ndarray, reach: float) -> None:
    """A sensor_msgs/LaserScan of beams all around, from straight behind on."""
    fill_header(message.header, frame, now)
    message.angle_min, message.angle_increment = -math.pi, 2.0 * math.pi / len(ranges)
    message.angle_max = message.angle_min + message.angle_increment * (len(ranges) - 1)
    message.range_min, message.range_max = 0.0, reach
    message.ranges = ranges.tolist()


def look(floor: FloorCells, pose: Pose, reach: float, beams: int = BEAMS) -> np.ndarray:
    """How far each beam is free, float [beams] [m]; infinite where it meets nothing within `reach`."""
    angles = pose[2] - math.pi + 2.0 * math.pi / beams * np.arange(beams)
    far = np.arange(0.0, reach, STEP * floor.cell)
    points = np.array(pose[:2]) + np.stack([np.cos(angles), np.sin(angles)], -1)[:, None] * far[:, None]
    cells = floor.index(points)
    solid = ~floor.free[cells[..., 0], cells[..., 1]]
    return np.where(solid.any(1), far[solid.argmax(1)], np.inf)
