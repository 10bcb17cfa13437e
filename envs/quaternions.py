"""An angle about z as the quaternion of a ROS message, and back. Robots without PyYAML use it, too."""

import math


def read_yaw(turn) -> float:
    """Angle about z [rad] of a geometry_msgs/Quaternion; 0 where nobody filled it in."""
    return math.atan2(2 * (turn.w * turn.z + turn.x * turn.y), 1 - 2 * (turn.y**2 + turn.z**2))


def fill_turn(turn, yaw: float) -> None:
    """Writes an angle about z [rad] into a geometry_msgs/Quaternion."""
    turn.x, turn.y, turn.z, turn.w = 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)
