"""The messages of ROS 2 that are spoken here, as DDS types with the names that ROS 2 has on the wire.

`TABLE` is the one place that says what a message holds, in the words of ROS's own definitions: fields in their order.
The classes are made from it; a field that is not given has the value that ROS gives it (0, "", nothing, no turn).
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field
from types import new_class
from typing import Any

from cyclonedds.idl import IdlStruct, types

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
