"""Bad input never gets far: a sentence says what it is, or what was ignored; and no goal ever lies in a wall."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt, label

from maexp.agents.deploy.planner.frames import OccupancyGrid
from maexp.agents.deploy.planner.grid import KnownGrid
from maexp.agents.deploy.planner.grid_search import flood, trace, trace_from
from maexp.agents.runtime import CHOICES, RobotPlanner, TeamPlanner, Word
from maexp.kernels.constants import BLOCKED, OPEN, UNREACHED

POSES = {"a": (1.0, 1.0, 0.0), "b": (1.5, 1.0, 0.0)}


def half_seen(height: int = 30, width: int = 40) -> np.ndarray:
    """A hall of which the left part is known."""
    grid = np.full((height, width), -1, np.int8)
    grid[:, : width // 2] = 0
    grid[[0, -1], : width // 2] = 100
    grid[:, 0] = 100
    return grid


@pytest.mark.parametrize(
    "change, part",
    [
        ({"grid": "floor.yaml"}, "grid is a str"),
        ({"grid": None}, "grid is a NoneType"),
        ({"grid": [[0, 1], [0]]}, "different lengths"),
        ({"grid": np.zeros(100, np.int8)}, "grid has 1 axes"),
        ({"grid": np.zeros((4, 4), bool)}, "of bool"),
        ({"grid": np.full((4, 4), 0.5)}, "multiply them by 100"),
        ({"resolution": 0}, "resolution=0 must be"),
        ({"resolution": float("nan")}, "resolution=nan must be"),
        ({"resolution": "fine"}, "resolution='fine' must be"),
        ({"origin": 3.0}, "origin=3.0 must be"),
        ({"origin": (0.0, float("inf"))}, "must be x, y"),
        ({"origin": (0, 0, 0, 0, 0, 0, 1)}, "must be x, y"),
        ({"poses": 7}, "poses=7 must be"),
        ({"poses": [1.0, 2.0]}, "poses: 0 has 1.0"),
        ({"poses": np.zeros((2, 2, 2))}, "poses: 0 has array([[0., 0.], [0., 0.]]), and"),
        ({"poses": {"a": "here"}}, "poses: 'a' has 'here'"),
        ({"robot_radius": -1.0}, "robot_radius of robot 'a' is -1.0"),
        ({"robot_radius": {"a": 0.3}}, "robot_radius of robot 'b' is None"),
        ({"robot_radius": [0.3]}, "robot_radius holds 1 values"),
        ({"velocities": [0.3]}, "velocities holds 1 values"),
        ({"radar_range": 0}, "radar_range=0 must be above 0"),
        ({"radar_range": 1e4}, "radar_range=10000 is 100,000 cells of 0.1 m, too many to plan on: lower radar_range"),
        ({"resolution": 2e-4}, "radar_range=5 is 25,000 cells of 0.0002 m"),
        ({"resolution": 50}, "radar_range=5 m is less than a cell of 50 m: give both in metres"),
        ({"radar_range": 1e-3}, "radar_range=0.001 m is less than a cell of 0.1 m"),
        ({"now": None, "radar_range": "far"}, "radar_range='far' must be a finite number"),
        ({"time_left": float("nan")}, "time_left=nan must be"),
    ],
)
def test_what_cannot_be_used_at_all_is_a_sentence(change, part):
    call = {"grid": half_seen(), "resolution": 0.1, "origin": (0, 0), "poses": POSES, "now": 0.0} | change
    with pytest.raises(ValueError) as caught:
        TeamPlanner().plan(**call)
    assert part in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "settings, part",
    [
        ({"policy": "best"}, "policy=best is unknown: choose one of"),
        ({"policy": ""}, "policy= is unknown: choose one of"),
        ({"policy": "x" * 5000}, "policy=x{100} is unknown: choose one of"),
        ({"policy": ["cost_utility"]}, "is unknown: did you mean cost_utility"),
        ({"seed": "first"}, "seed='first' must be a whole number, 0 or more"),
        ({"seed": -1}, "seed=-1 must be a whole number"),
        ({"occupied": 650}, "occupied=650 must be at most 100"),
        ({"radar_range": -1}, "radar_range=-1 must be above 0"),
        ({"patience": float("inf")}, "patience=inf must be a finite number"),
        ({"least_area": -0.1}, "least_area=-0.1 must be 0 or more"),
    ],
)
def test_settings_that_cannot_be_are_a_sentence(settings, part):
    with pytest.raises(ValueError, match=part):
        TeamPlanner(**settings)


def test_what_is_strange_in_a_grid_is_unknown_and_said():
    clean, odd = half_seen(), half_seen().astype(float)
    clean[5, 5:8] = -1
    odd[5, 5:8] = np.nan, 101.0, -7.0
    plan, same = TeamPlanner(), TeamPlanner()
    first, second = (planner.plan(grid, 0.1, (0, 0), POSES, now=0.0) for planner, grid in ((plan, clean), (same, odd)))
    assert np.array_equal(first.goals, second.goals) and first.notes == ()
    assert second.notes == ("grid: 3 cells hold neither -1 nor 0 to 100 and were taken as unknown",)
    wrapped = TeamPlanner().plan(clean.astype(np.uint8), 0.1, (0, 0), POSES, now=0.0)
    assert np.array_equal(wrapped.goals, first.goals) and wrapped.notes == ()  # -1 is 255 there


@pytest.mark.parametrize(
    "pose, why",
    [
        (None, "c has no pose and was left out"),
        ((float("nan"), 1.0, 0.0), "c has no pose and was left out"),
        ((-3.0, 1.0), "c is outside of the grid at (-3.00, 1.00) and was left out"),
        ((0.95, 2.15, float("nan")), "c is in a wall or on unknown ground at (0.95, 2.15) and was left out"),
        ((3.6, 2.9), "c is in a wall or on unknown ground at (3.60, 2.90) and was left out"),
    ],
)
def test_robots_that_cannot_take_part_are_left_out_and_said(pose, why):
    grid = half_seen()
    grid[15:28, 3:16] = 100
    alone = TeamPlanner(robot_radius=0.15).plan(grid, 0.1, (0, 0), POSES, now=0.0)
    plan = TeamPlanner(robot_radius=0.15).plan(grid, 0.1, (0, 0), POSES | {"c": pose}, now=0.0)
    assert plan.notes == (why,) and plan.names == ("a", "b", "c")
    assert plan.active.tolist() == [True, True, False] and len(plan.ways[2]) == 0
    assert np.array_equal(plan.goals[:2], alone.goals) and not plan.done
    stays = [np.nan] * 2 if "no pose" in why else pose[:2]
    np.testing.assert_array_equal(plan.goals[2], stays)


def test_nobody_takes_part():
    for poses in ({}, np.zeros((0, 3)), {"a": None}):
        plan = TeamPlanner().plan(half_seen(), 0.1, (0, 0), poses, now=0.0)
        assert not plan.done and not plan.active.any() and len(plan.goals) == len(poses)


@pytest.mark.parametrize("grid", [np.zeros((0, 0)), np.full((5, 7), -1), np.full((5, 7), 100)])
def test_a_grid_without_free_cells(grid):
    plan = TeamPlanner().plan(grid, 0.5, (0, 0), POSES, now=0.0)
    assert not plan.done and np.array_equal(plan.goals, [POSES[name][:2] for name in POSES])
    assert "the grid holds no free cell yet: robots stay where they are" in plan.notes


def test_a_robot_on_ground_that_it_does_not_see_or_near_a_wall_still_drives():
    grid = half_seen()
    grid[6:15, 6:15] = -1  # a blind spot around the robot
    for pose in ((1.0, 1.0), (0.15, 2.0)):
        plan = TeamPlanner(robot_radius=0.3).plan(grid, 0.1, (0, 0), [pose], now=0.0)
        assert plan.active.all() and not plan.notes


def test_a_robot_in_a_wall_drives_from_beside_it_and_it_is_said():
    grid = half_seen()
    grid[10:20, 10] = 100
    plan = TeamPlanner(robot_radius=0.15).plan(grid, 0.1, (0, 0), [(1.05, 1.55, 0.0)], now=0.0)
    assert plan.notes == ("robot 0 is in a wall at (1.05, 1.55): its way starts beside it",) and plan.active.all()


def test_a_grid_that_grows_and_shifts_its_origin_changes_nothing():
    grid = half_seen()
    planner = TeamPlanner()
    before = planner.plan(grid, 0.1, (0.0, 0.0), POSES, now=0.0)
    larger = np.pad(grid, ((17, 3), (23, 5)), constant_values=-1)
    after = planner.plan(larger, 0.1, (-2.3, -1.7), POSES, now=1.0)
    np.testing.assert_allclose(after.goals, before.goals, atol=1e-9)
    assert len(after.targets) == len(before.targets) and after.notes == ()


def test_what_was_given_up_stays_so_on_a_shifted_grid():
    grid = half_seen()
    planner = TeamPlanner(patience=5.0)
    planner.plan(grid, 0.1, (0.0, 0.0), POSES, now=0.0)
    later = planner.plan(grid, 0.1, (0.0, 0.0), POSES, now=6.0)
    larger = np.pad(grid, ((17, 3), (23, 5)), constant_values=-1)
    shifted = planner.plan(larger, 0.1, (-2.3, -1.7), POSES, now=7.0)
    assert any("gave its target up" in note for note in later.notes)
    np.testing.assert_allclose(shifted.goals, later.goals, atol=1e-9)


def test_another_resolution_is_said():
    planner = TeamPlanner()
    planner.plan(half_seen(), 0.1, (0, 0), POSES, now=0.0)
    plan = planner.plan(np.kron(half_seen(), np.ones((2, 2))), 0.05, (0, 0), POSES, now=1.0)
    assert plan.notes == ("the grid has another resolution or turn than before: what was given up is forgotten",)


def test_a_turned_grid_gives_the_same_goals_turned():
    turn = np.array([[np.cos(0.7), np.sin(0.7)], [-np.sin(0.7), np.cos(0.7)]])
    corner = np.array([3.0, -8.0])
    poses = np.array([pose[:2] for pose in POSES.values()])
    straight = TeamPlanner().plan(half_seen(), 0.1, (0, 0), poses, now=0.0)
    turned = TeamPlanner().plan(half_seen(), 0.1, (*corner, 0.7), poses @ turn + corner, now=0.0)
    np.testing.assert_allclose(turned.goals, straight.goals @ turn + corner, atol=1e-9)


def test_robots_that_appear_and_vanish():
    planner, grid = TeamPlanner(), half_seen()
    sizes = []
    for names in ("a", "ab", "b", "", "ab"):
        plan = planner.plan(grid, 0.1, (0, 0), {name: POSES[name] for name in names}, now=100.0 * len(sizes))
        assert plan.names == tuple(names) and plan.active.all()
        sizes.append(set(planner.watch.tracks))
    assert sizes == [{"a"}, {"a", "b"}, {"b"}, set(), {"a", "b"}]


def check_goals(grid: np.ndarray, cell: float, origin, radius: float, poses, plan) -> None:
    """Goals lie on known free ground with room for the robot, in one piece with where it can be."""
    gap = distance_transform_edt(grid < 50) if (grid >= 50).any() else np.full(grid.shape, np.inf)
    room = (grid >= 0) & (grid < 50) & (gap * cell >= radius)
    piece, _ = label(room)
    for robot in np.flatnonzero(plan.active):
        assert np.isfinite(plan.goals[robot]).all()
        index = np.floor((plan.ways[robot][1:] - origin) / cell).astype(int)
        at = piece[index[:, 1], index[:, 0]]
        assert (at > 0).all() and (at == at[0]).all()
        np.testing.assert_array_equal(plan.ways[robot][-1], plan.goals[robot])
        np.testing.assert_array_equal(plan.ways[robot][0], poses[robot][:2])
    assert np.array_equal(plan.goals[~plan.active], np.asarray(poses)[~plan.active, :2], equal_nan=True)


@pytest.mark.parametrize("seed", range(100))
def test_a_way_leads_on_from_where_a_robot_stands(seed):
    """Not by the middle of its own cell, and over passable cells alone; from a blocked cell to where its way starts."""
    rng = np.random.default_rng(seed)
    passable = np.where(rng.random((12, 15)) < 0.7, np.uint8(OPEN), np.uint8(BLOCKED))
    grid = KnownGrid(np.zeros(passable.shape, np.int64), 0.7, (-4.0, 9.0))
    source = int(rng.choice(np.flatnonzero(passable)))
    distance = flood(passable, np.array([source]))[0]
    for end in np.flatnonzero((distance < UNREACHED).ravel() & (distance.ravel() > 0)):
        start = grid.to_map(grid.centers(source) + rng.uniform(-0.35, 0.35, 2))
        way = trace_from(start, grid, passable, distance, end)
        assert len(way) == len(trace(passable, distance, end)) and (way[0] == start).all()
        points = np.concatenate([a + np.linspace(0.0, 1.0, 99)[:, None] * (b - a) for a, b in pairwise(way)])
        assert passable.ravel()[grid.cells(grid.from_map(points))].all()
        beside = grid.to_map(grid.centers(source) + (0.7, 0.0))
        from_there = trace_from(beside, grid, passable, distance, end)
        np.testing.assert_allclose(from_there[1], grid.to_map(grid.centers(source)))


@pytest.mark.parametrize("seed", range(400))
def test_no_goal_in_a_wall_on_random_grids(seed):
    rng = np.random.default_rng(seed)
    height, width = rng.integers(1, 60, 2)
    cell, radius = rng.uniform(0.02, 1.5), rng.uniform(0.01, 1.0)
    coarse = rng.choice([-1, 0, 100], p=rng.dirichlet([2, 4, 1]), size=(height // 4 + 1, width // 4 + 1))
    grid = np.kron(coarse, np.ones((4, 4), int))[:height, :width]
    spots = rng.random(grid.shape) < 0.05 * rng.random()
    grid[spots] = rng.integers(-1, 101, spots.sum())
    origin = rng.uniform(-50, 50, 2)
    poses = origin + rng.uniform(-0.2, 1.2, (rng.integers(1, 6), 2)) * (width * cell, height * cell)
    if rng.random() < 0.2:
        poses[0] = np.nan
    planner = TeamPlanner(
        str(rng.choice(list(CHOICES))),
        radar_range=max(cell, rng.uniform(0.3, 12.0)),
        robot_radius=radius,
        bounded=bool(rng.random() < 0.3),
        least_area=rng.choice([None, 0.0]),
        patience=1.5,
        clear_mates=False,
    )
    for now in range(3):
        plan = planner.plan(grid, cell, origin, poses, now=now)
        check_goals(grid, cell, origin, radius, poses, plan)
        assert not (plan.done and plan.active.any())
        shift = rng.integers(0, 5, 2)
        grid = np.pad(grid, ((shift[1], 1), (shift[0], 0)), constant_values=-1)
        origin = origin - shift * cell


@pytest.mark.parametrize("kind", [np.int8, np.int64, np.uint8, np.float32])
def test_a_grid_of_ones_has_walls_of_ones(kind):
    """As the comment in nav_msgs/OccupancyGrid is read; a grid that holds more has percentages."""
    plain, call = half_seen(), {"resolution": 0.1, "origin": (0, 0), "poses": POSES, "now": 0.0}
    wanted = TeamPlanner(radar_range=2.0).plan(plain, **call)
    ones = np.where(plain == 100, 1, plain).astype(kind)
    plan = TeamPlanner(radar_range=2.0).plan(ones, **call)
    assert np.array_equal(plan.goals, wanted.goals) and plan.active.all()
    assert [note for note in plan.notes if "1 was taken as occupied; give 0 to 100" in note]
    ones[5, 5] = 2
    percent = TeamPlanner(radar_range=2.0).plan(ones, **call)
    assert not np.array_equal(percent.goals, wanted.goals) and not percent.notes
    shared = RobotPlanner("a", radar_range=2.0)
    shared.hear(Word("b", POSES["b"], 0.0, 0.0, {"b": (0.0, OccupancyGrid(plain, 0.1, (0.0, 0.0, 0.0)))}))
    ones[5, 5] = 0
    plan = shared.plan(ones, 0.1, (0, 0), POSES["a"], now=0.0, share=True)
    assert np.array_equal(plan.goals[0], wanted.goals[0]), "beside the grid of a mate that holds 100"
    assert (shared.word().grids["a"][1].values == 100).any()
    told = RobotPlanner("a", radar_range=2.0)
    told.hear(Word("b", POSES["b"], 0.0, 0.0, {"b": (0.0, OccupancyGrid(ones, 0.1, (0.0, 0.0, 0.0)))}))
    plan = told.plan(np.where(plain == 100, -1, plain), 0.1, (0, 0), POSES["a"], now=0.0, share=True)
    assert np.array_equal(plan.goals[0], wanted.goals[0]), "of a mate"
    assert any(note.startswith("the map of 'b': ") for note in plan.notes)


def test_shares_are_refused_where_the_unknown_is_255():
    grid = np.where(half_seen() < 0, 255.0, np.where(half_seen() > 0, 0.9, 0.0))
    with pytest.raises(ValueError, match="multiply them by 100"):
        TeamPlanner().plan(grid, 0.1, (0, 0), POSES, now=0.0)


@pytest.mark.parametrize("kind", [np.int8, np.uint8, float])
def test_what_is_masked_is_unknown(kind):
    plain, call = half_seen(), {"resolution": 0.1, "origin": (0, 0), "poses": POSES, "now": 0.0}
    wanted = TeamPlanner(radar_range=2.0).plan(plain, **call)
    masked = np.ma.masked_array(np.maximum(plain, 0).astype(kind), plain < 0)
    plan = TeamPlanner(radar_range=2.0).plan(masked, **call)
    assert np.array_equal(plan.goals, wanted.goals) and plan.active.all() and not plan.notes
    alone = RobotPlanner("a", radar_range=2.0)
    alone.plan(masked, 0.1, (0, 0), POSES["a"], now=0.0, share=True)
    assert np.array_equal(alone.word().grids["a"][1].values, plain)
    lost = np.ma.masked_array(np.array(list(POSES.values())), [[False] * 3, [True] * 3])
    plan = TeamPlanner(radar_range=2.0).plan(plain, **call | {"poses": lost})
    assert plan.active.tolist() == [True, False] and "robot 1 has no pose and was left out" in plan.notes
