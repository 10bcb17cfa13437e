"""Surfaces and known free space of a file as sets of voxels: meshes, clouds and octrees."""

from __future__ import annotations

import logging
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from maexp.envs.io.cloud_extras import read_las, read_octree, split_voxels
from maexp.envs.io.cloud_files import Cloud, read_xyz
from maexp.envs.io.mesh_files import need, read_triangles
from maexp.envs.io.pcd_files import read_pcd
from maexp.envs.io.ply_files import read_ply
from maexp.envs.maps.point_cloud import MapError

MESHES = (".stl", ".obj", ".glb", ".gltf")
OCTREES = (".bt", ".ot")
CLOUDS = (".pcd", ".ply", ".xyz", ".las", ".laz")
VOLUME_FILES = (*CLOUDS, *MESHES, *OCTREES)
MAX_TRIANGLES = 20_000_000  # after cutting them to the size of a voxel
CHUNK = 400_000  # triangles that are cut at once
MAX_FACES = 5_000_000  # of a file


def read_surfaces(path: Path) -> tuple[Cloud, np.ndarray | None]:
    """The points of a file, and its triangles float64 [count, 3, 3] where it is a mesh; in the units of the file."""
    suffix = path.suffix.lower()
    if suffix == ".ot":
        return read_full_octree(path), None
    if suffix == ".bt":
        return read_octree(path), None
    if suffix in (".las", ".laz"):
        return read_las(path), None
    if suffix in (".pcd", ".xyz"):
        return (read_pcd if suffix == ".pcd" else read_xyz)(path), None
    vertices, faces = read_ply(path) if suffix == ".ply" else _read_mesh(path)
    if not len(faces):
        return Cloud(vertices), None
    if len(faces) > MAX_FACES:
        raise MapError(f"{path} has {len(faces)} triangles; at most {MAX_FACES} are read: simplify it")
    triangles = np.asarray(vertices, dtype=np.float64)[faces]
    if not np.isfinite(triangles).all():
        raise MapError(f"{path} has vertices that are NaN or infinite; save the mesh again")
    up = "y" if suffix in (".glb", ".gltf") else "auto"
    return Cloud(triangles.reshape(-1, 3), up=up), triangles


def _read_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    need("trimesh", "mesh", path)
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)
    return read_triangles(path)


def cut_triangles(triangles: np.ndarray, longest: float):
    """Yields points of the triangles [count, 3, 3] [m], such that no part of them is `longest` [m] from a point.

    Each triangle is halved across its longest edge until none is longer.

    Raises:
        MapError: that takes too many triangles for the surface.
    """
    edges = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = 0.5 * np.linalg.norm(edges, axis=1).sum()
    length = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).sum()
    expected = 6.0 * area / longest**2 + 4.0 * length / longest
    if not expected <= MAX_TRIANGLES:
        raise MapError(
            f"the mesh has {area:g} m2 of surface, too much for voxels of {1.25 * longest:g} m: check units, or set a "
            "larger importing.resolution"
        )
    left = [triangles[start : start + CHUNK] for start in range(0, len(triangles), CHUNK)]
    while left:
        part = left.pop()
        edge = np.linalg.norm(part - np.roll(part, -1, axis=1), axis=2)  # from corner k to corner k + 1
        small = edge.max(axis=1) <= longest
        if small.any():
            done = part[small]
            yield np.concatenate([done.reshape(-1, 3), done.mean(axis=1)])
        part, first = part[~small], edge[~small].argmax(axis=1)
        if not len(part):
            continue
        rows = np.arange(len(part))
        a, b, c = (part[rows, (first + k) % 3] for k in range(3))
        middle = 0.5 * (a + b)
        halves = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
        left += [halves[start : start + CHUNK] for start in range(0, len(halves), CHUNK)]


def read_full_octree(path: Path) -> Cloud:
    """Centres of the occupied and of the free voxels of an OctoMap .ot file with plain or coloured nodes."""
    pyoctomap = need("pyoctomap", "octree", path)
    with path.open("rb") as file:
        head = file.read(4096)
    start = head.find(b"\ndata")
    found = {key: re.search(rb"\n" + key + rb"\s+(\S+)", head[:start]) for key in (b"id", b"res", b"size")}
    if not head.startswith(b"# Octomap OcTree file") or start < 0 or None in found.values():
        raise MapError(f"{path} is no OctoMap octree; .ot files of octomap are read")
    kind = found[b"id"][1].decode("ascii", errors="replace")
    bytes_per_node = {"OcTree": 5, "ColorOcTree": 8}.get(kind)
    if bytes_per_node is None:
        raise MapError(f"{path} holds a tree of kind {kind[:40]!r}; OcTree and ColorOcTree are read")
    try:
        resolution, nodes = float(found[b"res"][1]), int(found[b"size"][1])
    except ValueError as error:
        raise MapError(f"{path} has a damaged octree header ({error}); save it again") from error
    rest = path.stat().st_size - start - 6
    if not 1e-3 <= resolution <= 100 or not 0 < nodes <= rest // bytes_per_node:
        raise MapError(f"{path} is truncated: it promises {nodes} nodes of {resolution:g} m and holds {rest} bytes")
    try:
        tree = getattr(pyoctomap, kind)(resolution).read(str(path))
        leaves = [(*leaf.getCoordinate(), leaf.getSize(), tree.isNodeOccupied(leaf)) for leaf in tree.begin_leafs()]
    except Exception as error:
        raise MapError(f"{path} is not a readable octree ({error}); save it again") from error
    table = np.array(leaves, dtype=np.float64).reshape(-1, 5)
    occupied = table[:, 4] > 0
    if not occupied.any():
        raise MapError(f"{path} has no occupied voxel; nothing would bound the free space")
    full, empty = (split_voxels(table[k, :3], table[k, 3], resolution) for k in (occupied, ~occupied))
    return Cloud(full, open_space=empty, metres_per_unit=1.0, up="z", spacing=resolution)


def drop_invalid(path: Path, cloud: Cloud, allowed: bool) -> Cloud:
    """Without NaN and infinite points; MapError where the file has some and they are not to be dropped."""
    good = np.isfinite(cloud.points).all(axis=1)
    if good.all():
        return cloud
    if not allowed:
        bad = int((~good).sum())
        raise MapError(f"{path} has {bad} points that are NaN or infinite; remove them, or set drop_invalid=true")
    return replace(cloud, points=cloud.points[good])
