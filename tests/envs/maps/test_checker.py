"""The checker finds what is wrong with a map, and the repair makes it right."""

import numpy as np
import pytest

from maexp.envs.maps.checker import check_map, repair_map
from maexp.envs.maps.plot import draw_map
from maexp.envs.maps.point_cloud import MapError, PointCloudMap
from maexp.envs.maps.reachability import WIDE, Raster
from maexp.envs.scenarios import make_map


def floor(width=40, depth=24, cell=0.25, wall_x=None, door=()):
    """A walled room, cut by a wall at column `wall_x` with a door at rows `door`; bool free [width, depth]."""
    free = np.zeros((width, depth), dtype=bool)
    free[1:-1, 1:-1] = True
    if wall_x is not None:
        free[wall_x] = False
        free[wall_x, list(door)] = True
    return free, cell


def to_map(free, cell, keep=None, turn=0.0, jitter=0.0, **fields):
    rng = np.random.default_rng(3)
    c, s = np.cos(turn), np.sin(turn)

    def points(mask):
        cells = np.argwhere(mask) * cell
        return (cells + rng.uniform(-jitter, jitter, cells.shape) * cell) @ np.array([[c, s], [-s, c]])

    wall = points(~free)
    return PointCloudMap(points(free), wall if keep is None else wall[keep(wall)], cell, **fields)


@pytest.mark.parametrize("turn, jitter", [(0.0, 0.0), (0.4, 0.0), (0.7, 0.12)])
def test_a_good_room(turn, jitter):
    report = check_map(to_map(*floor(), turn=turn, jitter=jitter))
    assert report.ok and report.verdict == "good" and not report.warnings
    assert report.sealed and report.components == [38 * 22]
    assert report.visible_share == 1.0 and report.memory_per_env > 100_000
    assert report.num_free == 38 * 22 and report.free_area == pytest.approx(38 * 22 / 16)
    assert "good" in report.table()


def test_a_hole_in_the_wall_is_found_and_sealed():
    open_map = to_map(*floor(), keep=lambda wall: ~((wall[:, 0] < 0.1) & (np.abs(wall[:, 1] - 3) < 0.3)))
    report = check_map(open_map)
    assert not report.ok and not report.sealed and "rays leave" in report.errors[0]
    repaired, steps = repair_map(open_map)
    assert check_map(repaired).ok and "sealed" in steps[0]
    assert 0 < len(repaired.obstacles) - len(open_map.obstacles) < 20, "the hole is closed, not the whole rim"


@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_no_walls_at_all(turn):
    bare = to_map(*floor(), keep=lambda wall: np.zeros(len(wall), dtype=bool), turn=turn)
    assert not check_map(bare).ok
    repaired, _ = repair_map(bare)
    assert check_map(repaired).ok


def test_two_pieces():
    world = to_map(*floor(wall_x=30))
    report = check_map(world)
    assert report.components == [29 * 22, 8 * 22] and not report.ok
    repaired, steps = repair_map(world)
    assert check_map(repaired).ok and len(repaired.free) == 29 * 22
    assert steps


def test_a_gap_too_narrow_for_the_robot():
    narrow = to_map(*floor(wall_x=25, door=[10]))  # walls 0.5 m apart; the robot needs 0.6 m
    report = check_map(narrow)
    assert report.ok and report.starts_cut_off > 0 and report.warnings
    repaired, _ = repair_map(narrow)
    after = check_map(repaired)
    assert after.ok and after.starts_cut_off == 0 and len(repaired.free) < 24 * 22 + 20
    assert not check_map(to_map(*floor(wall_x=25, door=[10, 11]))).starts_cut_off


def test_room_is_counted_for_the_worst_order():
    corridor = to_map(*floor(width=46, depth=9))  # one lane of starts: 8.75 m - 2 x 0.65 m beside the ends
    report = check_map(corridor, num_robots=3)
    assert 5 <= report.room <= 8
    report = check_map(corridor, num_robots=9)
    assert not report.ok and "num_robots=9" in report.errors[0]
    assert check_map(corridor, start_clearance=0.3).room > report.room
    assert check_map(to_map(*floor(width=6, depth=6))).room == 0


def test_free_and_obstacle_at_once():
    world = to_map(*floor())
    double = PointCloudMap(world.free, np.concatenate([world.obstacles, world.free[100:103]]), 0.25)
    assert any("free and obstacle" in error for error in check_map(double).errors)
    repaired, _ = repair_map(double)
    assert check_map(repaired).ok and len(repaired.free) == len(world.free) - 3


@pytest.mark.parametrize("name", ["maze_small", "random_obstacles", "random_obstacles_adaptive"])
def test_generated_maps_pass(name):
    report = check_map(make_map(name, 1))
    assert report.ok and not report.warnings, report.table()


def test_the_picture(tmp_path):
    from PIL import Image

    path = draw_map(to_map(*floor(), name="room"), tmp_path / "a room.png", size=300)
    with Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB"))
    assert 200 < pixels.shape[1] < 700
    blue = (pixels == (198, 219, 239)).all(axis=-1).mean()
    assert 0.2 < blue < 0.8


def test_points_farther_apart_than_the_radar_reaches_are_an_error():
    maze = make_map("maze_small", 3)
    huge = PointCloudMap(maze.free * 16_000.0, maze.obstacles * 16_000.0, maze.resolution * 16_000.0)
    report = check_map(huge)
    assert not report.ok and any("check the units" in error for error in report.errors)
    assert not any("check the units" in error for error in check_map(maze).errors)
    with pytest.raises(MapError, match="check the units"):
        repair_map(huge)


@pytest.mark.parametrize("reach", [WIDE // 2, WIDE * 3])
def test_discs_are_painted_by_their_definition(reach):
    rng = np.random.default_rng(0)
    raster = Raster(np.array([-2.0, 1.0]), 0.05, (3 * reach, 4 * reach))
    corner, size = np.array([-2.0, 1.0, 0.0]), 0.05 * reach * np.array([3.0, 4.0, 0.0])
    points = rng.uniform(corner - 0.2 * size, corner + 1.2 * size, (6, 3))
    radius = rng.uniform(0.0, 0.05 * reach, 6)
    places = raster.places(np.ones(raster.shape, dtype=bool)).reshape(*raster.shape, 2)
    away = np.linalg.norm(places[:, :, None] - points[:, :2], axis=-1)
    painted = raster.paint(points, radius)
    assert (painted == (away <= radius).any(axis=-1)).all() and 0 < painted.mean() < 1
