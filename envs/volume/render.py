"""Pictures of teams in volumes: the plan, seen from above, and the elevation, seen from the side.

A column of the plan is green as far as its free voxels are explored and pale yellow as far as they are not; what is
known to be solid is drawn over it, the higher the lighter. The elevation below shows the same along y. Robots are discs
with their goals as crosses, in both.
"""

import numpy as np
from PIL import Image, ImageDraw

from maexp.envs.render.frames import (
    EXPLORED,
    INK,
    LIGHT,
    NOTHING,
    STRIP,
    UNEXPLORED,
    WALL_UNSEEN,
    draw_caption,
    robot_colour,
)

LOW, HIGH = np.array((52, 52, 90)), np.array((176, 150, 150))
"""Colours of the lowest and of the highest solid voxels."""


def draw_volume(snapshot: dict, size: int = 512) -> np.ndarray:
    """Picture of one team, uint8 (height, width, 3): plan, elevation and a caption strip.

    Args:
        snapshot: what ``ExplorationEnv.snapshot(i)`` returns on a volume.
        size: width in pixels.
    """
    m = snapshot["map"]
    nx, ny, nz = m.shape
    scale = size / max(nx, ny)  # pixels a voxel
    plan = _paint(snapshot, 2)
    side = _paint(snapshot, 1)
    parts = [_draw(snapshot, plan, (0, 1), scale, size), _draw(snapshot, side, (0, 2), scale, size)]
    parts.append(draw_caption(snapshot, size, scale / m.resolution))
    height = sum(len(part) for part in parts)
    frame = np.full((height + height % 2, size + size % 2, 3), STRIP, dtype=np.uint8)
    row = 0
    for part in parts:
        frame[row : row + len(part), :size] = part
        row += len(part)
    return frame


def _paint(snapshot: dict, axis: int) -> np.ndarray:
    """Colours float [a, b, 3] of the voxels looked at along an axis."""
    free, seen, solid = (snapshot[name] for name in ("seeable", "seen_free", "seen_surface"))
    count = free.sum(axis)
    share = np.divide((seen & free).sum(axis), count, out=np.zeros(count.shape), where=count > 0)[..., None]
    colours = np.where(
        (count > 0)[..., None], np.array(UNEXPLORED) * (1 - share) + np.array(EXPLORED) * share, WALL_UNSEEN
    )
    layers = np.arange(free.shape[axis]).reshape([-1 if k == axis else 1 for k in range(3)])
    # From above what stands nearest is the highest; from the side every depth looks alike, so many count.
    top = np.where(solid, layers, -1).max(axis)
    height = top / max(free.shape[2] - 1, 1) if axis == 2 else np.full(top.shape, 0.5)
    shade = LOW + (HIGH - LOW) * np.clip(height, 0.0, 1.0)[..., None]
    weight = np.clip(solid.sum(axis) / max(0.5 * free.shape[axis], 1.0), 0.0, 1.0)[..., None]
    weight = np.where((top >= 0)[..., None], np.maximum(weight, 0.25), 0.0)
    return colours * (1 - weight) + shade * weight


def _draw(snapshot: dict, colours: np.ndarray, axes: tuple[int, int], scale: float, size: int) -> np.ndarray:
    """One view with the robots in it, uint8 (height, size, 3); its second axis points up."""
    m = snapshot["map"]
    wide, high = (max(1, round(count * scale)) for count in colours.shape[:2])
    picture = Image.fromarray(np.ascontiguousarray(colours.transpose(1, 0, 2)[::-1]).astype(np.uint8))
    picture = picture.resize((wide, high), Image.Resampling.NEAREST)
    canvas = Image.new("RGB", (size, high + 2), NOTHING)
    canvas.paste(picture, (0, 0))
    draw = ImageDraw.Draw(canvas)

    def pixel(point: np.ndarray) -> tuple[float, float]:
        a, b = ((point[axis] - m.origin[axis]) / m.resolution * scale for axis in axes)
        return float(a), float(high - b)

    radius = max(3.0, 0.3 / m.resolution * scale)
    for i, at in enumerate(snapshot["center"]):
        colour = robot_colour(i)
        past = [pixel(point) for point in snapshot["trail"][:, i]]
        if len(past) > 1:
            draw.line(past, fill=tuple(round(LIGHT * 255 + (1 - LIGHT) * c) for c in colour), width=2)
        x, y = pixel(snapshot["goal"][i])
        for d in (1, -1):
            draw.line([(x - 4 * d, y - 4), (x + 4 * d, y + 4)], fill=colour, width=2)
        x, y = pixel(at)
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour, outline=INK)
        if axes == (0, 1):
            heading = snapshot["pose"][i][3]
            draw.line([(x, y), (x + radius * np.cos(heading), y - radius * np.sin(heading))], fill=NOTHING, width=2)
        if snapshot["collided"][i]:
            draw.line([(x - radius, y), (x + radius, y)], fill=NOTHING, width=2)
    return np.asarray(canvas)
