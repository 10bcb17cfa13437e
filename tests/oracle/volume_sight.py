"""What is in sight among voxels, in float64: lines of sight to many points of every voxel."""

import itertools

import numpy as np

POINTS = (0.02, 0.5, 0.98)  # of a voxel, along each axis


def clear(free, start, ends):
    """Whether nothing but free voxels is on the lines from a point to others [voxels], apart from those at their ends.

    free: bool [X, Y, Z]; start [3]; ends [K, 3]. The parts of a line between two planes of the grid are in one voxel.
    """
    start, ends = np.asarray(start, dtype=np.float64), np.asarray(ends, dtype=np.float64)
    if not len(ends):
        return np.zeros(0, dtype=bool)
    away = ends - start
    share = [np.zeros((len(ends), 1)), np.ones((len(ends), 1))]
    for axis in range(3):
        low = int(np.floor(min(start[axis], ends[:, axis].min())))
        high = int(np.floor(max(start[axis], ends[:, axis].max())))
        for plane in range(low, high + 1):
            with np.errstate(divide="ignore", invalid="ignore"):
                t = (plane - start[axis]) / away[:, axis]
            share.append(np.where((t > 0.0) & (t < 1.0), t, 1.0)[:, None])
    share = np.sort(np.concatenate(share, axis=1), axis=1)
    result = np.ones(len(ends), dtype=bool)
    last = np.floor(ends).astype(int)
    for k in range(share.shape[1] - 1):
        middle = start + 0.5 * (share[:, k] + share[:, k + 1])[:, None] * away
        v = np.floor(middle).astype(int)
        passed = (share[:, k + 1] - share[:, k] > 1e-12) & (v != last).any(1)
        inside = ((v >= 0) & (v < free.shape)).all(1)
        w = np.where(inside[:, None], v, 0)
        result &= ~passed | (inside & free[w[:, 0], w[:, 1], w[:, 2]])
    return result


def in_view(offset, up, ahead=None, side=None, within=0.5):
    """Whether points at offsets [K, 3] are in a field of view, half of it up and down and half to the sides of a
    heading [rad]: by half a voxel within its edges, or where ``within`` is negative so far beyond them."""
    away = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
    room = np.where(abs(within) < away, within / away, np.sign(within) * np.pi)
    result = np.abs(np.arctan2(offset[:, 2], np.hypot(offset[:, 0], offset[:, 1]))) <= 0.5 * up - room
    if side is not None:
        flat = np.maximum(np.hypot(offset[:, 0], offset[:, 1]), 1e-9)
        room = np.where(abs(within) < flat, within / flat, np.sign(within) * np.pi)
        turn = np.arctan2(offset[:, 1], offset[:, 0]) - ahead
        result &= np.abs((turn + np.pi) % (2.0 * np.pi) - np.pi) <= 0.5 * side - room
    return result


def sights(free, occupied, start, reach, up, ahead=None, side=None):
    """What is to be seen from a point [voxels]: two bool grids [X, Y, Z].

    The first: voxels whose middle is in range and in sight, half a voxel within the view: these must be seen. The
    second: voxels of which some of 28 points is in sight, wherever it is: others must not.
    """
    start = np.asarray(start, dtype=np.float64)
    must, may = np.zeros(free.shape, dtype=bool), np.zeros(free.shape, dtype=bool)
    index = np.argwhere(free | occupied)
    index = index[np.linalg.norm(index + 0.5 - start, axis=1) <= reach + 1.5]
    offset = index + 0.5 - start
    good = clear(free, start, index + 0.5)
    may[tuple(index[good].T)] = True
    good &= (np.linalg.norm(offset, axis=1) <= reach) & in_view(offset, up, ahead, side)
    must[tuple(index[good].T)] = True
    for point in itertools.product(POINTS, repeat=3):
        good = clear(free, start, index + np.array(point))
        may[tuple(index[good].T)] = True
    return must, may
