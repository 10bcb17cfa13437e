"""Whole numbers at the sizes where 32 bits no longer hold what is computed from them."""

import numpy as np
import pytest
import torch
import warp as wp

from maexp.kernels import frontier_clusters, targets
from maexp.kernels.constants import FREE, STRAIGHT, TIGHT_FACTOR, UNKNOWN, UNREACHED
from maexp.kernels.geodesic import geodesic_distance
from maexp.kernels.launches import launch_on
from maexp.kernels.occupancy_grid import NavGrids

pytestmark = pytest.mark.kernels

launch = launch_on("cpu")


def ints(values) -> wp.array:
    return wp.array(np.asarray(values, np.int32), dtype=wp.int32, device="cpu")


def one_grid(width: int, height: int) -> NavGrids:
    grids = NavGrids()
    grids.width, grids.height, grids.cell = ints([width]), ints([height]), wp.array([1.0], dtype=float, device="cpu")
    return grids


def wall_words_of(width: int) -> int:
    return -(-width // 32)


def test_a_block_of_millions_of_frontier_cells_has_its_target_in_the_middle():
    """Squares of multiples of 1,200 x 1,200 cells pass 2^31 by far."""
    side = 1200
    grids, row = one_grid(side, side), ints([0])
    known = np.full((side, side), FREE, np.uint8)
    known[::2] = UNKNOWN  # every other line: its neighbours are frontier cells
    known, frontier = (wp.array(cells.reshape(1, -1), dtype=wp.uint8, device="cpu") for cells in (known, 0 * known))
    size, target, kept = (wp.full((1, 1), value, dtype=wp.int32, device="cpu") for value in (0, 0, -1))
    sums = wp.zeros((1, 1, 2), dtype=wp.int64, device="cpu")
    changed = ints(np.full((1, wall_words_of(side) * side), -1))
    launch(frontier_clusters._sum_frontier, (1, side), [grids, row, ints([side]), known, changed, frontier, size, sums])
    count = side**2 // 2
    assert size.numpy()[0, 0] == count
    assert sums.numpy()[0, 0].tolist() == [count * (side - 1) // 2, count * side // 2]
    reached = np.full((1, side * side), UNREACHED)
    corner, middle = 3 * side + 5, (side // 2 + 40) * side + side // 2 - 30
    reached[0, [corner, middle, side * side - 1]] = 7
    launch(
        frontier_clusters._place_targets,
        (1, 1),
        [
            grids,
            row,
            ints([side]),
            ints([1]),
            size,
            sums,
            ints(reached),
            changed,
            row,
            ints(np.zeros((1, 1, 2))),
            1,
            1,
            1,
            target,
            kept,
        ],
    )
    assert target.numpy()[0, 0] == middle


def test_ways_of_the_last_env_of_a_large_batch():
    """Env 46,341 of one robot: its number times the robots of the batch passes 2^31."""
    envs = 46_342
    cells = 4
    grids = one_grid(cells, 1)
    passable = wp.full((envs, cells), 1, dtype=wp.uint8, device="cpu")
    distance = np.full((envs, cells), UNREACHED)
    distance[-1] = np.arange(cells) * STRAIGHT
    wanted = np.full((envs, 1, 1), -1)
    wanted[-1] = cells - 1
    found = ints(np.full((envs, 1, 1), -5))
    launch(
        targets._first_cells,
        (envs, 1, 1),
        [grids, ints(np.zeros(envs)), passable, ints(np.arange(envs)), ints(distance), ints(wanted), STRAIGHT, found],
    )
    assert found.numpy()[-1, 0, 0] == 1 and (found.numpy()[:-1] == -1).all()


def test_distances_stay_below_unreached_on_the_longest_ways():
    """A serpentine through 500,000 cells, a weight of 40 a step at most, leaves room for grids forty times as large."""
    height, width = 999, 501
    passable = torch.ones(1, height, width, dtype=torch.bool)
    for y in range(1, height, 2):
        passable[0, y] = False
        passable[0, y, -1 if y % 4 == 1 else 0] = True
    distance = geodesic_distance(passable, torch.tensor([0]))
    longest = int(distance[distance < UNREACHED].max())
    assert longest > 240_000 * STRAIGHT and longest * TIGHT_FACTOR < UNREACHED / 40
