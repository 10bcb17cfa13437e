"""Robots that are planned for together go to different places: shared out as the definition says, and kept apart by
whatever overrides a choice."""

import numpy as np
import pytest
from oracle.sharing import share
from test_stall_monitor import SETTINGS, World, explore

from maexp.agents.deploy.planner import team_planner as planner_module
from maexp.agents.deploy.planner.assignment import DistinctTargets, share_targets
from maexp.agents.deploy.planner.stall_monitor import Track, Watch
from maexp.agents.deploy.planner.team import Team
from maexp.agents.runtime import CHOICES, TeamPlanner


def test_targets_are_shared_out_as_they_should():
    rng, settled = np.random.default_rng(0), 0
    for _ in range(400):
        robots, targets, side = rng.integers(1, 8), rng.integers(0, 12), rng.choice([5.0, 9.0, 30.0])
        points = rng.uniform(0, side, (targets, 2))
        way = np.linalg.norm(points - rng.uniform(0, side, (robots, 1, 2)), axis=-1)
        preference = np.where(rng.random(way.shape) < 0.3, -np.inf, rng.uniform(-1, 1, way.shape) - 0.1 * way)
        body = rng.uniform(0.2, 1.0, robots)
        got = share_targets(preference, way, points, body).tolist()
        case = {
            "preference": preference.tolist(),
            "way": way.tolist(),
            "point": [points.tolist()] * robots,
            "hears": [[True] * robots] * robots,
            "body": body.tolist(),
        }
        assert got == ([-1 if k is None else k for k in share(case)] if targets else [-1] * robots)
        settled += sum(k >= 0 for k in got)
    assert settled > 500


def gap(plan) -> float:
    """The least distance between two goals [m]."""
    goals = plan.goals[plan.active]
    apart = np.linalg.norm(goals[:, None] - goals, axis=-1) + np.where(np.eye(len(goals), dtype=bool), np.inf, 0.0)
    return float(apart.min(initial=np.inf))


@pytest.mark.parametrize("name", [*CHOICES, "universal"])
def test_goals_of_a_team_are_apart(name):
    if name == "universal":
        pytest.importorskip("onnxruntime", reason="THE EXTRA maexp[runtime] IS NOT INSTALLED")
    world, planner = World(robots=3), TeamPlanner(name, **SETTINGS)
    for _ in range(25):
        plan = world.call(planner)
        assert gap(plan) >= 0.4 and (plan.active | plan.waits).all()
        world.drive(plan)


def test_without_the_argument_robots_go_where_they_like_best():
    world, planner = World(robots=3), TeamPlanner("nearest_frontier", distinct=False, **SETTINGS)
    gaps = []
    for _ in range(25):
        plan = world.call(planner)
        gaps.append(gap(plan))
        world.drive(plan)
    assert min(gaps) == 0.0


def same_wish(scene) -> np.ndarray:
    """All want the same target, one after the other another one."""
    wish = np.arange(scene.travel.shape[1]) == same_wish.turn % 2
    return np.where(wish, 1.0, -scene.travel)


def test_robots_that_go_back_and_forth_together_are_sent_apart(monkeypatch):
    """The rule that overrides a choice keeps goals apart, in the call in which it does and afterwards."""
    monkeypatch.setitem(planner_module.CHOICES, "fickle", same_wish)
    world, planner = World(robots=3), TeamPlanner("fickle", **SETTINGS | {"patience": 60.0})
    said = []
    for same_wish.turn in range(12):
        plan = world.call(planner)
        assert gap(plan) >= 0.4
        said += plan.notes
        world.now += 1.0
    assert sum("back and forth" in sentence for sentence in said) >= 2


def corridor() -> np.ndarray:
    """10 m long and 1.5 m wide, on cells of 0.25 m; the right third is not known yet."""
    grid = np.full((8, 44), 100)
    grid[1:7, 1:30], grid[1:7, 30:43] = 0, -1
    return grid


def test_a_robot_that_stands_still_takes_no_target_away():
    planner = TeamPlanner("nearest_frontier", **SETTINGS | {"robot_radius": 0.4})
    poses = {"a": (5.5, 1.0), "b": (4.0, 1.0)}
    first = planner.plan(corridor(), 0.25, (0, 0), poses, now=0.0)
    planner.watch.tracks["a"].failed = 3  # it stands still, whatever its target
    later = planner.plan(corridor(), 0.25, (0, 0), poses, now=1.0)
    assert first.active.tolist() == later.waits.tolist() == [True, False]
    assert first.waits.tolist() == later.active.tolist() == [False, True]


@pytest.mark.parametrize("spare", ["wait", "home"])
def test_the_last_target_is_for_who_is_there_first_and_the_others_wait_or_go_home(spare):
    grid = corridor()
    planner = TeamPlanner("cost_utility", spare=spare, **SETTINGS | {"robot_radius": 0.4})
    first = planner.plan(grid, 0.25, (0, 0), {"a": (5.5, 1.0), "b": (4.0, 1.0)}, now=0.0)
    names = ("waits", "drives home")
    assert first.active.tolist() == [True, False] and first.waits.tolist() == [False, True], "it is at home"
    assert first.notes == ("b waits: the others have the targets that are left",) and not first.done
    np.testing.assert_allclose(first.goals[1], (4.0, 1.0))
    later = planner.plan(grid, 0.25, (0, 0), {"a": (4.5, 1.0), "b": (6.5, 1.0)}, now=1.0)
    said = f"a {names[spare == 'home']}: the others have the targets that are left"
    assert said in later.notes and later.waits.tolist() == [spare == "wait", False]
    assert later.active.tolist() == [spare == "home", True]
    np.testing.assert_allclose(later.goals[0], (5.5, 1.0) if spare == "home" else (4.5, 1.0), atol=0.25)
    grid[grid < 0] = 0
    over = planner.plan(grid, 0.25, (0, 0), {"a": (4.5, 1.0), "b": (6.5, 1.0)}, now=2.0)
    assert over.done and not over.active.any() and not over.waits.any()


def test_an_unknown_word_is_named():
    with pytest.raises(ValueError, match="spare='away' is unknown: choose wait or home"):
        TeamPlanner(spare="away")


def test_a_team_still_explores_to_the_end():
    world = World(robots=3)
    assert explore(world, TeamPlanner("cost_utility", spare="home", **SETTINGS), 300)[-1] == "done"
    assert world.share() > 0.97


class Blocks:
    """Three targets by their blocks."""

    def keys(self):
        return [(0, 0), (1, 0), (2, 0)]


def test_who_goes_back_and_forth_gets_the_nearest_that_nobody_has():
    at = np.zeros(2)
    team = Team((0, 1), np.zeros((2, 2)), np.zeros(2), np.zeros(2), np.full(2, 0.3))
    for other, wanted in ((2, 0), (0, 1)):  # the other robot has the farthest target, or the nearest
        watch = Watch(60.0, 60.0)
        past = [((k, 0), at) for k in (1, 2, 1)]
        watch.tracks = {0: Track(at, 0.0, 0.0, block=(1, 0), past=past), 1: Track(at, 0.0, 0.0)}
        way = np.array([[1.0, 2.0, 3.0]] * 2)
        shares = DistinctTargets(-way, way, np.array([[0.0, 0.0], [5.0, 0.0], [9.0, 0.0]]), team.radius)
        shares.taken = np.array([2, other])
        watch.near = np.zeros((2, 3), dtype=bool)
        notes = watch.settle(team, np.array([0, 1]), Blocks(), way, shares, 5.0)
        assert len(notes) == 1 and shares.taken.tolist() == [wanted, other]
        assert watch.tracks[0].hold == (wanted, 0)
