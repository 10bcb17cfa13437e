"""Which target a classical planner chooses, when it gives one up, and how far beyond it the goal lies."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from mazes import OFFSET, REGION, make_env

from maexp.agents.policies.classical import FrontierPlanner
from maexp.envs import RobotConfig, make_map
from maexp.envs.targets.heuristics import (
    CLASSICAL,
    rank_by_area,
    rank_by_assignment,
    rank_by_force,
    rank_by_utility,
    rank_nearest,
    value_targets,
    worthwhile,
)
from maexp.envs.targets.tracker import TensorScene, plan_in_turn


def test_goals_under_dwa_are_in_sight_and_in_reach():
    env = make_env(4, planner="dwa", clearance=4.0)  # no place of these corridors is open ground then
    td = env.reset()
    planner = FrontierPlanner(env, rank_nearest)
    reach = 0.5 * 2.0 * 2.0**2 + 0.75  # two seconds from standstill
    for _ in range(3):
        td[REGION], td[OFFSET] = planner(td["agents", "observation", "pose"])
        centers = planner.tracker.nav.centers().clone()
        passable = planner.tracker.nav.passable.passable.numpy().copy()
        td = env.step(td)["next"]
        goal = env.simulation.tensors["goal"]
        assert ((goal - centers).norm(dim=-1) <= reach + 1e-3).float().mean() > 0.9
        for e in range(4):
            w = int(planner.tracker.nav.width[planner.tracker.nav.state["map_id"][e]])
            for i in range(3):
                a, b = centers[e, i].numpy(), goal[e, i].numpy()
                line = a + np.linspace(0.2, 1.0, 20)[:, None] * (b - a)
                cells = np.floor(line + 0.5).astype(int)
                assert passable[e][cells[:, 1] * w + cells[:, 0]].mean() > 0.9


class Places:
    """Stands in for a `Navigation` where a choice needs only the robots' places."""

    radar_range, rows = 10.0, 1  # all hear each other

    def __init__(self, at, ways=None):
        self.at, self.ways = torch.tensor(at), ways
        self.state = {"comm": torch.ones(*self.at.shape[:2], self.at.shape[1], dtype=torch.bool)}

    def centers(self):
        return self.at

    def cell_of_env(self):
        return torch.ones(len(self.at))

    @property
    def target(self):
        return torch.zeros(self.ways.shape[:3], dtype=torch.long)

    def points_on_way(self, cells, ahead: float):
        return self.at.unsqueeze(2) + self.ways

    def grow_trees(self, samples: int, branch: float):
        return torch.ones(len(self.at), 1, self.ways.shape[2], dtype=torch.bool)


def scene_of(travel, points=None, size=None, alive=None, nav=None) -> TensorScene:
    travel = torch.tensor(travel)
    points = torch.zeros(*travel.shape, 2) if points is None else torch.tensor(points)
    size = torch.ones_like(travel) if size is None else torch.tensor(size)
    alive = torch.ones(travel.shape[:2], dtype=torch.bool) if alive is None else torch.tensor(alive)
    gain = torch.ones_like(travel)
    nav = nav or Places(np.zeros((*travel.shape[:2], 2), np.float32))
    return TensorScene(travel, points, size, gain, torch.zeros_like(points), alive, nav)


INF = float("inf")


def test_targets_with_little_to_see_wait():
    """They come last, the nearest first, where a robot gets to others."""
    scene = scene_of([[[5.0, 2.0, INF, 1.0], [1.0, INF, INF, 3.0]]])
    scene = replace(scene, gain=torch.tensor([[[0.2, 0.4, 0.4, 0.2]] * 2]))
    assert worthwhile(scene).tolist() == [[[False, True, False, False], [True, False, False, True]]]
    for rank in (rank_nearest, rank_by_area, rank_by_assignment):
        first = rank(scene)[0, 0]
        assert first.argsort(descending=True).tolist() == [1, 3, 0, 2] and first[2] == -INF


def test_utility_weighs_what_is_to_be_seen_against_the_way():
    gain = torch.tensor([[[0.2, 0.4]]])
    near, far = (replace(scene_of([[[1.0, way]]]), gain=gain) for way in (10.0, 400.0))
    assert rank_by_utility(near).argmax(-1).tolist() == [[1]]
    assert rank_by_utility(far).argmax(-1).tolist() == [[0]]
    torch.testing.assert_close(value_targets(near), torch.tensor([[[0.2 - 0.003, 0.4 - 0.03]]]))


def test_voronoi_keeps_to_the_own_area_and_ignores_the_dead():
    travel = [[[1.0, 5.0, 9.0], [2.0, 4.0, 3.0], [7.0, 8.0, 8.0]]]
    assert rank_by_area(scene_of(travel)).argmax(-1).tolist() == [[0, 2, 0]]
    assert rank_by_area(scene_of(travel, alive=[[False, True, True]])).argmax(-1).tolist()[0][1:] == [0, 0]


def test_hungarian_takes_the_least_total_and_shares_none():
    scene = scene_of([[[1.0, 2.0, INF], [1.5, 9.0, INF]], [[INF, 3.0, INF], [INF, 1.0, INF]]])
    assert rank_by_assignment(scene).argmax(-1).tolist() == [[1, 0], [1, 1]]


def test_choices_in_turn_spread_the_team():
    at = [[[0.0, 0.0], [2.0, 0.0], [30.0, 0.0]]]
    points = [at[0], at[0]]
    travel = [[[1.0, 1.0, 6.0], [1.0, 1.0, 6.0]]]
    scene = scene_of(travel, points=[points])
    gain = torch.tensor([[[1.0, 0.9, 0.8]] * 2])
    heard, alone = torch.ones(1, 2, 2, dtype=torch.bool), torch.eye(2, dtype=torch.bool).unsqueeze(0)
    value, points = gain - scene.travel / 10.0, scene.points / 10.0
    score, taken, claimed = plan_in_turn(gain, value, points, heard)
    assert taken.tolist() == [[0, 2]]  # 1 is in sight of 0
    torch.testing.assert_close(claimed, torch.tensor([[[0.0, 0.0, 0.0], [1.0, 0.8, 0.0]]]))
    torch.testing.assert_close(score, value - gain * claimed)
    assert plan_in_turn(gain, value, points, alone)[1].tolist() == [[0, 0]]  # who hears nothing shares nothing
    other = plan_in_turn(gain.double(), value.double(), points.double(), heard.int())  # of any type
    assert all(torch.equal(a, b) for a, b in zip(other, (score, taken, claimed), strict=True))


@pytest.mark.parametrize("name", CLASSICAL)
@pytest.mark.parametrize("lost", [[1], [2], [1, 2]])
def test_robots_without_a_target_leave_the_choices_of_the_others_as_they_are(name, lost):
    """A robot that has collided has no way anywhere."""
    points = [[40.0, 0.0], [0.0, 30.0], [-20.0, 0.0]]
    at = torch.tensor([[[0.0, 20.0], [-9.0, 0.0], [30.0, 0.0]]])
    travel = (at.unsqueeze(2) - torch.tensor([[points]])).norm(dim=-1)

    def choose(kept):
        ways = torch.tensor([[points]]) - at[:, kept].unsqueeze(2)
        alive, way = torch.ones(1, 3, dtype=torch.bool), travel.clone()
        alive[:, lost], way[:, lost] = False, INF
        scene = scene_of(
            way[:, kept].tolist(),
            [[points] * len(kept)],
            alive=alive[:, kept].tolist(),
            nav=Places(at[:, kept].tolist(), ways),
        )
        return CLASSICAL[name](scene)[0].argmax(-1).tolist()

    whole, living = choose([0, 1, 2]), [i for i in range(3) if i not in lost]
    assert [whole[i] for i in living] == choose(living)


def test_force_turns_toward_the_larger_pull_and_away_from_others():
    ways = torch.tensor([[[[3.0, 0.0], [-3.0, 0.0]]] * 2])
    travel, size = [[[5.0, 5.0], [5.0, 5.0]]], [[[4.0, 5.0], [4.0, 5.0]]]
    alone = scene_of(travel, size=size, nav=Places([[[0.0, 0.0], [50.0, 0.0]]], ways))
    assert rank_by_force(alone).argmax(-1).tolist() == [[1, 1]]
    close = scene_of(travel, size=size, nav=Places([[[0.0, 0.0], [-2.0, 0.0]]], ways))
    assert rank_by_force(close).argmax(-1).tolist() == [[0, 1]]
    dead = scene_of(travel, size=size, alive=[[True, False]], nav=close.nav)
    assert rank_by_force(dead).argmax(-1).tolist()[0][0] == 1


def test_a_target_that_stays_is_given_up_and_tried_again_when_nothing_else_is_left():
    env = make_env(1, num_robots=1)
    env.reset()
    env.simulation.tensors["macro_step"].fill_(1)
    planner = FrontierPlanner(env, rank_nearest)
    planner.tracker.nav.update()
    here = planner.tracker.nav.centers().unsqueeze(2)
    travel = torch.full((1, 1, planner.tracker.nav.num_blocks), INF)
    travel[..., :2] = torch.tensor([0.5, 20.0])
    points = here.expand(-1, -1, planner.tracker.nav.num_blocks, -1).clone()
    points[..., 1, :] += 20.0
    block = torch.arange(planner.tracker.nav.num_blocks).view(1, 1, -1)
    kept = []
    for step in range(1, 5):
        env.simulation.tensors["macro_step"].fill_(step)
        for _ in range(2):  # looking twice counts once
            given = planner.tracker._give_up(planner.tracker.nav, travel, points, block)[0, 0, :2].tolist()
        kept.append(given)
    assert kept == [[0.5, 20.0], [0.5, 20.0], [INF, 20.0], [INF, 20.0]]
    travel[..., 1] = INF
    assert planner.tracker._give_up(planner.tracker.nav, travel, points, block)[0, 0, 0] == 0.5


def test_a_robot_that_gets_stuck_gives_its_target_up_and_the_others_do_not():
    env = make_env(1, num_robots=2)
    env.reset()
    planner = FrontierPlanner(env, rank_nearest)
    planner.tracker.nav.update()
    travel = torch.full((1, 2, planner.tracker.nav.num_blocks), INF)
    travel[..., :2] = torch.tensor([9.0, 20.0])
    points, block = torch.full((*travel.shape, 2), 1000.0), torch.arange(travel.shape[2]).view(1, 1, -1)
    state = planner.tracker.state
    for step in range(1, 4):
        env.simulation.tensors["macro_step"].fill_(step)
        state["chosen"], state["stood"] = torch.zeros_like(state["chosen"]), planner.tracker.nav.centers().clone()
        state["stood"][0, 1, 0] -= 1.0  # the second robot has moved
        kept = planner.tracker._give_up(planner.tracker.nav, travel, points, block)
    assert kept[0, :, :2].tolist() == [[INF, 20.0], [9.0, 20.0]]
    env.simulation.tensors["macro_step"].fill_(0)
    assert planner.tracker._give_up(planner.tracker.nav, travel, points, block)[0, :, :2].tolist() == [
        [9.0, 20.0],
        [9.0, 20.0],
    ]


@pytest.mark.parametrize("speed, drive", [(0.0, 4.0), (3.0, 10.0), (8.0, 16.0)])
def test_goals_lie_beyond_the_target_as_far_as_a_robot_gets(speed, drive):
    """Two seconds at 2 m/s^2 and at most 8 m/s."""
    env = make_env(1)
    env.reset()
    planner = FrontierPlanner(env, rank_nearest)
    env.simulation.tensors["pose"][..., 2] = speed
    gap = torch.tensor([2.0, 9.0, 30.0])
    target = planner.tracker.nav.centers() + torch.stack([torch.zeros(3), gap], -1)
    toward = torch.tensor([6.0, 0.0]).expand(1, 3, 2)
    goal = planner.tracker._approach(torch.zeros(1, 3, dtype=torch.long), target, toward)
    expected = torch.stack([(drive - gap).clamp_min(0.0), torch.zeros(3)], -1)
    torch.testing.assert_close(goal - target, expected.unsqueeze(0), atol=1e-4, rtol=0)


def test_how_far_goals_lie_is_each_robots_own():
    """A slow robot, a fast one, and one that slides sideways; two seconds at 2 m/s^2."""
    kinds = [("differential", 0.5), ("differential", 8.0), ("omnidirectional", 8.0)]
    env = make_env(1, robot=[RobotConfig(kind=kind, max_speed=speed, max_accel=2.0) for kind, speed in kinds])
    env.reset()
    planner = FrontierPlanner(env, rank_nearest)
    env.simulation.tensors["slip"][:, 2] = 3.0
    target = planner.tracker.nav.centers()
    toward = torch.tensor([6.0, 0.0]).expand(1, 3, 2)
    goal = planner.tracker._approach(torch.zeros(1, 3, dtype=torch.long), target, toward)
    drive = torch.stack([torch.tensor([1.0, 4.0, 10.0]), torch.zeros(3)], -1)
    torch.testing.assert_close(goal - target, drive.unsqueeze(0), atol=1e-4, rtol=0)


@pytest.mark.parametrize(
    "scenario, clearance, drive", [("outdoor", 3.0, 16.0), ("maze_small", 3.0, 4.0), ("maze_small", 4.0, 0.0)]
)
def test_under_dwa_goals_lie_beyond_near_targets_in_open_ground_only(scenario, clearance, drive):
    """Four seconds from standstill at 2 m/s^2 outdoors, two in a maze, whose corridors are open to small clearances."""
    env = make_env(2, planner="dwa", clearance=clearance, maps=[make_map(scenario, 0)])
    env.reset()
    planner = FrontierPlanner(env, rank_nearest)
    nav = planner.tracker.nav
    nav.update()
    cell, x = float(nav.cell_size[0]), torch.tensor([1.0, 0.0])
    near = (nav.centers() / cell).round() * cell  # the robot's own place, as the middle of a cell
    cells = ((near - nav.origin[0]) / cell).floor().long()
    cells = cells[..., 1] * int(nav.width[0]) + cells[..., 0]
    beyond = planner.tracker._approach(cells, nav.points(cells), (6.0 * x).expand(2, 3, 2)) - nav.points(cells)
    is_open = nav.leads_through_open_ground(nav.centers())
    assert is_open.any() == (drive > 0.0)
    torch.testing.assert_close(beyond, drive * is_open.unsqueeze(-1) * x, atol=1e-4, rtol=0)
