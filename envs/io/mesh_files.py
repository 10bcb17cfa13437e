"""Meshes as clouds: triangles of .ply, .obj, .stl and .glb files, and points spread over them. Needs `trimesh`."""

from __future__ import annotations

import importlib
import json
import logging
import re
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np

from maexp.envs.io.cloud_files import Cloud, Faces, check_rest, float32_step, parse_numbers
from maexp.envs.io.ply_files import check_corners, fan, read_ply
from maexp.envs.maps.point_cloud import MapError

MAX_SAMPLES = 3_000_000
TRIANGLE_FAN = 6  # a mode of primitives that trimesh takes for single triangles
STL_HEAD, STL_ROW = 84, 50  # bytes
HARMLESS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_", "KHR_lights_", "KHR_xmp")
HARMLESS += ("EXT_lights_", "KHR_mesh_variants", "KHR_audio", "EXT_mesh_features", "EXT_structural_metadata")
UNPACK = "save it without (gltf-transform copy IN.glb OUT.glb, or Blender's export without compression)"


def read_mesh(path: Path, spacing: float) -> Cloud:
    """Points spread evenly over a mesh, one for every `spacing` squared of its surface [file units]; seeded."""
    need("trimesh", "mesh", path)
    vertices, triangles = read_triangles(path)
    return spread_points(path, vertices, triangles, spacing)


def read_ply_cloud(path: Path, spacing: float) -> Cloud:
    """The vertices of a .ply file, or where it has faces points spread over them."""
    vertices, triangles = read_ply(path)
    if len(triangles):
        return spread_points(path, vertices, triangles, spacing)
    return Cloud(vertices, step=float32_step(vertices))


def spread_points(path: Path, vertices: np.ndarray, triangles: np.ndarray, spacing: float) -> Cloud:
    """Points on triangles int [count, 3] between vertices [vertices, 3]."""
    trimesh = need("trimesh", "mesh", path)
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)
    used = vertices[triangles]
    if not np.isfinite(used).all():
        raise MapError(f"{path} has faces at vertices that are NaN or infinite; save it again")
    normals = np.cross(used[:, 1] - used[:, 0], used[:, 2] - used[:, 0])
    areas = np.linalg.norm(normals, axis=1) / 2
    area = float(areas.sum())
    if not (np.isfinite(area) and area > 0):
        raise MapError(f"{path} has {len(vertices)} vertices and no surface of finite area; check the mesh")
    count = round(area / spacing**2) if area / spacing**2 < 1e15 else 10**15
    if not 1 <= count <= MAX_SAMPLES:
        raise MapError(
            f"{path} has {area:g} square units of surface: {count} points at sample_spacing={spacing:g} are not "
            f"between 1 and {MAX_SAMPLES}; check units, or set sample_spacing"
        )
    mesh = trimesh.Trimesh(vertices, triangles, process=False, validate=False)
    points, _ = trimesh.sample.sample_surface(mesh, count, seed=0)
    real = areas > 0
    faces = _outward(Faces(used[real].mean(axis=1), normals[real] / (2 * areas[real, None]), areas[real]))
    glb = path.suffix.lower() == ".glb"  # Y-up and in metres by its standard
    return Cloud(
        np.asarray(points, dtype=np.float64),
        metres_per_unit=1.0 if glb else None,
        up="y" if glb else "auto",
        faces=faces,
        step=float32_step(np.unique(used.reshape(-1, 3), axis=0)),
    )


def _outward(faces: Faces) -> Faces:
    """Faces whose normals point out of what they bound: exporters that mirror turn all of them round."""
    arms = faces.centres - np.average(faces.centres, axis=0, weights=faces.areas)
    volume = float((faces.areas * (faces.normals * arms).sum(axis=1)).sum())
    inside_out = volume < -0.01 * float((faces.areas * np.linalg.norm(arms, axis=1)).sum())
    return replace(faces, normals=-faces.normals) if inside_out else faces


def read_triangles(path: Path) -> tuple[np.ndarray, np.ndarray]:
    suffix = path.suffix.lower()
    if suffix == ".obj":
        return _read_obj(path)
    return _read_stl(path) if suffix == ".stl" else _read_glb(path)


def _read_obj(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of an .obj; a negative index counts back from the last vertex above its line."""
    text = path.read_bytes().decode("utf-8-sig", errors="replace")
    text = re.sub(r"\\[ \t]*\r?\n", " ", text)
    vertices: list[str] = []
    faces: list[tuple[int, str]] = []  # vertices above, and the line
    for line in map(str.strip, text.split("\n")):
        if line[:2] in ("v ", "v\t"):
            vertices.append(" ".join(line.split("#")[0].split()[1:4]))
        elif line[:2] in ("f ", "f\t"):
            faces.append((len(vertices), line))
    if not vertices or not faces:
        raise MapError(f"{path} has {len(vertices)} vertices and {len(faces)} faces; a mesh has both")
    points = parse_numbers(path, vertices, None)
    if points.shape[1] != 3:
        raise MapError(f"{path}: a vertex has {points.shape[1]} coordinates, not 3; save it again")
    polygons = []
    for above, line in faces:
        try:
            corners = [int(word.split("/", 1)[0]) for word in line.split("#")[0].split()[1:]]
        except ValueError:
            corners = []
        if len(corners) < 3 or 0 in corners or min(corners) < -above:
            raise MapError(f"{path}: {line[:60]!r} is no face over {above} vertices; save it again")
        polygons.append([corner - 1 if corner > 0 else above + corner for corner in corners])
    return points, check_corners(path, points, fan(polygons))


def _read_stl(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """An .stl, binary or text: each triangle has vertices of its own."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(STL_HEAD)
    count = struct.unpack_from("<I", head, 80)[0] if len(head) == STL_HEAD else 0
    text = head.lstrip().lower().startswith(b"solid")
    if count and size >= STL_HEAD + STL_ROW * count and not (text and size != STL_HEAD + STL_ROW * count):
        check_rest(path, STL_HEAD + STL_ROW * count, STL_ROW)
        layout = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
        with path.open("rb") as file:
            file.seek(STL_HEAD)
            corners = np.frombuffer(file.read(STL_ROW * count), layout)["corners"].reshape(-1, 3)
    elif text:
        corners = _read_text_stl(path)
    else:
        told = f"promises {count} triangles in {size} bytes" if len(head) == STL_HEAD else f"has {size} bytes"
        raise MapError(f"{path} is truncated or no STL: it {told}; save it again")
    return corners.astype(np.float64), np.arange(len(corners)).reshape(-1, 3)


def _read_text_stl(path: Path) -> np.ndarray:
    lines = [line.split() for line in path.read_bytes().decode("ascii", errors="replace").lower().splitlines()]
    rows = [" ".join(words[1:]) for words in lines if words[:1] == ["vertex"]]
    begun = {name: sum(words[:1] == [name] for words in lines) for name in ("solid", "facet")}
    ended = {name: sum(words[:1] == [f"end{name}"] for words in lines) for name in ("solid", "facet")}
    if begun != ended or len(rows) != 3 * begun["facet"] or not rows:
        raise MapError(f"{path} is truncated: {begun['facet']} facets begin in it, {ended['facet']} end; save it again")
    corners = parse_numbers(path, rows, None)
    if corners.shape[1] != 3:
        raise MapError(f"{path}: a vertex has {corners.shape[1]} coordinates, not 3; save it again")
    return corners


def _read_glb(path: Path) -> tuple[np.ndarray, np.ndarray]:
    trimesh = need("trimesh", "mesh", path)
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)
    _check_extensions(path)
    try:
        mesh = trimesh.load(path, force="mesh", process=False, skip_materials=True)
        return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    except Exception as error:  # trimesh raises whatever its loaders raise on damaged files
        raise MapError(f"{path} is not a readable mesh ({type(error).__name__}: {error}); save it again") from error


def _check_extensions(path: Path) -> None:
    """Raise MapError for extensions of glTF that hold geometry: without them walls would be left out in silence."""
    tree = _glb_tree(path)
    needed = {str(name) for name in tree.get("extensionsRequired") or []}
    needed = {name for name in needed if not name.startswith(HARMLESS)} | _packed(tree)
    if needed:
        told = ", ".join(sorted(needed))
        raise MapError(f"{path} stores its geometry with the glTF extension {told}, which is not read; {UNPACK}")


def _glb_tree(path: Path) -> dict:
    """The JSON of a .glb."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(20)
        mark, _, length, json_length, kind = struct.unpack("<4sIII4s", head) if len(head) == 20 else (b"", 0, 0, 0, b"")
        if mark != b"glTF" or kind != b"JSON" or json_length > size - 20 or length > size:
            raise MapError(f"{path} is no whole .glb: it promises {length} bytes and holds {size}; save it again")
        data = file.read(json_length)
    try:
        tree = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise MapError(f"{path} is not a readable mesh ({error}); save it again") from error
    if not isinstance(tree, dict):
        raise MapError(f"{path} is not a readable mesh (its JSON is no object); save it again")
    return tree


def _packed(tree: dict) -> set[str]:
    """Extensions that hold geometry which the plain parts of the file do not, whether it calls them required or not."""
    found = set()
    accessors = _dicts(tree, "accessors")
    for mesh in _dicts(tree, "meshes"):
        for primitive in _dicts(mesh, "primitives"):
            if primitive.get("mode") == TRIANGLE_FAN:
                found.add("(none, but triangle fans)")
            at = (primitive.get("attributes") or {}).get("POSITION")
            position = accessors[at] if isinstance(at, int) and 0 <= at < len(accessors) else {}
            plain = "bufferView" in position
            found |= {name for name in primitive.get("extensions") or {} if "compression" in name and not plain}
            if plain and position.get("componentType") != 5126:
                found.add("KHR_mesh_quantization")
    for name, parts in (("nodes", ("EXT_mesh_gpu_instancing",)), ("buffers", ("meshopt",))):
        for part in _dicts(tree, name):
            named = [key for key in part.get("extensions") or {} if any(word in key for word in parts)]
            found |= {key for key in named if name == "nodes" or "uri" not in part and len(_dicts(tree, name)) > 1}
    return found


def _dicts(tree: dict, name: str) -> list[dict]:
    parts = tree.get(name)
    return [part for part in parts if isinstance(part, dict)] if isinstance(parts, list) else []


def need(package: str, extra: str, path: Path):
    """An optional package; MapError names the extra that installs it."""
    try:
        return importlib.import_module(package)
    except ImportError as error:
        command = f'pip install "maexp[{extra}]"'
        raise MapError(f"{path} needs the package {package}, which is not installed; {command}") from error
