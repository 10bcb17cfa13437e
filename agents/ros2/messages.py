"""The messages of ROS 2 that are spoken here, as DDS types with the names that ROS 2 has on the wire.

`TABLE` is the one place that says what a message holds, in the words of ROS's own definitions: fields in their order.
The classes are made from it; a field that is not given has the value that ROS gives it (0, "", nothing, no turn).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from types import new_class
from typing import Any

from cyclonedds.idl import IdlStruct, types

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
}
"""Message -> its fields, each message after those that it is made of."""
PLAIN = {
    "int8": types.int8,
    "int32": types.int32,
    "uint32": types.uint32,
    "float32": types.float32,
    "float64": types.float64,
    "string": str,
}
FIRST = {"string": "", "float32": 0.0, "float64": 0.0}
ONE = {("geometry_msgs/msg/Quaternion", "w"): 1.0}


def wire_name(message: str) -> str:
    """std_msgs/msg/Header -> std_msgs::msg::dds_::Header_."""
    package, kind, name = message.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def _full(kind: str) -> str:
    return kind.replace("/", "/msg/")


def _make_classes() -> dict[str, type]:
    found: dict[str, type] = {}
    for message, text in TABLE.items():
        hints, defaults = {}, {}
        for one in text.split(", "):
            kind, name = one.split()
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
    count = size.removesuffix("]")
    if count:
        return types.array[hint, int(count)], field(default_factory=lambda: [FIRST.get(inner, 0)] * int(count))
    return types.sequence[hint], field(default_factory=list)


CLASSES = _make_classes()
