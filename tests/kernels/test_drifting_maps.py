"""Maps that shift with odometry: the kernels against their definition, and what robots make of such maps."""

import numpy as np
import pytest
import torch
from oracle import mapping
from worlds import act, play_alike, room

from maexp.agents.policies import POLICIES
from maexp.envs import (
    CommConfig,
    ExplorationEnv,
    FaultsConfig,
    ObservationConfig,
    OdometryConfig,
    PlannerConfig,
    RadarConfig,
    make_map,
)
from maexp.envs.imagined.maps import Beliefs
from maexp.envs.maps.nav_grid import build_nav_grid
from maexp.envs.targets.navigation import Navigation, known_grids
from maexp.kernels import unpack_flags
from maexp.kernels.constants import OBSTACLE, UNKNOWN
from maexp.kernels.launches import launch_on
from maexp.kernels.planner import find_paths

pytestmark = pytest.mark.kernels

WORLDS = [room(24, 17, "mixed"), room(19, 22, "rotated", spacing=0.8)]
SOME = dict(drift=0.2, turn=0.1, jump=0.5, jump_rate=0.5)
NONE = dict(jump=1e-9, jump_rate=1e-9)
NEAR = CommConfig(range=7.0)
LATE = CommConfig(range=7.0, base_station=True, bandwidth=400.0, delay=0.3)
WRONG = RadarConfig(range=6.0, missed=0.4, false_alarm=0.2, evidence=2)
DIRECT = PlannerConfig(name="direct")


def make(odometry: dict, envs: int = 2, map_errors: bool = True, **settings) -> ExplorationEnv:
    settings = {"local_steps": 4, "macro_steps": 15, "num_threads": 1, "seed": 4, "success_coverage": 1.0} | settings
    settings = {"maps": WORLDS, "num_robots": 3, "radar": RadarConfig(range=6.0)} | settings
    return ExplorationEnv(
        settings.pop("maps"),
        envs,
        settings.pop("num_robots"),
        odometry=OdometryConfig(**odometry, map_errors=map_errors),
        **settings,
    )


class Followed:
    """Drawings of one team by the definition, brought up to date after every scan."""

    def __init__(self, env: ExplorationEnv, e: int):
        self.env, self.e, self.m = env, e, int(env.simulation.tensors["map_id"][e])
        world, bank = env.maps[self.m], env.bank
        orders = bank.order_free[self.m], bank.order_boundary[self.m]
        self.nav = build_nav_grid(world).reorder(*orders)
        shape = (self.nav.origin, self.nav.cell, self.nav.width, self.nav.height)
        self.grid = mapping.Grid(*shape, self.nav.stand_in)
        self.free, self.boundary = world.free[orders[0]].astype(float), world.boundary[orders[1]].astype(float)
        self.reach = 1.5 * np.maximum(world.resolution, world.boundary_spacing[orders[1]].astype(float)) + 1e-5
        rows = env.num_robots if env.settings.limited else 1
        self.drawings = [mapping.Drawing(self.grid) for _ in range(rows)]
        self.told = 0

    def bits(self, name: str, count: int) -> np.ndarray:
        """Flags of the radios, bool [U, count]."""
        words = self.env.simulation.tensors[name][self.e : self.e + 1, :, :count]
        return unpack_flags(words, 32 * words.shape[1])[0].numpy()

    def follow(self) -> None:
        """After a scan: looks, robot after robot from the last, then what is told."""
        s, e, robots = self.env.simulation.tensors, self.e, self.env.num_robots
        step, limited = int(s["local_step"][e]), self.env.settings.limited
        wrong = self.bits("false_walls", len(self.free)) if s["false_walls"].shape[-1] > 1 else None
        seen = self.bits("seen_boundary", len(self.boundary))
        for i in reversed(range(robots)):
            count = int(s["visible_count"][e, i])
            viewed = count if self.env.simulation.settings.false_alarms == 0 else int(s["viewed_count"][e, i])
            view = s["visible"][e, i, :viewed].tolist() if not s["failed"][e, i] else []
            assert len(set(view)) == len(view), "those without a return are behind the others, none is lost"
            points = []
            for slot, j in enumerate(view):
                if slot < count or wrong[i, j]:
                    points.append(("free", j, self.free[j, :2], int(self.nav.free_cell[j]), slot < count))
            poses = [
                (*s[f"center{which}"][e, i, :2].tolist(), float(s[f"pose{which}"][e, i, 3]))
                for which in ("", "_estimate")
            ]
            radius = self.env.radar_configs[i].range
            for j in self.walls_in_view(view, poses[0][:2], radius) & set(seen[i].nonzero()[0].tolist()):
                points.append(("boundary", j, self.boundary[j, :2], int(self.nav.boundary_cell[j]), True))
            when = mapping.GIVES_WAY if s["collided"][e, i] else step
            row = self.drawings[i if limited else 0]
            row.look(*poses, points, when, radius - 2.0 * self.nav.cell)
        if limited:
            self.tell()

    def walls_in_view(self, view: list[int], center, radius: float) -> set[int]:
        """Those in range that some ground in view touches."""
        found = set()
        for j in view:
            near = np.linalg.norm(self.boundary - self.free[j], axis=1) <= self.reach
            far = np.linalg.norm(self.boundary[:, :2] - center, axis=1) > radius
            found |= set((near & ~far).nonzero()[0].tolist())
        return found

    def tell(self) -> None:
        s, e = self.env.simulation.tensors, self.e
        robots = self.env.num_robots
        hears = unpack_flags(s["hears"][e : e + 1].transpose(1, 2).contiguous(), robots)[0].T[:robots].numpy()
        for kind, cells in (("free", self.nav.free_cell), ("boundary", self.nav.boundary_cell)):
            known = self.bits(f"known_{kind}", len(cells))
            before = sum(len(drawing.places) for drawing in self.drawings)
            for j in known[:robots].any(0).nonzero()[0].tolist():
                mapping.tell(self.drawings, kind, j, known[:robots, j], hears, int(cells[j]))
            self.told += sum(len(drawing.places) for drawing in self.drawings) - before

    def shown(self, row: int) -> np.ndarray:
        """uint8 (H, W): drawn cells, and false walls over them."""
        drawing, columns = self.drawings[row], range(self.nav.width)
        grid = np.array([[drawing.value(x, y) for x in columns] for y in range(self.nav.height)], np.uint8)
        s = self.env.simulation.tensors
        if s["false_walls"].shape[-1] > 1:
            flags = self.bits("false_walls", len(self.free))
            flags = flags[row] if self.env.settings.limited else flags.any(0)
            for j in flags.nonzero()[0].tolist():
                if ("free", j) in drawing.places:
                    place, certain = drawing.places["free", j]
                    ((x, y),) = self.grid.covered(place, True)
                    grid[y, x] = OBSTACLE
                    if not certain:
                        drawing.doubtful.add((x, y))
        return grid

    def check(self, known: np.ndarray) -> int:
        """Compare grids and places with the env's; how many cells were compared."""
        s, compared = self.env.simulation.tensors, 0
        for row, drawing in enumerate(self.drawings):
            want = self.shown(row)
            got = known[row, : want.size].reshape(want.shape)
            sure = np.ones(want.shape, bool)
            for x, y in drawing.doubtful:
                if 0 <= x < want.shape[1] and 0 <= y < want.shape[0]:
                    sure[y, x] = False
            np.testing.assert_array_equal(got[sure], want[sure])
            compared += int((sure & (want != UNKNOWN)).sum())
            for kind in ("free", "boundary"):
                places = s[f"place_{kind}"][self.e, row]
                for (name, j), (place, certain) in drawing.places.items():
                    if name == kind and certain:
                        assert int(places[j]) == 1 + place[1] * (2 * self.nav.width + 1) + place[0]
                assert int((places != 0).sum()) == sum(name == kind for name, _ in drawing.places)
        return compared


@pytest.mark.parametrize(
    "settings",
    [
        dict(),
        dict(radar=WRONG),
        dict(comm=NEAR, radar=WRONG, faults=FaultsConfig(probability=0.4, duration=1.0)),
        dict(comm=LATE, planner=DIRECT, num_robots=4),
    ],
    ids=["team", "team, false alarms", "near, false alarms, faults", "late, controls"],
)
def test_what_is_drawn_is_that_of_the_definition(settings):
    """Every scan of two teams on two maps, with jumps: places, cells, false walls, what others tell; one collides."""
    env = make(SOME, **settings)
    grids, launch, followed, compared = known_grids(env), launch_on(env.device), [], 0

    def follow(env):
        nonlocal compared
        if not followed:
            followed.extend(Followed(env, e) for e in range(2))
        grids.paint(launch)
        known = grids.known.numpy().reshape(2, grids.rows_per_env, -1)
        for team, rows in zip(followed, known, strict=True):
            team.follow()
            compared += team.check(rows)

    env.set_step_hook(follow)
    env.reset()
    generator = torch.Generator().manual_seed(2)
    for k in range(8):
        env.simulation.tensors["collided"][:, 1] = k > 3
        env.step(act(env, generator))
    off = env.simulation.tensors["center_estimate"] - env.simulation.tensors["center"]
    assert compared > 10_000 and off.norm(dim=-1).max() > 0.4
    assert not env.settings.limited or sum(team.told for team in followed) > 100


@pytest.mark.parametrize("comm", [CommConfig(), NEAR, LATE])
def test_who_knows_where_it_is_draws_what_is_there(comm):
    """Without an error grids are those of true maps, at every step, and so is all that robots do."""
    worlds = [room(24, 17), make_map("maze_small", 0), make_map("indoor_small", 1)]
    both = [make(NONE, 3, errors, maps=worlds, comm=comm, seed=2) for errors in (True, False)]
    policies, found = [POLICIES["cost_utility"](env) for env in both], []
    grids = [known_grids(env) for env in both]
    states = [env.reset() for env in both]
    for _ in range(12):
        states = [
            env.step_and_maybe_reset(policy(td))[1] for env, policy, td in zip(both, policies, states, strict=True)
        ]
        for one in grids:
            one.paint(launch_on("cpu"))
        found.append(grids[0].known.numpy())
        np.testing.assert_array_equal(found[-1], grids[1].known.numpy())
        np.testing.assert_array_equal(grids[0].walls.numpy(), grids[1].walls.numpy())
        assert torch.equal(*(env.simulation.tensors["pose"] for env in both))
    assert (found[-1] == OBSTACLE).sum() > 100 and states[0]["info", "map_error"].max() < 1e-3


@pytest.mark.parametrize("settings", [dict(), dict(comm=NEAR, radar=WRONG)])
def test_what_changes_is_entered_as_if_painted_anew(settings):
    """Grids, masks, distances and targets that follow, against those of who looks for the first time."""
    env = make(SOME, 3, **settings)
    kept, anew, policy = Navigation(env), 0, POLICIES["nearest_frontier"](env)
    td = env.reset()
    for _ in range(20):
        td = env.step_and_maybe_reset(policy(td))[1]
        kept.update()
        fresh = Navigation(env)
        fresh.update()
        for name in ("known", "frontier", "target", "size", "way"):
            assert torch.equal(getattr(kept, name), getattr(fresh, name)), name
        np.testing.assert_array_equal(kept.known_grids.walls.numpy(), fresh.known_grids.walls.numpy())
        for row, m in enumerate(kept.passable.grid_of_row.numpy()):
            masks = [nav.passable.passable.numpy()[row, : nav.width[m] * nav.height[m]] for nav in (kept, fresh)]
            np.testing.assert_array_equal(*masks)
        anew += int((kept.known_grids.news_count.numpy() < 0).sum())
    assert 0 < anew < 20 * len(kept.known_grids.news_count.numpy()), "some rows lose a wall, not all"
    for block in env.simulation.blocks:  # robots find their ways on the same grids
        block.replay(find_paths)
        rows = slice(block.first * kept.rows, block.last * kept.rows)
        np.testing.assert_array_equal(block.wavefront.known.known.numpy(), kept.known_grids.known.numpy()[rows])


def two_robots(comm: CommConfig):
    """The grids [rows, H, W] of two robots in one room that stand 8 m apart, the second believing to be 2 m higher."""
    env = make(NONE, 1, maps=[room(40, 22)], num_robots=2, comm=comm, radar=RadarConfig(range=9.0), planner=DIRECT)
    env.set_starts([[8.0, 17.0, 0.0], [16.0, 17.0, 0.0]])
    td = env.reset()
    env.simulation.tensors["odometry_error"][0, 1] = torch.tensor([0.0, -2.0, 0.0])
    for name in ("drawn", "place_free", "place_boundary"):
        env.simulation.tensors[name].zero_()
    td["agents", "action", "control"] = torch.zeros(1, 2, 2)
    env.step(td)
    nav = Navigation(env)
    nav.update()
    shape = int(nav.height[0]), int(nav.width[0])
    return nav.known[0, :, : shape[0] * shape[1]].reshape(-1, *shape), env


def test_a_map_of_two_who_are_off_has_a_double_wall():
    """The wall at y = 23 stands at 21, too, where the second robot sees it."""
    known, env = two_robots(CommConfig())
    lines = [(known[0, y] == OBSTACLE).nonzero().squeeze(-1).tolist() for y in (23, 21)]
    assert set(range(5, 12)) <= set(lines[0]) and set(range(14, 19)) <= set(lines[1])
    assert len(set(lines[0]) & set(lines[1])) > 3, "both see this part"
    assert float(env.simulation.map_error()[0]) == pytest.approx(0.7, abs=0.5)


def test_who_hears_of_a_map_that_is_off_keeps_its_own():
    """Each has what it saw where it believes it, and what only its mate saw where that does."""
    known, env = two_robots(CommConfig(range=20.0))
    s = env.simulation.tensors
    own, shifted = ((known[i, 23 - 2 * i] == OBSTACLE).nonzero().squeeze(-1).tolist() for i in (0, 1))
    boundary = env.bank.maps[0].boundary[env.bank.order_boundary[0]]
    seen = unpack_flags(s["seen_boundary"][:, :, : len(boundary)], 2)[0].numpy()
    top = boundary[:, 1] == 23.0
    for i, line in enumerate((own, shifted)):
        assert set(boundary[top & seen[i], 0].astype(int).tolist()) <= set(line)
        told = top & ~seen[i] & seen[1 - i]
        assert told.sum() > 3
        there = known[i, 23 - 2 * (1 - i)]
        assert all(there[int(x)] == OBSTACLE for x in boundary[told, 0])
    assert (known[0] != known[1]).any()


@pytest.mark.parametrize("settings", [dict(), dict(comm=LATE, radar=WRONG)])
def test_maps_repeat_in_any_batch_from_a_saved_state_and_in_a_copy(settings):
    names = ("drawn", "place_free", "place_boundary", "pose")
    *_, small = play_alike(make(SOME, 1, **settings), make(SOME, 3, **settings), 8, names)
    state = small.simulation.tensors
    assert all(state[name].any() for name in names)
    small.set_episodes(torch.tensor([9]))
    small.reset()
    fresh = make(SOME, 1, **settings)
    fresh.set_episodes(torch.tensor([9]))
    fresh.reset()
    assert all(torch.equal(state[name], fresh.simulation.tensors[name]) for name in names)


def test_the_error_is_the_mean_distance():
    """Against NumPy, of what each robot knows."""
    for comm in (CommConfig(), NEAR):
        env = make(SOME, comm=comm)
        env.reset()
        generator = torch.Generator().manual_seed(3)
        for _ in range(6):
            td = env.step(act(env, generator))["next"]
        for e in range(2):
            team = Followed(env, e)
            origin, found = np.array(team.nav.origin), []
            flags = team.bits("known_free" if env.settings.limited else "seen_free", len(team.free))
            for row in range(len(team.drawings)):
                known = (flags[row] if env.settings.limited else flags.any(0)).nonzero()[0]
                place = env.simulation.tensors["place_free"][e, row].numpy()[known] - 1
                half = np.stack([place % (2 * team.nav.width + 1), place // (2 * team.nav.width + 1)], 1)
                gap = origin + 0.5 * team.nav.cell * half - team.free[known, :2]
                found.append(np.linalg.norm(gap, axis=1).mean())
            assert float(td["info", "map_error"][e, 0]) == pytest.approx(np.mean(found), abs=1e-4)
        assert td["info", "map_error"].min() > 0.1


@pytest.mark.parametrize("comm", [CommConfig(), CommConfig(range=6.0, base_station=True, strategy="return_to_base")])
@pytest.mark.parametrize("name", ["cost_utility", "rrt_frontiers", "voronoi", "lookahead", "clairvoyant"])
def test_whoever_plans_goes_on(name, comm):
    """With small errors, and with errors larger than the map."""
    for odometry in (dict(drift=0.05), dict(drift=60.0, turn=3.0)):
        env = make(odometry, comm=comm, observation=ObservationConfig(targets=6))
        policy, td = POLICIES[name](env), env.reset()
        first = td["info", "coverage"].clone()
        for _ in range(5):
            _, td = env.step_and_maybe_reset(policy(td))
            assert all(leaf.isfinite().all() for leaf in td["agents"].values(True, True))
        assert (td["info", "coverage"] > first).any()


@pytest.mark.parametrize("comm", [CommConfig(), NEAR])
def test_imagined_worlds_are_made_of_what_is_drawn(comm):
    """Walls stand in the middle of the cells where robots believe them, and nowhere else: no true place gets there."""
    env = make(SOME, 1, maps=[WORLDS[1]], comm=comm)
    policy, td = POLICIES["lookahead"](env), env.reset()
    for _ in range(4):
        td = env.step(policy(td))["next"]
    env.simulation.tensors["active"].fill_(1)
    nav = Navigation(env)
    nav.update()
    beliefs = Beliefs(env, 1, 2, nav)
    beliefs.look(torch.tensor([0]))
    state, walls = beliefs.certain, 0
    for world in range(beliefs.worlds):
        maps = beliefs.env.simulation.map_tensors
        count = int(beliefs.total[world, 1])
        begin = int(maps["boundary_begin"][world])
        place = maps["boundary"][begin : begin + count, :2]
        origin, cell = (beliefs.grid_views[name][world] for name in ("origin", "cell"))
        part = ((place - origin) / cell) % 1.0
        torch.testing.assert_close(part, torch.full_like(part, 0.5), atol=1e-3, rtol=0.0)
        walls += count
        known = nav.known[0, world if beliefs.worlds > 1 else 0]
        assert int((state[world] != 0).sum()) == int((known != UNKNOWN).sum())
    assert walls > 20


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (dict(), "odometry.map_errors=true and robots know where they are, so their maps are true: add odometry.drift"),
        (dict(drift=-0.1), "odometry.drift=-0.1 must be"),
    ],
)
def test_bad_settings_are_named(settings, words):
    with pytest.raises(ValueError, match=words):
        make(settings)
    with pytest.raises(ValueError, match="odometry.map_errors='yes' must be"):
        OdometryConfig(drift=0.1, map_errors="yes").checked()
