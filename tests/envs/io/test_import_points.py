"""Text and binary clouds as programs write them: commas, headers, damaged rows, 8-byte fields, large numbers."""

import struct

import numpy as np
import pytest
from test_import_clouds import assert_room, scan_room, terrain, write_pcd, write_ply, write_xyz

from maexp.envs.io import import_map, import_map_with_report
from maexp.envs.io.cloud_files import read_xyz
from maexp.envs.io.pcd_files import read_pcd
from maexp.envs.io.ply_files import read_ply
from maexp.envs.maps.point_cloud import MapError

POINTS = np.random.default_rng(0).uniform(-5, 9, (60, 3)).round(3)


def rows(points=POINTS, between=" ", comma=False):
    text = "\n".join(between.join(f"{value:.3f}" for value in row) for row in points) + "\n"
    return text.replace(".", ",") if comma else text


@pytest.mark.parametrize("between", [";", "\t", " ", " ; ", "  "])
def test_decimal_commas_are_read(tmp_path, between):
    path = tmp_path / "x.xyz"
    path.write_text(rows(between=between, comma=True))
    cloud = read_xyz(path)
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert "decimal commas" in cloud.assumed[0][0]


@pytest.mark.parametrize("between", [",", ", ", ";", "\t", " ,", ",\t"])
def test_commas_that_separate(tmp_path, between):
    path = tmp_path / "x.xyz"
    path.write_text(rows(between=between))
    if between == " ,":  # 1 ,2 ,3 might be tenths
        with pytest.raises(MapError, match="may be decimal commas or separators"):
            read_xyz(path)
        return
    np.testing.assert_array_equal(read_xyz(path).points, POINTS)
    path.write_text("".join(f"{int(x)}{between}{int(y)}{between}{int(z)}\n" for x, y, z in POINTS))
    np.testing.assert_array_equal(read_xyz(path).points, np.trunc(POINTS))


@pytest.mark.parametrize("line", ["1,0, 2,0, 3,0", "1.234,5;2,0;3,0", "1,234,5;2,0;3,0", "1 ,2 ,3"])
def test_unclear_commas_are_refused_by_name(tmp_path, line):
    (tmp_path / "x.xyz").write_text(f"{line}\n" * 40)
    with pytest.raises(MapError, match="may be decimal commas or separators"):
        read_xyz(tmp_path / "x.xyz")


def test_rows_of_different_commas_are_refused(tmp_path):
    (tmp_path / "x.xyz").write_text(rows(comma=True, between=";") + "1,2,3\n")
    with pytest.raises(MapError, match="commas"):
        read_xyz(tmp_path / "x.xyz")


HEADS = {
    "//X Y Z\n": "xyz",
    "//X Y Z\n60\n": "xyz",
    "60\n": "xyz",
    "# made by hand\n\n": "xyz",
    "X Y Z\n": "xyz",
    '"x";"y";"z"\n': "xyz",
    "//Y X Z\n": "yxz",
    "\ufeff": "xyz",
    "\ufeff//X Y Z\r\n": "xyz",
    "x,y,z\n": "xyz",
}


@pytest.mark.parametrize("head", HEADS)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_heads_of_xyz(tmp_path, head, encoding):
    if encoding == "utf-16":
        head = head.lstrip("\ufeff")
    (tmp_path / "x.xyz").write_bytes((head + rows()).encode(encoding))
    found = read_xyz(tmp_path / "x.xyz").points
    np.testing.assert_array_equal(found[:, ["xyz".index(axis) for axis in HEADS.get(head, "xyz")]], POINTS)


def test_a_count_that_is_wrong(tmp_path):
    (tmp_path / "x.xyz").write_text("99\n" + rows())
    with pytest.raises(MapError, match="promises 99 points and holds 60"):
        read_xyz(tmp_path / "x.xyz")


def ascii_ply(points, more="", after=""):
    head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    head += "property float x\nproperty float y\nproperty float z\n"
    return head + more + "end_header\n" + rows(points) + after


EXTRAS = {
    "face 0": ("element face 0\nproperty list uchar int vertex_indices\n", ""),
    "camera": ("element camera 1\nproperty float view_px\nproperty float view_py\n", "1 2\n"),
    "edge": ("element edge 1\nproperty list uchar int vertex_index\n", "2 0 1\n"),
}


@pytest.mark.parametrize("extra", EXTRAS)
def test_a_damaged_ascii_ply_is_refused(tmp_path, extra):
    path = tmp_path / "x.ply"
    text = ascii_ply(scan_room(), *EXTRAS[extra])
    path.write_text(text)
    assert_room(import_map(path))
    lines = text.splitlines(keepends=True)
    spoilt = lines.copy()
    spoilt[int(0.6 * len(lines))] = "1.0 x.5 2.0\n"
    short = lines.copy()
    short[int(0.6 * len(lines))] = "1.0 2.0\n"
    for broken in (
        spoilt,
        short,
        lines[: int(0.95 * len(lines))],
        [text[: int(0.95 * len(text))]],
        [*lines, lines[-1]],
    ):
        path.write_text("".join(broken))
        with pytest.raises(MapError, match="x.ply"):
            import_map(path)


def test_a_damaged_mesh_of_text_is_refused(tmp_path):
    pytest.importorskip("trimesh")
    faces = "element face 2\nproperty list uchar int vertex_indices\n"
    for after in ("3 0 1 2\n3 0 1\n", "3 0 1 2\n3 0 1 x\n", "3 0 1 2\n", "3 0 1 2\n3 0 1 999\n", "3 0 1 2\n4 0 1 2\n"):
        (tmp_path / "x.ply").write_text(ascii_ply(POINTS, faces, after))
        with pytest.raises(MapError, match="x.ply"):
            import_map(tmp_path / "x.ply")


@pytest.mark.parametrize("order", "<>")
def test_binary_ply_with_whatever_else(tmp_path, order):
    """Elements before and after, lists among the vertices, faces of several lengths."""
    name = {"<": "little", ">": "big"}[order]
    head = f"ply\nformat binary_{name}_endian 1.0\nelement camera 1\nproperty list uchar int a\nproperty double b\n"
    head += f"element vertex {len(POINTS)}\nproperty uchar red\nproperty double x\nproperty float y\nproperty float z\n"
    head += "element face 2\nproperty list uchar int vertex_index\nproperty uchar flag\nend_header\n"
    body = struct.pack(f"{order}B2id", 2, 7, 8, 0.5)
    body += b"".join(struct.pack(f"{order}Bdff", 9, *row) for row in POINTS)
    body += struct.pack(f"{order}B3iB", 3, 0, 1, 2, 1) + struct.pack(f"{order}B4iB", 4, 3, 4, 5, 6, 1)
    (tmp_path / "x.ply").write_bytes(head.encode() + body)
    points, triangles = read_ply(tmp_path / "x.ply")
    np.testing.assert_allclose(points, POINTS, atol=1e-6)
    assert sorted(triangles.tolist()) == [[0, 1, 2], [3, 4, 5], [3, 5, 6]]
    for broken in (body[:-3], body + b"x" * 20):
        (tmp_path / "x.ply").write_bytes(head.encode() + broken)
        with pytest.raises(MapError, match="x.ply"):
            read_ply(tmp_path / "x.ply")


def lzf_of(data):
    """Packed by runs of 32 bytes as they are, and one copy where a byte repeats."""
    parts, at = b"", 0
    while at < len(data):
        run = len(data[at:]) - len(data[at:].lstrip(data[at : at + 1]))
        if run > 12:
            parts += bytes([0]) + data[at : at + 1] + bytes([7 << 5, run - 1 - 9, 0])
            at += run if run < 250 else run
        else:
            piece = data[at : at + 32]
            parts += bytes([len(piece) - 1]) + piece
            at += len(piece)
    return parts


def pcd(points, types="FFF", sizes=(4, 4, 4), kind="binary", fields="x y z", head="FIELDS", count=None, extra=""):
    layout = np.dtype([(str(i), f"<{t.lower()}{s}") for i, (t, s) in enumerate(zip(types, sizes, strict=True))])
    table = np.zeros(len(points), layout)
    for i in range(3):
        table[str(i)] = points[:, i]
    text = f"VERSION .7\n{head} {fields}\nSIZE {' '.join(map(str, sizes))}\nTYPE {' '.join(types)}\n"
    text += f"COUNT {count}\n" if count else ""
    text += f"WIDTH {len(points)}\nHEIGHT 1\nPOINTS {len(points)}\nDATA {kind}\n"
    if kind.lower() == "binary_compressed":
        flat = b"".join(table[name].tobytes() for name in layout.names)
        packed = lzf_of(flat)
        return text.encode() + struct.pack("<II", len(packed), len(flat)) + packed
    return text.encode() + table.tobytes()


@pytest.mark.parametrize("kind", ["binary", "binary_compressed", "BINARY", "Binary_Compressed"])
@pytest.mark.parametrize(
    "types, sizes", [("FFF", (8, 8, 8)), ("FFF", (4, 4, 8)), ("III", (8, 8, 8)), ("FFU", (8, 4, 2))]
)
def test_pcd_fields_of_every_size(tmp_path, kind, types, sizes):
    points = np.abs(np.trunc(POINTS * 100)) if set(types) != {"F"} else POINTS.astype(np.float32)
    (tmp_path / "x.pcd").write_bytes(pcd(points, types, sizes, kind))
    np.testing.assert_array_equal(read_pcd(tmp_path / "x.pcd").points, points)


@pytest.mark.parametrize(
    "more",
    [
        dict(fields="X Y Z"),
        dict(head="COLUMNS"),
        dict(count="0 0 0"),
        dict(count="1 1 1"),
        dict(fields="x y z rgb", types="FFFU", sizes=(4, 4, 4, 4), count="1 1 1 0"),
    ],
)
def test_pcd_headers_as_programs_write_them(tmp_path, more):
    points = POINTS.astype(np.float32)
    for kind in ("binary", "binary_compressed"):
        (tmp_path / "x.pcd").write_bytes(pcd(points, kind=kind, **more))
        np.testing.assert_array_equal(read_pcd(tmp_path / "x.pcd").points, points)


def test_a_damaged_compressed_pcd_is_refused(tmp_path):
    data = bytearray(pcd(POINTS, kind="binary_compressed"))
    at = data.index(b"compressed\n") + len(b"compressed\n") + 8
    for place, value in ((at, 31 + 32), (at, 0), (at + 33, 255)):
        spoilt = data.copy()
        spoilt[place] = value
        (tmp_path / "x.pcd").write_bytes(spoilt)
        with pytest.raises(MapError, match="x.pcd"):
            read_pcd(tmp_path / "x.pcd")


def test_ascii_pcd_is_read_to_its_last_field(tmp_path):
    path = write_pcd(tmp_path / "x.pcd", POINTS)
    text = path.read_text()
    path.write_text(text.replace("DATA ascii", "DATA ASCII"))
    assert len(read_pcd(path).points) == 60
    for broken in (text[: int(0.95 * len(text))], text + "1 2 3\n", text.rstrip() + " 7\n"):
        path.write_text(broken)
        with pytest.raises(MapError, match="x.pcd"):
            read_pcd(path)


UTM = np.array([512_000.0, 5_400_000.0, 0.0])


@pytest.mark.parametrize("suffix", ["pcd", "ply", "xyz"])
def test_float32_far_from_the_origin_is_refused_with_its_step(tmp_path, suffix):
    points = (scan_room() + UTM).astype(np.float32).astype(np.float64)
    write = {"pcd": lambda p: write_pcd(p, points, "binary"), "ply": lambda p: write_ply(p, points)}
    path = write.get(suffix, lambda p: write_xyz(p, points))(tmp_path / f"x.{suffix}")
    with pytest.raises(MapError, match=r"float32 .* steps of 0\.5 m, .* subtract an offset .* 8-byte"):
        import_map(path)


def test_exact_numbers_far_from_the_origin_are_fine(tmp_path):
    assert_room(import_map(write_xyz(tmp_path / "x.xyz", scan_room() + UTM)))
    (tmp_path / "x.pcd").write_bytes(pcd(scan_room() + UTM, "FFF", (8, 8, 8)))
    world, report = import_map_with_report(tmp_path / "x.pcd")
    assert_room(world)
    assert not report.warnings
    lattice = np.trunc(terrain() / 2) * 2  # whole metres, which float32 holds
    assert not any(
        "float32" in text for text in import_map_with_report(write_xyz(tmp_path / "y.xyz", lattice))[1].warnings
    )


def test_an_airborne_scan_in_steps_is_warned_of(tmp_path):
    points = (terrain() + [0, 5_000_000, 0]).astype(np.float32).astype(np.float64)
    world, report = import_map_with_report(write_xyz(tmp_path / "x.xyz", points))
    assert world.scenario == "outdoor" and any("steps of 0.5 m" in text for text in report.warnings)


def test_unit_and_axis_are_noted_or_refused(tmp_path):
    path = write_ply(tmp_path / "x.ply", scan_room())
    _, report = import_map_with_report(path)
    assert len(report.assumptions) == 2 and "assumed: its unit is not known" in report.table()
    with pytest.raises(MapError, match="strict=true refuses; set importing.units"):
        import_map(path, strict=True)
    with pytest.raises(MapError, match="strict=true refuses; set importing.up=z"):
        import_map(path, strict=True, units="m")
    world, report = import_map_with_report(path, strict=True, units="m", up="z")
    assert_room(world)
    assert report.as_dict()["assumptions"] == [] and '"steps"' in report.to_json()
