"""Import of clouds: floor plans, indoor and airborne scans, meshes, octrees; good, odd and broken."""

import sys

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from maexp.envs.io import import_map, import_map_with_report
from maexp.envs.maps.checker import check_map
from maexp.envs.maps.point_cloud import MapError
from maexp.envs.scenarios import find_scenario

ROOM = (8.0, 6.0, 2.5)  # [m]
BLOCK = (2.0, 3.0, 2.0, 3.0)  # x and y of a block in the room [m]


def scan_room(floor=True, ceiling=True, spacing=0.08, seed=0):
    """A room with a block 0.8 m high, as points [m]."""
    random = np.random.default_rng(seed)
    width, depth, height = ROOM

    def sheet(span_a, span_b):
        a, b = np.meshgrid(np.arange(*span_a, spacing), np.arange(*span_b, spacing), indexing="ij")
        return a.ravel(), b.ravel()

    parts = []
    for x in (0.0, width):
        y, z = sheet((0, depth), (0, height))
        parts.append(np.stack([np.full_like(y, x), y, z], axis=1))
    for y in (0.0, depth):
        x, z = sheet((0, width), (0, height))
        parts.append(np.stack([x, np.full_like(x, y), z], axis=1))
    for z, wanted in ((0.0, floor), (height, ceiling)):
        x, y = sheet((0, width), (0, depth))
        if wanted:
            parts.append(np.stack([x, y, np.full_like(x, z)], axis=1))
    x, y = sheet(BLOCK[:2], BLOCK[2:])
    parts.append(np.stack([x, y, np.full_like(x, 0.8)], axis=1))
    points = np.concatenate(parts)
    return points + random.normal(scale=0.01, size=points.shape)


def turn(points, degrees, axis="z"):
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    i, j = {"z": (0, 1), "x": (1, 2)}[axis]
    turned = points.copy()
    turned[:, i], turned[:, j] = c * points[:, i] - s * points[:, j], s * points[:, i] + c * points[:, j]
    return turned


def write_pcd(path, points, kind="ascii"):
    head = f"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\n"
    head += f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA {kind}\n"
    data = points.astype("<f4")
    body = data.tobytes() if kind == "binary" else "\n".join(" ".join(map(str, row)) for row in data).encode() + b"\n"
    path.write_bytes(head.encode() + body)
    return path


def write_ply(path, points):
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
    head += "property float x\nproperty float y\nproperty float z\nend_header\n"
    path.write_bytes(head.encode() + points.astype("<f4").tobytes())
    return path


def write_xyz(path, points):
    np.savetxt(path, points, fmt="%.4f")
    return path


WRITERS = {"pcd": write_pcd, "ply": write_ply, "xyz": write_xyz}


def holds(world, place):
    return bool((np.linalg.norm(world.free[:, :2] - place, axis=1) < world.resolution).any())


def assert_room(world, points=None):
    assert 0.75 * 47 < world.free_area < 1.02 * 48, world.free_area
    report = check_map(world)
    assert report.ok and not report.warnings, report.table()


@pytest.mark.parametrize("suffix", WRITERS)
def test_a_scanned_room(tmp_path, suffix):
    world, report = import_map_with_report(WRITERS[suffix](tmp_path / f"a room.{suffix}", scan_room()))
    assert_room(world)
    assert (world.name, world.scenario) == ("a room", "pointcloud")
    assert not holds(world, (2.5, 2.5)) and holds(world, (5.0, 3.0)), "the block is no floor, the room is"
    assert world.obstacle_height.max() > 0.5
    assert {"read", "floor", "slices", "free space", "check"} <= {step.name for step in report.steps}


@pytest.mark.parametrize("kind", ["ascii", "binary"])
def test_pcd_kinds(tmp_path, kind):
    assert_room(import_map(write_pcd(tmp_path / "x.pcd", scan_room(), kind)))


def test_a_tilted_floor_is_levelled(tmp_path):
    tilted = turn(scan_room(), 8, "x")
    path = write_ply(tmp_path / "x.ply", tilted)
    world, report = import_map_with_report(path)
    assert_room(world)
    assert any("levelled by 8." in step.detail or "levelled by 7.9" in step.detail for step in report.steps)
    try:
        assert import_map(path, level=False).free_area < 30
    except MapError:
        pass  # no floor is flat enough


def test_a_turned_room(tmp_path):
    assert_room(import_map(write_ply(tmp_path / "x.ply", turn(scan_room(), 33))))


def test_a_room_without_floor(tmp_path):
    """The ceiling levels the cloud; the inside of the walls is free, and nothing outside is."""
    path = write_ply(tmp_path / "x.ply", scan_room(floor=False))
    world, report = import_map_with_report(path)
    assert_room(world)
    assert any("no floor was scanned" in step.detail for step in report.steps)
    with pytest.raises(MapError, match="free"):
        import_map(path, infer_free=False)


def test_units_axes_strays_and_invalid_points(tmp_path):
    points = scan_room()
    feet = write_ply(tmp_path / "feet.ply", points / 0.3048)
    assert_room(import_map(feet, units="ft"))
    assert import_map(feet, resolution=0.5).free_area > 200
    y_up = points[:, [0, 2, 1]] * [1, 1, -1]
    assert_room(import_map(write_ply(tmp_path / "up.ply", y_up), up="y"))
    random = np.random.default_rng(1)
    strays = random.uniform(-40, 40, size=(30, 3))
    world, report = import_map_with_report(write_ply(tmp_path / "stray.ply", np.concatenate([points, strays])))
    assert_room(world)
    step = next(step for step in report.steps if step.name == "outliers")
    assert 28 <= step.before - step.after <= 60
    broken = points.copy()
    broken[:5] = np.nan
    broken[5] = np.inf
    path = write_ply(tmp_path / "nan.ply", broken)
    with pytest.raises(MapError, match="6 points that are NaN or infinite"):
        import_map(path)
    assert_room(import_map(path, drop_invalid=True))


def test_set_by_hand(tmp_path):
    path = write_ply(tmp_path / "x.ply", scan_room())
    assert holds(import_map(path, step_height=0.9, robot_height=1.2), (2.5, 2.5)), "a robot that climbs 0.9 m"
    assert import_map(path, crop=(0, 0, 5, 6)).free[:, 0].max() < 5.2
    assert import_map(path, name="y", resolution=0.2).resolution == 0.2
    assert import_map(path, voxel=0.2, fill_holes=4).free_area > 30
    lifted = scan_room(floor=False) + [0, 0, 5.0]
    low = import_map(write_ply(tmp_path / "low.ply", lifted), floor=5.0)
    assert_room(low)
    with pytest.raises(MapError, match="crop"):
        import_map(path, crop=(100, 100, 200, 200))
    with pytest.raises(MapError, match="robot_height"):
        import_map(path, step_height=2.0, robot_height=1.0)


def floor_plan(spacing=0.1, jitter=0.03):
    """The walls of two rooms with a door of 1.2 m, 10 x 6 m, as flat points [m]."""
    random = np.random.default_rng(2)
    along = np.arange(0, 10 + 1e-9, spacing)
    across = np.arange(0, 6 + 1e-9, spacing)
    wall = across[(across < 2.4) | (across > 3.6)]
    parts = [(along, 0 * along), (along, 0 * along + 6), (0 * across, across), (0 * across + 10, across)]
    parts.append((0 * wall + 5, wall))
    points = np.concatenate([np.stack([x, y, 0 * x + 1.5], axis=1) for x, y in parts])
    points[:, :2] += random.uniform(-jitter, jitter, size=(len(points), 2))
    return points


@pytest.mark.parametrize("degrees", [0, 27])
def test_a_flat_cloud_is_a_plan(tmp_path, degrees):
    world = import_map(write_pcd(tmp_path / "plan.pcd", turn(floor_plan(), degrees)))
    assert 48 < world.free_area < 61
    assert check_map(world).ok
    inside = turn(np.array([[2.5, 3.0, 0.0], [7.5, 3.0, 0.0], [11.0, 3.0, 0.0]]), degrees)[:, :2]
    assert [holds(world, place) for place in inside] == [True, True, False]


def test_free_space_is_not_inferred_outside(tmp_path):
    """A house door stands open, and a wall stands 5 m from the house: between them nothing encloses."""
    points = floor_plan()
    points = points[~((points[:, 0] > 9.5) & (np.abs(points[:, 1] - 3) < 0.7))]
    fence = np.stack([np.full(61, 15.0), np.arange(61) / 10, np.full(61, 1.5)], axis=1)
    world = import_map(write_pcd(tmp_path / "plan.pcd", np.concatenate([points, fence])))
    assert world.free_area < 70 and not holds(world, (13.0, 0.5)) and not holds(world, (13.0, 5.5))


def terrain(spacing=0.9):
    """A slope of 60 x 50 m, a house and a tree on it, far from the origin; one return 500 m up."""
    random = np.random.default_rng(3)
    x, y = np.meshgrid(np.arange(0, 120, spacing), np.arange(0, 100, spacing), indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), 0.05 * x.ravel() + 250], axis=1)
    points[:, :2] += random.uniform(-0.3, 0.3, size=(len(points), 2))
    house = (points[:, 0] > 50) & (points[:, 0] < 62) & (points[:, 1] > 40) & (points[:, 1] < 60)
    points[house, 2] += 7.0
    points[100, 2] += 500
    return points + [512_000, 400_000, 0]


def test_an_airborne_scan(tmp_path):
    world, report = import_map_with_report(write_xyz(tmp_path / "x.xyz", terrain()))
    assert world.scenario == "outdoor" and check_map(world).ok
    assert 0.9 * 11_760 < world.free_area < 12_190, "cells of 1.3 m, cut to 0.75 m, reach beyond the edge"
    standing = next(step.after for step in report.steps if step.name == "terrain")
    assert standing == pytest.approx(240 / 0.9**2, rel=0.15), "the house stands on the slope, and nothing else"
    low = world.free[:, :2].min(axis=0)
    assert not holds(world, low + (56, 50)) and holds(world, low + (20, 50)) and holds(world, low + (100, 50))
    assert np.abs(world.free).max() < 1000, "moved to the origin"
    tile = import_map(tmp_path / "x.xyz", tile=60.0)
    assert np.ptp(tile.free[:, :2], axis=0).max() <= 60.0 and check_map(tile).ok


def test_walls_of_a_sparse_scan_stay_closed(tmp_path):
    """Many cells as small as a car's collision threshold hold no point; the hedge between two fields has no hole."""
    points = terrain(spacing=1.2)
    hedge = np.abs(points[:, 0] - points[:, 0].min() - 30) < 0.9
    points[hedge, 2] += 3.0
    world, report = import_map_with_report(write_xyz(tmp_path / "x.xyz", points))
    assert world.resolution == 0.75 and check_map(world).ok
    assert "density" in [step.name for step in report.steps]
    assert 0.9 * 8_660 < world.free_area < 9_000, "the larger field alone"


def test_las_in_feet(tmp_path):
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = [0.001] * 3, [1_600_000, 1_300_000, 0]
    keys = laspy.vlrs.known.GeoKeyDirectoryVlr()
    key = laspy.vlrs.known.GeoKeyEntryStruct(id=3076, tiff_tag_location=0, count=1, value_offset=9002)
    keys.geo_keys.append(key)
    keys.geo_keys_header.number_of_keys = 1
    header.vlrs.append(keys)
    data = laspy.LasData(header)
    data.x, data.y, data.z = (terrain() / 0.3048).T
    data.write(tmp_path / "x.las")
    world, report = import_map_with_report(tmp_path / "x.las")
    assert "0.3048 m a unit (by the file)" in report.table()
    assert 0.9 * 11_760 < world.free_area < 12_190
    room = laspy.LasData(laspy.LasHeader(point_format=3, version="1.2"))
    room.header.scales = [0.001] * 3
    rng = np.random.default_rng(0)
    floor = rng.uniform(0, 8, (40_000, 3)) * [1, 1, 0]
    along = rng.uniform(0, 8, 40_000)
    walls = np.stack([np.where(rng.random(40_000) < 0.5, 0.0, 8.0), along, rng.uniform(0, 2.5, 40_000)], axis=1)
    walls = np.where(rng.random((40_000, 1)) < 0.5, walls, walls[:, [1, 0, 2]])
    room.x, room.y, room.z = np.concatenate([floor, walls]).T
    room.write(tmp_path / "room.las")
    inside = import_map(tmp_path / "room.las")  # denser than any scan from the air
    assert inside.scenario == "pointcloud" and inside.resolution <= 0.25 and 45 < inside.free_area < 64
    raw = (tmp_path / "x.las").read_bytes()
    for broken in (raw[: len(raw) // 2], raw[:100], b"LASF" + bytes(500), b"x" * 1000):
        (tmp_path / "y.las").write_bytes(broken)
        with pytest.raises(MapError, match="y.las"):
            import_map(tmp_path / "y.las")


@pytest.mark.parametrize("suffix", ["obj", "glb", "ply"])
def test_meshes(tmp_path, suffix):
    trimesh = pytest.importorskip("trimesh")
    width, depth, height = ROOM
    shell = trimesh.creation.box(bounds=[[0, 0, 0], [width, depth, height]])
    block = trimesh.creation.box(bounds=[[2, 2, 0], [3, 3, 0.8]])
    mesh = trimesh.util.concatenate([shell, block])
    if suffix == "glb":  # Y-up by its standard
        mesh.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    mesh.export(tmp_path / f"x.{suffix}")
    world = import_map(tmp_path / f"x.{suffix}")
    assert_room(world)
    assert not holds(world, (2.5, 2.5))
    with pytest.raises(MapError, match="sample_spacing"):
        import_map(tmp_path / f"x.{suffix}", sample_spacing=1e-4)


def test_an_octree(tmp_path):
    pyoctomap = pytest.importorskip("pyoctomap")
    tree = pyoctomap.OcTree(0.1)
    for point in scan_room():
        tree.updateNode(point, True)
    tree.writeBinary(str(tmp_path / "x.bt"))
    path = tmp_path / "x.bt"
    assert_room(import_map(path))
    data = path.read_bytes()
    for broken in (data[: len(data) // 3], data[:30], b"# Octomap OcTree binary file\n", b"x" * 500):
        path.write_bytes(broken)
        with pytest.raises(MapError, match="x.bt"):
            import_map(path)


@pytest.mark.parametrize("package, suffix", [("laspy", "laz"), ("trimesh", "obj"), ("pyoctomap", "bt")])
def test_a_missing_extra_is_named(tmp_path, monkeypatch, package, suffix):
    monkeypatch.setitem(sys.modules, package, None)
    (tmp_path / f"x.{suffix}").write_text("LASF")
    with pytest.raises(MapError, match=r"pip install \"maexp\["):
        import_map(tmp_path / f"x.{suffix}")


def test_broken_clouds_are_refused(tmp_path):
    points = scan_room(spacing=0.2)
    cases = {
        "half.pcd": write_pcd(tmp_path / "a.pcd", points, "binary").read_bytes()[:5000],
        "half.ply": write_ply(tmp_path / "a.ply", points).read_bytes()[:5000],
        "ascii.pcd": write_pcd(tmp_path / "b.pcd", points).read_bytes()[:5000],
        "empty.pcd": write_pcd(tmp_path / "c.pcd", points[:0]).read_bytes(),
        "more.pcd": write_pcd(tmp_path / "d.pcd", points)
        .read_bytes()
        .replace(b"%d\n" % len(points), b"%d\n" % (len(points) + 50)),
        "words.pcd": write_pcd(tmp_path / "e.pcd", points).read_bytes().replace(b"0.", b"x.", 40),
        "more.ply": b"ply\nformat ascii 1.0\nelement vertex 9\nproperty float x\nproperty float y\n"
        b"property float z\nend_header\n" + b"1.0 2.0 3.0\n" * 8,
        "few.xyz": b"1 2 3\n4 5 6\n",
        "words.xyz": b"one two three\n",
        "two.xyz": b"1 2\n3 4\n",
        "bytes.xyz": bytes(range(128, 256)),
        "other.ply": b"solid\n" * 100,
        "head.pcd": b"FIELDS x y z\nSIZE 4 4 4\nWIDTH 9999999999\nHEIGHT 1\nDATA binary\n" + bytes(99),
        "less.pcd": b"FIELDS x y\nSIZE 4 4\nWIDTH 3\nHEIGHT 1\nDATA ascii\n1 2\n1 2\n1 2\n",
        "packed.pcd": b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 90\nHEIGHT 1\nDATA binary_compressed\n" + bytes(99),
        "none.ply": b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nend_header\n1\n2\n3\n",
        "mesh.obj": b"v 1 2\nf 1 2 9\n",
        "mesh.glb": b"glTF" + bytes(200),
        "zero.xyz": b"0 0 0\n" * 100,
    }
    for name, content in cases.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(MapError) as caught:
            import_map(tmp_path / name)
        assert "\n" not in str(caught.value), caught.value


SMALL = scan_room(spacing=0.5)


@settings(max_examples=25, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    suffix=st.sampled_from(["pcd", "ply", "xyz"]),
    cut=st.floats(0.0, 1.0),
    hits=st.lists(st.tuples(st.floats(0, 0.999), st.integers(0, 255)), max_size=8),
)
def test_a_damaged_file_is_an_error_or_a_map(tmp_path, suffix, cut, hits):
    kind = {"kind": "binary"} if suffix == "pcd" else {}
    data = bytearray(WRITERS[suffix](tmp_path / f"x.{suffix}", SMALL, **kind).read_bytes())
    for place, value in hits:
        data[int(place * place * len(data))] = value  # most hit the header
    (tmp_path / f"y.{suffix}").write_bytes(data[: int(len(data) * max(cut, 0.001)) + 1])
    try:
        world = import_map(tmp_path / f"y.{suffix}")
    except MapError:
        return
    assert check_map(world).ok


REAL = {  # file, scenario: free area the map must have [m2]
    ("indoor/pcl_room_scan1.pcd", "auto"): (15, 40),
    ("indoor/freiburg_geb079_voxels.ply", "auto"): (70, 250),
    ("indoor/upenn_room.pcd", "indoor_small"): (5, 14),
    ("indoor/asl_flying_arena.ply", "indoor_small"): (2.5, 8),
    ("outdoor/isprs_samp12.pcd", "auto"): (12_000, 30_000),
    ("outdoor/autzen_trim.laz", "auto"): (15_000, 35_000),
}


@pytest.mark.parametrize("name, scenario", REAL)
def test_real_scans(data_dir, name, scenario):
    if name.endswith(".laz"):
        pytest.importorskip("laspy")
    world = import_map(data_dir / name, scenario=scenario)
    low, high = REAL[name, scenario]
    assert low < world.free_area < high
    assert world.resolution <= find_scenario(world.scenario).collision_threshold
    report = check_map(world)
    assert report.ok and not report.warnings, report.table()


@pytest.mark.parametrize("name", ["upenn_room.pcd", "asl_flying_arena.ply"])
def test_too_small_for_the_robot(data_dir, name):
    with pytest.raises(MapError, match=r"say how large your robots are, as robot\.radius=0\.075"):
        import_map(data_dir / "indoor" / name)
