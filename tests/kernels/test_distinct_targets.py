"""Targets shared out among the robots of a team, against plain loops in double precision."""

import math
from itertools import combinations

import numpy as np
import pytest
import torch
from oracle.sharing import share

from maexp.kernels.distinct_targets import share_targets

pytestmark = pytest.mark.kernels

ENVS = 40


def teams(seed: int, robots: int, targets: int, side: float) -> dict[str, np.ndarray]:
    """Teams on a square, some targets out of reach, some robots that get nowhere, some that do not hear each other."""
    rng = np.random.default_rng(seed)
    at, place = rng.uniform(0, side, (ENVS, robots, 1, 2)), rng.uniform(0, side, (ENVS, 1, targets, 2))
    way = np.linalg.norm(place - at, axis=-1)
    preference = rng.uniform(-1, 1, way.shape) - 0.1 * way
    preference[rng.random(way.shape) < 0.3] = -np.inf
    preference[rng.random((ENVS, robots)) < 0.1] = -np.inf
    hears = rng.random((ENVS, robots, robots)) < 0.6
    hears[: ENVS // 2] = True
    found = {
        "preference": preference,
        "way": way,
        "point": np.broadcast_to(place, (*way.shape, 2)),
        "hears": hears,
        "body": rng.uniform(0.2, 1.0, (ENVS, robots)),
    }
    return {name: value.astype(np.float32) if value.dtype != bool else value for name, value in found.items()}


def run(team: dict[str, np.ndarray]) -> list[list[int]]:
    return share_targets(**{name: torch.from_numpy(value.copy()) for name, value in team.items()}).tolist()


@pytest.mark.parametrize(
    ("robots", "targets", "side"), [(1, 5, 9.0), (3, 2, 5.0), (3, 14, 9.0), (5, 4, 8.0), (8, 11, 5.0), (7, 40, 30.0)]
)
def test_targets_are_shared_out_as_they_should(robots, targets, side):
    team, settled = teams(robots + targets, robots, targets, side), 0
    for e, got in enumerate(run(team)):
        case = {name: value[e].astype(float).tolist() for name, value in team.items()}
        assert got == [-1 if k is None else k for k in share(case)], e
        for i, j in combinations([i for i in range(robots) if got[i] >= 0], 2):
            if team["hears"][e, i, j] or team["hears"][e, j, i]:
                gap = math.dist(case["point"][i][got[i]], case["point"][j][got[j]])
                assert gap > case["body"][i] + case["body"][j] - 1e-5
                settled += 1
    assert settled > 10 or robots == 1


def line(preference, way, at=None, hears=None) -> list[int]:
    """One team with targets at these places on a line [m]; bodies of 0.5 m."""
    preference = torch.tensor([preference])
    robots, targets = preference.shape[1:]
    at = [10.0 * k for k in range(targets)] if at is None else at
    point = torch.tensor([[[[x, 0.0] for x in at]] * robots])
    hears = torch.ones(1, robots, robots, dtype=torch.bool) if hears is None else torch.tensor([hears])
    return share_targets(preference, torch.tensor([way]), point, hears, torch.full((1, robots), 0.5))[0].tolist()


NO = -math.inf


@pytest.mark.parametrize(
    ("preference", "way", "wanted"),
    [
        # What is free is kept, whoever is nearer.
        ([[3.0, 1.0], [1.0, 3.0]], [[9.0, 1.0], [1.0, 9.0]], [0, 1]),
        # Both want the first: the nearer one has it, the first of equals.
        ([[3.0, 1.0], [3.0, 1.0]], [[5.0, 1.0], [4.0, 1.0]], [1, 0]),
        ([[3.0, 1.0], [3.0, 1.0]], [[4.0, 1.0], [4.0, 1.0]], [0, 1]),
        # Who gives in takes what it likes best of the rest, not what is nearest.
        ([[3.0, 1.0, 2.0], [3.0, 1.0, 2.0]], [[4.0, 1.0, 9.0], [3.0, 1.0, 9.0]], [2, 0]),
        # ... and does not take what a third one wants.
        (
            [[3.0, 2.0, 1.0], [3.0, 2.0, 1.0], [0.0, 3.0, 0.0]],
            [[4.0, 1.0, 9.0], [3.0, 1.0, 9.0], [8.0, 8.0, 8.0]],
            [2, 0, 1],
        ),
        # Too few: who is there first has it, the others none.
        ([[1.0], [1.0], [1.0]], [[3.0], [2.0], [4.0]], [-1, 0, -1]),
        # Too few: the second is nearer to the second target than the third, who wants it.
        ([[3.0, 1.0], [3.0, 1.0], [1.0, 3.0]], [[5.0, 9.0], [7.0, 8.0], [60.0, 50.0]], [0, 1, -1]),
        # Enough for all, where one that can go elsewhere makes room.
        ([[3.0, NO], [3.0, 1.0]], [[9.0, math.inf], [2.0, 20.0]], [0, 1]),
        # Nothing in reach.
        ([[NO, NO], [3.0, 1.0]], [[math.inf] * 2, [1.0, 1.0]], [-1, 0]),
    ],
)
def test_who_gets_what(preference, way, wanted):
    assert line(preference, way) == wanted


def test_targets_nearer_to_each_other_than_the_bodies_are_one_place():
    preference, way = [[3.0, 2.0, 1.0], [2.0, 3.0, 1.0]], [[4.0, 4.0, 9.0], [5.0, 5.0, 9.0]]
    assert line(preference, way, at=[0.0, 0.9, 20.0]) == [0, 2]
    assert line(preference, way, at=[0.0, 1.1, 20.0]) == [0, 1]


def test_robots_that_do_not_hear_each_other_share_nothing():
    preference, way = [[3.0, 1.0]] * 3, [[4.0, 1.0], [5.0, 1.0], [6.0, 1.0]]
    hears = [[True, False, False], [False, True, True], [False, False, True]]  # one of a pair is enough
    assert line(preference, way, hears=hears) == [0, 0, 1]


def test_named_targets_count_most():
    assert line([[math.inf, 3.0], [3.0, 1.0]], [[9.0, 1.0], [1.0, 1.0]]) == [1, 0]
    assert line([[math.inf, NO], [3.0, 1.0]], [[9.0, math.inf], [1.0, 1.0]]) == [0, 1]
