"""Waypoints drawn nearer, clearances fitted to the path, and what is to be seen from a target, against plain loops."""

from functools import partial

import numpy as np
import pytest
import warp as wp
from oracle import pace as oracle

from maexp.kernels import braking, information_gain, speed_limits
from maexp.kernels.constants import FREE, OBSTACLE, RAYS, UNKNOWN
from maexp.kernels.cpp_snippets import LOOK_CELLS
from maexp.kernels.dynamics import ACKERMANN, DIFFERENTIAL, Robots
from maexp.kernels.occupancy_grid import NavGrids
from maexp.kernels.path_steps import PATH_CELLS

pytestmark = pytest.mark.kernels

launch = partial(wp.launch, device="cpu")
SIZES = ((13, 41), (17, 9))  # height, width of the two maps; one row of cells takes two words
CELL = np.array([0.5, 2.0])
ORIGIN = np.array([[-3.0, 4.0], [1.0, -9.0]])
MAP_OF_ENV = [1, 0, 1]
ROBOTS = 4
LEAD = 0.3


def array(values, dtype):
    return wp.array(np.asarray(values), dtype=dtype, device="cpu")


def nav_grids() -> NavGrids:
    grids = NavGrids()
    grids.origin, grids.cell = array(ORIGIN, wp.vec2), array(CELL, wp.float32)
    grids.height, grids.width = (array([size[k] for size in SIZES], wp.int32) for k in (0, 1))
    return grids


class World:
    """Random known grids and teams on them; lengths in cells, turned to metres for the kernels."""

    def __init__(self, seed: int, obstacles: float):
        rng = self.rng = np.random.default_rng(seed)
        shares = [0.3, 0.7 - obstacles, obstacles]
        self.known = [rng.choice([UNKNOWN, FREE, OBSTACLE], SIZES[m], p=shares) for m in MAP_OF_ENV]
        self.rows = np.zeros((3, max(h * w for h, w in SIZES)), np.uint8)
        for row, known in zip(self.rows, self.known, strict=True):
            row[: known.size] = known.ravel()
        self.cell = CELL[MAP_OF_ENV][:, None]
        sides = np.array([SIZES[m][::-1] for m in MAP_OF_ENV])[:, None]
        self.at = rng.uniform(0.2, 0.8, (3, ROBOTS, 2)) * sides
        self.target = rng.uniform(0.0, 1.0, (3, ROBOTS, 2)) * sides
        self.goal = np.where(rng.random((3, ROBOTS, 1)) < 0.5, self.target, self.target + 1.0)
        self.speed, self.heading = rng.uniform(-3, 3, (3, ROBOTS)), rng.uniform(-3, 3, (3, ROBOTS))
        self.slip = np.where(rng.random((3, ROBOTS)) < 0.5, 0.0, rng.uniform(-1, 1, (3, ROBOTS)))
        self.collided = (rng.random((3, ROBOTS)) < 0.3).astype(int)
        self.active = np.array([1, 1, 0])
        self.accel, self.threshold, self.clearance = (
            rng.uniform(a, b, (3, ROBOTS)) for a, b in ((1, 3), (0.3, 0.8), (0.9, 2.0))
        )

    def walls(self) -> wp.array:
        """A bit for every obstacle cell, rows of cells padded to words of 32."""
        words = np.zeros((3, max(h * -(-w // 32) for h, w in SIZES)), np.uint32)
        for row, known in zip(words, self.known, strict=True):
            padded = np.pad(known == OBSTACLE, ((0, 0), (0, -known.shape[1] % 32))).reshape(-1, 32)
            row[: len(padded)] = (padded << np.arange(32, dtype=np.uint32)).sum(1)
        return array(words.view(np.int32), wp.int32)

    def metres(self, places) -> np.ndarray:
        return places * self.cell[..., None] + ORIGIN[MAP_OF_ENV][:, None]

    def robots(self) -> Robots:
        robots = Robots()
        lengths = {"collision_threshold": self.threshold, "clearance": self.clearance}
        for name, field in ({"max_accel": self.accel} | lengths).items():
            setattr(robots, name, array(field * self.cell, wp.float32))
        return robots

    def state(self) -> list:
        center = np.concatenate([self.metres(self.at), np.zeros((3, ROBOTS, 1))], axis=-1)
        return [array(self.active, wp.int32), array(self.collided, wp.int32), array(center, wp.vec3)]

    def constants(self, e: int, i: int) -> dict:
        names = ("creep", "headroom", "brake", "slack", "slack_gap", "slack_time", "samples", "ahead", "fit", "least")
        return {name: getattr(speed_limits, name.upper()) for name in names} | {
            "look": LOOK_CELLS,
            "lead": LEAD,
            "accel": self.accel[e, i],
            "threshold": self.threshold[e, i],
            "clearance": self.clearance[e, i],
        }

    def moves(self, e: int, i: int) -> bool:
        return bool(self.active[e] and not self.collided[e, i])


def test_waypoints_leave_room_to_brake():
    drawn = 0
    for seed in range(6):
        world = World(seed, obstacles=(0.0, 0.02, 0.1)[seed % 3])
        pose = np.zeros((3, ROBOTS, 4))
        pose[..., 2], pose[..., 3] = world.speed * world.cell, world.heading
        active, collided, center = world.state()
        target = array(world.metres(world.target), wp.vec2)
        goal = np.where((world.goal == world.target)[..., :1], target.numpy()[..., :2], world.metres(world.goal))
        launch(
            speed_limits._hold_back,
            (3, ROBOTS),
            [
                nav_grids(),
                array(MAP_OF_ENV, wp.int32),
                world.robots(),
                1,
                LEAD,
                active,
                collided,
                array(pose, wp.vec4),
                array(world.slip * world.cell, wp.float32),
                center,
                array(goal, wp.vec2),
                world.walls(),
            ],
            [target],
        )
        c, s = np.cos(world.heading), np.sin(world.heading)
        vx, vy = world.speed * c - world.slip * s, world.speed * s + world.slip * c
        for e in range(3):
            team = [
                {
                    "x": world.at[e, i, 0],
                    "y": world.at[e, i, 1],
                    "vx": vx[e, i],
                    "vy": vy[e, i],
                    "stopped": world.collided[e, i],
                    "target": world.target[e, i],
                    "goal": world.goal[e, i],
                }
                for i in range(ROBOTS)
            ]
            for i in range(ROBOTS):
                want = world.target[e, i]
                if world.moves(e, i):
                    want = oracle.held_back(world.known[e], team, i, world.constants(e, i))
                    drawn += not np.allclose(want, world.target[e, i])
                got = (target.numpy()[e, i] - ORIGIN[MAP_OF_ENV[e]]) / world.cell[e]
                np.testing.assert_allclose(got, want, atol=2e-3)
    assert drawn > 10


def test_differential_drives_can_stop_on_the_way_that_they_drive():
    seen = set()
    for seed in range(8):
        world = World(seed, obstacles=(0.0, 0.01, 0.03, 0.1)[seed % 4])
        rng, horizon, dt = world.rng, 3, 0.1
        kind = np.where(rng.random((3, ROBOTS)) < 0.8, DIFFERENTIAL, ACKERMANN)
        top, rate, radar = (rng.uniform(a, b, (3, ROBOTS)) for a, b in ((1, 4), (0.5, 3), (2, 12)))
        kept = world.clearance * rng.uniform(0.3, 1.0, (3, ROBOTS))
        robots = world.robots()
        robots.kind, robots.max_turn = array(kind, wp.int32), array(rate, wp.float32)
        robots.max_speed, robots.radar_range = (array(values * world.cell, wp.float32) for values in (top, radar))
        pose = np.zeros((3, ROBOTS, 4))
        pose[..., 2], pose[..., 3] = world.speed * world.cell, world.heading
        active, collided, center = world.state()
        target = array(world.metres(world.target), wp.vec2)
        clearance = array(kept * world.cell, wp.float32)
        launch(
            braking._hold_turns,
            (3, ROBOTS),
            [
                nav_grids(),
                array(MAP_OF_ENV, wp.int32),
                robots,
                1,
                horizon,
                dt,
                active,
                collided,
                array(pose, wp.vec4),
                center,
                world.walls(),
            ],
            [target, clearance],
        )
        for e, i in np.ndindex(3, ROBOTS):
            want = (*world.target[e, i], kept[e, i])
            if world.moves(e, i) and kind[e, i] == DIFFERENTIAL:
                names = ("ease", "looks", "least_look", "straight_on", "nudge", "narrow")
                p = (
                    {name: getattr(braking, name.upper()) for name in names}
                    | world.constants(e, i)
                    | {
                        "spare": braking.SPARE_CELLS,
                        "slowest": braking.SLOWEST / world.cell[e, 0],
                        "fine": 0.01,
                        "horizon": horizon,
                        "dt": dt,
                        "top": top[e, i],
                        "rate": rate[e, i],
                        "radar": radar[e, i],
                    }
                )
                back = np.pi if world.speed[e, i] < 0 else 0.0
                me = {
                    "x": world.at[e, i, 0],
                    "y": world.at[e, i, 1],
                    "speed": abs(world.speed[e, i]),
                    "heading": world.heading[e, i] + back,
                    "target": world.target[e, i],
                    "keeps": kept[e, i],
                }
                mates = [(*world.at[e, j], world.collided[e, j]) for j in range(ROBOTS) if j != i]
                want = oracle.held_turn(world.known[e], me, mates, p)
                aside = np.linalg.det([np.subtract(want[:2], world.at[e, i]), world.target[e, i] - world.at[e, i]])
                seen |= {("aside", abs(aside) > 1e-6), ("narrowed", want[2] < kept[e, i])}
            got = (target.numpy()[e, i] - ORIGIN[MAP_OF_ENV[e]]) / world.cell[e]
            np.testing.assert_allclose(got, want[:2], atol=5e-3)
            assert clearance.numpy()[e, i] / world.cell[e, 0] == pytest.approx(want[2], abs=1e-5)
    assert len(seen) == 4


def test_clearance_fits_the_narrowest_place_of_the_path_nearby():
    seen = set()
    for seed in range(6):
        world = World(seed, obstacles=(0.0, 0.02, 0.25)[seed % 3])
        items = 3 * ROBOTS
        path = np.full((items, PATH_CELLS), -1)
        total, used = world.rng.integers(0, PATH_CELLS + 9, items), np.zeros(items, int)
        for item in range(items):
            size = world.known[item // ROBOTS].size
            path[item] = world.rng.integers(0, size, PATH_CELLS)
            used[item] = min(world.rng.choice([-1, 0, 1, 9, PATH_CELLS - 1]), min(total[item], PATH_CELLS) - 1)
        active, collided, center = world.state()
        clearance = array(np.full((3, ROBOTS), -1.0), wp.float32)
        launch(
            speed_limits._fit_clearance,
            (3, ROBOTS),
            [
                nav_grids(),
                array(MAP_OF_ENV, wp.int32),
                world.robots(),
                1,
                active,
                collided,
                center,
                world.walls(),
                array(path, wp.int32),
                array(total, wp.int32),
                array(used, wp.int32),
            ],
            [clearance],
        )
        for e, i in np.ndindex(3, ROBOTS):
            item, width = e * ROBOTS + i, SIZES[MAP_OF_ENV[e]][1]
            # The path is stored from its end: cell j, counted from the robot, was the (total - 1 - j)-th written.
            cells = [path[item, (total[item] - 1 - j) % PATH_CELLS] for j in range(used[item] + 1)]
            p = world.constants(e, i)
            want = oracle.fitted_clearance(world.known[e], *world.at[e, i], [(c % width, c // width) for c in cells], p)
            got = clearance.numpy()[e, i]
            if not world.moves(e, i):
                assert got == -1.0
                continue
            assert got / world.cell[e, 0] == pytest.approx(want, abs=1e-3)
            seen.add(int(want > p["least"] * p["threshold"]) + int(want == p["clearance"]))
    assert seen == {0, 1, 2}


@wp.kernel(enable_backward=False)
def _measure(
    grids: NavGrids, m: int, walls: wp.array2d(dtype=wp.int32), at: wp.array(dtype=wp.vec2), out: wp.array(dtype=float)
):
    k = wp.tid()
    out[k] = speed_limits.nearest_obstacle(grids, m, walls, 0, at[k])


@pytest.mark.parametrize("m", [0, 1])
@pytest.mark.parametrize("share", [0.02, 0.3])
def test_the_nearest_obstacle_is_one_of_the_grid_alone(m, share):
    """Also from places at its edges and beyond them; all bits around the rows of the grid are set."""
    rng = np.random.default_rng(5)
    height, width = SIZES[m]
    words = -(-width // 32)
    bits = np.zeros((height, 32 * words), bool)
    bits[:, :width] = rng.random((height, width)) < share
    around = np.full((3, height * words), -1, np.int32)
    around[1] = np.packbits(bits, bitorder="little").view(np.int32)
    walls = wp.array(ptr=around[1:].ctypes.data, shape=(1, height * words), dtype=wp.int32, device="cpu")
    places = rng.uniform(-7, np.array([width, height]) + 7, (4000, 2))
    got = wp.zeros(len(places), dtype=float, device="cpu")
    launch(_measure, len(places), [nav_grids(), m, walls, array(places * CELL[m] + ORIGIN[m], wp.vec2)], [got])
    centres = np.argwhere(bits)[:, ::-1] + 0.5
    gaps = np.linalg.norm(places[:, None] - centres[None], axis=-1)
    near = (np.abs(np.floor(places)[:, None] + 0.5 - centres[None]) <= LOOK_CELLS).all(-1)
    want = np.where(near, gaps, LOOK_CELLS).min(axis=1, initial=LOOK_CELLS)
    np.testing.assert_allclose(got.numpy() / CELL[m], want, atol=1e-4)


def test_what_is_to_be_seen_from_a_target_ends_at_walls():
    for seed in range(3):
        world = World(seed, obstacles=0.06)
        blocks = 7
        target = np.stack([world.rng.integers(-1, known.size, blocks) for known in world.known])
        area, middle = wp.zeros((3, blocks), dtype=float), wp.zeros((3, blocks), dtype=wp.vec2)
        radius = 6.1
        rays = [wp.zeros((RAYS, 14), dtype=kind) for kind in (wp.vec2i, wp.vec3)]
        launch(information_gain._spread_rays, rays[0].shape, [], rays)
        launch(
            information_gain._look_around,
            (3, blocks),
            [
                nav_grids(),
                array(MAP_OF_ENV, wp.int32),
                array(world.rows, wp.uint8),
                array(target, wp.int32),
                *rays,
                radius,
            ],
            [area, middle],
        )
        for e, k in np.ndindex(3, blocks):
            cell, width = CELL[MAP_OF_ENV[e]], SIZES[MAP_OF_ENV[e]][1]
            want = (0.0, 0.0, 0.0)
            if target[e, k] >= 0:
                place = target[e, k] % width, target[e, k] // width
                want = oracle.look_around(world.known[e], *place, int(radius / cell), RAYS)
            got = area.numpy()[e, k], *(middle.numpy()[e, k] / cell)
            np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-3)
