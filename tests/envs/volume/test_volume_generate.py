"""Generated voxels, where robots can be among them, and what sensors see from there."""

import math

import numpy as np
import pytest

from maexp.agents.files import checksum
from maexp.envs import SCENARIOS, VoxelMap, make_map, split
from maexp.envs.scenarios import GENERATED, VOLUMES, find_scenario
from maexp.envs.volume import Body, check_volume, draw_volume, seeable
from maexp.envs.volume.reach import DRIVING, ball, label_reachable, largest_reach, passable, reach_from

NAMES = [name for name, row in VOLUMES.items() if row.build]


def box(*shape, side=0.25):
    free = np.zeros(shape, dtype=bool)
    free[1:-1, 1:-1, 1:-1] = True
    return VoxelMap(free, ~free, side)


def test_the_plane_never_meets_them():
    assert not set(VOLUMES) & set(SCENARIOS) and not set(VOLUMES) & set(GENERATED)
    assert {row.kind for row in SCENARIOS.values()} == {"plane"}
    assert {row.kind for row in VOLUMES.values()} == {"volume"}
    assert find_scenario("cave").radar_range == 5.0


@pytest.mark.parametrize("name", NAMES)
def test_maps_are_good_and_hold_a_team(name):
    for index in (0, split(name)[1][-1], 1234):
        world = make_map(name, index)
        report = check_volume(world, num_robots=8)
        assert report.ok and not report.warnings, report.table()
        assert report.leaks == 0 and len(report.components) == 1 and report.room >= 8
        assert world.shape == (120, 120, 24) and not (world.free == world.occupied).any()
        assert (world.name, world.scenario) == (f"{name}_{index}", name)


@pytest.mark.parametrize("name", NAMES)
def test_maps_are_the_same_on_every_call_and_differ_by_index(name):
    first, second, other = make_map(name, 5), make_map(name, 5), make_map(name, 6)
    assert checksum(first) == checksum(second) != checksum(other)
    training, held_out = split(name)
    assert (training, held_out) == (range(32), range(32, 40))


def test_stairs_join_the_storeys_of_offices():
    for index in range(4):
        world = make_map("office_3d", index)
        places = largest_reach(world.free, world.occupied, Body(DRIVING), world.resolution)
        assert places[:, :, 1].sum() > 1000 and places[:, :, 12].sum() > 1000


def test_ball_by_its_definition():
    for radius, side, count in ((0.1, 0.25, 1), (0.2, 0.25, 19), (0.25, 0.25, 27), (0.4, 0.25, 57)):
        shape = ball(radius, side)
        far = shape.shape[0] // 2
        for index in np.ndindex(shape.shape):
            gap = np.maximum(np.abs(np.array(index) - far) - 0.5, 0) * side
            assert shape[index] == (np.linalg.norm(gap) < radius or index == (far,) * 3)
        assert shape.sum() == count


def test_a_robot_that_drives_climbs_steps_and_no_walls():
    free = np.zeros((20, 7, 10), dtype=bool)
    free[1:-1, 1:-1, 1:-1] = True
    for k in range(4):
        free[6 + k :, :, : 2 + k] = False  # steps of one voxel
    body = Body(DRIVING, radius=0.25, step=0.27, height=0.5)
    labels, sizes = label_reachable(passable(free, ~free, body, 0.25), body, 0.25)
    assert len(sizes) == 1 and (labels[:, 3] > 0).any(axis=0).nonzero()[0].tolist() == [1, 2, 3, 4, 5]
    assert (labels[2:-2, 3] > 0).any(axis=1).all()
    free[6:, :, :5] = False  # the same rise at once
    _, sizes = label_reachable(passable(free, ~free, body, 0.25), body, 0.25)
    assert len(sizes) == 2
    lower = reach_from(free, ~free, body, 0.25, np.array([[3, 3, 1]]))
    assert lower.any() and not lower[6:].any()
    assert body.climb(0.25) == 2 and body.climb(0.3) == 1 and Body(step=0.25).climb(0.25) == 1


def test_a_slit_stops_robots_that_fly():
    world = box(21, 11, 11)
    free = world.free.copy()
    free[10] = False
    free[10, 4:6, 4:6] = True
    _, sizes = label_reachable(passable(free, ~free, Body(), 0.25), Body(), 0.25)
    assert len(sizes) == 2
    free[10, 4:7, 4:7] = True
    _, sizes = label_reachable(passable(free, ~free, Body(), 0.25), Body(), 0.25)
    assert len(sizes) == 1


def sees(free, target, source, reach, fov):
    """By the definition: points every 1/200 of the line lie in free voxels."""
    away = np.array(source) - target
    if np.linalg.norm(away) > reach or abs(math.atan2(away[2], math.hypot(*away[:2]))) > fov / 2 + 1e-9:
        return False
    cells = target + np.rint(np.linspace(0, 1, 201)[:, None] * away).astype(int)
    return free[tuple(cells.T)].all()


def test_what_is_seen_on_a_small_map_by_the_definition():
    rng = np.random.default_rng(1)
    free = np.pad(rng.random((7, 8, 6)) < 0.7, 1)
    world = VoxelMap(free, ~free, 0.5)
    sources = free & (rng.random(free.shape) < 0.03)
    for fov in (math.pi / 2, math.pi / 6):
        seen = seeable(world, 2.0, fov, sources, exact=True)
        wanted = np.array(
            [
                sources[tuple(t)] or any(sees(free, t, s, 4, fov) for s in np.argwhere(sources))
                for t in np.argwhere(free)
            ]
        )
        assert (seen[free] != wanted).mean() <= 0.01  # lines through edges
        assert not seen[~free].any() and 0.1 < wanted.mean() < 1.0
        quick = seeable(world, 2.0, fov, sources)
        assert not (quick & ~seen).any() and quick.sum() >= 0.98 * seen.sum()


def test_room_behind_a_wall_is_not_seeable():
    world = box(30, 12, 10)
    free = world.free.copy()
    free[15] = False
    world = VoxelMap(free, ~free, 0.25)
    sources = np.zeros_like(free)
    sources[5, 5, 5] = True
    seen = seeable(world, 5.0, math.pi, sources)
    assert seen[1:15].sum() == free[1:15].sum() and not seen[15:].any()


def test_the_verdict():
    assert check_volume(box(30, 30, 12)).verdict == "good"
    tiny = check_volume(box(4, 4, 4))
    assert not tiny.ok and "no room" in tiny.errors[0] and "robot.radius" in tiny.errors[0]
    assert "room for" in check_volume(box(6, 6, 6), num_robots=8).errors[0]
    free = box(30, 30, 12).free
    assert "close it" in check_volume(VoxelMap(free, np.zeros_like(free), 0.25)).errors[0]
    assert (
        "side of the box"
        in check_volume(VoxelMap(np.ones((20, 20, 9), bool), np.zeros((20, 20, 9), bool), 0.25)).errors[0]
    )
    split_free = free.copy()
    split_free[15] = False
    halves = check_volume(VoxelMap(split_free, ~split_free, 0.25))
    assert halves.ok and "2 pieces" in halves.warnings[0] and len(halves.components) == 2
    assert "2 pieces" in halves.table()


def test_a_picture(tmp_path):
    from PIL import Image

    image = np.asarray(Image.open(draw_volume(make_map("office_3d", 0), tmp_path / "x.png")).convert("L"))
    assert image.shape[0] > 500 and (image < 240).mean() > 0.3
