"""A file as a map of voxels: axis up, side of a voxel, inside and outside, a closed box, room for the team."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from maexp.envs.io.levelling import find_strays, guess_up, thin, turn_up
from maexp.envs.io.options import ImportOptions
from maexp.envs.io.report import ImportReport, ScannedPoints
from maexp.envs.maps.point_cloud import MapError, check_file, read_npz
from maexp.envs.volume.checker import check_volume
from maexp.envs.volume.map import MAX_MAP_VOXELS, VoxelMap, is_voxel_file
from maexp.envs.volume.reach import Body, passable
from maexp.envs.volume.surfaces import VOLUME_FILES, cut_triangles, drop_invalid, read_surfaces

MAX_VOXELS = 4_000_000  # of the box where the side of a voxel is chosen
SIDES = (0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 8.0, 10.0)
FINEST = 2  # of SIDES: 0.2 m where the file would allow less
HEADROOM = 3.0  # [m] of open sky above the highest point
INSIDE_SHARE = 0.1  # of the box: an enclosed place as large as this is the map
BOUNDING_SHARE = 0.5  # of the surfaces bound the space between floor and ceiling, or over a floor: it is the map
HOLE = 1.0  # [m]; holes of the floor up to here are floor
DOOR = 2.0  # [m]; gaps in walls up to here do not lead outside
KEPT_PIECE = 0.05  # of the largest piece of free space: smaller ones are left out
LOST_SHARE = 0.2
SPARSE = 10.0  # fewer points a square metre over more than 100 m are a scan from the air


@dataclass(frozen=True)
class Scene:
    """What a file holds, upright and in metres.

    Attributes:
        points: on surfaces, float64 [count, 3].
        triangles: float64 [count, 3, 3] of a mesh, else None.
        empty: known free places [open_count, 3] of an octree, else None.
        side: of the octree's voxels [m], else None.
        aerial: seen from above: what lies under the ground is no place.
    """

    points: np.ndarray
    triangles: np.ndarray | None
    empty: np.ndarray | None
    side: float | None
    aerial: bool


def import_volume(path: str | os.PathLike, options: ImportOptions) -> tuple[VoxelMap, ImportReport]:
    """The map of voxels of a file, and what each step did.

    Raises:
        MapError: the file cannot be read, or leaves no room for the team; says what was found and what to do.
    """
    begin = time.perf_counter()
    path, report = Path(path), ImportReport(str(path))
    check_file(path)
    suffix = path.suffix.lower()
    if suffix == ".npz":
        world = _read_saved(path, report)
    elif suffix in VOLUME_FILES:
        world = _make_volume(_read_scene(path, options, report), path, options, report)
    else:
        known = ", ".join((*VOLUME_FILES, ".npz"))
        raise MapError(f"{path}: files of type {suffix or '(none)'} hold no volume; {known} do: leave volume=true out")
    verdict = check_volume(world, num_robots=options.num_robots, radius=options.robot_radius)
    if not verdict.ok:
        raise MapError(f"{path} gives no usable map: {'; '.join(verdict.errors)}")
    report.warnings += verdict.warnings
    report.add("check", f"{verdict.verdict}: room for {verdict.room} robots that fly, {verdict.ground_room} that drive")
    report.seconds = time.perf_counter() - begin
    return world, report


def _read_saved(path: Path, report: ImportReport) -> VoxelMap:
    arrays = read_npz(path)
    if not is_voxel_file(arrays):
        raise MapError(f"{path} is no map of voxels; save one with VoxelMap.save, or leave volume=true out")
    world = VoxelMap.from_arrays(arrays, path)
    report.add("read", f"{path.name}: a saved map of voxels", after=int(world.free.sum()))
    return world


def _read_scene(path: Path, options: ImportOptions, report: ImportReport) -> Scene:
    cloud, triangles = read_surfaces(path)
    cloud = drop_invalid(path, cloud, options.drop_invalid)
    scale, why = options.metres_per_unit, "as set"
    if scale is None:
        scale, why = (cloud.metres_per_unit, "by the file") if cloud.metres_per_unit else (1.0, "assumed")
    if options.metres_per_unit is None and cloud.metres_per_height not in (None, scale):
        why += f"; heights {cloud.metres_per_height:g} m"
        cloud = replace(cloud, points=cloud.points * (1.0, 1.0, cloud.metres_per_height / scale))
    if not len(cloud.points) or not np.abs(cloud.points).max() * scale < 1e9:
        raise MapError(f"{path} holds no points within 1e9 m; check the file and importing.units")
    up = options.up if options.up != "auto" else cloud.up
    up = guess_up(cloud.points) if up == "auto" else up
    points = cloud.points * scale
    report.before = ScannedPoints.some_of(points)
    size = " x ".join(f"{span:.1f}" for span in np.ptp(points, axis=0))
    what = "points" if triangles is None else f"corners of {len(triangles):,} triangles"
    report.add("read", f"{path.name}: {what}, {size} m, {scale:g} m a unit ({why})", after=len(points))
    report.add("up", f"{up} of the file points up ({'as set' if options.up != 'auto' else 'detected'})")
    points = turn_up(points, up)
    empty = None if cloud.open_space is None else turn_up(cloud.open_space * scale, up)
    side = None if cloud.spacing is None else cloud.spacing * scale
    if triangles is not None:
        return Scene(points, points.reshape(-1, 3, 3), None, None, False)
    if side is None and options.outliers is not False and len(points) >= 20:
        points = points[thin(points, 0.02)]
        stray = find_strays(points)
        report.add("outliers", "points far from all others dropped", len(points), int((~stray).sum()))
        points = points[~stray]
    return Scene(points, None, empty, side, _is_aerial(points, cloud.outdoor, options))


def _is_aerial(points: np.ndarray, outdoor: bool, options: ImportOptions) -> bool:
    if options.place != "auto":
        return options.place == "outdoor"
    wide, deep = np.ptp(points[:, :2], axis=0)
    return outdoor or (max(wide, deep) > 100.0 and len(points) < SPARSE * wide * deep)


def _make_volume(scene: Scene, path: Path, options: ImportOptions, report: ImportReport) -> VoxelMap:
    low, high = scene.points.min(axis=0), scene.points.max(axis=0)
    if scene.empty is not None and len(scene.empty):
        low, high = np.minimum(low, scene.empty.min(axis=0)), np.maximum(high, scene.empty.max(axis=0))
    if options.crop is not None:
        xmin, ymin, xmax, ymax = options.crop
        low[:2], high[:2] = np.maximum(low[:2], (xmin, ymin)), np.minimum(high[:2], (xmax, ymax))
        report.add("crop", f"to x {xmin:g} to {xmax:g} m, y {ymin:g} to {ymax:g} m")
        if (low >= high).any():
            raise MapError(f"importing.crop={options.crop} holds nothing of {path}; choose another box")
    shift = np.zeros(3)
    if options.recentre or (options.recentre is None and np.abs([low, high]).max() > 1e4):
        shift = np.floor(low)
        report.add("recentre", f"moved by {-shift[0]:g}, {-shift[1]:g}, {-shift[2]:g} m")
    if scene.aerial:
        high[2] += HEADROOM
    side = _choose_side(scene, high - low, options, report)
    shape = tuple(int(count) for count in np.floor((high - low) / side) + 1)
    low = (low + high - np.array(shape) * side) / 2 if scene.side is None else low - 0.5 * scene.side
    solid = _fill(scene, low, side, shape)
    report.add("surfaces", f"{' x '.join(map(str, shape))} voxels of {side:g} m", len(scene.points), int(solid.sum()))
    free, what = _find_free(scene, solid, low, side)
    report.add("inside", what, int((~solid).sum()), int(free.sum()))
    free = _keep_pieces(free, side, options, report)
    free, occupied = np.pad(free, 1), np.pad(solid, 1)
    closed = ndimage.binary_dilation(free) & ~free
    report.add(
        "box", f"closed: {int((closed & ~occupied).sum()):,} open or unknown voxels beside free ones became wall"
    )
    occupied |= closed
    origin = tuple(low - side - shift)
    return VoxelMap(free, occupied, side, origin, name=options.name or path.stem, scenario="volume")


def _choose_side(scene: Scene, span: np.ndarray, options: ImportOptions, report: ImportReport) -> float:
    """Side of a voxel [m]: as set, or the finest for which the box has at most `MAX_VOXELS`."""

    def count(side: float) -> float:
        return float(np.prod(np.floor(span / side) + 3))

    if options.resolution is not None:
        side = options.resolution
        if count(side) > MAX_MAP_VOXELS:
            raise MapError(
                f"importing.resolution={side:g} m makes {count(side):,.0f} voxels of a box of "
                f"{' x '.join(f'{length:.1f}' for length in span)} m, at most {MAX_MAP_VOXELS:,} are possible: set a "
                "larger one, or importing.crop"
            )
        report.add("voxel", f"{side:g} m, as set: {count(side):,.0f} voxels")
        return side
    finest, why = SIDES[FINEST], ""
    if scene.side is not None:
        finest, why = scene.side, ", that of the octree"
    elif scene.triangles is None:
        finest = max(finest, 1.5 * _spacing(scene.points))
        why = ", so that surfaces have no holes" if finest > SIDES[FINEST] else ""
    sides = [side for side in (*SIDES, *(10.0 * k for k in range(2, 200))) if side >= finest * (1 - 1e-9)]
    if scene.side is not None:
        sides = [scene.side * k for k in range(1, 100)]
    for side in sides:
        if count(side) <= MAX_VOXELS:
            told = why if side == sides[0] else f", the finest with at most {MAX_VOXELS:,} voxels"
            report.add("voxel", f"{side:g} m{told}: {count(side):,.0f} voxels (importing.resolution)")
            return side
    raise MapError(
        f"a box of {' x '.join(f'{length:g}' for length in span)} m has more than {MAX_VOXELS:,} voxels of "
        f"{sides[-1]:g} m: check importing.units, or set importing.crop"
    )


def _spacing(points: np.ndarray) -> float:
    """Distance to the nearest other point that nine of ten points keep [m]."""
    some = points[:: max(1, len(points) // 5000)]
    if len(points) < 2:
        return 0.0
    away, _ = cKDTree(points).query(some, k=[2])
    return float(np.percentile(away, 90))


def _fill(scene: Scene, low: np.ndarray, side: float, shape: tuple[int, int, int]) -> np.ndarray:
    """Voxels that surfaces run through; bool [X, Y, Z]."""
    solid = np.zeros(shape, dtype=bool)
    parts = [scene.points] if scene.triangles is None else cut_triangles(scene.triangles, 0.8 * side)
    for points in parts:
        mark(solid, points, low, side)
    return solid


def mark(grid: np.ndarray, points: np.ndarray, low: np.ndarray, side: float) -> None:
    """Set the voxels of a grid that hold points [m]; points outside do not count."""
    index = np.floor((points - low) / side).astype(np.int64)
    index = index[((index >= 0) & (index < grid.shape)).all(axis=1)]
    grid[tuple(index.T)] = True


def _find_free(scene: Scene, solid: np.ndarray, low: np.ndarray, side: float) -> tuple[np.ndarray, str]:
    """Free voxels, and in words how they were told from outside."""
    if scene.empty is not None:
        free = np.zeros_like(solid)
        mark(free, scene.empty, low, side)
        return free & ~solid, "the free voxels of the octree"
    empty = ~solid
    if scene.aerial:
        ground = np.where(solid.any(axis=2), solid.argmax(axis=2), -1)
        known = ground >= 0
        if not known.all():  # where nothing was scanned, the ground is as high as the nearest
            nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
            ground = ground[tuple(nearest)]
        layers = np.arange(solid.shape[2])
        solid |= layers <= ground[:, :, None]
        return ~solid, "seen from above: free is what lies over the ground, under a closed sky"
    labels, count = ndimage.label(empty)
    outer = np.concatenate([labels[ends].ravel() for ends in _ends(3)])
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    sizes[0] = 0
    inner = sizes.copy()
    inner[np.unique(outer)] = 0
    if inner.sum() and inner.max() >= max(INSIDE_SHARE * sizes[np.unique(outer)].sum(), 50):
        good = inner >= KEPT_PIECE * inner.max()
        return good[labels], "surfaces enclose it: the inside is free, the outside unknown"
    return _find_open(solid, side)


def _find_open(solid: np.ndarray, side: float) -> tuple[np.ndarray, str]:
    """Free voxels of a place that surfaces do not enclose, and in words how they were told from outside."""
    empty = ~solid
    above, below = _below_something(solid), _below_something(solid[:, :, ::-1])[:, :, ::-1]
    between = above & below & empty
    if _bounds(solid, between):
        inside = between | (_walled_in(solid, side) & (above | below) & empty)
        return inside, (
            "open at the sides: free is what lies between floor and ceiling, or between walls over a floor or under a "
            "ceiling; the bottom of the box is ground"
        )
    if _bounds(solid, below & empty):
        wide = max(1, round(0.5 * HOLE / side))
        floor = np.pad((below & empty).any(axis=2), wide)
        filled = ndimage.binary_closing(floor, np.ones((3, 3)), iterations=wide)[wide:-wide, wide:-wide]
        holes = filled & ~solid.any(axis=2)
        return empty & (below | holes[:, :, None]), "no ceiling: free is what lies over a floor, under a closed sky"
    return empty, "open: all of the box is free but surfaces; the bottom of the box is ground, its sides are closed"


def _bounds(solid: np.ndarray, space: np.ndarray) -> bool:
    """Whether most surfaces lie beside `space`; both bool [X, Y, Z]."""
    beside = solid & ndimage.binary_dilation(space, np.ones((3, 3, 3)))
    return bool(beside.sum() >= BOUNDING_SHARE * solid.sum())


def _below_something(solid: np.ndarray) -> np.ndarray:
    """Voxels with a solid one higher in their column; bool [X, Y, Z]."""
    result = np.zeros_like(solid)
    result[:, :, :-1] = np.logical_or.accumulate(solid[:, :, :0:-1], axis=2)[:, :, ::-1]
    return result


def _walled_in(solid: np.ndarray, side: float) -> np.ndarray:
    """Voxels that the walls of their layer go around, doors up to `DOOR` taken as shut; bool [X, Y, Z]."""
    wide = max(1, round(0.5 * DOOR / side))
    result = np.zeros_like(solid)
    for z in range(solid.shape[2]):
        layer = np.pad(solid[:, :, z], wide + 1)
        shut = ndimage.distance_transform_cdt(~layer, "chessboard") <= wide if layer.any() else layer
        filled = ndimage.binary_fill_holes(shut)
        away = ndimage.distance_transform_cdt(filled, "chessboard") > wide
        result[:, :, z] = away[wide + 1 : -wide - 1, wide + 1 : -wide - 1]
    return result


def _ends(axes: int) -> list[tuple]:
    return [(slice(None),) * axis + (end,) for axis in range(axes) for end in (0, -1)]


def _keep_pieces(free: np.ndarray, side: float, options: ImportOptions, report: ImportReport) -> np.ndarray:
    """The pieces of free space that a robot fits in and that are not small beside the largest one."""
    labels, count = ndimage.label(free)
    if not count:
        raise MapError(
            f"{report.path}: voxels of {side:g} m leave no passage: nothing is free; set a smaller "
            "importing.resolution, or check importing.up and importing.units"
        )
    sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    body = Body(radius=options.robot_radius or Body().radius)
    fits = passable(np.pad(free, 1), np.pad(~free, 1), body, side)[1:-1, 1:-1, 1:-1]
    room = np.bincount(labels[fits], minlength=count + 1)[1:] > 0
    if not room.any():
        raise MapError(
            f"{report.path}: voxels of {side:g} m leave no passage for a robot of {body.radius:g} m radius: set a "
            "smaller importing.resolution or robot.radius, or check units"
        )
    kept = room & (sizes >= KEPT_PIECE * sizes[room].max())
    result = np.concatenate([[False], kept])[labels]
    report.add("pieces", f"kept {int(kept.sum())} of {count} pieces of free space", int(free.sum()), int(result.sum()))
    if result.sum() < (1 - LOST_SHARE) * free.sum():
        lost = 1 - result.sum() / free.sum()
        report.warn(f"{lost:.0%} of the free space is in small pieces, or too narrow for a robot, and is left out")
    return result
