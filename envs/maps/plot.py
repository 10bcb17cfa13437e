"""A picture of a map as PNG: free space, walls, boundary, scale."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from maexp.envs.atomic_write import whole_file
from maexp.envs.maps.point_cloud import PointCloudMap
from maexp.envs.maps.raster import map_raster

COLORS = {"outside": (245, 245, 245), "free": (198, 219, 239), "boundary": (8, 48, 107), "obstacle": (140, 140, 150)}


def draw_map(world: PointCloudMap, path: str | os.PathLike, *, size: int = 900) -> Path:
    """Writes a picture of `world`, about `size` pixels on its longer side; returns its path."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # late: slow to import
    from matplotlib.figure import Figure

    raster = map_raster(world, size)
    figure = Figure(figsize=(raster.width / 100 + 1.2, raster.height / 100 + 1.5), dpi=100, layout="constrained")
    paint_map(figure.add_subplot(), world, size)
    with whole_file(Path(path)) as part:
        FigureCanvasAgg(figure).print_png(part)
    return Path(path)


def paint_map(axes, world: PointCloudMap, size: int) -> None:
    """The map with its title and a scale bar, in axes of matplotlib; `size` as for `draw_map`."""
    raster = map_raster(world, size)
    left, top = raster.corner
    right, bottom = left + raster.width / raster.scale, top - raster.height / raster.scale
    axes.imshow(raster.paint(_color_table(world)), extent=(left, right, bottom, top), interpolation="nearest")
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    (xmin, ymin), (xmax, ymax) = world.extent
    axes.set_title(
        f"{world.name}: {xmax - xmin:.1f} x {ymax - ymin:.1f} m at {world.resolution:g} m, "
        f"{world.free_area:,.0f} m² free\n"
        f"{len(world.free):,} free, {len(world.boundary):,} boundary, {len(world.obstacles):,} obstacle points",
        fontsize=9,
    )
    _draw_scale(axes, left, right, bottom, top)


def _color_table(world: PointCloudMap) -> np.ndarray:
    """One colour for nothing, every free and boundary point, and all hidden obstacles; uint8 [entries, 3]."""
    rows = [COLORS["outside"]] + [COLORS["free"]] * len(world.free)
    rows += [COLORS["boundary"]] * len(world.boundary) + [COLORS["obstacle"]]
    return np.array(rows, dtype=np.uint8)


def _draw_scale(axes, left: float, right: float, bottom: float, top: float) -> None:
    """A bar of a round length, about a fifth of the picture."""
    rough = (right - left) / 5
    power = 10.0 ** np.floor(np.log10(rough))
    length = max(step for step in (1, 2, 5) if step * power <= rough) * power
    x, y = left + 0.03 * (right - left), bottom + 0.03 * (top - bottom)
    axes.plot([x, x + length], [y, y], color="crimson", linewidth=3, solid_capstyle="butt")
    axes.text(x + length / 2, y + 0.01 * (top - bottom), f"{length:g} m", color="crimson", ha="center", va="bottom")
