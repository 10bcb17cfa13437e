"""Gallery of the scenarios, one PNG each: `python -m tests.tools.gallery docs/gallery`."""

import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw
from scipy.spatial import cKDTree

from maexp.envs.maps.point_cloud import PointCloudMap
from maexp.envs.scenarios import SCENARIOS, make_map

PANEL = 420  # pixels a side
COLORS = {"ink": (30, 30, 30), "paper": (255, 255, 255), "wall": (25, 30, 45), "free": (222, 233, 242)}
FURNITURE = (150, 120, 90)
DOT = (70, 120, 170)
INDICES = {"outdoor": (1, 2, 4, 8)}  # a town centre, a housing estate, a campus and open country


def draw_gallery(name: str, path: Path) -> Path:
    """Write four maps of scenario `name` side by side to `path` (PNG, 64 colours)."""
    maps = [make_map(name, index) for index in INDICES.get(name, range(4))]
    sheet = Image.new("RGB", (len(maps) * (PANEL + 16) + 16, PANEL + 52), COLORS["paper"])
    pen = ImageDraw.Draw(sheet)
    for k, world in enumerate(maps):
        picture = Image.fromarray(draw_panel(world))
        scale = PANEL / max(picture.size)
        picture = picture.resize([round(side * scale) for side in picture.size], Image.Resampling.BOX)
        left = 16 + k * (PANEL + 16)
        sheet.paste(picture, (left + (PANEL - picture.width) // 2, 32 + (PANEL - picture.height) // 2))
        (xmin, ymin), (xmax, ymax) = world.extent
        text = f"{world.name}: {xmax - xmin:.4g} x {ymax - ymin:.4g} m, {len(world.free):,} free points"
        pen.text((left, 10), text, fill=COLORS["ink"])
    sheet.quantize(64, dither=Image.Dither.NONE).save(path, optimize=True)
    return path


def draw_panel(world: PointCloudMap) -> np.ndarray:
    """Picture of one map, uint8 (height, width, 3), x to the right, y up, at least PANEL pixels on its longer side.

    Heights, where the map has them, colour ground (higher is darker) and obstacles (walls dark, furniture brown).
    A map of varying density is drawn as dots, one for each free point.
    """
    low = np.minimum(world.free.min(axis=0), world.obstacles.min(axis=0))[:2]
    span = np.maximum(world.free.max(axis=0), world.obstacles.max(axis=0))[:2] - low + world.resolution
    zoom = int(np.ceil(PANEL * world.resolution / span.max()))
    varied = np.ptp(world.free_spacing) > 0
    image = np.full((*np.round(span / world.resolution * zoom).astype(int), 3), 255, dtype=np.uint8)

    def paint(points: np.ndarray, colors: np.ndarray, width: int) -> None:
        corner = np.round((points[:, :2] - low) / world.resolution * zoom).astype(int) + (zoom - width) // 2
        for dx in range(width):
            for dy in range(width):
                image[corner[:, 0] + dx, corner[:, 1] + dy] = colors

    paint(world.obstacles, _obstacle_colors(world), zoom)
    paint(world.free, np.array(DOT if varied else _free_colors(world)), 1 if varied else zoom)
    return image.transpose(1, 0, 2)[::-1]


def _free_colors(world: PointCloudMap) -> np.ndarray:
    """Colours of the free points: flat, or green to brown over 16 m of height."""
    if world.free_height is None or np.ptp(world.free_height) == 0:
        return np.array(COLORS["free"])
    share = np.round(np.clip(world.free_height / 16, 0, 1) * 16)[:, None] / 16
    return (np.array([226, 238, 205]) * (1 - share) + np.array([160, 165, 105]) * share).astype(np.uint8)


def _obstacle_colors(world: PointCloudMap) -> np.ndarray:
    """Colours of the obstacle points: dark walls; furniture, trees and hedges lighter; water blue."""
    colors = np.tile(np.uint8(COLORS["wall"]), (len(world.obstacles), 1))
    if world.obstacle_height is None:
        return colors
    if np.ptp(world.free_height) == 0:
        colors[world.obstacle_height < 2] = FURNITURE
        return colors
    above = world.obstacle_height - _ground_under(world)
    colors[above < 9.5] = (70, 95, 70)
    colors[above < 4] = (120, 140, 90)
    colors[above < -1.5] = (110, 160, 200)
    return colors


def _ground_under(world: PointCloudMap) -> np.ndarray:
    """Ground height at the obstacle points, from the nearest free points [m]."""
    distance, nearest = cKDTree(world.free[:, :2]).query(world.obstacles[:, :2], k=4)
    weight = 1 / (distance + 1e-6)
    return (world.free_height[nearest] * weight).sum(axis=1) / weight.sum(axis=1)


def main() -> None:
    """Draw every scenario into the folder named on the command line."""
    if len(sys.argv) != 2:
        raise SystemExit("usage: python -m tests.tools.gallery FOLDER")
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for name, scenario in SCENARIOS.items():
        if scenario.build is not None:
            path = draw_gallery(name, folder / f"{name}.png")
            print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
