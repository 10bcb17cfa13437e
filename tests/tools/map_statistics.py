"""What kind of place a map is, in figures: `python -m tests.tools.map_statistics [MAP FILES ...]`."""

import sys
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from skimage.measure import euler_number
from skimage.morphology import remove_small_holes, skeletonize

from maexp.envs.maps.point_cloud import PointCloudMap
from maexp.envs.scenarios import SCENARIOS, find_scenario, make_map

EIGHT = np.ones((3, 3), dtype=int)
MAPS = 8  # of each scenario
COLUMNS = (
    "map",
    "free m²",
    "free share",
    "width m (10 to 90 %)",
    "way in widths",
    "branches",
    "dead ends",
    "loops",
    "pillars",
)  # branches and dead ends: per 100 widths of way


@dataclass(frozen=True)
class MapStatistics:
    """Figures of one map; lengths in metres, areas in square metres.

    The skeleton is that of the free space with pillars filled: obstacles a radar sees around at a glance,
    smaller than a square of half its range.
    """

    free_area: float
    free_share: float  # of the bounding box
    width_low: float  # free width along the skeleton: 10 %, 50 %, 90 % of its length
    width: float
    width_high: float
    skeleton_length: float
    branches: int  # places where three or more ways meet
    dead_ends: int
    loops: int  # ways around something larger than a pillar
    pillars: int


def measure_map(world: PointCloudMap) -> MapStatistics:
    """Statistics of `world`; points are put on a grid of the finest spacing."""
    cell = float(min(world.free_spacing.min(), world.resolution))
    free = rasterise(world, cell)
    whole = 1 - int(euler_number(free, connectivity=1))
    radar = find_scenario(world.scenario).radar_range
    solid = remove_small_holes(free, max_size=round((0.5 * radar / cell) ** 2), connectivity=2)
    distance = ndimage.distance_transform_edt(solid)
    skeleton = prune(skeletonize(solid), distance)
    branches, dead_ends = count_nodes(skeleton)
    widths = (2 * distance[skeleton] - 1) * cell
    low, middle, high = np.percentile(widths, [10, 50, 90])
    loops = int(ndimage.label(solid)[1]) - int(euler_number(solid, connectivity=1))
    return MapStatistics(
        free_area=world.free_area,
        free_share=float(world.free_area / (np.array(free.shape) - 2).prod() / cell**2),
        width_low=float(low),
        width=float(middle),
        width_high=float(high),
        skeleton_length=float(skeleton.sum() * cell),
        branches=branches,
        dead_ends=dead_ends,
        loops=loops,
        pillars=whole - loops,
    )


def rasterise(world: PointCloudMap, cell: float) -> np.ndarray:
    """Free space as a grid of `cell` [m], bool, a border of one blocked cell around."""
    low = np.array(world.extent[0])
    shape = np.round((np.array(world.extent[1]) - low) / cell).astype(int) + 3
    free = np.zeros(shape, dtype=bool)
    for spacing in np.unique(world.free_spacing):
        points = world.free[world.free_spacing == spacing, :2] - low
        reach = max(1, round(float(spacing) / cell))  # a coarse point stands for reach x reach cells
        corner = np.round(points / cell - (reach - 1) / 2).astype(int) + 1
        for dx in range(reach):
            for dy in range(reach):
                free[np.clip(corner[:, 0] + dx, 0, shape[0] - 1), np.clip(corner[:, 1] + dy, 0, shape[1] - 1)] = True
    walls = np.round((world.boundary[:, :2] - low) / cell).astype(int) + 1
    free[walls[:, 0], walls[:, 1]] = False  # in a jittered cloud a boundary point wins its cell
    return free


def prune(skeleton: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Skeleton without spurs that only point into a corner: ends shorter than the half width they start from."""
    for _ in range(3):
        neighbours = ndimage.convolve(skeleton.astype(int), EIGHT, mode="constant") - 1
        joints = ndimage.binary_dilation(skeleton & (neighbours >= 3), EIGHT) & skeleton
        branches, count = ndimage.label(skeleton & ~joints, EIGHT)
        if count == 0:
            break
        length = np.bincount(branches.ravel(), minlength=count + 1)
        has_end = np.bincount(branches[skeleton & (neighbours == 1)], minlength=count + 1) > 0
        touching = ndimage.grey_dilation(np.where(joints, distance, 0.0), footprint=EIGHT)
        half_width = ndimage.maximum(touching, branches, np.arange(count + 1))
        spur = has_end & (half_width > 0) & (length < 1.3 * half_width)
        spur[0] = False
        if not spur.any():
            break
        skeleton = skeletonize(skeleton & ~spur[branches])
    return skeleton


def count_nodes(skeleton: np.ndarray) -> tuple[int, int]:
    """Branching places (clusters of joints) and dead ends of a skeleton."""
    neighbours = ndimage.convolve(skeleton.astype(int), EIGHT, mode="constant") - 1
    joints = ndimage.label(ndimage.binary_dilation(skeleton & (neighbours >= 3), EIGHT), EIGHT)[1]
    return int(joints), int((skeleton & (neighbours == 1)).sum())


def table_row(label: str, rows: list[MapStatistics]) -> str:
    """One line of the table: means over `rows`."""

    def mean(field: str) -> float:
        return float(np.mean([getattr(row, field) for row in rows]))

    per = 100 / mean("skeleton_length") * mean("width")
    columns = [
        label,
        f"{mean('free_area'):,.0f}",
        f"{mean('free_share'):.2f}",
        f"{mean('width'):.2g} ({mean('width_low'):.2g} to {mean('width_high'):.2g})",
        f"{mean('skeleton_length') / mean('width'):.0f}",
        f"{mean('branches') * per:.0f}",
        f"{mean('dead_ends') * per:.0f}",
        f"{mean('loops'):.1f}",
        f"{mean('pillars'):.0f}",
    ]
    return f"| {' | '.join(columns)} |"


def main() -> None:
    """Print the table for the scenarios, and for the map files named on the command line."""
    print(f"| {' | '.join(COLUMNS)} |")
    print(f"| {' | '.join(['---'] * len(COLUMNS))} |")
    for name, scenario in SCENARIOS.items():
        if scenario.build is not None:
            print(table_row(f"`{name}`", [measure_map(make_map(name, k)) for k in range(MAPS)]), flush=True)
    for path in sys.argv[1:]:
        from maexp.envs.io import import_map  # needs the table of scenarios itself

        world = import_map(path)
        print(table_row(world.name, [measure_map(world)]), flush=True)


if __name__ == "__main__":
    main()
