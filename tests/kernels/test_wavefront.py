"""Known and passable grids, sight, paths and waypoints against plain loops."""

from functools import partial

import numpy as np
import pytest
import warp as wp
from oracle import waypoint as oracle
from oracle.grid import geodesic_distance

from maexp.envs.maps.nav_grid import build_nav_grid, stack_nav_grids
from maexp.envs.maps.point_cloud import PointCloudMap
from maexp.kernels.constants import FREE, OBSTACLE, SNAP_CELLS, UNKNOWN
from maexp.kernels.geodesic import SKIP
from maexp.kernels.occupancy_grid import KnownGrids, NavGrids
from maexp.kernels.path_steps import PATH_CELLS, in_sight
from maexp.kernels.traversability import PassableGrids
from maexp.kernels.types import Maps
from maexp.kernels.wavefront import PathSearch, distinct_masks

pytestmark = pytest.mark.kernels

launch = partial(wp.launch, device="cpu")


def array(values, dtype):
    return wp.array(np.asarray(values), dtype=dtype, device="cpu")


def lattice(kinds: np.ndarray, cell: float, origin=(0.0, 0.0)) -> PointCloudMap:
    """A map with one point at the centre of every cell; `kinds` (H, W) holds FREE or OBSTACLE."""
    points = {}
    for kind in (FREE, OBSTACLE):
        rows, columns = np.nonzero(kinds == kind)
        points[kind] = np.stack([columns, rows], axis=1) * cell + np.asarray(origin)
    return PointCloudMap(points[FREE], points[OBSTACLE], cell, boundary=points[OBSTACLE])


def maps_of(places: list[PointCloudMap]) -> Maps:
    maps = Maps()
    maps.free_begin = array(np.cumsum([0] + [len(p.free) for p in places]), wp.int32)
    maps.boundary_begin = array(np.cumsum([0] + [len(p.boundary) for p in places]), wp.int32)
    return maps


def flag_words(seen: list[np.ndarray], words: int, points: int) -> np.ndarray:
    """int32 [E, words, points] from one bool (N, n) per env."""
    flags = np.zeros((len(seen), words, points), np.uint32)
    for e, rows in enumerate(seen):
        for i, row in enumerate(rows):
            flags[e, i // 32, : len(row)] |= row.astype(np.uint32) << np.uint32(i % 32)
    return flags.view(np.int32)


class Scene:
    """Random maps of different sizes, and what random robots have seen of them."""

    def __init__(self, seed: int, robots: int, rows_per_env: int, share=0.5, map_id=(1, 0, 1)):
        rng = np.random.default_rng(seed)
        self.kinds = [np.where(rng.random(size) < 0.75, FREE, OBSTACLE) for size in ((7, 12), (11, 6))]
        self.places = [lattice(k, c, o) for k, c, o in zip(self.kinds, (0.5, 2.0), ((-3, 4), (1, -9)), strict=True)]
        self.map_id = list(map_id)
        self.grids, self.cells = stack_nav_grids([build_nav_grid(p) for p in self.places])
        chosen = [self.places[m] for m in map_id]
        self.free = [rng.random((robots, len(p.free))) < share for p in chosen]
        self.boundary = [rng.random((robots, len(p.boundary))) < share for p in chosen]
        words = -(-robots // 32)
        self.known = KnownGrids(
            maps_of(self.places),
            self.grids,
            array(self.map_id, wp.int32),
            array(flag_words(self.free, words, max(len(p.free) for p in self.places)), wp.int32),
            array(flag_words(self.boundary, words, max(len(p.boundary) for p in self.places)), wp.int32),
            rows_per_env,
            self.cells,
        )
        self.known.paint(launch)

    def expected(self, e: int, robot: int | None) -> np.ndarray:
        """(H, W) what the robot (None: the team) of env e knows."""
        kinds = self.kinds[self.map_id[e]]
        known = np.zeros(kinds.shape, np.uint8)
        for kind, seen in ((FREE, self.free[e]), (OBSTACLE, self.boundary[e])):
            seen = seen.any(axis=0) if robot is None else seen[robot]
            rows, columns = np.nonzero(kinds == kind)
            known[rows[seen], columns[seen]] = kind
        return known


def test_known_grid_of_the_team_and_of_each_robot():
    robots = 35  # two words of flags
    team, own = Scene(1, robots, 1, share=0.02), Scene(1, robots, robots, share=0.02)
    for e in range(3):
        for robot in [None, *range(robots)]:
            scene, row = (team, e) if robot is None else (own, e * robots + robot)
            want = scene.expected(e, robot)
            got = scene.known.known.numpy()[row]
            np.testing.assert_array_equal(got[: want.size].reshape(want.shape), want)
            assert (got[want.size :] == UNKNOWN).all()


@pytest.mark.parametrize("through_unknown", [True, False])
def test_passable_cells_keep_their_distance(through_unknown):
    scene = Scene(2, 2, 1, share=0.3)
    radius = np.array([[0.6, 1.3], [0.0, 2.5], [2.1, 0.7]], np.float32)  # metres
    masks = PassableGrids(scene.known, radius, None, 0.25, through_unknown)
    masks.paint(launch)
    for e in range(3):
        for k in range(2):
            known = scene.expected(e, None)
            cell = scene.places[scene.map_id[e]].resolution
            want = oracle.passable_cells(known, radius[e, k] / cell + 0.25, through_unknown)
            got = masks.passable.numpy()[e * 2 + k]
            np.testing.assert_array_equal(got[: want.size].reshape(want.shape), want)
            assert not got[want.size :].any()


def test_a_mask_per_robot_reads_the_robots_own_row():
    scene = Scene(3, 2, 2, share=0.4)
    masks = PassableGrids(scene.known, np.zeros((3, 2), np.float32), None, 0.0, through_unknown=False)
    masks.paint(launch)
    for e in range(3):
        for i in range(2):
            want = scene.expected(e, i) == FREE
            np.testing.assert_array_equal(masks.passable.numpy()[e * 2 + i][: want.size], want.ravel())
    with pytest.raises(ValueError, match="2 known rows"):
        PassableGrids(scene.known, np.zeros((3, 1), np.float32), None, 0.0, through_unknown=False)


def test_cells_between_the_points_of_a_cloud_take_the_nearest_state():
    """A jittered, rotated cloud leaves cells without points: they are no holes, and no walls."""
    rng = np.random.default_rng(8)
    y, x = np.mgrid[0:30, 0:40]
    points = np.stack([x, y], axis=-1).reshape(-1, 2) * 0.25 + rng.uniform(-0.1, 0.1, (1200, 2))
    edge = ((x == 0) | (y == 0) | (x == 39) | (y == 29)).reshape(-1)
    c, s = np.cos(0.6), np.sin(0.6)
    points = points @ np.array([[c, s], [-s, c]])
    place = PointCloudMap(points[~edge], points[edge], 0.25)
    grid = build_nav_grid(place)
    occupied = np.zeros(grid.width * grid.height, bool)
    occupied[grid.free_cell] = occupied[grid.boundary_cell] = True
    assert (grid.stand_in[occupied] == np.flatnonzero(occupied)).all()
    assert occupied[grid.stand_in[grid.stand_in >= 0]].all()
    grids, cells = stack_nav_grids([grid])
    everything = [array(np.ones((1, 1, n)), wp.int32) for n in (len(place.free), len(place.boundary))]
    known = KnownGrids(maps_of([place]), grids, array([0], wp.int32), *everything, 1, cells)
    known.paint(launch)
    shown = known.known.numpy()[0].reshape(grid.height, grid.width)
    centres = np.stack(np.meshgrid(np.arange(grid.width), np.arange(grid.height)), axis=-1) + 0.5
    centres = centres * grid.cell + grid.origin
    inside = centres @ np.array([[c, -s], [s, c]])  # turned back: the cloud's own axes
    middle = (inside > 0.5).all(axis=-1) & (inside < np.array([9.25, 6.75])).all(axis=-1)
    assert middle.sum() > 500 and (shown[middle] == FREE).all()
    assert (~occupied).reshape(shown.shape)[middle].sum() > 50
    far = (inside < -1.0).any(axis=-1)
    assert (shown[far] == UNKNOWN).all()


def test_points_of_a_lattice_lie_at_cell_centres():
    kinds = np.full((5, 9), FREE)
    kinds[2, 3] = OBSTACLE
    grid = build_nav_grid(lattice(kinds, 0.1, (7.3, -2.9)))
    assert (grid.width, grid.height) == (9, 5)
    np.testing.assert_array_equal(np.sort(np.r_[grid.free_cell, grid.boundary_cell]), np.arange(45))
    np.testing.assert_array_equal(grid.boundary_cell, [2 * 9 + 3])
    order = np.random.default_rng(0).permutation(44)
    np.testing.assert_array_equal(grid.reorder(order, np.array([0])).free_cell, grid.free_cell[order])


@wp.kernel(enable_backward=False)
def _see_pairs(
    passable: wp.array2d(dtype=wp.uint8), pairs: wp.array2d(dtype=wp.int32), w: int, out: wp.array(dtype=wp.int32)
):
    k = wp.tid()
    out[k] = wp.where(in_sight(passable, 0, pairs[k, 0], pairs[k, 1], w), 1, 0)


def test_sight_touches_every_cell_of_the_segment():
    rng = np.random.default_rng(9)
    height, width = 9, 13
    passable = rng.random((height, width)) < 0.85
    cells = height * width
    pairs = rng.integers(0, cells, (600, 2))
    out = wp.zeros(len(pairs), dtype=wp.int32, device="cpu")
    row = array(passable.reshape(1, -1), wp.uint8)
    wp.launch(_see_pairs, len(pairs), inputs=[row, array(pairs, wp.int32), width], outputs=[out], device="cpu")
    want = [oracle.in_sight(passable, divmod(a, width), divmod(b, width)) for a, b in pairs.tolist()]
    np.testing.assert_array_equal(out.numpy(), want)
    assert 50 < sum(want) < 550


def run_planner(scene: Scene, robots_xy, goals, reach: float, paths: PathSearch | None = None, **state):
    """One replanning and one waypoint for every robot; positions in cells. Returns targets and the search."""
    envs, robots = robots_xy.shape[:2]
    if paths is None:
        masks = PassableGrids(scene.known, np.zeros((envs, 1), np.float32), None, 0.5, through_unknown=True)
        masks.paint(launch)
        paths = PathSearch(masks, np.zeros(robots, int))
    cell, origin = scene.grids.cell.numpy()[scene.map_id], scene.grids.origin.numpy()[scene.map_id]
    metres = partial(lambda p: p * cell[:, None, None] + origin[:, None])
    center = np.concatenate([metres(robots_xy), np.zeros((envs, robots, 1))], axis=-1)
    arrays = {
        "active": array(state.get("active", np.ones(envs)), wp.int32),
        "collided": array(state.get("collided", np.zeros((envs, robots))), wp.int32),
        "center": array(center, wp.vec3),
        "goal": array(metres(goals), wp.vec2),
    }
    target = array(metres(state.get("target", goals)), wp.vec2)
    reach = array(np.repeat(reach * cell[:, None], robots, axis=1), wp.float32)
    paths.find(launch, *arrays.values(), target)
    paths.pick(launch, *arrays.values(), reach, target)
    return (target.numpy() - origin[:, None]) / cell[:, None, None], paths


def random_places(scene: Scene, robots: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    sizes = np.array([scene.kinds[m].shape[::-1] for m in scene.map_id])
    return rng.integers(0, sizes[:, None], (len(sizes), robots, 2)) + rng.uniform(0.1, 0.9, (len(sizes), robots, 2))


def test_waypoints_match_the_oracle():
    for seed in range(4):
        scene = Scene(seed, 2, 1, share=0.3)
        robots = 5
        here, goals = random_places(scene, robots, seed), random_places(scene, robots, seed + 50)
        got, paths = run_planner(scene, here, goals, 4.0)
        direct = 0
        for e in range(3):
            shape = scene.kinds[scene.map_id[e]].shape
            passable = paths.passable.passable.numpy()[e][: shape[0] * shape[1]].reshape(shape)
            for i in range(robots):
                want = oracle.waypoint(passable, here[e, i], goals[e, i], 4.0, SNAP_CELLS)
                np.testing.assert_allclose(got[e, i], want, atol=1e-4)
                direct += np.allclose(want, goals[e, i])
        assert 0 < direct < 3 * robots


def open_scene(height: int, width: int) -> Scene:
    scene = Scene(0, 1, 1, map_id=(0,))
    scene.kinds = [np.full((height, width), FREE)]
    scene.places = [lattice(scene.kinds[0], 1.0)]
    scene.grids, scene.cells = stack_nav_grids([build_nav_grid(p) for p in scene.places])
    nothing = [array(np.zeros((1, 1, n)), wp.int32) for n in (height * width, 1)]
    scene.known = KnownGrids(maps_of(scene.places), scene.grids, array([0], wp.int32), *nothing, 1, scene.cells)
    return scene


def wall_off(paths: PathSearch, cells) -> None:
    mask = paths.passable.passable.numpy()
    mask[0, cells] = 0
    paths.passable.passable.assign(mask)


def test_a_path_is_kept_until_it_is_blocked_used_up_or_out_of_sight():
    height, width = 3, 200
    scene = open_scene(height, width)
    at = np.array([[[1.5, 1.5]]])
    goal = np.array([[[198.5, 1.5]]])
    first, paths = run_planner(scene, at, goal, 6.0)
    np.testing.assert_allclose(first[0, 0], [7.5, 1.5])
    assert paths.path_total.numpy()[0] == 198 > PATH_CELLS

    def replanned(x: float, blocked=()) -> bool:
        wall_off(paths, list(blocked))
        run_planner(scene, np.array([[[x, 1.5]]]), goal, 6.0, paths, target=first)
        return paths.search.stop.numpy()[0] != SKIP

    assert not replanned(2.5)
    assert not replanned(2.5, [width + 80])  # beyond what is kept
    assert replanned(2.5, [width + 20])
    assert not replanned(2.6)
    # Half of what is kept lies behind: the next search starts from here.
    assert not replanned(1.5 + PATH_CELLS / 2 - 3)
    assert replanned(1.5 + PATH_CELLS / 2 + 3)
    # Out of sight of every cell of the path.
    assert not replanned(150.5)
    assert replanned(150.5)


def test_a_new_goal_always_searches_anew_and_stopped_robots_never():
    scene = open_scene(4, 9)
    at, goal = np.array([[[1.5, 1.5]]]), np.array([[[7.5, 2.5]]])
    first, paths = run_planner(scene, at, goal, 2.0)
    cases = [
        (goal, {}, True),
        (first, {}, False),
        (goal, {"active": [0]}, False),
        (goal, {"collided": [[1]]}, False),
    ]
    for before, state, searches in cases:
        target, _ = run_planner(scene, at, goal, 2.0, paths, target=before, **state)
        assert (paths.search.stop.numpy()[0] != SKIP) == searches
        np.testing.assert_allclose(target, goal if state else first)  # a stopped robot's is left alone


def test_a_goal_walled_in_leads_to_the_nearest_reachable_cell():
    scene = open_scene(5, 11)
    at, goal = np.array([[[0.5, 2.5]]]), np.array([[[10.2, 2.7]]])
    _, paths = run_planner(scene, at, goal, 20.0)
    wall_off(paths, [8, 8 + 11, 8 + 22, 8 + 33, 8 + 44])
    got, _ = run_planner(scene, at, goal, 20.0, paths)
    np.testing.assert_allclose(got[0, 0], [7.5, 2.5])
    wall_off(paths, list(range(55)))
    got, _ = run_planner(scene, at, goal, 20.0, paths)
    np.testing.assert_allclose(got[0, 0], goal[0, 0], rtol=1e-6)  # no way at all: straight on


def test_following_waypoints_arrives():
    """A robot that steps from cell to cell toward its waypoints gets around every wall."""
    scene = Scene(0, 2, 1, share=1.0, map_id=(0,))
    shape = scene.kinds[0].shape
    masks = PassableGrids(scene.known, np.zeros((1, 1), np.float32), None, 0.5, through_unknown=True)
    masks.paint(launch)
    passable = masks.passable.numpy()[0][: shape[0] * shape[1]].reshape(shape)
    start = int(np.flatnonzero(passable)[0])
    distance = geodesic_distance(passable, [start]).ravel()
    end = int(np.argmax(np.where(distance < 1 << 30, distance, -1)))
    paths = PathSearch(masks, np.zeros(1, int))
    at = np.array([[[start % shape[1] + 0.5, start // shape[1] + 0.5]]])
    goal = np.array([[[end % shape[1] + 0.5, end // shape[1] + 0.5]]])
    for _ in range(200):
        target, _ = run_planner(scene, at, goal, 5.0, paths)
        at = np.floor(at + (target - at) / np.abs(target - at).max(initial=1.0)) + 0.5
        x, y = at[0, 0].astype(int)
        assert passable[y, x]
    np.testing.assert_allclose(at, goal, atol=1e-3)


def test_tight_cells_lie_between_the_two_radii_and_are_avoided():
    scene = Scene(2, 2, 1, share=0.25)
    radius, comfort = np.full((3, 1), 0.2, np.float32), np.full((3, 1), 1.1, np.float32)
    masks = PassableGrids(scene.known, radius, comfort, 0.5, through_unknown=True)
    masks.paint(launch)
    for e in range(3):
        known = scene.expected(e, None)
        cell = scene.places[scene.map_id[e]].resolution
        hard, soft = (oracle.passable_cells(known, r[0, 0] / cell + 0.5, True) for r in (radius, comfort))
        want = np.where(soft, 1, np.where(hard, 2, 0))
        np.testing.assert_array_equal(masks.passable.numpy()[e][: want.size], want.ravel())
        assert (want == 2).any()
    # Around a wall's end: the way through the gap is shorter, but tight.
    scene = open_scene(9, 11)
    at, goal = np.array([[[1.5, 4.5]]]), np.array([[[9.5, 4.5]]])
    _, paths = run_planner(scene, at, goal, 20.0)
    wall_off(paths, [5 + 11 * y for y in range(9) if y not in (4, 8)])
    mask = paths.passable.passable.numpy()
    assert steps_on(paths, scene, at, goal, 4 * 11 + 5)
    mask[0, 4 * 11 + 5] = 2
    paths.passable.passable.assign(mask)
    # A detour of 80 - 14 * 4 more than straight on is longer than 3 * 10: the gap is still worth it ...
    assert steps_on(paths, scene, at, goal, 4 * 11 + 5)
    mask[0, [4 * 11 + 4, 4 * 11 + 6]] = 2
    paths.passable.passable.assign(mask)
    # ... and no longer when three cells of it are tight.
    assert not steps_on(paths, scene, at, goal, 4 * 11 + 5)


def steps_on(paths: PathSearch, scene: Scene, at, goal, cell: int) -> bool:
    run_planner(scene, at, goal, 20.0, paths)
    return cell in paths.path.numpy()[0, : paths.path_total.numpy()[0]]


def test_robots_alike_share_a_mask():
    radius = np.array([[0.5, 0.7, 0.5, 0.5]] * 2, np.float32)
    comfort = np.array([[1.0, 1.0, 1.0, 2.0]] * 2, np.float32)
    hard, soft, mask_of_robot = distinct_masks(radius, comfort, each=False)
    assert hard.shape == soft.shape == (2, 3)
    np.testing.assert_array_equal(hard[:, mask_of_robot], radius)
    np.testing.assert_array_equal(soft[:, mask_of_robot], comfort)
    assert distinct_masks(radius, comfort, each=True)[2].tolist() == [0, 1, 2, 3]


def test_nav_grids_struct_has_every_field():
    assert set(NavGrids.vars) == {
        "origin",
        "cell",
        "width",
        "height",
        "free_cell",
        "boundary_cell",
        "cell_begin",
        "stand_in",
        "void_begin",
        "voids",
    }
