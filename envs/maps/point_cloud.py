"""A place as point clouds: free, obstacle and boundary points in metres, and their file format."""

from __future__ import annotations

import os
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from maexp.envs.atomic_write import whole_file

BOUNDARY_REACH = 1.5  # an obstacle point bounds free space within this many spacings of a free point
MAX_POINTS = 20_000_000  # of a scan; a file that promises more is refused before anything is allocated
MAX_MAP_POINTS = 4_000_000  # of a map, per cloud
MAX_SPACING_RATIO = 64.0  # largest over smallest spacing of a map
MISJUDGED = 8.0  # the resolution may differ from the free points' usual distance by this factor
MAX_FILE_BYTES = 2 * 1024**3  # of a map file, packed or unpacked
_FORMAT = "maexp-map-1"
_CLOUDS = ("free", "obstacles", "boundary")
_PER_POINT = ("free_spacing", "obstacle_spacing", "free_height", "obstacle_height")
_TEXTS = ("format", "name", "scenario")


class MapError(ValueError):
    """A map that cannot be used: says what was found and what to do."""


@dataclass(frozen=True, eq=False, init=False, repr=False)
class PointCloudMap:
    """Free, obstacle and boundary points of a place.

    Args:
        free: explorable points [m], shape [free_count, 3] (or [free_count, 2], then z = 0).
        obstacles: points that block motion and sight [m], shape [obstacle_count, 3] or [obstacle_count, 2].
        resolution: spacing of the points [m].
        name: what tables and file names call the map.
        scenario: whose parameters (robot, radar, steps) fit the map; "pointcloud" for imports.
        boundary: obstacle points that touch free space [m], shape [boundary_count, 3]; default: the obstacle
            points within 1.5 spacings of a free point.
        free_spacing, obstacle_spacing: spacing around each point [m], shape [count]; default: `resolution`.
        free_height, obstacle_height: heights of the scan [m], shape [count], for drawing; optional.

    Exact duplicates are removed; otherwise points keep the order given. Arrays are float32.

    Raises:
        MapError: empty free space, wrong shapes, NaN or infinite values, resolution <= 0 or far from the points'
            distances, spacings that differ too much, or coordinates too large for float32.
    """

    free: np.ndarray
    obstacles: np.ndarray
    boundary: np.ndarray
    resolution: float
    name: str
    scenario: str
    free_spacing: np.ndarray
    obstacle_spacing: np.ndarray
    boundary_spacing: np.ndarray
    free_height: np.ndarray | None
    obstacle_height: np.ndarray | None

    def __init__(
        self,
        free,
        obstacles,
        resolution: float,
        *,
        name: str = "map",
        scenario: str = "pointcloud",
        boundary=None,
        free_spacing=None,
        obstacle_spacing=None,
        free_height=None,
        obstacle_height=None,
    ):
        resolution = _check_resolution(resolution)
        free, free_mask = _check_cloud("free", free, resolution)
        obstacles, obstacle_mask = _check_cloud("obstacles", obstacles, resolution)
        if not len(free):
            raise MapError("free has 0 points; a map needs at least one free point to explore")
        free_spacing = _check_spacing("free_spacing", free_spacing, free_mask, resolution)
        obstacle_spacing = _check_spacing("obstacle_spacing", obstacle_spacing, obstacle_mask, resolution)
        _check_distances(free, resolution)
        if boundary is None:
            touching = find_boundary(free, obstacles, np.maximum(obstacle_spacing, resolution))
            boundary, boundary_spacing = obstacles[touching], obstacle_spacing[touching]
        else:
            boundary, _ = _check_cloud("boundary", boundary, resolution)
            boundary_spacing = _spacing_of_nearest(boundary, obstacles, obstacle_spacing, resolution)
        values = {
            "free": free,
            "obstacles": obstacles,
            "boundary": boundary,
            "resolution": resolution,
            "name": str(name),
            "scenario": str(scenario),
            "free_spacing": free_spacing,
            "obstacle_spacing": obstacle_spacing,
            "boundary_spacing": boundary_spacing,
            "free_height": None if free_height is None else _check_per_point("free_height", free_height, free_mask),
            "obstacle_height": (
                None if obstacle_height is None else _check_per_point("obstacle_height", obstacle_height, obstacle_mask)
            ),
        }
        for field, value in values.items():
            object.__setattr__(self, field, value)

    @property
    def extent(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """((xmin, ymin), (xmax, ymax)) [m]: the bounding box of the free and the boundary points."""
        planar = np.concatenate([self.free[:, :2], self.boundary[:, :2]])
        (xmin, ymin), (xmax, ymax) = planar.min(axis=0).tolist(), planar.max(axis=0).tolist()
        return (xmin, ymin), (xmax, ymax)

    @property
    def free_area(self) -> float:
        """Area the free points stand for [m^2]: the sum of their spacings squared."""
        return float(np.square(self.free_spacing, dtype=np.float64).sum())

    def __repr__(self) -> str:
        return (
            f"PointCloudMap({self.name!r}, {len(self.free)} free, {len(self.obstacles)} obstacle, "
            f"{len(self.boundary)} boundary points at {self.resolution:g} m)"
        )

    def save(self, path: str | os.PathLike) -> Path:
        """Writes the map as .npz (no pickle); the file appears whole or not at all.

        Raises MapError where it cannot be written: no such folder, a full disk.
        """
        return write_npz(path, self.to_arrays())

    def to_arrays(self) -> dict[str, np.ndarray]:
        """The arrays of a map file, to write them beside others."""
        arrays = {name: getattr(self, name) for name in _CLOUDS + _PER_POINT}
        arrays = {name: array for name, array in arrays.items() if array is not None}
        texts = {"format": _FORMAT, "name": self.name, "scenario": self.scenario}
        arrays |= {name: np.array(text, dtype=np.str_) for name, text in texts.items()}
        return arrays | {"resolution": np.float64(self.resolution)}

    @classmethod
    def load(cls, path: str | os.PathLike) -> PointCloudMap:
        """Reads what `save` wrote; raises MapError on any other or damaged file."""
        return cls.from_arrays(read_npz(path), path)

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray], path: str | os.PathLike) -> PointCloudMap:
        """The map among the arrays that `path` held; raises MapError as `load` does."""
        missing = {"format", "name", "scenario", "resolution", *_CLOUDS} - arrays.keys()
        if missing:
            raise MapError(
                f"{path} is a .npz file but not a MAexp map (no {', '.join(sorted(missing))}); "
                "save maps with PointCloudMap.save"
            )
        texts = {name: _as_text(path, name, arrays[name]) for name in _TEXTS}
        if texts["format"] != _FORMAT:
            raise MapError(f"{path} has map format {texts['format']!r}; this version reads {_FORMAT!r}")
        if arrays["resolution"].shape != () or arrays["resolution"].dtype.kind not in "fiu":
            raise MapError(f"{path}: resolution must be one number, found shape {arrays['resolution'].shape}")
        fields = {name: arrays[name] for name in _CLOUDS + _PER_POINT if name in arrays}
        try:
            return cls(
                **fields,
                resolution=float(arrays["resolution"]),
                name=texts["name"],
                scenario=texts["scenario"],
            )
        except MapError as error:
            raise MapError(f"{path}: {error}") from error


def find_boundary(free: np.ndarray, obstacles: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """Obstacle points that touch free space: within 1.5 `spacing` [m] of a free one; bool [count]."""
    if not len(obstacles):
        return np.zeros(0, dtype=bool)
    reach = BOUNDARY_REACH * np.asarray(spacing, dtype=np.float64) * (1 + 1e-6)  # float32 may round up
    distance, _ = cKDTree(free).query(obstacles, distance_upper_bound=float(reach.max()) * (1 + 1e-9))
    return distance <= reach


def write_npz(path: str | os.PathLike, arrays: dict[str, np.ndarray]) -> Path:
    """Writes arrays as .npz (no pickle); the file appears whole or not at all.

    Raises MapError where it cannot be written: no such folder, a full disk.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise MapError(f"{path} lies in no folder: make {path.parent} first")
    try:
        with whole_file(path) as part, open(part, "wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)
    except OSError as error:
        raise MapError(f"{path} could not be written ({error.strerror or error}): choose another place") from error
    return path


def read_npz(path: str | os.PathLike) -> dict[str, np.ndarray]:
    """All arrays of an .npz file, sizes checked before anything is allocated; never unpickles."""
    path = Path(path)
    check_file(path)
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            if sum(member.file_size for member in members) > MAX_FILE_BYTES or len(members) > 64:
                raise MapError(
                    f"{path} unpacks to more than {MAX_FILE_BYTES / 2**30:g} GiB or 64 arrays; no MAexp map is so large"
                )
            for member in members:
                _check_member(path, archive, member)
        with np.load(path, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except MapError:
        raise
    except (MemoryError, NotImplementedError, RuntimeError) as error:
        raise MapError(f"{path} cannot be unpacked ({error}); save it again without encryption") from error
    except Exception as error:  # zipfile and NumPy raise whatever odd headers make them raise
        reason = f"{path} is not a readable .npz file ({error}); it may be truncated: save it again"
        raise MapError(reason) from error


def check_file(path: Path, most: int | None = MAX_FILE_BYTES) -> None:
    """Raises MapError unless `path` is a readable, non-empty regular file of at most `most` bytes (None: any size)."""
    try:
        if not path.exists():
            raise MapError(f"{path} does not exist; check the path")
        if not path.is_file():
            raise MapError(f"{path} is not a file; give the path of a map file")
        size = path.stat().st_size
    except OSError as error:  # a name too long, a folder that may not be entered
        raise MapError(f"{str(path)[:200]} cannot be looked up ({error.strerror}); check the path") from error
    if size == 0 or (most is not None and size > most):
        told = "at least 1" if most is None else f"between 1 and {most}"
        raise MapError(f"{path} has {size} bytes; a map file has {told}")
    if not os.access(path, os.R_OK):
        raise MapError(f"{path} cannot be read; change its permissions")


def _check_member(path: Path, archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> None:
    """An array's header must promise exactly the bytes its member holds."""
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        header = np.lib.format
        read = header.read_array_header_1_0 if version == (1, 0) else header.read_array_header_2_0
        shape, _, dtype = read(file)
        count = 1
        for length in shape:  # Python integers: a product of crafted lengths must not wrap around
            count *= length
        found = f"array {member.filename} promises {shape} {dtype}"
        if dtype.hasobject:
            raise MapError(f"{path}: {found}, which are pickled and never loaded; save numbers")
        if count * dtype.itemsize > member.file_size:
            raise MapError(f"{path}: {found}, which the file does not hold; save it again")
        if count > 3 * MAX_MAP_POINTS:
            raise MapError(f"{path}: {found}; a map has at most {MAX_MAP_POINTS} points, thin it")


def _as_text(path, name: str, array: np.ndarray) -> str:
    if array.dtype.kind != "U" or array.shape != () or len(str(array)) > 1000:
        raise MapError(f"{path}: {name} must be one short text, found {array.dtype} {array.shape}")
    if not str(array).isprintable():
        raise MapError(f"{path}: {name} holds control characters: {str(array)[:40]!r}")
    return str(array)


def _check_resolution(resolution) -> float:
    try:
        value = float(resolution)
    except (TypeError, ValueError):
        raise MapError(f"resolution={resolution!r} must be a number of metres") from None
    if not (np.isfinite(value) and value > 0):
        raise MapError(f"resolution={value} must be finite and greater than 0 m")
    return value


def _check_cloud(name: str, points, resolution: float) -> tuple[np.ndarray, _Kept]:
    """Float32 [kept, 3] without exact duplicates, and which of the given points were kept."""
    try:
        points = np.asarray(points)
    except ValueError:
        raise MapError(f"{name} is ragged; give an array of shape (n, 3)") from None
    if points.dtype.kind not in "fiu":
        raise MapError(f"{name} has dtype {points.dtype}; give numbers in metres, shape (n, 3)")
    if points.size == 0:
        return np.zeros((0, 3), dtype=np.float32), _Kept(0, None)
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise MapError(f"{name} has shape {points.shape}; give an array of shape (n, 3) in metres")
    if len(points) > MAX_MAP_POINTS:
        raise MapError(f"{name} has {len(points)} points; thin it (a larger resolution) to {MAX_MAP_POINTS}")
    bad = int((~np.isfinite(points)).any(axis=1).sum())
    if bad:
        raise MapError(f"{name} has {bad} points that are NaN or infinite; remove them")
    largest = float(np.abs(points).max())
    if largest * 2.0**-23 > 0.1 * resolution:
        raise MapError(
            f"{name} has coordinates up to {largest:g} m, too large for float32 at {resolution:g} m; "
            "subtract an offset from all points"
        )
    cloud = np.zeros((len(points), 3), dtype=np.float32)
    cloud[:, : points.shape[1]] = points
    cloud += 0.0  # -0.0 and 0.0 are one place
    if cloud[:, 2].any():
        highest = float(np.abs(cloud[:, 2]).max())
        raise MapError(f"{name} has z up to {highest:g} m; maps are planar: set z = 0 and give heights apart")
    kept = _first_occurrences(cloud)
    return (cloud if kept is None else cloud[kept]), _Kept(len(points), kept)


@dataclass(frozen=True)
class _Kept:
    """Which of `given` points survived the removal of duplicates (None: all)."""

    given: int
    indices: np.ndarray | None


def _first_occurrences(cloud: np.ndarray) -> np.ndarray | None:
    rows = np.ascontiguousarray(cloud).view([("", np.float32)] * 3).ravel()
    _, first = np.unique(rows, return_index=True)
    return None if len(first) == len(cloud) else np.sort(first)


def _check_per_point(name: str, values, kept: _Kept) -> np.ndarray:
    values = np.asarray(values)
    if values.dtype.kind not in "fiu" or values.shape != (kept.given,):
        raise MapError(f"{name} has shape {values.shape}; give one number per point, shape ({kept.given},)")
    if not np.isfinite(values).all():
        raise MapError(f"{name} has NaN or infinite values; remove them")
    values = values.astype(np.float32)
    return values if kept.indices is None else values[kept.indices]


def _check_spacing(name: str, values, kept: _Kept, resolution: float) -> np.ndarray:
    if values is None:
        count = kept.given if kept.indices is None else len(kept.indices)
        return np.full(count, resolution, dtype=np.float32)
    spacing = _check_per_point(name, values, kept)
    if len(spacing) and spacing.min() <= 0:
        raise MapError(f"{name} has values down to {spacing.min():g}; a spacing must be greater than 0 m")
    low, high = min(spacing.min(initial=resolution), resolution), max(spacing.max(initial=resolution), resolution)
    if high > MAX_SPACING_RATIO * low:
        found = f"{name} and resolution range from {low:g} to {high:g} m"
        raise MapError(f"{found}, more than {MAX_SPACING_RATIO:g} to 1; bring them closer together")
    return spacing


def _check_distances(free: np.ndarray, resolution: float) -> None:
    """The resolution must be about how far the free points lie from one another, lest everything or nothing touches."""
    if len(free) < 20:
        return
    away, _ = cKDTree(free).query(free[:: max(1, len(free) // 200)], k=[2])
    usual = float(np.median(away))
    if not resolution / MISJUDGED <= usual <= resolution * MISJUDGED:
        raise MapError(
            f"resolution={resolution:g} m, but free points lie {usual:g} m apart: give the spacing of the points"
        )


def _spacing_of_nearest(points, obstacles, spacing, resolution) -> np.ndarray:
    if not len(points) or not len(obstacles):
        return np.full(len(points), resolution, dtype=np.float32)
    _, nearest = cKDTree(obstacles).query(points)
    return spacing[nearest]
