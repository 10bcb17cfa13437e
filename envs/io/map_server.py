"""Maps to files of ROS: yaml and pgm for map_server and nav2."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from PIL import Image

from maexp.envs.atomic_write import whole_file
from maexp.envs.io.grid import MAX_CELLS
from maexp.envs.maps.point_cloud import MapError, PointCloudMap


def export_ros_map(world: PointCloudMap, path: str | os.PathLike) -> Path:
    """Writes `path` (.yaml) and the image beside it (.pgm), one pixel a resolution; returns the yaml's path.

    Free pixels are 254, occupied ones 0, all others 205 (unknown), with map_server's usual thresholds.
    """
    path = Path(path)
    if path.suffix not in (".yaml", ".yml"):
        raise MapError(f"{path} must end in .yaml")
    cell = world.resolution
    points = np.concatenate([world.free[:, :2], world.obstacles[:, :2]]).astype(np.float64)
    low = points.min(axis=0) - 0.5 * cell
    shape = np.rint((points.max(axis=0) + 0.5 * cell - low) / cell).astype(int) + 1
    if shape.prod() > MAX_CELLS:
        raise MapError(f"{world.name} needs {shape[0]} x {shape[1]} pixels at {cell:g} m; at most {MAX_CELLS}")
    image = np.full(shape, 205, dtype=np.uint8)
    for cloud, spacing, value in (
        (world.free, world.free_spacing, 254),
        (world.obstacles, world.obstacle_spacing, 0),  # last: a pixel with any obstacle is occupied
    ):
        for width in np.unique(spacing):
            some = cloud[spacing == width, :2].astype(np.float64)
            reach = max(1, round(float(width) / cell))  # coarse points fill as many pixels as they stand for
            for dx in range(reach):
                for dy in range(reach):
                    shift = (np.array([dx, dy]) - (reach - 1) / 2) * cell
                    index = np.floor((some + shift - low) / cell + 1e-4).astype(int).clip(0, shape - 1)
                    image[index[:, 0], index[:, 1]] = value
    picture = path.with_suffix(".pgm")
    with whole_file(picture) as part:
        Image.fromarray(np.ascontiguousarray(image.T[::-1])).save(part, format="PPM")
    text = (
        f"image: {picture.name}\nresolution: {cell:.6g}\norigin: [{low[0]:.6f}, {low[1]:.6f}, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    with whole_file(path) as part:
        Path(part).write_text(text, encoding="utf-8")
    return path
