"""Recordings of ROS: the last occupancy grid of a bag, or its point clouds registered by tf. Needs `rosbags`."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from maexp.envs.io.cloud_files import Cloud, float32_step
from maexp.envs.io.grid import FREE, OBSTACLE, Grid
from maexp.envs.io.levelling import thin
from maexp.envs.io.options import ImportOptions
from maexp.envs.io.report import ImportReport, ScannedImage
from maexp.envs.io.ros_messages import TfTree, to_grid, to_points
from maexp.envs.maps.point_cloud import MAX_POINTS, MapError, check_file

BAGS = (".mcap", ".db3")
UPDATE = "map_msgs/msg/OccupancyGridUpdate"
UPDATE_TEXT = "std_msgs/Header header\nint32 x\nint32 y\nuint32 width\nuint32 height\nint8[] data"
GRID, CLOUD, TF = "nav_msgs/msg/OccupancyGrid", "sensor_msgs/msg/PointCloud2", "tf2_msgs/msg/TFMessage"
VOXEL = 0.02  # [m]; scans are thinned to this as they come, or a minute of a lidar would fill the memory
GREY = np.array([205, 254, 0], dtype=np.uint8)  # of unknown, free and obstacle in map_server's images


def is_bag(path: Path) -> bool:
    """Whether this is a bag: a file of one, or a folder that rosbag2 wrote."""
    try:
        return path.suffix.lower() in BAGS or (path / "metadata.yaml").is_file()
    except OSError:  # a name too long: not ours to refuse
        return False


def read_bag(path: Path, options: ImportOptions, report: ImportReport) -> Grid | Cloud:
    """The map that a bag holds: see `ImportOptions.topic` for which.

    Raises:
        MapError: it cannot be read, holds neither kind of message, or several topics would do.
    """
    _check_readable(path)
    with _opened(path) as bag:
        chosen = _choose_topic(path, bag, options)
        if chosen.msgtype == GRID:
            return _last_grid(path, bag, chosen, options, report)
        return _all_clouds(path, bag, chosen, options, report)


def _check_readable(path: Path) -> None:
    """A bag may be larger than the memory: it is read message by message."""
    parts = sorted(path.iterdir()) if path.is_dir() else [path]
    for part in parts:
        if part.suffix.lower() in BAGS or part.name == "metadata.yaml" or part == path:
            check_file(part, most=None)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """rosbags' reader; whatever it raises on damaged files becomes a sentence."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        command = 'pip install "maexp[rosbag]"'
        raise MapError(f"{path} needs the package rosbags, which is not installed; {command}") from error
    try:  # bags before ROS 2 Iron do not hold the definitions of their messages
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
            sent = any(connection.msgtype == UPDATE for connection in bag.connections)
            if sent and UPDATE not in bag.typestore.fielddefs:  # neither in bags before Iron nor in the store
                bag.typestore.register(get_types_from_msg(UPDATE_TEXT, UPDATE))
            yield bag
    except MapError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split())[:300] or type(error).__name__
        advice = "it may be damaged: ros2 bag reindex may help"
        raise MapError(f"{path} cannot be read as a bag ({reason}); {advice}") from error


def _choose_topic(path: Path, bag, options: ImportOptions):
    """The connection to read: the one asked for, the only grid, or else the only cloud."""
    held = {connection.topic: connection for connection in bag.connections if connection.msgcount}
    usable = {topic: connection for topic, connection in held.items() if connection.msgtype in (GRID, CLOUD)}
    if options.topic is not None:
        wanted = usable.get(options.topic) or usable.get(f"/{options.topic}")
        if wanted is None:
            raise MapError(f"importing.topic={options.topic!r} of {path} holds no map; {_list(usable) or _list(held)}")
        return wanted
    grids = [connection for connection in usable.values() if connection.msgtype == GRID]
    for kind in (grids, list(usable.values())):
        if len(kind) == 1:
            return kind[0]
        if kind:
            named = {connection.topic: connection for connection in kind}
            raise MapError(
                f"{path} has {len(kind)} topics that could be the map; choose one with topic=NAME (on the command line "
                f"importing.topic=NAME); {_list(named)}"
            )
    raise MapError(f"{path} holds no {GRID} and no {CLOUD}; {_list(held) or 'it holds no messages'}")


def _list(connections: dict) -> str:
    told = [
        f"{topic} ({connection.msgcount} x {connection.msgtype})" for topic, connection in sorted(connections.items())
    ]
    return f"it has {', '.join(told[:20])}{' ...' if len(told) > 20 else ''}" if told else ""


def _messages(bag, connections: list) -> Iterator[Any]:
    if not connections:  # which rosbags takes for all of them
        return
    for connection, _, raw in bag.messages(connections=connections):
        yield bag.deserialize(raw, connection.msgtype)


def _last_grid(path: Path, bag, chosen, options: ImportOptions, report: ImportReport) -> Grid:
    last = deque(((time, raw) for _, time, raw in bag.messages(connections=[chosen])), maxlen=1)
    if not last:
        raise MapError(f"{path} promises messages on {chosen.topic} and holds none; record it again")
    time, raw = last[0]
    message = _updated(bag, bag.deserialize(raw, chosen.msgtype), time, chosen.topic, report)
    grid = to_grid(path, message, options, report)
    report.before = ScannedImage(GREY[grid.labels].T[::-1], grid.cell, grid.origin)
    report.add(
        "read",
        f"the last of {chosen.msgcount} grids on {chosen.topic}: {grid.labels.shape[0]} x {grid.labels.shape[1]} cells "
        f"of {grid.cell:g} m; {grid.count(FREE):,} free, {grid.count(OBSTACLE):,} occupied",
        after=grid.labels.size,
    )
    return grid


def _updated(bag, message, since: int, topic: str, report: ImportReport):
    """The last grid with the parts that were sent after it at `since` [ns] (``map_msgs/OccupancyGridUpdate``)."""
    offered = [connection for connection in bag.connections if connection.msgtype == UPDATE and connection.msgcount]
    wanted = [connection for connection in offered if connection.topic == f"{topic}_updates"]
    grids = {connection.topic for connection in bag.connections if connection.msgtype == GRID}
    if not wanted and len(grids) == 1 and len({connection.topic for connection in offered}) == 1:
        wanted = offered  # under another name, yet nothing else can be meant
    if not wanted:
        if offered:
            told = ", ".join(sorted({connection.topic for connection in offered}))
            report.warn(f"updates of grids on {told} were not applied: those of {topic} come on {topic}_updates")
        return message
    width, height = int(message.info.width), int(message.info.height)
    if width * height != len(message.data):
        return message  # which is refused
    cells = np.array(message.data, dtype=np.int8).reshape(height, width)
    applied = outside = 0
    for _, _, raw in bag.messages(connections=wanted, start=since):
        part = bag.deserialize(raw, UPDATE)
        x, y, wide, high = int(part.x), int(part.y), int(part.width), int(part.height)
        if x < 0 or y < 0 or x + wide > width or y + high > height or wide * high != len(part.data):
            outside += 1
            continue
        cells[y : y + high, x : x + wide] = np.asarray(part.data, dtype=np.int8).reshape(high, wide)
        applied += 1
    if outside:
        report.warn(f"{outside} updates on {wanted[0].topic} do not fit the last grid and were left out")
    if applied:
        report.add("updates", f"{applied} parts sent on {wanted[0].topic} after the last grid", after=applied)
    message.data = cells.ravel()
    return message


def _all_clouds(path: Path, bag, chosen, options: ImportOptions, report: ImportReport) -> Cloud:
    """Every cloud of a topic, in the frame that tf calls fixed, one point a voxel."""
    tree = TfTree()
    for message in _messages(bag, [connection for connection in bag.connections if connection.msgtype == TF]):
        tree.add(message)
    voxel = min(options.voxel or VOXEL, VOXEL)
    kept, added, count, lost, frame, step = np.empty((0, 3)), [], 0, 0, "", 0.0
    for message in _messages(bag, [chosen]):
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        placed = tree.find(message.header.frame_id, stamp)
        count += 1
        if placed is None:
            lost += 1
            continue
        frame, rotation, translation = placed
        points = to_points(path, message)
        step = max(step, float32_step(points))
        points = points[np.isfinite(points).all(axis=1)] @ rotation.T + translation
        if len(points):
            added.append(points[thin(points, voxel)])
        if sum(map(len, added)) > len(kept) + 1_000_000:
            kept, added = _joined(path, kept, added, voxel), []
    kept = _joined(path, kept, added, voxel)
    if not len(kept):
        raise MapError(
            f"{path}: of {count} clouds on {chosen.topic} {lost} had no transform at their time and the others no "
            "points; record /tf and /tf_static, too"
        )
    if lost:
        report.warn(f"{lost} of {count} clouds had no transform at their time and were left out")
    if count > 1 and not tree.moves:
        report.warn(f"no transform in the bag moves {frame}: the {count} clouds were laid over each other as they are")
    told = f"{count - lost} clouds of {chosen.topic} in the frame {frame}, {voxel:g} m voxels"
    report.add("register", told, after=len(kept))
    return Cloud(kept, metres_per_unit=1.0, up="z", step=step)


def _joined(path: Path, kept: np.ndarray, added: list[np.ndarray], voxel: float) -> np.ndarray:
    points = np.concatenate([kept, *added])
    points = points[thin(points, voxel)] if len(points) else points
    if len(points) > MAX_POINTS:
        raise MapError(f"{path} gives more than {MAX_POINTS} points at voxels of {voxel:g} m; cut the bag")
    return points


def bag_name(path: Path) -> str:
    """What the map of a bag is called."""
    return os.path.basename(os.path.abspath(path)) if path.is_dir() else path.stem
