"""Import of files: floor maps of ROS and arrays of MAexp, good, odd and broken."""

import re

import numpy as np
import pytest
import yaml
from PIL import Image
from scipy import ndimage

from maexp.envs.io import ImportOptions, export_ros_map, import_map, import_map_with_report, postprocess
from maexp.envs.io import grid as grids
from maexp.envs.maps.checker import check_map
from maexp.envs.maps.point_cloud import MapError
from maexp.envs.scenarios import make_map

UNKNOWN, FREE, WALL = 205, 254, 0


def picture(width=120, height=90):
    """A room with a wall all around but for one side, where it meets unknown space; uint8 [height, width]."""
    image = np.full((height, width), UNKNOWN, dtype=np.uint8)
    image[10:80, 10:110] = FREE
    image[9, 9:111] = image[80, 9:111] = image[9:81, 9] = WALL  # the right side stays open to the unknown
    return image


def write_ros(folder, pixels=None, name="floor", suffix="pgm", **content):
    folder.mkdir(exist_ok=True, parents=True)
    Image.fromarray(picture() if pixels is None else pixels).save(folder / f"{name}.{suffix}")
    given = {"image": f"{name}.{suffix}", "resolution": 0.1, "origin": [0.0, 0.0, 0.0], "negate": 0}
    given |= {"occupied_thresh": 0.65, "free_thresh": 0.196} | content
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump({key: value for key, value in given.items() if value is not None}))
    return path


@pytest.mark.parametrize("suffix", ["pgm", "png"])
def test_a_room(tmp_path, suffix):
    world, report = import_map_with_report(write_ros(tmp_path / "a folder (1) = x", suffix=suffix))
    assert (world.name, world.scenario, world.resolution) == ("floor", "pointcloud", 0.25)
    assert world.free_area == pytest.approx(70.0, rel=0.08)
    assert check_map(world).ok
    # Pixel rows count from the top, y from the bottom: free rows 10..79 of 90 are y = 1.0 .. 8.0 m.
    np.testing.assert_allclose(world.free[:, :2].min(axis=0), [1.0, 1.0], atol=0.3)
    np.testing.assert_allclose(world.free[:, :2].max(axis=0), [11.0, 8.0], atol=0.3)
    east = world.boundary[world.boundary[:, 0] > 10.9]
    assert np.ptp(east[:, 1]) > 6.5, "unknown space beside free space becomes a wall"
    assert [step.name for step in report.steps][:2] == ["read", "resolution"]
    assert f"floor.{suffix}" in report.table()


def test_which_way_is_up(tmp_path):
    image = picture()
    image[12:22, 12:40] = WALL  # near the top: large y
    world = import_map(write_ros(tmp_path, image))
    block = world.obstacles[(world.obstacles[:, 0] > 1.8) & (world.obstacles[:, 0] < 3.5)]
    assert ((block[:, 1] > 6.6) & (block[:, 1] < 7.8)).any()
    assert not ((block[:, 1] > 1.2) & (block[:, 1] < 6.0)).any()


def test_negate_origin_and_yaw(tmp_path):
    plain = import_map(write_ros(tmp_path))
    negated = import_map(write_ros(tmp_path / "n", 255 - picture(), negate=1))
    assert len(negated.free) == len(plain.free)
    turned = import_map(write_ros(tmp_path / "t", origin=[5.0, -3.0, 0.5]))
    c, s = np.cos(0.5), np.sin(0.5)
    expected = plain.free[:, :2] @ np.array([[c, s], [-s, c]]) + [5.0, -3.0]
    np.testing.assert_allclose(turned.free[:, :2], expected, atol=1e-4)


def test_unknown_painted_as_free(tmp_path):
    image = picture()
    image[image == UNKNOWN] = 206  # the usual threshold of 0.196 calls it free
    world, report = import_map_with_report(write_ros(tmp_path, image))
    assert world.free_area == pytest.approx(70.0, rel=0.08)
    assert any("206" in warning for warning in report.warnings)
    strict, report = import_map_with_report(write_ros(tmp_path, image, free_thresh=0.15))
    assert len(strict.free) == len(world.free) and not report.warnings


def test_walls_that_are_only_grey(tmp_path):
    image = picture()
    image[10:80, 60] = 150  # one pixel, between the thresholds
    assert import_map(write_ros(tmp_path, image), grey_walls=True).free_area < 40
    image[image == WALL] = 150
    assert import_map(write_ros(tmp_path, image)).free_area < 40


def test_a_small_room_gets_fine_cells(tmp_path):
    image = np.full((70, 70), UNKNOWN, dtype=np.uint8)
    image[10:60, 10:60] = FREE
    image[10:60, 34:36] = WALL
    image[30:36, 34:36] = FREE  # a door of 0.6 m, just passable
    world = import_map(write_ros(tmp_path, image, resolution=0.1, name="small"))
    assert world.resolution < 0.25 and world.free_area > 20
    closed = import_map(write_ros(tmp_path, image, resolution=0.1, name="small"), min_passage=1.0)
    assert closed.free_area < 15


def test_a_radius_decides_what_a_robot_fits_through(tmp_path):
    image = np.full((150, 150), UNKNOWN, dtype=np.uint8)
    image[10:140, 10:140] = FREE
    image[10:140, 74:76] = WALL
    image[70:80, 74:76] = FREE  # a door of 1 m
    path = write_ros(tmp_path, image)
    wide, report = import_map_with_report(path, robot_radius=0.35)
    assert wide.free_area > 150 and wide.resolution <= 0.35
    assert "round, 0.7 m across, collides 0.35 m and starts 1.05 m from walls (robot.radius=0.35)" in report.table()
    assert "closed gaps narrower than 0.7 m" in report.table()
    assert import_map(path, robot_radius=0.65).free_area < 85
    assert "round" not in import_map_with_report(path)[1].table()
    with pytest.raises(MapError, match=r"robot\.radius=3 can use .* room for 0 of num_robots=3 .* smaller robot"):
        import_map(path, robot_radius=3.0)
    with pytest.raises(MapError, match=r"robot\.radius=-1 must be a number of metres greater than 0"):
        import_map(path, robot_radius=-1)


def test_what_lies_behind_narrow_gaps_is_told_with_the_setting_that_decides(tmp_path):
    image = np.full((150, 150), UNKNOWN, dtype=np.uint8)
    image[10:140, 10:140] = FREE
    image[10:140, 74:76] = WALL
    image[70:75, 74:76] = FREE  # a door of 0.5 m
    path = write_ros(tmp_path, image)

    def warnings(**settings) -> str:
        return " ".join(import_map_with_report(path, **settings)[1].warnings)

    assert not warnings(robot_radius=0.2)
    lies = r"\d\d% of the free space lies behind gaps narrower than"
    assert re.search(lies + r" 0\.7 m, too narrow for a robot of robot\.radius=0\.35", warnings(robot_radius=0.35))
    assert re.search(lies + r" importing\.min_passage=0\.8 m, and .* set less", warnings(min_passage=0.8))
    with pytest.raises(MapError, match=r"found 0\.0 m2 .* robot\.radius=50 can use .* a smaller robot\.radius"):
        import_map(path, robot_radius=50)
    with pytest.raises(MapError, match=r"found 0\.0 m2 .* set a smaller importing\.min_passage"):
        import_map(path, min_passage=100)


def test_coarse_pixels_are_cut_to_what_keeps_a_robot_from_colliding(tmp_path):
    """A robot of `pointcloud` collides 0.3 m from a point, one of `indoor_small` at 0.06 m."""
    for scenario, pixel, threshold in (("pointcloud", 0.5, 0.3), ("indoor_small", 0.1, 0.06)):
        path = write_ros(tmp_path, resolution=pixel)
        world, report = import_map_with_report(path, scenario=scenario)
        assert world.resolution == threshold and check_map(world).ok and not report.warnings
        told = next(step.detail for step in report.steps if step.name == "density")
        assert f"{pixel:g} m" in told and f"{threshold:g} m" in told
    by_hand, report = import_map_with_report(path, resolution=0.05)
    assert by_hand.resolution == 0.05 and "density" in [step.name for step in report.steps] and not report.warnings


@pytest.mark.parametrize("ratio", [0.05, 0.37, 0.5, 0.83, 0.999])
def test_cut_cells_keep_every_wall_and_every_door(ratio):
    labels = np.random.default_rng(0).integers(0, 3, (23, 17)).astype(np.uint8)
    coarse = grids.Grid(labels, 2.0, (3.0, -1.0), 0.4, height=labels + 0.5)
    fine = grids.refine(coarse, 2.0 * ratio)
    assert fine.cell == 2.0 * ratio
    x, y = np.meshgrid(*(np.arange(n) + 0.5 for n in fine.labels.shape), indexing="ij")
    old = np.floor(coarse.to_index(fine.to_world(np.stack([x, y], -1)))).astype(int).clip(0, [22, 16])
    np.testing.assert_array_equal(fine.labels, labels[old[..., 0], old[..., 1]])
    np.testing.assert_array_equal(fine.height, fine.labels + 0.5)
    for label, touching in ((grids.OBSTACLE, grids.EIGHT), (grids.FREE, None)):
        assert ndimage.label(fine.labels == label, touching)[1] == ndimage.label(labels == label, touching)[1]


def test_cells_coarser_than_the_collision_threshold_are_warned_of(tmp_path):
    path = write_ros(tmp_path, resolution=0.2)
    for setting, given in (("resolution", 0.4), ("max_points", 2000)):
        world, report = import_map_with_report(path, **{setting: given})
        assert world.resolution == pytest.approx(0.4)
        (warning,) = report.warnings
        assert f"{setting}={given}" in warning and "coarser than 0.3 m" in warning and "scenario=pointcloud" in warning
    advice = int(re.search(r"set importing.max_points=(\d+)", warning)[1])
    world, report = import_map_with_report(path, max_points=advice)
    assert world.resolution <= 0.3 and len(world.free) <= advice and not report.warnings


def test_a_large_box_is_imported_in_coarser_cells(tmp_path, monkeypatch):
    """Rather than refused, as where few of a large map's cells are free."""
    path = write_ros(tmp_path, resolution=0.5)
    fine = import_map(path)
    whole = import_map_with_report(path, resolution=0.3)[1]
    cells = next(step.after for step in whole.steps if step.name == "resolution")
    monkeypatch.setattr(postprocess, "CLEANED_CELLS", int(0.8 * cells))
    world, report = import_map_with_report(path)
    assert fine.resolution == 0.3 < world.resolution < 0.5 and check_map(world).ok
    (warning,) = report.warnings
    assert "coarser than 0.3 m" in warning and warning.endswith("; set importing.crop") and "max_points" not in warning


def test_set_by_hand(tmp_path):
    path = write_ros(tmp_path)
    assert import_map(path, resolution=0.5).resolution == 0.5
    assert import_map(path, ImportOptions(name="x")).name == "x"
    half = import_map(path, crop=(0, 0, 6, 9))
    assert half.free[:, 0].max() < 6.1 and check_map(half).ok
    image = picture()
    image[10:80, 50:53] = WALL
    path = write_ros(tmp_path, image)
    assert import_map(path).free[:, 0].min() > 5 > import_map(path, component=(2.0, 4.0)).free[:, 0].min()
    bare = tmp_path / "bare.png"
    Image.fromarray(picture()).save(bare)
    assert import_map(bare, pixel_size=0.1).free_area == pytest.approx(70.0, rel=0.08)


@pytest.mark.parametrize(
    "content, words",
    [
        (dict(image="none.pgm"), "does not exist"),
        (dict(image=7), "image=7"),
        (dict(resolution=None), "resolution"),
        (dict(resolution="wide"), "resolution"),
        (dict(resolution=-1.0), "resolution"),
        (dict(resolution=float("nan")), "resolution"),
        (dict(origin="here"), "origin"),
        (dict(origin=[0, "a", 0]), "origin"),
        (dict(occupied_thresh=0.1), "occupied_thresh"),
        (dict(mode="odd"), "mode"),
        (dict(free_thresh=0.0), "no pixel is free"),
    ],
)
def test_a_bad_yaml_is_refused(tmp_path, content, words):
    with pytest.raises(MapError, match=words):
        import_map(write_ros(tmp_path, **content))


def test_broken_files_are_refused(tmp_path):
    path = write_ros(tmp_path)
    image = tmp_path / "floor.pgm"
    data = image.read_bytes()
    for broken in (data[: len(data) // 2], data[:10], b"", b"hello", b"P5\n99999999 99999999\n255\n" + data):
        image.write_bytes(broken)
        with pytest.raises(MapError, match="floor.pgm"):
            import_map(path)
    for text in ("a: [", "just words", "image: x\x00", "[1, 2]"):
        path.write_text(text)
        with pytest.raises(MapError, match="floor.yaml"):
            import_map(path)
    with pytest.raises(MapError, match="does not exist"):
        import_map(tmp_path / "none.yaml")
    (tmp_path / "x.doc").write_text("x")
    with pytest.raises(MapError, match="doc"):
        import_map(tmp_path / "x.doc")
    with pytest.raises(MapError, match="pixel_size"):
        import_map(Image.fromarray(picture()).save(tmp_path / "y.png") or tmp_path / "y.png")


def test_no_room_for_the_team(tmp_path):
    image = np.full((40, 40), UNKNOWN, dtype=np.uint8)
    image[10:30, 10:30] = FREE
    with pytest.raises(MapError, match="room for . of num_robots=3"):
        import_map(write_ros(tmp_path, image))


@pytest.mark.parametrize(
    "name, value", [("up", "w"), ("units", "ell"), ("resolution", 0.0), ("crop", (1, 1, 0, 2)), ("x", 1)]
)
def test_bad_options(tmp_path, name, value):
    with pytest.raises(MapError, match=name):
        import_map(write_ros(tmp_path), **{name: value})


def save_triple(folder, world, **replace):
    arrays = {"freespace": world.free, "obstacles": world.obstacles, "boundary": world.boundary} | replace
    for kind, array in arrays.items():
        if array is not None:
            np.save(folder / f"map 7_{kind}.npy", array)
    return folder / "map 7_freespace.npy"


def test_arrays_of_maexp(tmp_path):
    maze = make_map("maze_small", 2)
    path = save_triple(tmp_path, maze)
    for given in (path, tmp_path / "map 7_obstacles.npy"):
        world = import_map(given, scenario="maze_small")
        np.testing.assert_array_equal(world.free, maze.free)
        np.testing.assert_array_equal(world.boundary, maze.boundary)
        assert (world.name, world.resolution, world.scenario) == ("map 7", 1.0, "maze_small")
    (tmp_path / "map 7_boundary.npy").unlink()
    np.testing.assert_array_equal(import_map(path, scenario="maze_small").boundary, maze.boundary)
    world = import_map(maze.save(tmp_path / "x.npz"))
    np.testing.assert_array_equal(world.free, maze.free)
    np.savez(tmp_path / "y.npz", freespace=maze.free, obstacles=maze.obstacles)
    assert len(import_map(tmp_path / "y.npz").free) == len(maze.free)


@pytest.mark.parametrize(
    "replace, words",
    [
        (dict(obstacles=None), "map 7_obstacles.npy does not exist"),
        (dict(freespace=np.zeros((0, 3))), "shape"),
        (dict(freespace=np.arange(9.0)), "shape"),
        (dict(freespace=np.full((9, 3), np.nan)), "NaN"),
        (dict(obstacles=np.full((9, 3), np.inf)), "infinite"),
        (dict(freespace=np.array([{}], dtype=object)), "readable"),
    ],
)
def test_bad_arrays_are_refused(tmp_path, replace, words):
    with pytest.raises(MapError, match=words):
        import_map(save_triple(tmp_path, make_map("maze_small", 2), **replace))


def test_truncated_arrays_are_refused(tmp_path):
    path = save_triple(tmp_path, make_map("maze_small", 2))
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(MapError, match="readable"):
        import_map(path)


def test_out_and_in_again(tmp_path):
    world = import_map(write_ros(tmp_path))
    path = export_ros_map(world, tmp_path / "out.yaml")
    again = import_map(path)
    assert again.resolution == world.resolution
    np.testing.assert_allclose(again.free, world.free, atol=1e-4)


REAL = {  # m2 of free space in the manifest, and the share of it we must keep
    "willow_full.yaml": 1393,
    "willow_2010.yaml": 1092,
    "rail_lab.yaml": 34,
    "rail_ilab.yaml": 86,
    "crob_lab_slam.yaml": 112,
    "jsk_eng8_6f.yaml": 298,
    "upo_big_lab.yaml": 393,
}


@pytest.mark.parametrize("name", REAL)
def test_real_floors(data_dir, name):
    world = import_map(data_dir / "maps2d" / name)
    report = check_map(world)
    assert report.ok and not report.warnings, report.table()
    assert 0.75 * REAL[name] < world.free_area < 1.02 * REAL[name]
    assert len(world.free) < 50_000
