"""Clouds, meshes and octrees as maps of voxels."""

import numpy as np
import pytest

from maexp.envs import MapError, VoxelMap, import_map
from maexp.envs.io import import_map_with_report
from maexp.envs.volume import check_volume
from maexp.envs.volume.surfaces import cut_triangles

trimesh = pytest.importorskip("trimesh")


def room_mesh(*boxes):
    """Boxes [(size, middle), ...] as one mesh."""
    parts = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for size, at in boxes]
    return trimesh.util.concatenate(parts)


def house(roof=True):
    """Four walls of 0.2 m, a floor, a roof, 8 x 6 x 3 m, a door of 1 x 2 m."""
    parts = [((8, 6, 0.2), (0, 0, 0.1)), ((0.2, 6, 3), (-3.9, 0, 1.5)), ((0.2, 6, 3), (3.9, 0, 1.5))]
    parts += [((8, 0.2, 3), (0, 2.9, 1.5)), ((3.5, 0.2, 3), (-2.25, -2.9, 1.5)), ((3.5, 0.2, 3), (2.25, -2.9, 1.5))]
    parts += [((1, 0.2, 1), (0, -2.9, 2.5))]
    return room_mesh(*parts, *([((8, 6, 0.2), (0, 0, 2.9))] if roof else []))


def text(report):
    return report.table()


@pytest.mark.parametrize("suffix", ["stl", "obj", "glb", "ply"])
def test_a_mesh_of_boxes(tmp_path, suffix):
    path = tmp_path / f"house.{suffix}"
    house().export(path)
    world, report = import_map_with_report(path, volume=True, up="z", num_robots=2)
    assert isinstance(world, VoxelMap) and world.scenario == "volume" and world.resolution == 0.2
    assert world.free_volume == pytest.approx(7.6 * 5.6 * 2.6, rel=0.2)
    assert not world.free[0].any() and check_volume(world, num_robots=2).leaks == 0
    (x, y, z), inside = world.indices((0.0, 0.0, 1.5)), world.indices((0.0, 0.0, 0.1))
    assert world.free[x, y, z] and not world.free[tuple(inside)]
    assert "0.2 m" in text(report) and "closed" in text(report)


def test_an_inner_surface_alone(tmp_path):
    shell = trimesh.creation.box((6, 5, 3))
    shell.invert()
    shell.export(tmp_path / "cave.stl")
    world, report = import_map_with_report(tmp_path / "cave.stl", volume=True)
    assert "inside is free" in text(report)
    assert world.free_volume == pytest.approx(6 * 5 * 3, rel=0.2)
    centre = tuple(world.indices((0, 0, 0)))
    assert world.free[centre]


def test_y_up(tmp_path):
    mesh = house()
    mesh.apply_scale((2, 2, 1))
    mesh.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0)))
    mesh.export(tmp_path / "house.obj")
    world, report = import_map_with_report(tmp_path / "house.obj", volume=True, num_robots=2)
    assert "y of the file points up (detected)" in text(report)
    assert world.shape[2] * world.resolution < 4 < world.shape[0] * world.resolution
    again = import_map(tmp_path / "house.obj", volume=True, num_robots=2, up="z")
    assert again.shape[2] > world.shape[2]


def test_two_storeys_that_a_slab_cuts_apart(tmp_path):
    upper = house()
    upper.apply_translation((0, 0, 3.0))
    room_mesh_of_two = trimesh.util.concatenate([house(), upper])
    room_mesh_of_two.export(tmp_path / "two.stl")
    world, report = import_map_with_report(tmp_path / "two.stl", volume=True, num_robots=2)
    assert any("2 pieces of free space are not joined" in warning for warning in report.warnings)
    spans = check_volume(world).driving
    assert len(spans) == 2 and abs(spans[1][1] - spans[0][1]) == pytest.approx(3.0, abs=0.21)


def test_without_a_ceiling_what_lies_over_the_floor_is_free(tmp_path):
    house(roof=False).export(tmp_path / "open.stl")
    world, report = import_map_with_report(tmp_path / "open.stl", volume=True, num_robots=2)
    assert check_volume(world, num_robots=2).leaks == 0
    assert world.free_volume == pytest.approx(7.6 * 5.6 * 2.8, rel=0.15)
    assert "closed" in text(report)


def write_ply(path, points):
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
    head += "property float x\nproperty float y\nproperty float z\nend_header\n"
    path.write_bytes(head.encode() + np.asarray(points, "<f4").tobytes())
    return path


def scan(side=6.0, high=2.5, step=0.05):
    """Floor, ceiling and walls of a room as points."""
    u = np.arange(0, side, step)
    v = np.arange(0, high, step)
    x, y = (g.ravel() for g in np.meshgrid(u, u))
    a, b = (g.ravel() for g in np.meshgrid(u, v))
    parts = [np.stack([x, y, 0 * x], 1), np.stack([x, y, 0 * x + high], 1)]
    for at in (0.0, side):
        parts += [np.stack([a, 0 * a + at, b], 1), np.stack([0 * a + at, a, b], 1)]
    return np.concatenate(parts)


def test_a_cloud(tmp_path):
    path = write_ply(tmp_path / "room.ply", scan())
    world, report = import_map_with_report(path, volume=True, resolution=0.25)
    assert world.resolution == 0.25 and "as set" in text(report)
    assert world.free_volume == pytest.approx(6 * 6 * 2.5, rel=0.25)
    assert import_map(path, volume=True, name="hall").name == "hall"
    again = VoxelMap.load(world.save(tmp_path / "room.npz"))
    assert (import_map(tmp_path / "room.npz", volume=True).free == again.free).all()
    in_cm = write_ply(tmp_path / "cm.ply", scan() * 100)
    assert import_map(in_cm, volume=True, units="cm", resolution=0.25).shape == world.shape


def test_the_side_of_a_voxel_is_chosen_for_4_million(tmp_path):
    path = write_ply(tmp_path / "big.ply", scan(60.0, 20.0, 0.25))
    world, report = import_map_with_report(path, volume=True)
    assert world.free.size <= 4_000_000 and "importing.resolution" in text(report)
    with pytest.raises(MapError, match="64,000,000"):
        import_map(path, volume=True, resolution=0.02)


@pytest.mark.parametrize("colour", [False, True])
def test_octrees(tmp_path, colour):
    pyoctomap = pytest.importorskip("pyoctomap")
    tree = pyoctomap.ColorOcTree(0.2) if colour else pyoctomap.OcTree(0.2)
    for x, y, z in np.ndindex(24, 20, 12):
        wall = x in (0, 23) or y in (0, 19) or z in (0, 11)
        tree.updateNode([0.2 * x + 0.1, 0.2 * y + 0.1, 0.2 * z + 0.1], wall)
    tree.write(str(tmp_path / "room.ot"))
    world = import_map(tmp_path / "room.ot", volume=True, num_robots=2)
    assert world.resolution == pytest.approx(0.2) and world.free.sum() == 22 * 18 * 10
    data = (tmp_path / "room.ot").read_bytes()
    (tmp_path / "cut.ot").write_bytes(data[: len(data) // 3])
    with pytest.raises(MapError, match="truncated"):
        import_map(tmp_path / "cut.ot", volume=True)
    if not colour:
        tree.writeBinary(str(tmp_path / "room.bt"))
        assert import_map(tmp_path / "room.bt", volume=True, num_robots=2).free.sum() == world.free.sum()


def test_what_is_refused(tmp_path):
    path = write_ply(tmp_path / "room.ply", scan())
    with pytest.raises(MapError, match="no passage.*resolution"):
        import_map(path, volume=True, resolution=1.4)
    with pytest.raises(MapError, match="no passage|no room|room for"):
        import_map(path, volume=True, robot_radius=2.0)
    with pytest.raises(MapError, match="crop"):
        import_map(path, volume=True, crop=(100, 100, 110, 110))
    head = b"ply\nformat binary_little_endian 1.0\nelement vertex 1000000000\nproperty float x\nproperty float y\n"
    (tmp_path / "huge.ply").write_bytes(head + b"property float z\nend_header\n" + b"\0" * 1200)
    with pytest.raises(MapError, match="promises 1000000000 points; thin it"):
        import_map(tmp_path / "huge.ply", volume=True)
    far = np.concatenate([scan(), [[1e8, 0, 0]]])
    with pytest.raises(MapError, match="units|crop|importing"):
        import_map(write_ply(tmp_path / "far.ply", far), volume=True, outliers=False, resolution=0.2)
    nan = scan()
    nan[7] = np.nan
    with pytest.raises(MapError, match="NaN"):
        import_map(write_ply(tmp_path / "nan.ply", nan), volume=True)
    assert import_map(tmp_path / "nan.ply", volume=True, drop_invalid=True).free.any()
    (tmp_path / "plan.pgm").write_bytes(b"P5 1 1 255 x")
    with pytest.raises(MapError, match="hold no volume"):
        import_map(tmp_path / "plan.pgm", volume=True)
    (tmp_path / "bad.stl").write_bytes(b"solid nothing")
    with pytest.raises(MapError):
        import_map(tmp_path / "bad.stl", volume=True)


def test_triangles_are_cut_until_no_edge_is_longer():
    triangle = np.array([[[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [0.0, 3.0, 0.0]]])
    points = np.concatenate(list(cut_triangles(triangle, 0.5)))
    inside = np.random.default_rng(0).random((500, 2))
    inside = np.where(inside.sum(axis=1, keepdims=True) > 1, 1 - inside, inside) * (10, 3)
    away = np.linalg.norm(points[None, :, :2] - inside[:, None], axis=2).min(axis=1)
    assert away.max() < 0.5 and (points[:, 2] == 0).all() and len(points) < 20_000
    with pytest.raises(MapError, match="larger importing.resolution"):
        list(cut_triangles(triangle * 1e4, 0.5))


@pytest.mark.slow
def test_the_real_scenes(data_dir):
    folder = data_dir / "volume"
    if not folder.is_dir():
        pytest.skip(f"REAL DATA ABSENT: no {folder}")
    world, report = import_map_with_report(folder / "building_4f.ply", volume=True)
    assert "2 pieces of free space are not joined" in report.warnings[0]
    spans = check_volume(world).driving
    assert [round(high - low) for _, low, high in spans] == [4, 4], "each half has two storeys joined by stairs"
    mine, report = import_map_with_report(folder / "edgar_mine.ply", volume=True)
    assert "y of the file" in report.table() and mine.free.size <= 4_000_000
    assert mine.free.mean() < 0.1, "the rock around is no free space"
    for name in ("floorplan4", "tunnel_s"):
        import_map(folder / f"{name}.ply", volume=True)
