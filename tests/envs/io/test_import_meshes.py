"""Meshes as CAD and Gazebo have them: floors with two faces, faces of all kinds, and extensions of glTF."""

import json
import struct

import numpy as np
import pytest
from test_import_clouds import scan_room, write_ply

from maexp.envs.io import import_map, import_map_with_report
from maexp.envs.io.mesh_files import _read_obj, _read_stl
from maexp.envs.maps.point_cloud import MapError

trimesh = pytest.importorskip("trimesh")
SLABS = (0.05, 0.1, 0.15, 0.2, 0.5, 1.0)  # [m]


def house(slab, order=0, inside_out=False):
    """A slab of 10.2 x 7.2 m, its top at height 0, with four walls and a block on it."""
    box = trimesh.creation.box
    parts = [box(bounds=[[0, 0, -slab], [10.2, 7.2, 0]]), box(bounds=[[4, 3, 0], [5, 4, 1.0]])]
    for low, high in (((0, 0), (10.2, 0.1)), ((0, 7.1), (10.2, 7.2)), ((0, 0), (0.1, 7.2)), ((10.1, 0), (10.2, 7.2))):
        parts.append(box(bounds=[[*low, 0], [*high, 2.5]]))
    mesh = trimesh.util.concatenate(parts)
    faces = np.random.default_rng(order).permutation(mesh.faces)
    return trimesh.Trimesh(mesh.vertices, faces[:, ::-1] if inside_out else faces, process=False)


def area_of(mesh, path, **settings):
    if path.suffix == ".glb":
        mesh = mesh.copy()
        mesh.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    mesh.export(path)
    world, report = import_map_with_report(path, **settings)
    assert not report.warnings
    return world.free_area


@pytest.mark.parametrize("slab", SLABS)
def test_the_floor_of_a_slab_is_its_top(tmp_path, slab):
    wanted = area_of(house(slab), tmp_path / "x.obj", floor=0.0, level=False)
    assert 60 < wanted < 70
    suffix = ("obj", "ply", "glb", "stl")[SLABS.index(slab) % 4]
    for order in (1, 2):
        assert area_of(house(slab, order), tmp_path / f"x.{suffix}") == pytest.approx(wanted, rel=0.01)
    assert area_of(house(slab, inside_out=True), tmp_path / "x.stl") == pytest.approx(wanted, rel=0.01)


def test_a_tilted_slab_is_levelled(tmp_path):
    mesh = house(0.15)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.deg2rad(6), [1, 0, 0]))
    assert area_of(mesh, tmp_path / "x.obj") == pytest.approx(area_of(house(0.15), tmp_path / "y.obj"), rel=0.02)


def test_a_screed_on_a_slab(tmp_path):
    """Solids that touch: the floor is the topmost of them."""
    screed = trimesh.creation.box(bounds=[[0.1, 0.1, 0.0], [10.1, 7.1, 0.2]])
    assert 60 < area_of(trimesh.util.concatenate([house(0.3), screed]), tmp_path / "x.stl") < 70


def test_two_floors_of_a_scan_that_drifted(tmp_path):
    points = scan_room()
    floor = points[(points[:, 2] < 0.05)] + [0, 0, 0.25]
    world, report = import_map_with_report(write_ply(tmp_path / "x.ply", np.concatenate([points, floor])))
    assert any("two floors lie 0.25 m above each other" in text for text in report.warnings)
    assert world.free_area > 35


def test_a_bed_is_no_floor(tmp_path):
    points = scan_room(ceiling=False)
    inside = (
        (points[:, 0] > 0.5) & (points[:, 0] < 4.5) & (points[:, 1] > 0.5) & (points[:, 1] < 5) & (points[:, 2] < 0.3)
    )
    points[inside, 2] += 0.4  # what is under it was not seen
    world, report = import_map_with_report(write_ply(tmp_path / "x.ply", points))
    assert world.free_area < 33 and not report.warnings


def obj_text(mesh, groups, negative):
    """The mesh in groups of faces, each behind vertices of its own."""
    lines, above = ["# a comment", "mtllib x.mtl"], 0
    for number, faces in enumerate(np.array_split(np.asarray(mesh.faces), groups)):
        corners = mesh.vertices[faces].reshape(-1, 3)
        lines += [f"g part{number}", *(f"v {x} {y} {z} 0.5 0.5 0.5" for x, y, z in corners), "vn 0 0 1"]
        for i in range(0, len(corners), 3):
            ids = [i + k - len(corners) if negative else above + i + k + 1 for k in range(3)]
            lines.append("f " + " ".join(f"{j}//{-1 if negative else 1}" for j in ids))
        above += len(corners)
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("negative", [False, True])
def test_obj_indices_count_from_both_ends(tmp_path, negative):
    mesh = house(0.1)
    (tmp_path / "x.obj").write_text(obj_text(mesh, 7, negative))
    vertices, triangles = _read_obj(tmp_path / "x.obj")
    np.testing.assert_allclose(vertices[triangles], mesh.vertices[mesh.faces])


def test_polygons_and_odd_lines_of_obj(tmp_path):
    text = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1/1 2/2 \\\n 3/3 4/4 # a square\nl 1 2\nf\t-4 -3 -2\r\n"
    (tmp_path / "x.obj").write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert sorted(_read_obj(tmp_path / "x.obj")[1].tolist()) == [[0, 1, 2], [0, 1, 2], [0, 2, 3]]


@pytest.mark.parametrize("line", ["f 1 2 9", "f 1 2", "f 1 2 x", "f 0 1 2", "f -9 1 2", "v 1 2", "v 1 2 z"])
def test_a_damaged_obj_is_refused(tmp_path, line):
    (tmp_path / "x.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3\n{line}\n")
    with pytest.raises(MapError, match="x.obj"):
        import_map(tmp_path / "x.obj")


def test_stl_of_both_kinds(tmp_path):
    mesh = house(0.2)
    for kind in ("stl", "stl_ascii"):
        path = tmp_path / "x.STL"
        mesh.export(path, file_type=kind)
        vertices, triangles = _read_stl(path)
        np.testing.assert_allclose(vertices[triangles], mesh.vertices[mesh.faces], atol=1e-5)
        whole = path.read_bytes()
        for broken in (whole[: int(0.95 * len(whole))], whole[:60], whole + b"x" * 60 * (kind == "stl"), b"solid\n"):
            if broken == whole:
                continue
            path.write_bytes(broken)
            with pytest.raises(MapError, match="x.STL"):
                import_map(path)
    mesh.apply_scale(1000)
    mesh.export(tmp_path / "mm.stl")
    assert 60 < import_map(tmp_path / "mm.stl", units="mm").free_area < 70


def change_glb(path, change):
    """The .glb with its JSON changed."""
    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    tree = json.loads(data[20 : 20 + length])
    change(tree)
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    head = struct.pack("<4sII", b"glTF", 2, 20 + len(text) + len(rest))
    path.write_bytes(head + struct.pack("<I4s", len(text), b"JSON") + text + rest)


def draco(tree):
    """One of the primitives packed, and the file does not call it required."""
    tree["extensionsUsed"] = ["KHR_draco_mesh_compression"]
    primitive = tree["meshes"][0]["primitives"][0]
    primitive["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
    tree["accessors"][primitive["attributes"]["POSITION"]].pop("bufferView")


EXTENSIONS = {
    "KHR_draco_mesh_compression": draco,
    "EXT_meshopt_compression": lambda tree: tree.update(extensionsRequired=["EXT_meshopt_compression"]),
    "KHR_mesh_quantization": lambda tree: tree.update(extensionsRequired=["KHR_mesh_quantization"]),
    "EXT_mesh_gpu_instancing": lambda tree: tree["nodes"][0].update(extensions={"EXT_mesh_gpu_instancing": {}}),
    "ACME_walls": lambda tree: tree.update(extensionsRequired=["ACME_walls", "KHR_materials_unlit"]),
}


@pytest.mark.parametrize("name", EXTENSIONS)
def test_extensions_that_hold_geometry_are_named(tmp_path, name):
    area_of(house(0.2), tmp_path / "x.glb")
    change_glb(tmp_path / "x.glb", EXTENSIONS[name])
    with pytest.raises(MapError, match=f"extension {name}, which is not read; save it without"):
        import_map(tmp_path / "x.glb")


def test_extensions_of_looks_do_no_harm(tmp_path):
    wanted = area_of(house(0.2), tmp_path / "x.glb")
    change_glb(tmp_path / "x.glb", lambda tree: tree.update(extensionsRequired=["KHR_materials_unlit"]))
    world, report = import_map_with_report(tmp_path / "x.glb", strict=True)
    assert world.free_area == wanted and not report.assumptions, "metres and y up are the standard's"


def test_a_glb_at_coordinates_of_a_country(tmp_path):
    mesh = house(0.2)
    mesh.apply_translation([512_000.3, 5_400_000.7, 0])
    with pytest.raises(MapError, match=r"steps of 0\.5 m"):
        area_of(mesh, tmp_path / "x.glb")
