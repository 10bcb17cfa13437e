"""What robots make of each other's targets, against NumPy in double precision."""

import numpy as np
import pytest
import torch

from maexp.kernels.greedy_assignment import choose_in_turn, compare_with_mates, gather_gain

pytestmark = pytest.mark.kernels

ENVS, ROBOTS, COUNT, TARGETS = 3, 9, 5, 12
REACH = 7.0


@pytest.fixture(params=[0, 1, 2])
def team(request) -> dict[str, np.ndarray]:
    """Robots with candidates of a common list, some absent; one hears nobody, one has none."""
    rng = np.random.default_rng(request.param)
    place = rng.uniform(0, 30, (ENVS, TARGETS, 2))
    best = np.stack([rng.permuted(np.arange(TARGETS))[:COUNT] for _ in range(ENVS * ROBOTS)])
    best = best.reshape(ENVS, ROBOTS, COUNT)
    hears = rng.random((ENVS, ROBOTS, ROBOTS)) < 0.7
    hears |= np.eye(ROBOTS, dtype=bool)
    hears[:, 2] = np.eye(ROBOTS, dtype=bool)[2]
    gain = rng.uniform(0, 1, (ENVS, ROBOTS, COUNT))
    value = gain - 0.03 * rng.uniform(0, 9, gain.shape)
    value[rng.random(value.shape) < 0.2] = -np.inf
    value[:, 5] = -np.inf
    ways = rng.uniform(0, 9, (ENVS, ROBOTS, TARGETS))
    ways[rng.random(ways.shape) < 0.2] = np.inf
    return {
        "point": place[np.arange(ENVS)[:, None, None], best],
        "best": best,
        "hears": hears,
        "gain": gain,
        "value": value,
        "ways": ways,
        "plan": rng.uniform(0, 30, (ENVS, ROBOTS, 2)),
        "has_plan": rng.random((ENVS, ROBOTS)) < 0.8,
        "last": rng.uniform(0, 30, (ENVS, ROBOTS, 2)),
        "has_last": rng.random((ENVS, ROBOTS)) < 0.6,
    }


def tensors(team: dict[str, np.ndarray], *names: str) -> list[torch.Tensor]:
    found = [torch.from_numpy(team[name]) for name in names]
    return [tensor.float() if tensor.is_floating_point() else tensor for tensor in found]


def test_choices_in_turn(team):
    gain, value, point, hears = tensors(team, "gain", "value", "point", "hears")
    score, taken, claimed = choose_in_turn(gain, value, point / REACH, hears)
    for e in range(ENVS):
        left = np.ones((ROBOTS, COUNT))
        waiting = np.isfinite(team["value"][e]).any(-1)
        rest = np.where(np.isfinite(team["value"][e]), team["value"][e], 0.0) - team["gain"][e]
        assert not waiting[5] and (score[e, 5] == 0).all() and taken[e, 5] == 0
        while waiting.any():
            now = np.where(np.isfinite(team["value"][e]), team["gain"][e] * left + rest, -np.inf)
            robot = np.where(waiting, now.max(-1), -np.inf).argmax()
            waiting[robot] = False
            k = now[robot].argmax()
            assert taken[e, robot] == k
            want = team["gain"][e, robot] * left[robot] + rest[robot]
            np.testing.assert_allclose(score[e, robot], want, atol=2e-6)
            np.testing.assert_allclose(claimed[e, robot], 1.0 - left[robot], atol=2e-6)
            gap = np.linalg.norm(team["point"][e] - team["point"][e, robot, k], axis=-1) / REACH
            left[team["hears"][e, :, robot]] *= np.minimum(gap, 1.0)[team["hears"][e, :, robot]]


def test_ways_plans_and_last_targets_of_those_that_are_heard(team):
    point, best, ways, hears, plan, has_plan, last, has_last = tensors(
        team, "point", "best", "ways", "hears", "plan", "has_plan", "last", "has_last"
    )
    found = compare_with_mates(point, best, ways, hears, (plan, has_plan), (last, has_last))
    for e, i, k in np.ndindex(ENVS, ROBOTS, COUNT):
        mates = [j for j in range(ROBOTS) if j != i and team["hears"][e, i, j]]

        def nearest(where: str, of: list[int], at=(e, i, k)) -> float:
            there, some = team[where][at[0]], team[f"has_{where}"][at[0]]
            return min((np.linalg.norm(team["point"][at] - there[j]) for j in of if some[j]), default=np.inf)

        want = (
            min((team["ways"][e, j, team["best"][e, i, k]] for j in mates), default=np.inf),
            nearest("plan", mates),
            nearest("last", [i]),
            nearest("last", mates),
        )
        np.testing.assert_allclose([float(tensor[e, i, k]) for tensor in found], want, rtol=1e-5)
    assert all(tensor.isinf().any() and tensor.isfinite().any() for tensor in found)


def test_gain_around_candidates(team):
    point, gain = tensors(team, "point", "gain")
    near, around = gather_gain(point, gain, REACH, 1.0, 2.5)
    gap = np.linalg.norm(team["point"][:, :, :, None] - team["point"][:, :, None], axis=-1) / REACH
    for got, limit in ((near, 1.0), (around, 2.5)):
        assert abs(gap - limit).min() > 1e-5
        np.testing.assert_allclose(got, ((gap < limit) * team["gain"][:, :, None]).sum(-1), rtol=1e-5)
