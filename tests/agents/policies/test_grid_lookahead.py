"""`TeamPlanner("lookahead")`: it plays what the simulator's search plays, and knows no more than the grid."""

import importlib
import math
import time

import numpy as np
import pytest

from maexp.agents.deploy.planner.features import Motion
from maexp.agents.policies.grid_lookahead import AHEAD, MOST_STEPS, WHEELBASE, Foresight, imagined_steps
from maexp.agents.policies.lookahead import LookaheadPlanner
from maexp.agents.policies.remote.numpy_policy import TeamSight
from maexp.agents.runtime import RobotPlanner, TeamPlanner
from maexp.envs import ExplorationEnv, LookaheadConfig, RobotConfig, make_map
from maexp.envs.imagined.grid_team import GridTeam
from maexp.kernels.constants import FREE, OBSTACLE, UNKNOWN

RADIUS = 0.75
POSES = [(3.0, 3.0, 0.0), (4.0, 3.0, 0.5), (3.0, 4.0, 1.0)]


def floor() -> np.ndarray:
    """Two rooms that a wall with a gap parts; what lies beyond them is unknown."""
    grid = -np.ones((80, 100), int)
    grid[20:60, 20:70] = 0
    grid[20:60, 20] = grid[20, 20:70] = 100
    grid[35:60, 45] = 100
    return grid


def planner(policy="lookahead", **more) -> TeamPlanner:
    return TeamPlanner(policy, **({"radar_range": 3.0, "robot_radius": 0.2} | more))


def plan(team: TeamPlanner, grid=None, poses=POSES, origin=(0.0, 0.0), now=0.0):
    return team.plan(floor() if grid is None else grid, 0.1, origin, poses, now=now)


@pytest.mark.parametrize("scenario, index", [("maze_small", 1003), ("random_obstacles", 1001)])
def test_it_chooses_as_the_simulators_search(scenario, index):
    """On the simulator's own grids with the simulator's robots, also where that departs from `multi_criteria`."""
    robot = RobotConfig(radius=RADIUS, wheelbase=WHEELBASE * RADIUS)
    env = ExplorationEnv(
        make_map(scenario, index), num_envs=1, num_robots=3, seed=1, robot=robot, decision_seconds="protocol"
    )
    sight, search = TeamSight(env), LookaheadPlanner(env, LookaheadConfig())
    td, same, departs = env.reset(), [], []
    episode = sight.episode(0)
    options = {name: episode[name] for name in ("radar_range", "robot_radius", "max_speed", "max_accel", "drive")}
    options |= {"least_area": 0.0, "patience": 1e6, "bounded": True, "seconds": episode["decision_seconds"]}
    teams = [TeamPlanner(policy, **options) for policy in ("lookahead", "multi_criteria")]
    for _ in range(5):
        sight.look()
        seen = sight.observation(0)
        where = (seen["grid"][0], seen["resolution"], seen["origin"], seen["poses"][0])
        more = {"velocities": seen["velocities"][0], "time_left": seen["time_left"], "now": seen["time"]}
        goals, plain = (team.plan(*where, **more).goals for team in teams)
        sent = search.goals()
        nav, chosen = search.tracker.nav, search.tracker.state["chosen"][0, :, 0]
        place = [int((nav.block[0, 0] == target).nonzero()[0]) for target in chosen]
        points = np.array([nav.point[0, robot, k].numpy() for robot, k in enumerate(place)])
        same += (np.linalg.norm(points - goals, axis=-1) < 1e-3).tolist()
        departs += (np.linalg.norm(plain - goals, axis=-1) > 1e-3).tolist()
        td["agents", "action", "goal"] = sent
        td = env.step(td)["next"].exclude("agents", "reward")
    assert np.mean(same) >= 0.75
    assert np.any(np.array(departs) & same)


def test_plans_repeat_and_depart_from_the_base():
    first, second = plan(planner()), plan(planner())
    assert np.array_equal(first.goals, second.goals) and first.active.all() and not first.notes
    assert not np.array_equal(first.goals, plan(planner("multi_criteria")).goals)


def test_nobody_is_told_how_large_the_place_is():
    """More unknown cells around the same ground, and another origin, change nothing. Robots stand inside cells: on an
    edge, rounding says in which."""
    inside = [(x + 0.03, y + 0.03, yaw) for x, y, yaw in POSES]
    wide = np.pad(floor(), ((16, 40), (24, 60)), constant_values=-1)  # by whole blocks of frontier cells
    before, after = plan(planner(), poses=inside), plan(planner(), wide, inside, origin=(-2.4, -1.6))
    assert np.allclose(before.goals, after.goals, atol=1e-6)


def test_one_planner_goes_on_while_its_grid_grows():
    team, grid = planner(), floor()
    small = plan(team, grid[:70, :80])
    room = team.foresight.team
    assert np.allclose(plan(team, grid[:72, :84], now=1.0).goals, small.goals) and team.foresight.team is room
    assert np.allclose(plan(team, np.pad(grid, ((0, 60), (0, 60)), constant_values=-1), now=2.0).goals, small.goals)
    assert team.foresight.team is room  # what is unknown takes no room
    grid = np.full((80, 140), 0)
    assert plan(team, grid, now=3.0).active.all() and team.foresight.team is not room


def test_a_turned_grid_and_robots_without_a_pose_or_a_place():
    yaw = 0.6
    turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
    turned = [(*(np.array(pose[:2]) @ turn), pose[2] + yaw) for pose in POSES]
    assert np.allclose(plan(planner()).goals @ turn, plan(planner(), poses=turned, origin=(0.0, 0.0, yaw)).goals)
    found = plan(planner(), poses={"a": POSES[0], "b": None, "c": (99.0, 99.0, 0.0), "d": POSES[2]})
    assert found.active.tolist() == [True, False, False, True]


def test_who_stands_beside_a_wall_is_not_lost_in_the_imagined_world():
    team = planner()
    poses = [(2.15, 2.15, 0.0), *POSES[1:]]  # nearer to two walls than its radius
    plan(team, poses=poses)
    branches = team.foresight.team.branches.env.simulation.tensors
    assert not branches["collided"].any()


def test_what_lies_beyond_the_edge():
    robots = [RobotConfig("differential", radius=0.2, max_speed=1.0, max_accel=1.0)]
    team = GridTeam((30, 40), 0.1, robots, 2.0, 10, 2.0, 2)
    known = np.full((30, 40), FREE, np.uint8)
    for edge in (UNKNOWN, OBSTACLE):
        team.put(known, np.array([[1.0, 2.0]]), np.zeros(1), np.zeros(1), np.ones(1, bool), edge)
        grid = team.branches.grid.numpy()
        assert (grid[1:31, 1:41] == FREE).all() and (grid[0] == edge).all() and (grid[:, 41:] == edge).all()
    assert team.env.simulation.tensors["center"][0, 0].tolist() == pytest.approx([1.1, 2.1, 0.0])


def test_a_deadline_leaves_the_base(monkeypatch):
    base = plan(planner("multi_criteria")).goals
    assert np.array_equal(plan(planner(deadline=1e-9)).goals, base)
    times = iter([0.0, 0.0, 1.0, 1.0])  # the first robot has its turn
    team = planner(deadline=0.5)
    monkeypatch.setattr(time, "monotonic", lambda: next(times))
    part, whole = plan(team).goals, None
    monkeypatch.undo()
    whole = plan(planner()).goals
    assert np.array_equal(part[0], whole[0]) and not np.array_equal(part, whole)


def test_one_candidate_is_the_rollout_policy():
    for base in ("cost_utility", "nearest_frontier", "universal"):
        told = {"candidates": 1, "rollout_policy": base}
        assert np.array_equal(plan(planner(lookahead=told)).goals, plan(planner(base)).goals)


@pytest.mark.parametrize(
    "told", [{"horizon": 2}, {"rollout_policy": "universal"}, {"unknown": "nearest"}, {"unknown": "predicted"}]
)
def test_settings_of_the_search(told):
    assert plan(planner(lookahead=told)).active.all()
    assert np.array_equal(plan(planner(lookahead=LookaheadConfig(**told))).goals, plan(planner(lookahead=told)).goals)


def test_how_long_an_imagined_decision_lasts():
    assert imagined_steps(5.0, Motion(1.0, 1.0, seconds=1.0)) == round(10 * 5.0 * AHEAD)
    assert imagined_steps(1.0, Motion(1.0, 1.0, seconds=4.0)) == 40
    assert imagined_steps(100.0, Motion(0.1, 1.0, seconds=1.0)) == MOST_STEPS
    team = planner(lookahead={"local_steps": 7})
    plan(team)
    assert team.foresight.team.env.local_steps == 7


def test_fine_grids_are_imagined_in_larger_cells(monkeypatch):
    fine = np.kron(floor(), np.ones((4, 4), int))
    team = planner(radar_range=3.0, robot_radius=0.35)
    assert team.plan(fine, 0.025, (0.0, 0.0), POSES, now=0.0).active.all()
    assert team.foresight.team.cell == pytest.approx(0.125)
    far = planner(radar_range=8.0)
    plan(far)
    assert far.foresight.team.env.radar_configs[0].range == pytest.approx(32 * 0.1)
    monkeypatch.setattr("maexp.agents.policies.grid_lookahead.MOST_CELLS", 1000)
    found = plan(planner())
    assert np.array_equal(found.goals, plan(planner("multi_criteria")).goals)
    assert found.notes == (
        "2,000 known cells are too many to look ahead on with 5 candidates: multi_criteria decides alone",
    )


@pytest.mark.parametrize(
    "options, told",
    [
        ({"lookahead": {"candidate": 3}}, "lookahead names 'candidate': choose among rollout_policy, candidates"),
        ({"lookahead": {"candidates": 0}}, r"lookahead.candidates=0 must be a whole number from 1 to 64"),
        ({"lookahead": 3}, "lookahead=3: give a LookaheadConfig, or a mapping"),
        ({"lookahead": {"rollout_policy": "clairvoyant"}}, "clairvoyant.* is unknown"),
        ({"deadline": 0.0}, "deadline=0.0 must be above 0"),
        ({"drive": "legs"}, "drive='legs' is unknown: choose ackermann or differential or omnidirectional"),
        ({"policy": "cost_utility", "deadline": 1.0}, "lookahead= and deadline= are for policy='lookahead'"),
    ],
)
def test_what_cannot_be(options, told):
    with pytest.raises(ValueError, match=told):
        planner(**({"policy": "lookahead"} | options))


def test_without_warp_it_says_so(monkeypatch):
    def refuse(name):
        raise ModuleNotFoundError("No module named 'warp'", name="warp")

    monkeypatch.setattr(importlib, "import_module", refuse)
    with pytest.raises(ValueError, match="plays the future in the simulator, and warp is not installed"):
        planner()
    assert plan(planner("multi_criteria")).active.all()


def test_a_robot_by_itself_looks_ahead_too():
    alone = RobotPlanner("a", "lookahead", radar_range=3.0, robot_radius=0.2)
    found = alone.plan(floor(), 0.1, (0.0, 0.0), POSES[0], now=0.0)
    assert found.active.all()
    assert isinstance(alone.team.foresight, Foresight)
