"""`multi_criteria`: each of its terms, all of them against plain loops, and the same for one team in NumPy."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_classical_choices import INF, Places, scene_of

from maexp.envs.targets import heuristics
from maexp.envs.targets.heuristics import APART, BEYOND, FARTHEST, WAY, rank_by_criteria
from maexp.envs.targets.tracker import TensorScene, plan_in_turn

REACH = Places.radar_range


def one_robot(travel, gain, far=None) -> TensorScene:
    """A robot and targets in a row, out of sight of each other; `far` from each is the middle of what it shows [m]."""
    points = [[[[30.0 * k, 0.0] for k in range(len(travel))]]]
    middle = torch.zeros(1, 1, len(travel), 2)
    middle[0, 0, :, 1] = torch.tensor(far or [0.0] * len(travel))
    return replace(scene_of([[travel]], points), gain=torch.tensor([[gain]]), middle=middle)


def best(scene) -> list:
    return rank_by_criteria(scene)[0].argmax(-1).tolist()


def test_more_to_see_is_better_and_out_of_reach_is_never_wanted():
    scene = one_robot([5.0, 5.0, INF, 5.0], [0.4, 0.6, 9.0, 0.5])
    assert rank_by_criteria(scene)[0, 0].argsort(descending=True).tolist() == [1, 3, 0, 2]
    assert rank_by_criteria(scene)[0, 0, 2] == -INF


def test_the_first_metres_of_a_way_count_most():
    """A radar range more costs a seventh of a disc at first, and less than a thirtieth after six."""
    gain = [0.5, 0.6]
    assert best(one_robot([0.0, REACH], gain)) == [0]
    assert best(one_robot([6.0 * REACH, 7.0 * REACH], gain)) == [1]


def test_open_ground_comes_before_corners():
    assert best(one_robot([5.0, 5.0], [0.5, 0.45], far=[1.0, 1.0])) == [0]
    assert best(one_robot([5.0, 5.0], [0.5, 0.45], far=[1.0, 6.0])) == [1]


def pair(at_first: float, hears: bool = True, alive: bool = True, lost: bool = False) -> TensorScene:
    """Two robots; the first can go `at_first` [m] or 60 m from the target beside the second, as far for as much."""
    nav = Places([[[0.0, 0.0], [0.0, 0.0]]])
    if not hears:
        nav.rows, nav.state["comm"] = 2, torch.eye(2, dtype=torch.bool).unsqueeze(0)
    points = [[[[at_first, 0.0], [60.0, 0.0], [0.0, 0.0]]] * 2]
    ways = [[[20.0, 20.0, INF], [INF, INF, INF if lost else 1.0]]]
    return replace(scene_of(ways, points, alive=[[True, alive]], nav=nav), gain=torch.tensor([[[0.5, 0.5, 0.9]] * 2]))


def test_robots_keep_away_from_where_others_would_go():
    """Farther than the radar reaches: what can be seen from both is claimed anyway."""
    assert rank_by_criteria(pair(15.0))[0, 0].argmax() == 1
    assert rank_by_criteria(pair(FARTHEST * REACH))[0, 0].argmax() == 0, "far enough: no farther is better"
    for other in (pair(15.0, hears=False), pair(15.0, alive=False, lost=True)):
        assert rank_by_criteria(other)[0, 0].argmax() == 0, "who is not heard or does not drive keeps nobody away"


def test_what_others_claim_counts_less():
    """Both want the same; the second, who would win less, goes where less is to be seen."""
    points = [[[[0.0, 0.0], [4.0 * REACH, 0.0]]] * 2]
    scene = replace(scene_of([[[5.0, 5.0], [6.0, 5.0]]], points), gain=torch.tensor([[[0.9, 0.3]] * 2]))
    assert best(scene) == [0, 1]


def crowd(seed: int):
    """A team of four with twelve targets, at random."""
    rng = np.random.default_rng(seed)
    at, points = rng.uniform(0, 50, (4, 2)), rng.uniform(0, 50, (12, 2))
    travel = np.linalg.norm(points - at[:, None], axis=-1) * rng.uniform(1, 2, (4, 12))
    travel[rng.random(travel.shape) < 0.2] = INF
    travel[1] = INF
    return at, points, travel, rng.uniform(0, 1, 12), rng.uniform(-5, 5, (12, 2))


class Arrays:
    """One team in NumPy, as of `maexp.agents.deploy.planner.scene.ArrayScene`."""

    xp, radar_range = np, REACH

    def __init__(self, at, points, travel, gain, middle):
        self.at, self.points, self.travel, self.gain, self.middle = at, points, travel, gain, middle
        self.alive = np.ones(len(at), bool)

    def in_turn(self, gain, value):
        gain = np.broadcast_to(gain, value.shape)
        points = np.broadcast_to(self.points / REACH, (*value.shape, 2))
        everyone = torch.ones(1, len(value), len(value), dtype=torch.bool)
        as_team = [torch.tensor(np.ascontiguousarray(array)).unsqueeze(0).float() for array in (gain, value, points)]
        return plan_in_turn(*as_team, everyone)[0][0].numpy()

    def heard(self, values, blank):
        return values[None]


@pytest.mark.parametrize("seed", range(4))
def test_all_terms_together_are_those_of_plain_loops(seed):
    at, points, travel, gain, middle = crowd(seed)
    value = np.full(travel.shape, -INF)
    for i, k in zip(*np.nonzero(np.isfinite(travel)), strict=True):
        value[i, k] = gain[k] - WAY * np.log(1 + travel[i, k] / REACH) + BEYOND * np.hypot(*middle[k]) / REACH
    scene = Arrays(at, points, travel, gain, middle)
    wanted = scene.in_turn(gain, value)
    wishes = {i: int(np.where(np.isfinite(travel[i]), wanted[i], -INF).argmax()) for i in (0, 2, 3)}
    expected = np.full(travel.shape, -INF)
    for i, k in zip(*np.nonzero(np.isfinite(travel)), strict=True):
        gaps = [np.hypot(*(points[k] - points[wishes[j]])) / REACH for j in wishes if j != i]
        expected[i, k] = wanted[i, k] + APART * min(*gaps, FARTHEST)
    np.testing.assert_allclose(rank_by_criteria(scene), expected, atol=1e-6)
    tensors = scene_of([travel.tolist()], [[points.tolist()] * 4], nav=Places([at.tolist()]))
    shown = {
        name: torch.tensor(array).float().expand(1, 4, *array.shape)
        for name, array in (("gain", gain), ("middle", middle))
    }
    np.testing.assert_allclose(rank_by_criteria(replace(tensors, **shown))[0].numpy(), expected, atol=1e-5)


def test_the_first_of_equal_wishes_counts_and_none_that_is_out_of_reach():
    """Two targets alike, and one that the other robot would like best and does not get to."""
    scene = pair(15.0)
    scene.points[0, :, 1] = torch.tensor([-15.0, 0.0])
    scene.travel[0, 1] = torch.tensor([5.0, 5.0, INF])
    score = torch.tensor([[[0.0, 0.0, 0.0], [-0.8, -0.8, 0.5]]])
    gaps = heuristics._gap_to_plans(scene, score, scene.travel.isfinite())[0, 0]
    torch.testing.assert_close(gaps[:2], torch.tensor([0.0, 3.0]))
