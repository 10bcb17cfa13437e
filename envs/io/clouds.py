"""From the points of a file to a source of labelled grids: units, axes, strays, floor or terrain, slices."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from maexp.envs.io.cloud_extras import read_las, read_octree
from maexp.envs.io.cloud_files import Cloud, Faces, read_xyz
from maexp.envs.io.levelling import find_floor, find_strays, guess_up, thin, turn_up
from maexp.envs.io.mesh_files import read_mesh, read_ply_cloud
from maexp.envs.io.options import ImportOptions
from maexp.envs.io.pcd_files import read_pcd
from maexp.envs.io.report import ImportReport, ScannedPoints
from maexp.envs.io.sources import FloorSource, Source
from maexp.envs.io.terrain import TerrainSource
from maexp.envs.maps.point_cloud import MapError
from maexp.envs.scenarios import Scenario

MESHES = (".obj", ".stl", ".glb")
CLOUDS = (".pcd", ".ply", ".xyz", ".las", ".laz", ".bt", *MESHES)
LEAST_POINTS = 20
FLAT = 1e-3  # a cloud this thin for its width is a floor plan already
OUTDOOR_SIZE, OUTDOOR_DENSITY = 100.0, 10.0  # larger [m] and sparser [points / m^2] than this was scanned from the air
INDOOR_DENSITY = 200.0  # [points / m^2]; a .las denser than this was scanned on the ground
ROUGH = 0.02  # [m]; coordinates in coarser steps than this are warned of
ROUGHEST = 1.0  # [m]; in coarser steps than this they are of no use even outdoors
FLOOR_SHARE = 0.7  # of what the walls enclose; where less of the floor was scanned, the rest is inferred


def read_cloud(path: Path, options: ImportOptions, report: ImportReport) -> tuple[Source, Scenario]:
    """The source of grids of a cloud, mesh or octree, and the scenario whose robot fits it."""
    return make_source(path, _read(path, options), options, report)


def make_source(path: Path, cloud: Cloud, options: ImportOptions, report: ImportReport) -> tuple[Source, Scenario]:
    """The same for a cloud that was read already."""
    points = _to_metres(path, cloud, options, report)
    points, up = _set_upright(points, cloud, options, report)
    outdoor = _is_outdoor(points, cloud, options)
    fallback = "outdoor" if outdoor else "pointcloud"
    scenario = options.find_scenario(fallback)
    _check_step(path, cloud, scenario, outdoor, options, report)
    before = len(points)
    voxel = options.voxel or (0.0 if outdoor else scenario.resolution / 5)
    if voxel:
        points = points[thin(points, voxel)]
        report.add("voxels", f"one point a voxel of {voxel:g} m", before, len(points))
    if outdoor:
        return _read_terrain(points, scenario, options, report), scenario
    return _read_floor(points, cloud, up, scenario, options, report), scenario


def _read(path: Path, options: ImportOptions) -> Cloud:
    suffix = path.suffix.lower()
    if suffix in (".las", ".laz"):
        return read_las(path, options.units != "auto")
    readers = {".pcd": read_pcd, ".xyz": read_xyz, ".bt": read_octree}
    if suffix in readers:
        return readers[suffix](path)
    spacing = options.sample_spacing or options.find_scenario().resolution / 5  # units are known before points are
    return (read_ply_cloud if suffix == ".ply" else read_mesh)(path, spacing / (options.metres_per_unit or 1.0))


def _to_metres(path: Path, cloud: Cloud, options: ImportOptions, report: ImportReport) -> np.ndarray:
    points = cloud.points
    good = np.isfinite(points).all(axis=1)
    if not good.all():
        bad = int((~good).sum())
        if not options.drop_invalid:
            raise MapError(
                f"{path} has {bad} points that are NaN or infinite; remove them, or set drop_invalid=true "
                "(on the command line importing.drop_invalid=true)"
            )
        points = points[good]
        report.add("invalid", "NaN and infinite points dropped", len(good), len(points))
    alike = _repeats(points)
    if alike.any():  # a search tree over thousands of points in one place never ends
        report.add("duplicates", "points that are there twice dropped", len(points), int((~alike).sum()))
        points = points[~alike]
    if len(points) < LEAST_POINTS:
        raise MapError(f"{path} holds {len(points)} different points; give a cloud with at least a few hundred")
    scale, why = options.metres_per_unit, "as set"
    if scale is None:
        scale, why = (cloud.metres_per_unit, "by the file") if cloud.metres_per_unit else (1.0, "assumed")
    if why == "assumed":
        report.assume("its unit is not known and was taken to be metres", "set importing.units=m, or what it is")
    for told, cure in cloud.assumed:
        report.assume(told, cure)
    points, heights = points * scale, cloud.metres_per_height
    if options.metres_per_unit is None and heights is not None and heights != scale:
        points[:, 2] *= heights / scale
        why += f"; heights {heights:g} m"
    if not np.abs(points).max() < 1e9:
        raise MapError(f"{path} has coordinates up to {np.abs(points).max():g} m; check units")
    report.before = ScannedPoints.some_of(points)
    size = " x ".join(f"{span:.1f}" for span in np.ptp(points, axis=0))
    report.add("read", f"{path.name}: {size} m, {scale:g} m a unit ({why})", len(cloud.points), len(points))
    return points


def _check_step(path, cloud: Cloud, scenario, outdoor: bool, options: ImportOptions, report: ImportReport) -> None:
    """Far from the origin float32 rounds coordinates: walls fall apart into points as far from each other."""
    step = cloud.step * (options.metres_per_unit or cloud.metres_per_unit or 1.0)
    if step <= ROUGH:
        return
    told = f"its coordinates are float32 numbers so large that they come in steps of {step:g} m"
    cure = "subtract an offset before it is saved, or save it with 8-byte numbers (double)"
    if step >= (ROUGHEST if outdoor else scenario.collision_threshold / 3):
        raise MapError(f"{path}: {told}, too coarse for walls: {cure}")
    report.warn(f"{told}: {cure}")


def _repeats(points: np.ndarray) -> np.ndarray:
    """Points that another one before them equals; bool [count]."""
    order = np.lexsort(points.T)
    result = np.zeros(len(points), dtype=bool)
    result[order[1:]] = (points[order[1:]] == points[order[:-1]]).all(axis=1)
    return result


def _set_upright(points, cloud: Cloud, options: ImportOptions, report: ImportReport) -> tuple[np.ndarray, str]:
    up = options.up if options.up != "auto" else cloud.up
    if up == "auto":
        up = guess_up(points)
        report.assume(f"the axis up was taken to be {up}", f"set importing.up={up}, or which it is")
    if up != "z":
        points = turn_up(points, up)
        report.add("up", f"{up} of the file points up")
    if options.outliers is not False:
        stray = find_strays(points)
        report.add("outliers", "points far from all others dropped", len(points), int((~stray).sum()))
        points = points[~stray]
    return points, up


def _is_outdoor(points: np.ndarray, cloud: Cloud, options: ImportOptions) -> bool:
    if options.place != "auto":
        return options.place == "outdoor"
    size = np.ptp(points[:, :2], axis=0)
    if cloud.outdoor and len(points) > INDOOR_DENSITY * size.prod():
        return False
    return cloud.outdoor or (size.max() > OUTDOOR_SIZE and len(points) < OUTDOOR_DENSITY * size.prod())


def _read_floor(points, cloud: Cloud, up: str, scenario, options: ImportOptions, report: ImportReport) -> FloorSource:
    size = np.ptp(points, axis=0)
    if size[2] <= FLAT * max(size[0], size[1]):
        return _read_plan(points, scenario, options, report)
    floor = find_floor(points, options.level, _turned(cloud.faces, up, cloud, options), cloud.spacing is None)
    if floor.double:
        report.warn(floor.double)
    height = floor.height if options.floor is None else options.floor
    report.add("floor", floor.story if options.floor is None else f"at {height:g} m, as set")
    points = points @ floor.rotation.T - [0.0, 0.0, height]
    points = _crop(points, options, report)
    empty = cloud.open_space
    if empty is not None:
        empty = turn_up(empty * (options.metres_per_unit or cloud.metres_per_unit), up)
        empty = empty @ floor.rotation.T - [0.0, 0.0, height]
    low = options.step_height if options.step_height is not None else max(0.25 * scenario.body_length, 0.05)
    voxel = (cloud.spacing or 0.0) * (options.metres_per_unit or cloud.metres_per_unit or 1.0)
    if options.step_height is None:
        low = max(low, 2.1 * voxel)  # the voxels of a floor fill up to two layers
    high = options.robot_height or max(0.3, 1.6 * scenario.body_length)
    if high <= low:
        raise MapError(f"importing.robot_height={high:g} m must be greater than importing.step_height={low:g} m")
    ground = points[np.abs(points[:, 2]) <= low]
    walls = points[(points[:, 2] > low) & (points[:, 2] <= high)]
    if not len(walls) and not len(ground):
        raise MapError(f"{report.path}: no point lies within {high:g} m above the floor at {height:g} m; set floor")
    finest = max(voxel, 0.2 * scenario.resolution)
    for kind in (ground if floor.scanned else ground[:0], walls):
        if len(kind) > LEAST_POINTS:
            finest = max(finest, min(1.2 * _spacing(kind[:, :2], 50), scenario.resolution))
    holes = 2 if options.fill_holes is None else options.fill_holes
    source = FloorSource(points, low, high, round(finest, 3), open_space=empty, holes=holes)
    kept = len(ground) + len(walls)
    report.add("slices", f"floor up to {low:.2f} m, obstacles up to {high:.2f} m", len(points), kept)
    _decide_inference(source, floor.scanned, scenario, options, report)
    return source


def _turned(faces: Faces | None, up: str, cloud: Cloud, options: ImportOptions) -> Faces | None:
    """The faces of a mesh in metres, upright."""
    if faces is None:
        return None
    scale = options.metres_per_unit or cloud.metres_per_unit or 1.0
    return Faces(turn_up(faces.centres * scale, up), turn_up(faces.normals, up), faces.areas * scale**2)


def _decide_inference(source: FloorSource, scanned: bool, scenario, options, report: ImportReport) -> None:
    share = source.floor_share(max(source.finest, scenario.resolution))
    source.infer = options.infer_free
    if source.infer is None:
        source.infer = not scanned or share < FLOOR_SHARE
    told = f"{share:.0%} of what walls enclose was seen to be free"
    report.add("free space", f"{told}: {'all of it is taken as free' if source.infer else 'only that is free'}")


def _read_plan(points: np.ndarray, scenario, options: ImportOptions, report: ImportReport) -> FloorSource:
    """A flat cloud: every point is a wall, and what walls enclose is free."""
    points = _crop(points, options, report)
    if options.infer_free is False:
        raise MapError(f"{report.path} is a flat cloud of walls: without infer_free nothing of it is free")
    spacing = _spacing(points[:, :2], 90)
    finest = max(1.5 * spacing, 0.2 * scenario.resolution)
    report.add("floor plan", f"a flat cloud, {spacing:.3f} m between points: walls; what they enclose is free")
    walls = np.column_stack([points[:, :2], np.ones(len(points))])
    holes = 0 if options.fill_holes is None else options.fill_holes
    return FloorSource(walls, 0.5, 1.5, round(finest, 3), infer=True, holes=holes)


def _read_terrain(points: np.ndarray, scenario, options: ImportOptions, report: ImportReport) -> TerrainSource:
    low = 1.0 if options.step_height is None else options.step_height
    high = options.robot_height or math.inf
    if high <= low:
        raise MapError(f"importing.robot_height={high:g} m must be greater than importing.step_height={low:g} m")
    _, cells = np.unique(np.floor(points[:, :2] / 4.0), axis=0, return_counts=True)
    finest = max(0.2 * scenario.resolution, math.ceil(14 / math.sqrt(float(np.median(cells)) / 16)) / 10)
    holes = 2 if options.fill_holes is None else options.fill_holes
    source = TerrainSource(points, low, high, finest, holes=holes)
    standing = int((source.above > low).sum())
    report.add("terrain", f"obstacles stand more than {low:g} m above the local ground", len(points), standing)
    if options.crop is not None:
        source = source.keep(_inside(points, options, report))
    side = options.tile or (scenario.size if scenario.name == "outdoor" else None)
    if side:
        before = len(source.points)
        source = source.tile(side)
        if len(source.points) < before:
            report.add("tile", f"the {side:g} m square with most free space", before, len(source.points))
    return source


def _crop(points: np.ndarray, options: ImportOptions, report: ImportReport) -> np.ndarray:
    return points if options.crop is None else points[_inside(points, options, report)]


def _inside(points: np.ndarray, options: ImportOptions, report: ImportReport) -> np.ndarray:
    """Which points lie in `options.crop`; bool [count]."""
    xmin, ymin, xmax, ymax = options.crop
    inside = ((points[:, :2] >= (xmin, ymin)) & (points[:, :2] <= (xmax, ymax))).all(axis=1)
    report.add("crop", f"to x {xmin:g} to {xmax:g} m, y {ymin:g} to {ymax:g} m", len(points), int(inside.sum()))
    if inside.sum() < LEAST_POINTS:
        (x0, y0), (x1, y1) = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
        raise MapError(
            f"importing.crop={options.crop} holds {inside.sum()} points; the cloud spans x {x0:.1f} to {x1:.1f} m, "
            f"y {y0:.1f} to {y1:.1f} m"
        )
    return inside


def _spacing(places: np.ndarray, percentile: float) -> float:
    """Percentile of the distance to the nearest other place [m]."""
    places = np.unique(places, axis=0)
    if len(places) < 2:
        raise MapError("all points of the cloud are in one place; check units and the file")
    some = places[:: max(1, len(places) // 5000)]
    away, _ = cKDTree(places).query(some, k=[2])
    return float(np.percentile(away, percentile))
