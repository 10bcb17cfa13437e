"""Random trees of a team, as `maexp.kernels.tree` grows them on the robots' grid."""

from __future__ import annotations

import numpy as np

from maexp.kernels.constants import FREE, UNKNOWN

from .grid import KnownGrid


def grow_trees(grid: KnownGrid, at: np.ndarray, rng: np.random.Generator, samples: int, branch: float) -> np.ndarray:
    """Free cells where the branches of the robots' trees left what is known, int64 [n].

    Args:
        at: where the robots are [m], float [N, 2].
        samples: points drawn for each tree.
        branch: longest step towards one of them [m].

    All trees grow at once, and x + iy stands for a place in cells: what this takes is mostly the number of calls.
    """
    robots = len(at)
    size = np.array([grid.width, grid.height])
    draw = np.minimum(rng.random((robots, samples, 2)) * size, size - 1e-6)
    branch = branch / grid.cell
    node = np.full((robots, samples + 1), np.inf, complex)
    node[:, 0] = (at / grid.cell) @ (1, 1j)
    flat, known, first_node = node.ravel(), grid.known.ravel(), np.arange(robots) * node.shape[1]
    numbers, row, count, ends = np.arange(int(2.0 * branch) + 3), np.arange(robots), [1] * robots, []
    for point in (draw @ (1, 1j)).T:
        away = node[:, : max(count)] - point[:, None]
        gap = away.real**2 + away.imag**2
        start = flat.take(gap.argmin(1) + first_node)
        length = np.sqrt(gap.min(1))
        way = (point - start) * np.minimum(1.0, branch / np.maximum(length, 1e-9))
        steps = np.minimum(2.0 * length, 2.0 * branch).astype(np.int64)
        shares = np.minimum(numbers / (steps[:, None] + 1), 1.0)  # where a branch is looked at; its end fills the row
        looked = start[:, None] + way[:, None] * shares
        cells = looked.imag.astype(np.int64) * grid.width + looked.real.astype(np.int64)
        state = known.take(cells)
        first = (state != FREE).argmax(1)
        for robot, (k, end) in enumerate(zip(first.tolist(), state[row, first].tolist(), strict=True)):
            if end == FREE:  # all along
                node[robot, count[robot]] = start[robot] + way[robot]
                count[robot] += 1
            elif end == UNKNOWN and k > 0:
                ends.append(cells[robot, k - 1])
    return np.array(ends, np.int64)
