"""Clouds from files that need an optional package: .las and .laz, meshes, octrees."""

from __future__ import annotations

import importlib
import logging
import re
import struct
from pathlib import Path

import numpy as np

from maexp.envs.io.cloud_files import Cloud, check_rest
from maexp.envs.maps.point_cloud import MAX_POINTS, MapError

GEO_UNITS = {9001: 1.0, 9002: 0.3048, 9003: 1200 / 3937}  # EPSG codes of linear units, in metres
PROJECTED_UNIT_KEY = 3076  # ProjLinearUnitsGeoKey
NOISE = (7, 18)  # LAS classes of low and high noise
MAX_SAMPLES = 3_000_000


def read_las(path: Path) -> Cloud:
    """Points of a .las or .laz file without those classed as noise; units from its geo keys or WKT."""
    laspy = _need("laspy", "las", path)
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
        noise = np.isin(np.asarray(data.classification), NOISE)
        unit = _las_unit(data.header)
    except MapError:
        raise
    except BaseException as error:  # the decompressor panics, which is no Exception, on damaged files
        if isinstance(error, KeyboardInterrupt | SystemExit):
            raise
        raise MapError(f"{path} cannot be read ({type(error).__name__}: {error}); it may be truncated") from error
    if len(points) != promised or promised == 0:
        raise MapError(f"{path} promises {promised} points, {len(points)} could be read; save it again")
    return Cloud(points[~noise], metres_per_unit=unit, up="z", outdoor=True)


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


def _las_unit(header) -> float | None:
    """Metres per unit by geo key 3076, else by the last UNIT of a WKT projection; None: the file does not say."""
    for record in [*header.vlrs, *(header.evlrs or [])]:
        for key in getattr(record, "geo_keys", []):
            if key.id == PROJECTED_UNIT_KEY and key.value_offset in GEO_UNITS:
                return GEO_UNITS[key.value_offset]
        text = getattr(record, "string", "")
        if isinstance(text, str) and "PROJCS" in text:
            plane = text.split("VERT_CS")[0]
            factors = re.findall(r'UNIT\["[^"]*",\s*([0-9.eE+-]+)', plane)
            if factors:
                return float(factors[-1])
    return None


def read_mesh(path: Path, spacing: float) -> Cloud:
    """Points spread evenly over a mesh, one for every `spacing` squared of its surface [file units]; seeded."""
    trimesh = _need("trimesh", "mesh", path)
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)
    try:
        mesh = trimesh.load(path, force="mesh", process=False, skip_materials=True)
        area = float(mesh.area)
        if not (np.isfinite(area) and area > 0):
            raise MapError(f"{path} has {len(mesh.vertices)} vertices and no surface of finite area; check the mesh")
        count = round(area / spacing**2)
        if not 1 <= count <= MAX_SAMPLES:
            raise MapError(
                f"{path} has {area:g} square units of surface: {count} points at sample_spacing={spacing:g} are not "
                f"between 1 and {MAX_SAMPLES}; check units, or set sample_spacing"
            )
        points, _ = trimesh.sample.sample_surface(mesh, count, seed=0)
    except MapError:
        raise
    except Exception as error:  # trimesh raises whatever its loaders raise on damaged files
        raise MapError(f"{path} is not a readable mesh ({type(error).__name__}: {error}); save it again") from error
    up = "y" if path.suffix.lower() in (".glb", ".gltf") else "auto"  # glTF is Y-up and in metres by its standard
    return Cloud(np.asarray(points, dtype=np.float64), up=up)


def read_octree(path: Path) -> Cloud:
    """Centres of the occupied and of the free voxels of an OctoMap .bt file."""
    pyoctomap = _need("pyoctomap", "octree", path)
    resolution, promised = _check_octree(path)
    try:
        tree = pyoctomap.OcTree(str(path).encode())
        leaves = [(*leaf.getCoordinate(), leaf.getSize(), tree.isNodeOccupied(leaf)) for leaf in tree.begin_leafs()]
    except Exception as error:
        raise MapError(f"{path} is not a readable octree ({error}); save it again") from error
    if not leaves:
        raise MapError(f"{path} promises {promised} nodes and none could be read; save it again")
    table = np.array(leaves, dtype=np.float64)
    expanded = _split_voxels(table[:, :3], table[:, 3], resolution)
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


def _split_voxels(centres: np.ndarray, sizes: np.ndarray, resolution: float) -> np.ndarray:
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


def _need(package: str, extra: str, path: Path):
    try:
        return importlib.import_module(package)
    except ImportError as error:
        command = f'pip install "maexp[{extra}]"'
        raise MapError(f"{path} needs the package {package}, which is not installed; {command}") from error
