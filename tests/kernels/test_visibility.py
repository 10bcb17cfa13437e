"""The radar kernel against the float64 oracle, and what must hold for any cloud."""

import math

import numpy as np
import pytest
import torch
from oracle import radar

import maexp.kernels as mk
from maexp.envs import ExplorationEnv, RadarConfig, make_map

pytestmark = pytest.mark.kernels


def cloud(seed: int, kind: str, spacing: float = 1.0, dims: int = 2):
    """`(free, obstacles, origin)` float32: rooms with walls on a lattice, jittered, or rotated; or a 3D cloud."""
    rng = np.random.default_rng(seed)
    ticks = np.arange(-8, 9) * spacing
    axes = np.meshgrid(ticks, ticks, np.arange(-2, 3) * spacing if dims == 3 else [0.0], indexing="ij")
    points = np.stack([a.ravel() for a in axes], axis=1)
    points = points[rng.permutation(len(points))][: 300 if dims == 3 else None]
    wall = (np.abs(points[:, 0] - 3 * spacing) < 1e-9) & (np.abs(points[:, 1]) > 1.5 * spacing)
    wall |= (np.abs(points[:, 1] + 4 * spacing) < 1e-9) | (rng.random(len(points)) < 0.08)
    if kind == "jittered":
        points[:, :dims] += rng.normal(0.0, 0.15 * spacing, (len(points), dims))
    if kind == "rotated":
        c, s = math.cos(0.37), math.sin(0.37)
        points[:, :2] = points[:, :2] @ np.array([[c, s], [-s, c]]) + [31.7, -12.3]
    origin = np.array([0.3, 0.2, 0.0]) * spacing + (np.array([31.7, -12.3, 0.0]) if kind == "rotated" else 0.0)
    if kind == "on a point":
        origin = points[np.flatnonzero(~wall)[np.argmin(np.linalg.norm(points[~wall], axis=1))]]
    return (a.astype(np.float32) for a in (points[~wall], points[wall], origin))


def scan(free, obstacles, origin, **settings) -> np.ndarray:
    """The kernel's verdict on NumPy clouds."""
    radius = settings.pop("obstacle_radius", 0.0)
    if isinstance(radius, np.ndarray):
        radius = torch.from_numpy(radius)
    tensors = (torch.from_numpy(np.ascontiguousarray(a, dtype=np.float32)) for a in (free, obstacles, origin))
    return mk.visible_points(*tensors, obstacle_radius=radius, **settings).numpy()


def check(free, obstacles, origin, *, heading=0.0, fov=2.0 * math.pi, **settings) -> np.ndarray:
    """Kernel and oracle agree wherever no threshold is within 1e-5; returns the oracle's verdict."""
    want, clear = radar.visible_points(free, obstacles, origin, heading=heading, fov=fov, **settings)
    got = scan(free, obstacles, origin, heading=heading, field_of_view=fov, **settings)
    assert got.dtype == bool and got.shape == (len(free),)
    np.testing.assert_array_equal(got[clear], want[clear])
    return want


@pytest.mark.parametrize("kind", ["lattice", "jittered", "rotated", "on a point"])
@pytest.mark.parametrize("alpha1, radius", [(1e-3, 0.0), (0.011, 0.0), (1e-3, "closing"), (1e-3, "each")])
def test_agrees_with_the_oracle(kind, alpha1, radius):
    free, obstacles, origin = cloud(3, kind)
    if radius == "closing":
        radius = 1.0 / math.sqrt(2.0)
    if radius == "each":
        radius = np.random.default_rng(5).uniform(0.0, 1.4, len(obstacles)).astype(np.float32)
    visible = check(free, obstacles, origin, radar_range=7.3, alpha1=alpha1, obstacle_radius=radius)
    assert 10 < visible.sum() < len(free) - 20


def test_few_points_are_too_close_to_call():
    """The comparison above means something: on a jittered cloud nearly every verdict is checked."""
    free, obstacles, origin = cloud(3, "jittered")
    _, clear = radar.visible_points(free, obstacles, origin, 7.3, obstacle_radius=0.7)
    assert clear.mean() > 0.99


@pytest.mark.parametrize("radius", [0.0, 0.3, 0.71])
def test_points_off_the_plane_agree_with_the_oracle(radius):
    free, obstacles, origin = cloud(11, "jittered", dims=3)
    visible = check(free, obstacles, origin, radar_range=8.1, obstacle_radius=radius)
    assert 10 < visible.sum() < len(free) - 20
    planar = obstacles.copy()
    planar[:, 2] = 0.0  # the usual mix: walls in the plane, points above and below
    check(free, planar, origin, radar_range=8.1, obstacle_radius=radius)
    level = free.copy()
    level[:, 2] = 0.0
    check(level, obstacles, origin, radar_range=8.1, obstacle_radius=radius)


@pytest.mark.parametrize("scale", [0.05, 40.0])
def test_spacing_of_any_size(scale):
    free, obstacles, origin = cloud(17, "jittered", spacing=scale)
    visible = check(free, obstacles, origin, radar_range=7.3 * scale, obstacle_radius=0.5 * scale)
    assert 10 < visible.sum() < len(free) - 20


@pytest.mark.parametrize("alpha1", [0.0, 0.3, 1.0, 1.7])
@pytest.mark.parametrize("alpha2", [-0.5, 0.0, 0.4])
def test_unusual_thresholds(alpha1, alpha2):
    free, obstacles, origin = cloud(19, "jittered")
    check(free, obstacles[::9], origin, radar_range=7.3, alpha1=alpha1, alpha2=alpha2, obstacle_radius=0.4)


@pytest.mark.parametrize("fov", [0.3, 1.5, math.pi, 5.0])
@pytest.mark.parametrize("heading", [0.0, 2.4, -3.1])
def test_field_of_view(fov, heading):
    free, obstacles, origin = cloud(23, "jittered")
    ahead = check(free, obstacles, origin, radar_range=7.3, obstacle_radius=0.7, heading=heading, fov=fov)
    around = scan(free, obstacles, origin, radar_range=7.3, obstacle_radius=0.7)
    assert ahead.any() and not (ahead & ~around).any() and ahead.sum() < around.sum()


def test_empty_clouds():
    some = np.ones((3, 3), np.float32)
    nothing = np.zeros((0, 3), np.float32)
    origin = np.zeros(3, np.float32)
    assert scan(nothing, some, origin).shape == (0,)
    assert scan(nothing, nothing, origin).shape == (0,)
    assert scan(some, nothing, origin).all()
    assert not scan(some, nothing, origin, radar_range=1.0).any()


def test_one_point_of_each():
    origin = np.zeros(3, np.float32)
    near, far = np.array([[2.0, 1.0, 0.0]], np.float32), np.array([[4.0, 2.0, 0.0]], np.float32)
    assert not scan(far, near, origin).any()
    assert scan(near, far, origin).all()
    assert scan(far, -near, origin).all()
    assert not scan(near, near, origin).any()  # a free point in an obstacle is hidden by it


def test_range_is_inclusive_and_nothing_beyond_it_counts():
    origin = np.zeros(3, np.float32)
    free = np.array([[3.0, 4.0, 0.0], [3.0, 4.0001, 0.0], [-5.0, 0.0, 0.0], [80.0, -90.0, 0.0]], np.float32)
    assert scan(free, np.zeros((0, 3)), origin, radar_range=5.0).tolist() == [True, False, True, False]
    # The wall masks from within the range only; alpha2 would let one just outside mask a point just inside.
    wall = np.array([[0.0, 5.1, 0.0]], np.float32)
    point = np.array([[0.0, 4.9, 0.0]], np.float32)
    assert scan(point, wall, origin, radar_range=5.0, alpha2=0.5).all()
    assert not scan(point, wall, origin, radar_range=5.2, alpha2=0.5).any()
    assert not scan(free, wall, np.array([1e4, 1e4, 0.0]), radar_range=5.0).any()


@pytest.mark.parametrize("reach", [1e4, 1e12, math.inf])
def test_range_beyond_the_world(reach):
    free, obstacles, origin = cloud(29, "jittered")
    want = scan(free, obstacles, origin, radar_range=100.0, obstacle_radius=0.7)
    np.testing.assert_array_equal(scan(free, obstacles, origin, radar_range=reach, obstacle_radius=0.7), want)
    assert want.any()


@pytest.mark.parametrize("alpha2", [1e-6, 2.0])
def test_where_the_sensor_stands(alpha2):
    """|P| = 0: a free point there is seen whatever stands about, an obstacle there masks nothing."""
    origin = np.array([4.0, -3.0, 0.0], np.float32)
    free = np.array([[4.0, -3.0, 0.0], [9.0, -3.0, 0.0], [4.0, 2.0, 0.0]], np.float32)
    here = np.array([[4.0, -3.0, 0.0]], np.float32)
    assert scan(free, here, origin, alpha2=alpha2, obstacle_radius=0.7).all()
    ring = here + np.array([[0.4, 0.0, 0.0], [0.0, 0.4, 0.0], [-0.4, 0.0, 0.0], [0.0, -0.4, 0.0]], np.float32)
    verdict = scan(free, np.concatenate([here, ring]), origin, alpha2=alpha2, obstacle_radius=0.35)
    assert verdict.tolist() == [True, False, False]


def test_an_obstacle_wider_than_its_distance_masks_the_half_plane_behind_it():
    origin = np.zeros(3, np.float32)
    wall = np.array([[0.5, 0.0, 0.0]], np.float32)
    free = np.array([[1.0, 5.0, 0.0], [-1.0, 5.0, 0.0], [0.2, 0.1, 0.0]], np.float32)
    assert scan(free, wall, origin, obstacle_radius=0.6).tolist() == [False, True, True]


@pytest.mark.parametrize("radius", [0.0, 0.7])
def test_order_of_points_does_not_matter(radius):
    free, obstacles, origin = cloud(31, "jittered")
    rng = np.random.default_rng(1)
    first, second = rng.permutation(len(free)), rng.permutation(len(obstacles))
    want = scan(free, obstacles, origin, radar_range=7.3, obstacle_radius=radius)
    got = scan(free[first], obstacles[second], origin, radar_range=7.3, obstacle_radius=radius)
    np.testing.assert_array_equal(got, want[first])


@pytest.mark.parametrize("radius", [0.0, 0.7])
def test_moving_the_world_changes_nothing(radius):
    free, obstacles, origin = cloud(37, "jittered")
    want = scan(free, obstacles, origin, radar_range=7.3, obstacle_radius=radius)
    for angle, shift in ((0.0, (250.0, -90.0)), (1.1, (0.0, 0.0)), (-2.6, (-73.0, 41.0)), (math.pi / 2, (0, 0))):
        c, s = math.cos(angle), math.sin(angle)
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        moved = [np.asarray(a, np.float64) @ turn + [*shift, 0.0] for a in (free, obstacles, origin)]
        moved = [a.astype(np.float32) for a in moved]
        _, clear = radar.visible_points(*moved, 7.3, obstacle_radius=radius, tolerance=1e-4)
        got = scan(*moved, radar_range=7.3, obstacle_radius=radius)
        np.testing.assert_array_equal(got[clear], want[clear])
        assert clear.mean() > 0.9


@pytest.mark.parametrize("radius", [0.0, 0.5])
def test_more_obstacles_or_wider_ones_never_reveal(radius):
    free, obstacles, origin = cloud(41, "rotated")
    few = scan(free, obstacles[::2], origin, radar_range=7.3, obstacle_radius=radius)
    many = scan(free, obstacles, origin, radar_range=7.3, obstacle_radius=radius)
    wide = scan(free, obstacles, origin, radar_range=7.3, obstacle_radius=radius + 0.3)
    assert not (many & ~few).any() and not (wide & ~many).any() and wide.sum() < many.sum() < few.sum()


def test_points_of_two_coordinates_lie_in_the_plane():
    free, obstacles, origin = cloud(43, "lattice")
    want = scan(free, obstacles, origin)
    np.testing.assert_array_equal(scan(free[:, :2], obstacles[:, :2], origin[:2]), want)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"free": np.ones((4, 5))}, "free"),
        ({"obstacles": np.full((4, 3), np.nan)}, "obstacles"),
        ({"origin": np.array([0.0, np.inf, 0.0])}, "origin"),
        ({"obstacle_radius": np.ones(3, np.float32)}, "obstacle_radius"),
        ({"obstacle_radius": -1.0}, "obstacle_radius"),
        ({"radar_range": -2.0}, "radar_range"),
        ({"radar_range": math.nan}, "radar_range"),
        ({"alpha2": math.nan}, "alpha2"),
    ],
)
def test_bad_input_is_refused_by_name(change, message):
    arguments = {"free": np.ones((6, 3)), "obstacles": np.ones((4, 3)), "origin": np.zeros(3)} | change
    with pytest.raises(ValueError, match=message):
        scan(arguments.pop("free"), arguments.pop("obstacles"), arguments.pop("origin"), **arguments)


def test_with_closing_radius_walls_are_opaque():
    """Ray casting over the cells of a maze: at most 0.5 % of the points called visible lie behind a wall."""
    from maexp.envs import make_map

    maze = make_map("maze", 0)
    cells = {tuple(c) for c in np.rint(maze.obstacles[:, :2] / maze.resolution).astype(int).tolist()}
    rng = np.random.default_rng(2)
    called, hidden, peeped, through = 0, 0, 0, 0
    for k in rng.choice(len(maze.free), 40, replace=False):
        origin = maze.free[k] + np.float32([*rng.uniform(-0.45, 0.45, 2), 0.0])
        seen = scan(
            maze.free, maze.obstacles, origin, radar_range=10.0, obstacle_radius=maze.resolution / math.sqrt(2.0)
        )
        called += seen.sum()
        hidden += radar.behind_wall(maze.free[seen], origin, cells, maze.resolution, step=0.04).sum()
        if called < 1500:
            seen = scan(maze.free, maze.obstacles, origin, radar_range=10.0)
            peeped += seen.sum()
            through += radar.behind_wall(maze.free[seen], origin, cells, maze.resolution, step=0.04).sum()
    assert called > 2000 and hidden <= 0.005 * called
    assert through > 0.03 * peeped  # without a radius one looks through walls: ray casting can tell


def test_agrees_with_the_recorded_poses(oracle_dir):
    """rho = 0 is the paper's criterion: the poses recorded from the original, apart from its rounding."""
    with np.load(oracle_dir / "map_maze.npz") as maze, np.load(oracle_dir / "masking_maze.npz") as poses:
        for verdict, skip, alpha1 in (("visible_paper", "tight_paper", 1e-3), ("visible_code", "tight_code", 0.011)):
            differ = 0
            for k, origin in enumerate(poses["center"]):
                walls = np.concatenate([maze["obstacles"], poses["other_body"][k]])
                got = scan(maze["freespace"], walls, origin, radar_range=10.0, alpha1=alpha1)
                differ += ((got != poses[verdict][k]) & ~poses[skip][k]).sum()
            assert differ <= 2  # distances equal to within a float32 digit


@pytest.mark.parametrize("radius", ["auto", 0.0])
def test_what_is_hidden_cell_by_cell_is_what_the_definition_masks(radius):
    """A long range makes cells of many points, which are left out whole where they are hidden."""
    place = make_map("maze_small", 3)
    env = ExplorationEnv(place, 6, 1, radar=RadarConfig(range=30.0, obstacle_radius=radius), num_threads=1)
    env.reset()
    closed = radius == "auto"
    walls, rho = (place.boundary, place.resolution / math.sqrt(2.0)) if closed else (place.obstacles, 0.0)
    seen = 0
    for e in range(6):
        shot = env.snapshot(e)
        origin = np.append(shot["center"][0], 0.0)
        want, clear = radar.visible_points(place.free, walls, origin, 30.0, obstacle_radius=rho)
        np.testing.assert_array_equal(shot["visible"][0][clear], want[clear])
        seen += want.sum()
    assert 60 < seen < 0.3 * 6 * len(place.free) or not closed, "or nothing was hidden"
