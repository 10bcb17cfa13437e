"""import_map: which reader a file goes to, and the check at the end."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING

from maexp.envs.io.bags import BAGS, bag_name, is_bag, read_bag
from maexp.envs.io.clouds import CLOUDS, make_source, read_cloud
from maexp.envs.io.grid import Grid
from maexp.envs.io.occupancy import read_occupancy
from maexp.envs.io.options import ImportOptions, make_options
from maexp.envs.io.point_files import read_npy_triple, read_npz_map
from maexp.envs.io.postprocess import crop_grid, finish_map
from maexp.envs.io.report import ImportReport, printable
from maexp.envs.io.sources import GridSource
from maexp.envs.maps.checker import check_map, repair_map
from maexp.envs.maps.point_cloud import MapError, PointCloudMap, check_file

if TYPE_CHECKING:
    from maexp.envs.volume.map import VoxelMap

GRIDS = (".yaml", ".yml", ".pgm", ".png", ".bmp", ".tif", ".tiff")
POINTS = (".npz", ".npy")


def import_map(
    path: str | os.PathLike, options: ImportOptions | None = None, *, volume: bool = False, **overrides
) -> PointCloudMap | VoxelMap:
    """Reads a file and makes it a map a team can explore; see `ImportOptions` for what can be set by hand.

    Args:
        path: .yaml (ROS map_server), .pgm, .png, .npz, .npy, .ply, .pcd, .xyz, .las, .laz, .obj, .stl, .glb, .bt, or a
            bag of ROS: .mcap, .db3 or the folder of a rosbag2.
        options: settings; None: everything automatic.
        volume: keep the file in three dimensions, as a `VoxelMap`.
        overrides: single settings by name, over `options`.

    Raises:
        MapError: the file cannot be read, or has no room for the team; says what was found and what to do.
    """
    return import_map_with_report(path, options, volume=volume, **overrides)[0]


def import_map_with_report(
    path: str | os.PathLike, options: ImportOptions | None = None, *, volume: bool = False, **overrides
) -> tuple[PointCloudMap | VoxelMap, ImportReport]:
    """`import_map`, and what each step did."""
    if volume:
        from maexp.envs.volume.importing import import_volume  # late: the plane alone needs none of it

        return import_volume(path, make_options(options, overrides))
    begin = time.perf_counter()
    path = Path(path)
    options = make_options(options, overrides)
    report = ImportReport(str(path), strict=options.strict)
    if not is_bag(path):
        check_file(path)
    world = _read(path, options, report)
    world = _check(world, options, report)
    report.seconds = time.perf_counter() - begin
    return world, report


def _read(path: Path, options: ImportOptions, report: ImportReport) -> PointCloudMap:
    suffix = path.suffix.lower()
    name = options.name or printable(path.stem)
    if is_bag(path):
        found = read_bag(path, options, report)
        name = options.name or printable(bag_name(path))
        if isinstance(found, Grid):
            return _finish_grid(found, name, options, report)
        source, scenario = make_source(path, found, options, report)
        return finish_map(source, scenario, name, options, report)
    if options.topic is not None:
        bags = ", ".join(BAGS)
        raise MapError(f"importing.topic={options.topic!r} is for bags of ROS ({bags}); {path} has no topics")
    if suffix in GRIDS:
        return _finish_grid(read_occupancy(path, options, report), name, options, report)
    if suffix in CLOUDS:
        source, scenario = read_cloud(path, options, report)
        return finish_map(source, scenario, name, options, report)
    if suffix == ".npz":
        return read_npz_map(path, options, report)
    if suffix == ".npy":
        return read_npy_triple(path, options, report)
    known = ", ".join((*GRIDS, *CLOUDS, *POINTS, *BAGS))
    raise MapError(f"{path}: files of type {suffix or '(none)'} cannot be imported; {known} can")


def _finish_grid(grid: Grid, name: str, options: ImportOptions, report: ImportReport) -> PointCloudMap:
    return finish_map(GridSource(crop_grid(grid, options, report)), options.find_scenario(), name, options, report)


def _check(world: PointCloudMap, options: ImportOptions, report: ImportReport) -> PointCloudMap:
    """The checker's verdict; what it finds is repaired once, and an unusable map is an error."""
    verdict = check_map(world, num_robots=options.num_robots, threshold=options.robot_radius)
    if not verdict.ok or verdict.warnings:
        threshold = options.robot_radius if options.min_passage is None else options.min_passage / 2
        world, steps = repair_map(world, threshold=threshold)
        for step in steps:
            report.add("repair", step)
        verdict = check_map(world, num_robots=options.num_robots, threshold=options.robot_radius)
    if not verdict.ok:
        raise MapError(f"{report.path} gives no usable map: {'; '.join(verdict.errors)}")
    report.warnings += verdict.warnings
    report.add("check", f"{verdict.verdict}: room for {verdict.room} robots, {verdict.visible_share:.1%} visible")
    return world
