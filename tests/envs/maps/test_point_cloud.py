"""PointCloudMap: validation, boundary, and a file format that refuses damaged and hostile files."""

import io
import os
import zipfile

import numpy as np
import pytest

from maexp.envs.maps.point_cloud import MapError, PointCloudMap


def room(size=5, resolution=0.5):
    """A square room of size x size free points in a ring of walls two points thick."""
    axis = np.arange(-2, size + 2)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    inside = (x >= 0) & (x < size) & (y >= 0) & (y < size)
    points = np.stack([x, y, np.zeros_like(x)], axis=-1) * resolution
    return points[inside], points[~inside]


@pytest.fixture
def small_map():
    free, obstacles = room()
    return PointCloudMap(free, obstacles, 0.5, name="room", scenario="maze", free_height=np.arange(25.0))


def test_fields(small_map):
    assert small_map.free.dtype == small_map.obstacles.dtype == small_map.boundary.dtype == np.float32
    assert small_map.free.shape == (25, 3)
    assert small_map.obstacles.shape == (81 - 25, 3)
    assert small_map.boundary.shape == (7 * 7 - 25, 3)  # the inner ring only, corners included
    assert small_map.extent == ((-0.5, -0.5), (2.5, 2.5))
    assert small_map.free_area == pytest.approx(25 * 0.25)
    assert (small_map.obstacle_spacing == 0.5).all()
    assert len(small_map.boundary_spacing) == len(small_map.boundary)


def test_boundary_follows_the_spacing_of_each_obstacle():
    free = [[0.0, 0.0, 0.0]]
    obstacles = [[1.4, 0, 0], [0, 2.9, 0], [0, -3.1, 0], [-1.6, 0, 0]]
    built = PointCloudMap(free, obstacles, 1.0, obstacle_spacing=[0.2, 2.0, 2.0, 1.0])
    np.testing.assert_allclose(built.boundary[:, :2], [[1.4, 0], [0, 2.9]])
    np.testing.assert_allclose(built.boundary_spacing, [0.2, 2.0])


def test_duplicates_go_and_order_stays():
    free = [[2, 0, 0], [1, 0, 0], [2, 0, 0], [-0.0, 0, 0], [0.0, 0, 0]]
    built = PointCloudMap(free, [[5, 0]], 1.0, free_spacing=[1, 2, 3, 4, 5], free_height=[1, 2, 3, 4, 5])
    np.testing.assert_array_equal(built.free, [[2, 0, 0], [1, 0, 0], [0, 0, 0]])
    np.testing.assert_array_equal(built.free_spacing, [1, 2, 4])
    np.testing.assert_array_equal(built.free_height, [1, 2, 4])


def test_no_obstacles_is_a_map():
    built = PointCloudMap([[0, 0, 0]], np.zeros((0, 3)), 1.0)
    assert built.boundary.shape == (0, 3) and built.extent == ((0, 0), (0, 0))


@pytest.mark.parametrize(
    "arguments, words",
    [
        (dict(free=np.zeros((0, 3))), "0 points"),
        (dict(free=[[np.nan, 0, 0]]), "NaN"),
        (dict(obstacles=[[np.inf, 0, 0]]), "obstacles has 1 points"),
        (dict(free=[1.0, 2.0, 3.0]), "shape"),
        (dict(free=[[1.0], [2.0]]), "shape"),
        (dict(free=[["a", "b", "c"]]), "dtype"),
        (dict(free=[[1e9, 0, 0]]), "offset"),
        (dict(resolution=0.0), "resolution"),
        (dict(resolution=float("nan")), "resolution"),
        (dict(resolution="fine"), "resolution"),
        (dict(free_spacing=[1.0, 2.0]), "free_spacing"),
        (dict(free_spacing=[-1.0]), "free_spacing"),
        (dict(obstacle_height=[np.nan]), "obstacle_height"),
    ],
)
def test_bad_input_is_refused(arguments, words):
    good = dict(free=[[0, 0, 0]], obstacles=[[1, 0, 0]], resolution=1.0)
    with pytest.raises(MapError, match=words):
        PointCloudMap(**(good | arguments))


def test_frozen(small_map):
    with pytest.raises(AttributeError):
        small_map.name = "other"


def test_save_and_load(small_map, tmp_path):
    path = tmp_path / "a map (1) = x.npz"
    small_map.save(path)
    again = PointCloudMap.load(path)
    for name in ("free", "obstacles", "boundary", "free_spacing", "boundary_spacing", "free_height"):
        np.testing.assert_array_equal(getattr(again, name), getattr(small_map, name))
    assert (again.name, again.scenario, again.resolution) == ("room", "maze", 0.5)
    assert again.obstacle_height is None
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_a_failed_save_leaves_the_old_file(small_map, tmp_path, monkeypatch):
    path = small_map.save(tmp_path / "x.npz")
    before = path.read_bytes()

    def fail(file, **arrays):
        file.write(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez_compressed", fail)
    with pytest.raises(MapError, match="x.npz could not be written .disk full"):
        small_map.save(path)
    assert path.read_bytes() == before and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_truncated(small_map, tmp_path, share):
    path = small_map.save(tmp_path / "x.npz")
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(MapError, match=str(path)):
        PointCloudMap.load(path)


def test_flipped_bytes_never_escape_as_another_error(small_map, tmp_path):
    path = small_map.save(tmp_path / "x.npz")
    data = bytearray(path.read_bytes())
    rng = np.random.default_rng(0)
    for position in rng.integers(0, len(data), 200):
        broken = bytearray(data)
        broken[position] ^= 0xFF
        path.write_bytes(broken)
        try:
            PointCloudMap.load(path)  # a flip in unused bytes may go unnoticed
        except MapError:
            pass


def write_zip(path, **members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)


def test_foreign_files(tmp_path):
    foreign = tmp_path / "x.npz"
    np.savez(foreign, a=np.arange(3))
    with pytest.raises(MapError, match="not a MAexp map"):
        PointCloudMap.load(foreign)
    np.savez(foreign, free=np.array([{"a": 1}], dtype=object))
    with pytest.raises(MapError):
        PointCloudMap.load(foreign)
    foreign.write_text("hello")
    with pytest.raises(MapError):
        PointCloudMap.load(foreign)
    with pytest.raises(MapError, match="does not exist"):
        PointCloudMap.load(tmp_path / "none.npz")
    with pytest.raises(MapError, match="not a file"):
        PointCloudMap.load(tmp_path)


def test_a_header_that_promises_too_much(tmp_path):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f4", "fortran_order": False, "shape": (2**40, 3)})
    write_zip(tmp_path / "x.npz", free=header.getvalue() + b"\0" * 12)
    with pytest.raises(MapError, match="promises"):
        PointCloudMap.load(tmp_path / "x.npz")


def test_a_zip_bomb(tmp_path, monkeypatch):
    monkeypatch.setattr("maexp.envs.maps.point_cloud.MAX_FILE_BYTES", 10_000)
    np.savez_compressed(tmp_path / "x.npz", free=np.zeros((10_000, 3)))
    assert os.path.getsize(tmp_path / "x.npz") < 10_000
    with pytest.raises(MapError, match="unpacks to more"):
        PointCloudMap.load(tmp_path / "x.npz")


def test_a_map_of_a_later_format(small_map, tmp_path):
    path = small_map.save(tmp_path / "x.npz")
    with np.load(path) as arrays:
        content = dict(arrays)
    np.savez(path, **(content | {"format": np.array("maexp-map-99")}))
    with pytest.raises(MapError, match="maexp-map-99"):
        PointCloudMap.load(path)
    np.savez(path, **(content | {"free": np.full((3, 3), np.nan)}))
    with pytest.raises(MapError, match="NaN"):
        PointCloudMap.load(path)
