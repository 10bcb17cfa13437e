"""Least-cost assignment against scipy."""

import numpy as np
import pytest
import torch
from scipy.optimize import linear_sum_assignment

from maexp.kernels.hungarian import FORBIDDEN, assign_targets

pytestmark = pytest.mark.kernels


@pytest.mark.parametrize(("robots", "targets"), [(1, 7), (3, 17), (5, 5), (7, 4), (12, 40)])
def test_total_cost_is_scipys(robots, targets):
    rng = np.random.default_rng(robots)
    cost = rng.integers(0, 3000, (9, robots, targets))
    cost[rng.random(cost.shape) < 0.3] = FORBIDDEN
    match = assign_targets(torch.tensor(cost)).numpy()
    for e in range(9):
        kept = [(i, k) for i, k in enumerate(match[e]) if k >= 0]
        chosen = [k for _, k in kept]
        assert len(set(chosen)) == len(chosen)
        rows, columns = linear_sum_assignment(cost[e])
        want = cost[e, rows, columns]
        assert sum(cost[e, i, k] for i, k in kept) == want[want < FORBIDDEN].sum()
        assert len(kept) == (want < FORBIDDEN).sum()


def test_nothing_to_assign_and_too_many_robots():
    assert (assign_targets(torch.full((2, 3, 4), FORBIDDEN)) == -1).all()
    assert (assign_targets(torch.zeros(2, 3, 0, dtype=torch.int64)) == -1).all()
    with pytest.raises(ValueError, match="num_robots=41"):
        assign_targets(torch.zeros(1, 41, 3, dtype=torch.int64))


def test_permuting_robots_permutes_the_assignment():
    rng = np.random.default_rng(4)
    cost = torch.tensor(rng.permutation(4 * 3 * 8).reshape(4, 3, 8) ** 2)  # no two sums alike, almost surely
    order = torch.tensor([2, 0, 1])
    assert torch.equal(assign_targets(cost)[:, order], assign_targets(cost[:, order]))
