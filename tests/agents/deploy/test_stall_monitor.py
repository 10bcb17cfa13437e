"""What robots attempt in vain is given up, said, and tried again; and done is said when nothing is left."""

import logging

import numpy as np
import pytest

from maexp.agents.deploy.planner import team_planner as planner_module
from maexp.agents.runtime import CHOICES, TeamPlanner

CELL, SIGHT, SPEED = 0.25, 2.0, 0.5
SETTINGS = {"radar_range": SIGHT, "robot_radius": 0.2, "patience": 5.0, "pause": 20.0}


def floor(width: int = 60, height: int = 40) -> np.ndarray:
    """Three rooms with doors: 0 free, 100 wall."""
    grid = np.zeros((height, width), np.int16)
    grid[[0, -1]], grid[:, [0, -1]] = 100, 100
    grid[:, width // 3], grid[:, 2 * width // 3] = 100, 100
    grid[height // 4 : height // 4 + 6, width // 3] = 0
    grid[3 * height // 4 : 3 * height // 4 + 6, 2 * width // 3] = 0
    return grid


class World:
    """Robots that see a disc in front of walls and drive along the ways they are given; no physics.

    Args:
        hidden: bool [H, W], cells that nobody ever sees.
    """

    def __init__(self, robots: int = 2, hidden=None):
        self.truth, self.seen = floor(), np.zeros((40, 60), bool)
        self.hidden = np.zeros_like(self.seen) if hidden is None else hidden
        self.at = np.array([[1.0 + 0.8 * k, 1.0] for k in range(robots)])
        self.frozen = np.zeros(robots, bool)
        self.now = 0.0
        self.look()

    def look(self) -> None:
        angle = np.arange(0.0, 2.0 * np.pi, 0.03)
        unit = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        ray = unit[:, None] * np.arange(0.0, SIGHT, 0.5 * CELL)[:, None]
        for at in self.at:
            x, y = ((at + ray) / CELL).astype(int).clip(0, (59, 39)).transpose(2, 0, 1)
            wall = self.truth[y, x] > 0
            behind = np.cumsum(wall, axis=1) - wall > 0
            self.seen[y[~behind], x[~behind]] = True
        self.seen &= ~self.hidden

    def grid(self) -> np.ndarray:
        return np.where(self.seen, self.truth, -1)

    def call(self, planner: TeamPlanner, **more):
        return planner.plan(self.grid(), CELL, (0.0, 0.0), self.at, now=self.now, **more)

    def drive(self, plan, seconds: float = 1.0) -> None:
        for robot in np.flatnonzero(plan.active & ~self.frozen):
            left = SPEED * seconds
            for point in plan.ways[robot][1:]:
                gap = np.linalg.norm(point - self.at[robot])
                share = min(1.0, left / max(gap, 1e-9))
                self.at[robot] += share * (point - self.at[robot])
                left -= gap
                if left <= 0.0:
                    break
        self.now += seconds
        self.look()

    def share(self) -> float:
        """Of the free cells, those seen."""
        return float(self.seen[self.truth == 0].mean())


def explore(world: World, planner: TeamPlanner, steps: int) -> list[str]:
    """Until done or for so many steps; all that was said."""
    said = []
    for _ in range(steps):
        plan = world.call(planner)
        said += plan.notes
        if plan.done:
            return [*said, "done"]
        world.drive(plan)
    return said


def wants(scene, target) -> np.ndarray:
    """What robots think of targets that want these, int [n]."""
    return np.where(np.arange(scene.travel.shape[1]) == target[:, None], 1.0, -scene.travel)


@pytest.mark.parametrize("name", CHOICES)
def test_explores_until_done(name):
    world = World()
    said = explore(world, TeamPlanner(name, **SETTINGS), 300 if name != "random" else 500)
    assert said[-1] == "done" and world.share() > 0.97
    plan = world.call(TeamPlanner(name, **SETTINGS))
    assert plan.done and not plan.active.any() and np.array_equal(plan.goals, world.at)
    assert all(way.shape == (0, 2) for way in plan.ways)


def test_a_robot_that_stands_still_gives_its_target_up_and_the_team_goes_on_without_it(caplog):
    world, planner = World(), TeamPlanner("nearest_frontier", **SETTINGS)
    world.frozen[0] = True
    with caplog.at_level(logging.WARNING, "maexp.runtime"):
        said = explore(world, planner, 300)
    gave_up = [sentence for sentence in said if sentence.startswith("robot 0 gave its target up: it did not move")]
    assert len(gave_up) == 3, said  # then it is parked, and nothing more is given up
    assert "robot 0 stands still whatever its target: the team plans without it" in said
    assert said[-1] == "done" and world.share() > 0.97
    assert set(gave_up) <= set(caplog.messages)


def test_a_parked_robot_that_moves_again_takes_part_again():
    world, planner = World(robots=1), TeamPlanner("nearest_frontier", **SETTINGS)
    world.frozen[0] = True
    explore(world, planner, 25)
    assert planner.watch.tracks[0].parked and planner.watch.given
    plan = world.call(planner)
    assert plan.active.all()  # it still has a goal, should it be able to move
    world.frozen[0] = False
    world.drive(plan)
    assert world.call(planner).active.all()
    assert not planner.watch.tracks[0].parked and not planner.watch.given
    assert explore(world, planner, 300)[-1] == "done" and world.share() > 0.97


def test_a_target_that_nobody_can_clear_is_given_up_for_good():
    hidden = np.zeros((40, 60), bool)
    hidden[30:36, 5:11] = True
    world = World(hidden=hidden)
    said = explore(world, TeamPlanner("nearest_frontier", **SETTINGS), 1000)
    assert said[-1] == "done" and world.share() > 0.9
    assert "a target was given up: 5 s beside it showed nothing new" in said


def test_the_last_target_is_tried_once_more():
    grid = np.full((5, 40), 100)
    grid[2:4, 1:15], grid[2:4, 15:39] = 0, -1
    planner = TeamPlanner("nearest_frontier", **SETTINGS | {"robot_radius": 0.1})
    plans = [planner.plan(grid, CELL, (0, 0), [(1.0, 0.75)], now=now) for now in (0.0, 6.0)]
    assert "nothing else is left: what was given up is tried once more" in plans[1].notes
    assert plans[1].active.all() and np.array_equal(plans[0].goals, plans[1].goals)


def test_a_target_given_up_is_tried_again_after_the_pause():
    world, planner = World(), TeamPlanner("nearest_frontier", **SETTINGS)
    world.frozen[:] = True
    first = world.call(planner)
    world.now += 6.0
    second = world.call(planner)
    assert len(second.notes) == 2 and not np.allclose(first.goals, second.goals)
    planner.watch.tracks[0].block = planner.watch.tracks[1].block = None
    world.now += 21.0
    assert np.allclose(world.call(planner).goals, first.goals)


@pytest.mark.parametrize("round_", [2, 3, 4])
def test_a_robot_that_goes_back_and_forth_is_sent_to_the_nearest(monkeypatch, round_):
    turn = iter(range(100))
    monkeypatch.setitem(
        planner_module.CHOICES,
        "fickle",
        lambda scene: wants(scene, np.argsort(scene.travel)[:, 1 + next(turn) % round_]),
    )
    world, planner = World(robots=1), TeamPlanner("fickle", **SETTINGS | {"patience": 60.0})
    goals, said = [], []
    for _ in range(2 * round_ + 2):
        plan = world.call(planner)
        goals.append(plan.goals[0])
        said.append(plan.notes)
        world.now += 1.0
    caught = 2 * round_ - 1
    assert [k for k, sentences in enumerate(said) if sentences] == [caught]
    assert said[caught] == ("robot 0 went back and forth between targets: it goes on to the nearest",)
    nearest = world.call(TeamPlanner("nearest_frontier", **SETTINGS)).goals[0]
    assert not np.allclose(goals[0], goals[1]) and np.allclose(goals[0], goals[round_])
    assert np.allclose(goals[caught:], nearest)


def test_one_target_and_none_in_turn_is_no_back_and_forth(monkeypatch):
    turn = iter(range(100))
    monkeypatch.setitem(
        planner_module.CHOICES,
        "flickering",
        lambda scene: wants(scene, np.argsort(scene.travel)[:, 1]) - (np.inf if next(turn) % 2 else 0.0),
    )
    world, planner = World(robots=1), TeamPlanner("flickering", **SETTINGS | {"patience": 60.0})
    for _ in range(14):
        assert not any("back and forth" in note for note in world.call(planner).notes)
        world.now += 1.0


@pytest.mark.parametrize("absent", ["without a pose", "not named"])
def test_a_robot_whose_pose_comes_and_goes_is_watched_while_it_is_there(absent):
    world, planner = World(robots=1), TeamPlanner("nearest_frontier", **SETTINGS)
    lost = {0: None} if absent == "without a pose" else {}

    def call(there: bool) -> tuple:
        poses = {0: world.at[0]} if there else lost
        plan = planner.plan(world.grid(), CELL, (0.0, 0.0), poses, now=world.now)
        world.now += 1.0
        return tuple(note for note in plan.notes if "gave" in note)

    assert not any(call(there=k == 0) for k in range(19))  # nobody could drive it
    assert not call(there=True)
    said = [call(there=bool(k % 2)) for k in range(10)]
    assert [sentences for sentences in said if sentences] == [("robot 0 gave its target up: it did not move for 5 s",)]


def test_a_robot_that_comes_no_nearer_gives_its_target_up():
    world, planner = World(robots=1), TeamPlanner("nearest_frontier", **SETTINGS)
    said = []
    for k in range(20):
        world.at[0] = 1.0, 1.0 + 0.2 * (k % 2)
        said += world.call(planner).notes
        world.now += 1.0
    assert "robot 0 gave its target up: it came no nearer for 15 s" in said


def test_reset_and_a_clock_that_starts_again_forget_the_past():
    world, planner = World(), TeamPlanner("nearest_frontier", **SETTINGS)
    world.frozen[:] = True
    explore(world, planner, 12)
    assert planner.watch.given
    planner.reset()
    assert not planner.watch.given
    explore(world, planner, 12)
    world.now = 0.0
    world.call(planner)
    assert not planner.watch.given


def stuck(grids, seconds: int = 60, patience: float = 10.0, at=(1.0, 0.75)) -> dict[str, list[int]]:
    """A robot that never moves on grids that change; when which sentence came first and again [s].

    Args:
        grids: function of the second: the grid and its origin.
    """
    planner, said = TeamPlanner("nearest_frontier", **SETTINGS | {"robot_radius": 0.1, "patience": patience}), {}
    for now in range(seconds):
        grid, origin = grids(now)
        for note in planner.plan(grid, CELL, origin, [at], now=now).notes:
            said.setdefault(note, []).append(now)
    return said


def corridor(length: int = 40) -> np.ndarray:
    """Known on the left, unknown on the right."""
    grid = np.full((5, length), 100)
    grid[2:4, 1:15], grid[2:4, 15 : length - 1] = 0, -1
    return grid


GAVE_UP = "robot 0 gave its target up: it did not move for 10 s"
PARKED = "robot 0 stands still whatever its target: the team plans without it"


@pytest.mark.parametrize(
    "flicker, slack",
    [
        (lambda now: now % 9 == 5, 1.2),
        (lambda now: now % 9 in (3, 4, 5), 1.6),
        (lambda now: now % 2 == 1, 2.1),
    ],
    ids=["one call in nine", "three in nine", "every other call"],
)
@pytest.mark.parametrize("how", ["seen", "cut off"])
def test_a_robot_that_stands_still_gives_up_a_target_that_comes_and_goes(flicker, slack, how):
    """The clock is the robot's. It does not run while there is nowhere to drive to."""

    def grids(now):
        grid = corridor()
        if flicker(now):
            grid[2:4, 15 if how == "seen" else 10] = 100
        return grid, (0.0, 0.0)

    said = stuck(grids, seconds=80)
    assert [10 * k <= now <= 10 * k * slack for k, now in enumerate(said[GAVE_UP], 1)] == [True] * 3
    assert PARKED in said


@pytest.mark.parametrize("share", [0.3, 0.5, 0.9])
def test_a_robot_that_stands_still_gives_its_target_up_on_a_grid_that_moves_by_parts_of_a_cell(share):
    """As SLAM that grows its map by odd lengths publishes it."""
    rng = np.random.default_rng(3)
    grid = corridor()

    def grids(now):
        return grid, tuple(share * CELL * rng.uniform(-1.0, 1.0, 2))

    said = stuck(grids)
    assert said[GAVE_UP][:2] == [10, 20] and PARKED in said


@pytest.mark.parametrize("turn", [0.01, 0.1])
def test_a_robot_that_stands_still_is_parked_on_a_grid_that_turns_to_and_fro(turn):
    grid, said = corridor(), {}
    planner = TeamPlanner("nearest_frontier", **SETTINGS | {"robot_radius": 0.1, "patience": 10.0})
    for now in range(60):
        for note in planner.plan(grid, CELL, (0.0, 0.0, turn * (now % 2)), [(1.0, 0.75)], now=now).notes:
            said.setdefault(note, []).append(now)
    assert said[GAVE_UP][:3] == [10, 20, 30] and PARKED in said


def test_a_target_beside_a_robot_that_comes_and_goes_is_given_up():
    def grids(now):
        grid = corridor()
        grid[2:4, 15] = 100 if now % 9 == 5 else -1
        return grid, (0.0, 0.0)

    said = stuck(grids, at=(3.6, 0.75))
    assert 10 <= said["a target was given up: 10 s beside it showed nothing new"][0] <= 12


def test_a_robot_that_passes_a_target_now_and_then_gives_nothing_up():
    planner, grid = TeamPlanner("nearest_frontier", **SETTINGS | {"robot_radius": 0.1, "patience": 10.0}), corridor()
    for now in range(60):
        at = (3.6, 0.75) if now % 8 == 0 else (0.5 + 0.3 * (now % 8), 0.75)
        assert not planner.plan(grid, CELL, (0.0, 0.0), [at], now=now).notes


def test_the_clock_of_standing_still_begins_anew_after_a_long_rest():
    def grids(now):
        grid = corridor()
        if 8 < now < 60:
            grid[2:4, 15] = 100
        return grid, (0.0, 0.0)

    assert stuck(grids, seconds=100)[GAVE_UP][0] == 70, "it has had 10 s again: the pause was 20 s"


def test_patience_is_over_in_time_where_steps_of_a_tenth_add_up_to_less():
    planner, now = TeamPlanner("nearest_frontier", **SETTINGS | {"robot_radius": 0.1, "patience": 0.8}), 0.0
    for _ in range(8):
        assert not planner.plan(corridor(), CELL, (0.0, 0.0), [(1.0, 0.75)], now=now).notes
        now += 0.1
    assert now < 0.8
    assert planner.plan(corridor(), CELL, (0.0, 0.0), [(1.0, 0.75)], now=now).notes
