"""Writes rosbag2 recordings with `rosbags`: occupancy grids, point clouds and transforms."""

import math
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

STORE = get_typestore(Stores.ROS2_HUMBLE)
UPDATE = "map_msgs/msg/OccupancyGridUpdate"
UPDATE_TEXT = "std_msgs/Header header\nint32 x\nint32 y\nuint32 width\nuint32 height\nint8[] data"
STORE.register(get_types_from_msg(UPDATE_TEXT, UPDATE))
GRID, CLOUD, TF = "nav_msgs/msg/OccupancyGrid", "sensor_msgs/msg/PointCloud2", "tf2_msgs/msg/TFMessage"


def kind(name: str):
    return STORE.types[name]


def header(frame: str, time: float):
    stamp = kind("builtin_interfaces/msg/Time")(sec=int(time), nanosec=int((time % 1) * 1e9))
    return kind("std_msgs/msg/Header")(stamp=stamp, frame_id=frame)


def turn(yaw: float):
    return kind("geometry_msgs/msg/Quaternion")(x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2))


def grid(values: np.ndarray, cell: float, corner=(0.0, 0.0), yaw: float = 0.0, time: float = 0.0):
    """An OccupancyGrid of `values` [rows y, columns x]."""
    point = kind("geometry_msgs/msg/Point")(x=corner[0], y=corner[1], z=0.0)
    origin = kind("geometry_msgs/msg/Pose")(position=point, orientation=turn(yaw))
    info = kind("nav_msgs/msg/MapMetaData")(
        map_load_time=header("", time).stamp,
        resolution=cell,
        width=values.shape[1],
        height=values.shape[0],
        origin=origin,
    )
    return kind(GRID)(header=header("map", time), info=info, data=values.astype(np.int8).ravel())


def update(values: np.ndarray, x: int, y: int, time: float = 0.0):
    """An OccupancyGridUpdate of `values` [rows y, columns x] at column x and row y."""
    return kind(UPDATE)(
        header=header("map", time),
        x=x,
        y=y,
        width=values.shape[1],
        height=values.shape[0],
        data=values.astype(np.int8).ravel(),
    )


def cloud(points: np.ndarray, frame: str, time: float, real: str = "<f4"):
    """A PointCloud2 of x, y, z [count, 3] behind an intensity, as drivers write them."""
    field, code, size = kind("sensor_msgs/msg/PointField"), {"4": 7, "8": 8}[real[-1]], int(real[-1])
    names = ("intensity", "x", "y", "z")
    fields = [field(name=name, offset=i * size, datatype=code, count=1) for i, name in enumerate(names)]
    table = np.column_stack([np.ones(len(points)), points]).astype(real)
    data = np.frombuffer(table.tobytes(), dtype=np.uint8)
    return kind(CLOUD)(
        header=header(frame, time),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=real[0] == ">",
        point_step=4 * size,
        row_step=4 * size * len(points),
        data=data,
        is_dense=False,
    )


def transforms(entries: list[tuple[str, str, float, tuple[float, float, float], float]]):
    """A TFMessage of (parent, child, time [s], shift [m], yaw [rad])."""
    vector, transform = kind("geometry_msgs/msg/Vector3"), kind("geometry_msgs/msg/Transform")
    stamped = kind("geometry_msgs/msg/TransformStamped")
    return kind(TF)(
        transforms=[
            stamped(
                header=header(parent, time),
                child_frame_id=child,
                transform=transform(translation=vector(x=shift[0], y=shift[1], z=shift[2]), rotation=turn(yaw)),
            )
            for parent, child, time, shift, yaw in entries
        ]
    )


def write_bag(path: Path, messages: list[tuple[str, float, object]], storage: str = "mcap") -> Path:
    """A rosbag2 folder of (topic, time [s], message); returns it."""
    with Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()]) as bag:
        connections = {}
        for topic, time, message in messages:
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, message.__msgtype__, typestore=STORE)
            raw = STORE.serialize_cdr(message, message.__msgtype__)
            bag.write(connections[topic], int(time * 1e9), raw)
    return path
