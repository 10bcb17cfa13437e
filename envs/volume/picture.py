"""A picture of a map of voxels as PNG: a view from above one corner with the roof off, and cuts at four heights."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from scipy import ndimage

from maexp.envs.atomic_write import whole_file
from maexp.envs.maps.plot import COLORS
from maexp.envs.volume.map import VoxelMap

CUTS = 4
VIEW_PIXELS = 900  # along the longer side of the view
MOST_SAMPLES = 6_000_000  # points that are painted
SHADES = (1.0, 0.78, 0.6)  # of faces that look up, along +x, along +y
TILT = 0.5  # of a horizontal step, drawn upwards


def draw_volume(world: VoxelMap, path: str | os.PathLike, before=None) -> Path:
    """Writes the picture of `world`; returns its path.

    Args:
        before: paints what the file held into a figure of matplotlib, beside the map; None: the map alone.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # late: slow to import
    from matplotlib.figure import Figure

    figure = Figure(figsize=(16 if before is None else 21, 8), dpi=90, layout="constrained")
    if before is None:
        after = figure
    else:
        left, after = figure.subfigures(1, 2, width_ratios=(5, 16))
        before(left)
    view, cuts = after.subfigures(1, 2)
    axes = view.add_subplot()
    axes.imshow(paint_view(world), interpolation="nearest")
    axes.set_axis_off()
    nx, ny, nz = world.shape
    size = " x ".join(f"{count * world.resolution:.1f}" for count in world.shape)
    axes.set_title(
        f"{world.name}: {size} m, {nx} x {ny} x {nz} voxels of {world.resolution:g} m\n"
        f"{world.free_volume:,.0f} m³ free, "
        f"{np.count_nonzero(world.free):,} free and {np.count_nonzero(world.occupied):,} occupied voxels; roof off",
        fontsize=9,
    )
    for panel, layer in zip(cuts.subplots(2, 2).flat, cut_layers(world), strict=True):
        _paint_cut(panel, world, layer)
    with whole_file(Path(path)) as part:
        FigureCanvasAgg(figure).print_png(part)
    return Path(path)


def cut_layers(world: VoxelMap) -> list[int]:
    """Layers of the cuts, evenly over those that hold free voxels."""
    layers = np.flatnonzero(world.free.any(axis=(0, 1)))
    shares = (np.arange(CUTS) + 0.5) / CUTS
    return [int(layers[min(len(layers) - 1, int(share * len(layers)))]) for share in shares]


def _paint_cut(axes, world: VoxelMap, layer: int) -> None:
    """One layer from above: x to the right, y up."""
    image = np.full((*world.shape[:2], 3), COLORS["outside"], dtype=np.uint8)
    image[world.free[:, :, layer]] = COLORS["free"]
    image[world.occupied[:, :, layer]] = COLORS["boundary"]
    (x0, y0, z0), (x1, y1, _) = world.extent
    axes.imshow(image.transpose(1, 0, 2), origin="lower", extent=(x0, x1, y0, y1), interpolation="nearest")
    axes.set_title(f"z = {z0 + (layer + 0.5) * world.resolution:.2f} m", fontsize=9)
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")


def paint_view(world: VoxelMap) -> np.ndarray:
    """Occupied voxels seen from above the corner of large x and y, coloured by height; uint8 [rows, columns, 3].

    Of each column only what lies below the highest free voxel around is drawn, so that roofs hide nothing.
    """
    from matplotlib import colormaps

    points, depth, shade, height = _sample_faces(world)
    nx, ny, nz = world.shape
    right, down = points[:, 1] - points[:, 0], TILT * (points[:, 0] + points[:, 1]) - points[:, 2]
    low, high = np.array([-nx, -nz], float), np.array([ny, TILT * (nx + ny)], float)
    scale = VIEW_PIXELS / (high - low).max()
    columns, rows = np.ceil((high - low) * scale).astype(int) + 1
    colours = colormaps["viridis"](0.1 + 0.85 * height / max(nz, 1))[:, :3] * shade[:, None] * 255
    image = np.full((rows, columns, 3), COLORS["outside"], dtype=np.uint8)
    order = np.argsort(depth, kind="stable")
    at = ((down - low[1]) * scale).astype(int), ((right - low[0]) * scale).astype(int)
    image[at[0][order], at[1][order]] = colours[order].astype(np.uint8)  # what is nearer is painted later
    return image


def _sample_faces(world: VoxelMap) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points [voxels] on the faces that look up, along +x and along +y, with depth, shade and height of each."""
    layers = np.arange(world.shape[2])
    top = np.where(world.free, layers, -1).max(axis=2)
    top = ndimage.maximum_filter(np.where(top < 0, top.max(), top), 5)  # so that walls stand, too
    solid = world.occupied & (layers[None, None] <= top[:, :, None])
    faces = []
    for axis, shade in ((2, SHADES[0]), (0, SHADES[1]), (1, SHADES[2])):
        hidden = np.zeros_like(solid)
        front = [slice(None)] * 3
        back = [slice(None)] * 3
        front[axis], back[axis] = slice(1, None), slice(None, -1)
        hidden[tuple(back)] = solid[tuple(front)]
        faces.append((axis, shade, np.argwhere(solid & ~hidden)))
    count = sum(len(cells) for _, _, cells in faces)
    per_side = VIEW_PIXELS / (sum(world.shape[:2]) * 1.0)
    fine = int(np.clip(np.ceil(1.6 * per_side), 1, max(1, int(np.sqrt(MOST_SAMPLES / max(count, 1))))))
    steps = (np.arange(fine) + 0.5) / fine
    u, v = (grid.ravel() for grid in np.meshgrid(steps, steps))
    parts = []
    for axis, shade, cells in faces:
        inside = np.insert(np.stack([u, v], axis=1), axis, 1.0, axis=1)
        points = (cells[:, None] + inside).reshape(-1, 3)
        depth = np.repeat(cells.sum(axis=1), len(u))
        parts.append((points, depth, np.full(len(points), shade), np.repeat(cells[:, 2], len(u))))
    points, depth, shade, height = (np.concatenate(column) for column in zip(*parts, strict=True))
    return points, depth, shade, height
