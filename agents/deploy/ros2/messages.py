"""ROS 2 messages as DDS types, and the conversion from arrays and numbers to them."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass, field
from types import new_class
from typing import Any

import numpy as np
from cyclonedds.idl import IdlStruct, types

from maexp.agents.deploy.irsim.simulator import FloorCells
from maexp.agents.deploy.planner.frames import NOWHERE, OccupancyGrid, Pose, fill_grid, fill_pose
from maexp.envs.quaternions import fill_turn

NAVIGATE = "nav2_msgs/action/NavigateToPose"
TABLE = {
    "builtin_interfaces/msg/Time": "int32 sec, uint32 nanosec",
    "rosgraph_msgs/msg/Clock": "builtin_interfaces/Time clock",
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp, string frame_id",
    "std_msgs/msg/String": "string data",
    "geometry_msgs/msg/Vector3": "float64 x, float64 y, float64 z",
    "geometry_msgs/msg/Point": "float64 x, float64 y, float64 z",
    "geometry_msgs/msg/Quaternion": "float64 x, float64 y, float64 z, float64 w",
    "geometry_msgs/msg/Pose": "geometry_msgs/Point position, geometry_msgs/Quaternion orientation",
    "geometry_msgs/msg/PoseStamped": "std_msgs/Header header, geometry_msgs/Pose pose",
    "geometry_msgs/msg/PoseWithCovariance": "geometry_msgs/Pose pose, float64[36] covariance",
    "geometry_msgs/msg/Twist": "geometry_msgs/Vector3 linear, geometry_msgs/Vector3 angular",
    "geometry_msgs/msg/TwistWithCovariance": "geometry_msgs/Twist twist, float64[36] covariance",
    "geometry_msgs/msg/Transform": "geometry_msgs/Vector3 translation, geometry_msgs/Quaternion rotation",
    "geometry_msgs/msg/TransformStamped": "std_msgs/Header header, string child_frame_id, "
    "geometry_msgs/Transform transform",
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "nav_msgs/msg/MapMetaData": "builtin_interfaces/Time map_load_time, float32 resolution, uint32 width, "
    "uint32 height, geometry_msgs/Pose origin",
    "nav_msgs/msg/OccupancyGrid": "std_msgs/Header header, nav_msgs/MapMetaData info, int8[] data",
    "map_msgs/msg/OccupancyGridUpdate": "std_msgs/Header header, int32 x, int32 y, uint32 width, uint32 height, "
    "int8[] data",
    "nav_msgs/msg/Odometry": "std_msgs/Header header, string child_frame_id, geometry_msgs/PoseWithCovariance pose, "
    "geometry_msgs/TwistWithCovariance twist",
    "sensor_msgs/msg/LaserScan": "std_msgs/Header header, float32 angle_min, float32 angle_max, "
    "float32 angle_increment, float32 time_increment, float32 scan_time, float32 range_min, float32 range_max, "
    "float32[] ranges, float32[] intensities",
    "builtin_interfaces/msg/Duration": "int32 sec, uint32 nanosec",
    "unique_identifier_msgs/msg/UUID": "uint8[16] uuid",
    "action_msgs/msg/GoalInfo": "unique_identifier_msgs/UUID goal_id, builtin_interfaces/Time stamp",
    "action_msgs/msg/GoalStatus": "action_msgs/GoalInfo goal_info, int8 status",
    "action_msgs/msg/GoalStatusArray": "action_msgs/GoalStatus[] status_list",
    "action_msgs/srv/CancelGoal_Request": "action_msgs/GoalInfo goal_info",
    "action_msgs/srv/CancelGoal_Response": "int8 return_code, action_msgs/GoalInfo[] goals_canceling",
    f"{NAVIGATE}_Goal": "geometry_msgs/PoseStamped pose, string behavior_tree",
    f"{NAVIGATE}_Result": "uint16 error_code, string error_msg",
    f"{NAVIGATE}_Feedback": "geometry_msgs/PoseStamped current_pose, builtin_interfaces/Duration navigation_time, "
    "builtin_interfaces/Duration estimated_time_remaining, int16 number_of_recoveries, float32 distance_remaining, "
    "float32 position_tracking_error, float32 heading_tracking_error",
    f"{NAVIGATE}_SendGoal_Request": f"unique_identifier_msgs/UUID goal_id, {NAVIGATE}_Goal goal",
    f"{NAVIGATE}_SendGoal_Response": "bool accepted, builtin_interfaces/Time stamp",
    f"{NAVIGATE}_GetResult_Request": "unique_identifier_msgs/UUID goal_id",
    f"{NAVIGATE}_GetResult_Response": f"int8 status, {NAVIGATE}_Result result",
    f"{NAVIGATE}_FeedbackMessage": f"unique_identifier_msgs/UUID goal_id, {NAVIGATE}_Feedback feedback",
}
"""Message -> its fields, each message after those that it is made of.

The result and the feedback of `NavigateToPose` have grown at their ends with the releases of nav2. Here they are as in
the newest: who has an older definition reads the part that it knows.
"""
HEADER = "uint64 guid, int64 seq, "
"""What `rmw_cyclonedds` puts before requests and responses: who asks, and the number of the question."""
PLAIN = {
    "bool": bool,
    "int8": types.int8,
    "uint8": types.uint8,
    "int16": types.int16,
    "uint16": types.uint16,
    "int32": types.int32,
    "uint32": types.uint32,
    "int64": types.int64,
    "uint64": types.uint64,
    "float32": types.float32,
    "float64": types.float64,
    "string": str,
}
FIRST = {"bool": False, "string": "", "float32": 0.0, "float64": 0.0}
ONE = {("geometry_msgs/msg/Quaternion", "w"): 1.0}


def wire_name(message: str) -> str:
    """std_msgs/msg/Header -> std_msgs::msg::dds_::Header_."""
    package, kind, name = message.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def _full(kind: str) -> str:
    return kind if kind.count("/") == 2 else kind.replace("/", "/msg/")


def _make_classes() -> dict[str, type]:
    found: dict[str, type] = {}
    for message, text in TABLE.items():
        hints, defaults = {}, {}
        before = HEADER if message.endswith(("_Request", "_Response")) else ""
        for part in f"{before}{text}".split(", "):
            kind, name = part.split()
            hints[name], defaults[name] = _read_field(found, kind, ONE.get((message, name)))
        words = {"typename": wire_name(message).replace("::", ".")}
        made = new_class(
            message.rpartition("/")[2],
            (IdlStruct,),
            words,
            lambda body, h=hints, d=defaults: body.update(__annotations__=h, __module__=__name__, **d),
        )
        found[message] = dataclass(made)
    return found


def _read_field(found: dict[str, type], kind: str, default: Any) -> tuple[Any, Any]:
    """Type and default of a field."""
    inner, bracket, size = kind.partition("[")
    hint = PLAIN.get(inner) or found[_full(inner)]
    if not bracket:
        simple = inner in PLAIN
        return hint, field(default=FIRST.get(inner, 0) if default is None else default) if simple else field(
            default_factory=hint
        )
    if count := size.removesuffix("]"):
        first = bytes(int(count)) if inner == "uint8" else [FIRST.get(inner, 0)] * int(count)
        return types.array[hint, int(count)], field(default_factory=lambda: copy(first))
    return types.sequence[hint], field(default_factory=list)


CLASSES = _make_classes()


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
