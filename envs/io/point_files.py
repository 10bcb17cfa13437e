"""Maps that are points already: our .npz, and MAexp's `*_freespace.npy`, `*_obstacles.npy`, `*_boundary.npy`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from maexp.envs.io.options import ImportOptions
from maexp.envs.io.report import ImportReport, printable
from maexp.envs.maps.point_cloud import MapError, PointCloudMap, check_file, read_npz
from maexp.envs.scenarios import find_scenario

KINDS = {
    "free": ("freespace", "free_space", "free"),
    "obstacles": ("obstacles", "obstacle"),
    "boundary": ("boundary", "boundaries"),
}


def read_npz_map(path: Path, options: ImportOptions, report: ImportReport) -> PointCloudMap:
    """A map saved by `PointCloudMap.save`, or any .npz that holds free and obstacle points by MAexp's names."""
    arrays = read_npz(path)
    if "format" in arrays:
        world = PointCloudMap.load(path)
        try:
            find_scenario(world.scenario)
        except ValueError as error:
            raise MapError(f"{path}: {error}") from error
        report.add("read", f"{path.name}: a saved map", after=len(world.free) + len(world.obstacles))
        return world
    found = {kind: next((n for n in names if n in arrays), None) for kind, names in KINDS.items()}
    clouds = {kind: arrays[name] for kind, name in found.items() if name}
    return _make_map(path, printable(path.stem), clouds, options, report)


def read_npy_triple(path: Path, options: ImportOptions, report: ImportReport) -> PointCloudMap:
    """The map one of whose `<name>_freespace.npy`, `_obstacles.npy`, `_boundary.npy` files is `path`."""
    endings = [f"_{name}" for names in KINDS.values() for name in names]
    ending = next((end for end in endings if path.stem.lower().endswith(end)), None)
    if ending is None:
        raise MapError(
            f"{path} is not one of MAexp's arrays; its name must end in _freespace.npy, _obstacles.npy or _boundary.npy"
        )
    stem = path.stem[: -len(ending)]
    clouds = {}
    for kind, names in KINDS.items():
        files = [path.with_name(f"{stem}_{name}.npy") for name in names]
        present = next((file for file in files if file.is_file()), None)
        if present is not None:
            clouds[kind] = _read_npy(present)
        elif kind != "boundary":
            raise MapError(f"{files[0]} does not exist; it belongs beside {path.name}")
    return _make_map(path, printable(stem), clouds, options, report)


def _read_npy(path: Path) -> np.ndarray:
    check_file(path)
    with path.open("rb") as file:
        if file.read(6) != b"\x93NUMPY":
            raise MapError(f"{path} is no .npy file: it does not begin with NumPy's mark; save it again")
    try:
        array = np.load(path, allow_pickle=False, mmap_mode="r")  # a header cannot promise more than the file holds
        return np.array(array)
    except Exception as error:  # NumPy raises whatever odd headers make it raise
        raise MapError(f"{path} is not a readable .npy file ({error}); save it again") from error


def _make_map(path, name, clouds: dict, options: ImportOptions, report: ImportReport) -> PointCloudMap:
    if not {"free", "obstacles"} <= clouds.keys():
        raise MapError(f"{path} holds no free and obstacle points (names: freespace, obstacles, boundary)")
    scenario = "pointcloud" if options.scenario == "auto" else options.scenario
    resolution = options.resolution or _typical_spacing(path, clouds["free"])
    clouds, heights = _flatten(clouds)
    try:
        world = PointCloudMap(
            clouds["free"],
            clouds["obstacles"],
            resolution,
            name=options.name or name,
            scenario=scenario,
            boundary=clouds.get("boundary"),
            **heights,
        )
    except MapError as error:
        raise MapError(f"{path}: {error}") from error
    given = sum(len(cloud) for cloud in clouds.values())
    kept = len(world.free) + len(world.obstacles) + (len(world.boundary) if "boundary" in clouds else 0)
    report.add("read", f"{', '.join(clouds)}; duplicates dropped; {resolution:g} m between points", given, kept)
    return world


def _flatten(clouds: dict) -> tuple[dict, dict]:
    """Clouds with z = 0, and the heights of free and obstacle points where they have any."""
    heights, flat = {}, dict(clouds)
    names = {"free": "free_height", "obstacles": "obstacle_height"}
    for kind, cloud in clouds.items():
        if cloud.ndim == 2 and cloud.shape[1] == 3 and cloud.dtype.kind in "fiu" and cloud[:, 2].any():
            flat[kind] = cloud[:, :2]
            if kind in names:
                heights[names[kind]] = cloud[:, 2]
    return flat, heights


def _typical_spacing(path, free: np.ndarray) -> float:
    """Median distance of a free point to its nearest neighbour [m]."""
    good = free.ndim == 2 and free.shape[1] in (2, 3) and len(free) > 1 and free.dtype.kind in "fiu"
    if not good or not np.isfinite(free).all():
        if good:
            raise MapError(f"{path}: free points are NaN or infinite; remove them")
        raise MapError(f"{path}: free points have shape {free.shape} {free.dtype}; at least 2 of shape (n, 3) [m]")
    planar = np.unique(free[:, :2].astype(np.float64), axis=0)
    if len(planar) < 2:
        raise MapError(f"{path}: all free points are in one place; give resolution")
    away, _ = cKDTree(planar).query(planar, k=[2])
    return float(np.float32(np.median(away)))
