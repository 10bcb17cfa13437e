"""Clouds from files that need an optional package: .las and .laz, octrees."""

from __future__ import annotations

import logging
import re
import struct
from pathlib import Path

import numpy as np

from maexp.envs.io.cloud_files import Cloud, check_rest
from maexp.envs.io.las_units import find_units
from maexp.envs.io.mesh_files import need
from maexp.envs.maps.point_cloud import MAX_POINTS, MapError

NOISE = (7, 18)  # LAS classes of low and high noise


def read_las(path: Path, units_set: bool = False) -> Cloud:
    """Points of a .las or .laz file without noise and what is flagged as withheld; units from its geo keys or WKT.

    Args:
        units_set: somebody else says what the units are.
    """
    laspy = need("laspy", "las", path)
    logging.getLogger("laspy").setLevel(logging.CRITICAL)
    _check_las(path)
    try:
        # One thread: the parallel reader aborts the process where a damaged table of chunks asks for too much memory.
        with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs) as file:
            promised = file.header.point_count
            if promised > MAX_POINTS:
                raise MapError(f"{path} promises {promised} points; thin it to {MAX_POINTS}")
            if path.suffix.lower() == ".las" and promised * file.header.point_format.size > path.stat().st_size:
                raise MapError(f"{path} is truncated: it promises {promised} points in {path.stat().st_size} bytes")
            plain = path.suffix.lower() == ".las" and not file.header.number_of_evlrs
            if plain and not file.header.global_encoding.waveform_data_packets_internal:
                stride = file.header.point_format.size
                check_rest(path, file.header.offset_to_point_data + promised * stride, stride)
            data = file.read()
        points = np.stack([np.asarray(data.x), np.asarray(data.y), np.asarray(data.z)], axis=1).astype(np.float64)
        left_out = np.isin(np.asarray(data.classification), NOISE) | np.asarray(data.withheld).astype(bool)
        plane, height = (None, None) if units_set else find_units(path, data.header)
    except MapError:
        raise
    except BaseException as error:  # the decompressor panics, which is no Exception, on damaged files
        if isinstance(error, KeyboardInterrupt | SystemExit):
            raise
        raise MapError(f"{path} cannot be read ({type(error).__name__}: {error}); it may be truncated") from error
    if len(points) != promised or promised == 0:
        raise MapError(f"{path} promises {promised} points, {len(points)} could be read; save it again")
    points = points[~left_out]
    if not len(points):
        raise MapError(f"{path}: all its {promised} points are classed as noise or flagged as withheld")
    return Cloud(points, metres_per_unit=plane, metres_per_height=height, up="z", outdoor=True)


def _check_las(path: Path) -> None:
    """The records a LAS header promises must fit in the file: laspy would read all of them, however many."""
    with path.open("rb") as file:
        head = file.read(375)
    if not head.startswith(b"LASF") or len(head) < 227:
        raise MapError(f"{path} is no LAS file (it does not begin with LASF); it is damaged or of another kind")
    size = path.stat().st_size
    header, points, records = struct.unpack_from("<HII", head, 94)
    late = struct.unpack_from("<QI", head, 235) if head[25] >= 4 and len(head) >= 247 else (0, 0)
    if header + 54 * records > points or points > size or late[0] + 60 * late[1] > size:
        raise MapError(f"{path} is damaged: its header promises more records than the file holds; save it again")
    if path.suffix.lower() == ".laz":
        _check_chunks(path, points, size)


def _check_chunks(path: Path, points: int, size: int) -> None:
    """The table of chunks of a .laz file: its place stands in front of the points, and it holds no more than fit."""
    with path.open("rb") as file:
        file.seek(points)
        at = struct.unpack("<q", file.read(8).ljust(8, b"\0"))[0]
        if at == -1:  # written by a program that could not go back
            file.seek(size - 8)
            at = struct.unpack("<q", file.read(8))[0]
        if points < at <= size - 8:
            file.seek(at)
            version, chunks = struct.unpack("<II", file.read(8))
            if version == 0 and chunks <= at - points:
                return
    raise MapError(f"{path} is damaged: it holds no table of its compressed points; save it again")


def read_octree(path: Path) -> Cloud:
    """Centres of the occupied and of the free voxels of an OctoMap .bt file."""
    pyoctomap = need("pyoctomap", "octree", path)
    resolution, promised = _check_octree(path)
    try:
        tree = pyoctomap.OcTree(str(path).encode())
        leaves = [(*leaf.getCoordinate(), leaf.getSize(), tree.isNodeOccupied(leaf)) for leaf in tree.begin_leafs()]
    except Exception as error:
        raise MapError(f"{path} is not a readable octree ({error}); save it again") from error
    if not leaves:
        raise MapError(f"{path} promises {promised} nodes and none could be read; save it again")
    table = np.array(leaves, dtype=np.float64)
    expanded = split_voxels(table[:, :3], table[:, 3], resolution)
    occupied = np.repeat(table[:, 4] > 0, np.rint(table[:, 3] / resolution).astype(int).clip(1) ** 3)
    if not occupied.any():
        raise MapError(f"{path} has no occupied voxel; nothing would bound the free space")
    return Cloud(expanded[occupied], open_space=expanded[~occupied], metres_per_unit=1.0, up="z", spacing=resolution)


def _check_octree(path: Path) -> tuple[float, int]:
    """Resolution [m] and number of nodes of a .bt header that its data can hold: two bytes each inner node."""
    with path.open("rb") as file:
        head = file.read(4096)
    start = head.find(b"\ndata")
    found = {key: re.search(rb"\n" + key + rb"\s+(\S+)", head[:start]) for key in (b"res", b"size")}
    if not head.startswith(b"# Octomap OcTree binary") or start < 0 or None in found.values():
        raise MapError(f"{path} is no binary OctoMap octree; .bt files of octomap are read")
    try:
        resolution, nodes = float(found[b"res"][1]), int(found[b"size"][1])
    except ValueError as error:
        raise MapError(f"{path} has a damaged octree header ({error}); save it again") from error
    rest = path.stat().st_size - start - 6
    if not 1e-3 <= resolution <= 100 or not 0 < nodes or rest < 2 or nodes > 8 * (rest // 2) + 1:
        raise MapError(f"{path} is truncated: it promises {nodes} nodes of {resolution:g} m and holds {rest} bytes")
    return resolution, nodes


def split_voxels(centres: np.ndarray, sizes: np.ndarray, resolution: float) -> np.ndarray:
    """Centres [m] of the finest voxels that make up voxels of `sizes` [m], in their order."""
    ratio = np.rint(sizes / resolution).astype(np.int64).clip(1)
    total = int((ratio**3).sum())
    if total > MAX_POINTS:
        raise MapError(f"the octree stands for {total} voxels of {resolution:g} m; at most {MAX_POINTS} are read")
    counts = ratio**3
    start = np.repeat(np.cumsum(counts) - counts, counts)
    inside, side = np.arange(total) - start, np.repeat(ratio, counts)
    index = np.stack([inside % side, inside // side % side, inside // side**2], axis=1)
    return np.repeat(centres, counts, axis=0) + (index + 0.5 - side[:, None] / 2) * resolution
