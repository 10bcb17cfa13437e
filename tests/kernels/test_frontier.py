"""Frontier cells against scipy's dilation and the plain-loop oracle."""

import numpy as np
import pytest
import torch
import warp as wp
from oracle import grid as oracle
from scipy import ndimage

from maexp.kernels.constants import FREE, OBSTACLE
from maexp.kernels.frontier import frontier_cells, mark_frontier

pytestmark = pytest.mark.kernels


def test_matches_scipy_and_oracle():
    rng = np.random.default_rng(2)
    free = rng.random((4, 11, 17)) < 0.5
    obstacle = rng.random((4, 11, 17)) < 0.3  # some cells are both
    got = frontier_cells(torch.tensor(free), torch.tensor(obstacle)).numpy()
    for b in range(4):
        unknown = ~free[b] & ~obstacle[b]
        want = free[b] & ~obstacle[b] & ndimage.binary_dilation(unknown)
        np.testing.assert_array_equal(got[b], want)
        np.testing.assert_array_equal(got[b], oracle.frontier_cells(free[b], obstacle[b]))
    assert got.any() and not got.all()


def test_edges_of_the_grid_are_no_frontier_and_rows_do_not_wrap():
    free = torch.ones(1, 3, 4, dtype=torch.bool)
    nothing = torch.zeros_like(free)
    assert not frontier_cells(free, nothing).any()
    free[0, 1, 3] = False
    assert frontier_cells(free, nothing)[0].nonzero().tolist() == [[0, 3], [1, 2], [2, 3]]


def test_diagonal_unknown_cell_is_no_frontier():
    free = torch.tensor([[[1, 0], [0, 0]]])
    obstacle = torch.tensor([[[0, 1], [1, 0]]])
    assert not frontier_cells(free, obstacle).any()


def test_more_knowledge_of_all_cells_leaves_no_frontier():
    rng = np.random.default_rng(4)
    free = torch.tensor(rng.random((3, 9, 7)) < 0.4)
    assert not frontier_cells(free, ~free).any()
    assert not frontier_cells(torch.zeros_like(free), torch.zeros_like(free)).any()
    assert frontier_cells(torch.zeros(0, 3, 4), torch.zeros(0, 3, 4)).shape == (0, 3, 4)


def test_mixed_grid_sizes():
    rng = np.random.default_rng(6)
    sizes = [(5, 9), (8, 6)]
    capacity = 53
    known = np.zeros((3, capacity), np.uint8)
    grid_of_row = [1, 0, 1]
    for row, g in enumerate(grid_of_row):
        cells = sizes[g][0] * sizes[g][1]
        known[row, :cells] = rng.integers(0, 3, cells)
    known[:, 49:] = FREE  # beyond both grids
    out = wp.empty((3, capacity), dtype=wp.uint8, device="cpu")
    ints = [wp.array(v, dtype=wp.int32, device="cpu") for v in (grid_of_row, [9, 6], [5, 8])]
    mark_frontier(wp.array(known, dtype=wp.uint8, device="cpu"), *ints, out, 8)
    for row, g in enumerate(grid_of_row):
        cells = sizes[g][0] * sizes[g][1]
        part = known[row, :cells].reshape(sizes[g])
        want = oracle.frontier_cells(part == FREE, part == OBSTACLE)
        np.testing.assert_array_equal(out.numpy()[row, :cells].reshape(sizes[g]), want)
        assert (out.numpy()[row, cells:] == 0).all()


def test_shapes_that_differ_are_refused():
    with pytest.raises(ValueError, match=r"\[B, H, W\]"):
        frontier_cells(torch.zeros(1, 3, 4), torch.zeros(1, 4, 3))
