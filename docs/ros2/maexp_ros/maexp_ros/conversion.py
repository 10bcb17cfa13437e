"""What RViz shows; imports nothing of ROS, so that it can be tested without."""

from __future__ import annotations

import numpy as np

from maexp.agents.deploy.planner.frames import fill_pose

COLOURS = ((0.84, 0.37, 0.0), (0.42, 0.12, 0.59), (0.84, 0.2, 0.51), (0.0, 0.24, 0.55), (0.0, 0.35, 0.24))
SPHERE, LINE_STRIP, SPHERE_LIST = 2, 4, 7  # of visualization_msgs/Marker
ADD, DELETE_ALL = 0, 3


def fill_way(marker, point, number: int, way: np.ndarray) -> None:
    """A way [k, 2] as a line of robot `number` in a visualization_msgs/Marker; `point` makes a geometry_msgs/Point."""
    _fill_marker(marker, "ways", number, LINE_STRIP, 0.05)
    marker.points = [point(x=float(x), y=float(y), z=0.05) for x, y in way]


def fill_goal(marker, number: int, goal: np.ndarray) -> None:
    """A goal [2] as a ball."""
    _fill_marker(marker, "goals", number, SPHERE, 0.3)
    fill_pose(marker.pose, goal[0], goal[1], 0.0)


def fill_targets(marker, point, targets: np.ndarray) -> None:
    """All places that were chosen from, [K, 2], as small balls."""
    _fill_marker(marker, "targets", 0, SPHERE_LIST, 0.12)
    marker.color.r, marker.color.g, marker.color.b = 0.5, 0.5, 0.5
    marker.points = [point(x=float(x), y=float(y), z=0.05) for x, y in targets]


def _fill_marker(marker, group: str, number: int, kind: int, size: float) -> None:
    marker.ns, marker.id, marker.type, marker.action = group, number, kind, ADD
    marker.scale.x = marker.scale.y = marker.scale.z = size
    marker.pose.orientation.w = 1.0
    colour = COLOURS[number % len(COLOURS)]
    marker.color.r, marker.color.g, marker.color.b, marker.color.a = *colour, 0.9
