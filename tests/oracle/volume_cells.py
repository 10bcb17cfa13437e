"""Where robots can go by what they know of a volume: room, cells, frontiers, distances; plain loops over voxels."""

import itertools
import math

import numpy as np

UNREACHED = 32767


def voxels(low, high):
    """All (x, y, z) from `low` up to `high`, which is not one of them."""
    return itertools.product(*(range(a, b) for a, b in zip(low, high, strict=True)))


def inside(v, shape) -> bool:
    return all(0 <= a < n for a, n in zip(v, shape, strict=True))


def room(known, body):
    """Voxels that are known to be free with all in a cube around them: bool [X, Y, Z]."""
    result = np.zeros_like(known)
    for v in np.argwhere(known):
        low, high = v - body, v + body + 1
        if (low >= 0).all() and (high <= known.shape).all():
            result[tuple(v)] = known[low[0] : high[0], low[1] : high[1], low[2] : high[2]].all()
    return result


def cells(known, surface, with_room, side, solid):
    """Open cells, bool [cx, cy, cz], and unknown voxels in each, 255 where it blocks rays."""
    shape = [-(-n // side) for n in known.shape]
    is_open, unknown = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=int)
    for c in voxels((0, 0, 0), shape):
        walls = 0
        for v in voxels([a * side for a in c], [min(a * side + side, n) for a, n in zip(c, known.shape, strict=True)]):
            is_open[c] |= with_room[v]
            walls += surface[v] and not known[v]
            unknown[c] += not known[v] and not surface[v]
        if walls >= math.ceil(solid * side**3 - 1e-9):
            unknown[c] = 255
    return is_open, unknown


def frontier(known, surface):
    """Known free voxels beside an unknown one: bool [X, Y, Z]."""
    result = np.zeros_like(known)
    for v in map(tuple, np.argwhere(known)):
        for axis, step in itertools.product(range(3), (-1, 1)):
            u = tuple(a + step * (k == axis) for k, a in enumerate(v))
            if inside(u, known.shape) and not known[u] and not surface[u]:
                result[v] = True
    return result


def nearest_open(is_open, at, most):
    """The open cell whose middle is nearest to a point [cells], at most so many cells off; None: there is none. And
    how much nearer it is than the next."""
    found = []
    here = [math.floor(a) for a in at]
    for c in voxels([a - most for a in here], [a + most + 1 for a in here]):
        if inside(c, is_open.shape) and is_open[c]:
            found.append((math.dist([a + 0.5 for a in c], at), c))
    found.sort()
    if not found:
        return None, math.inf
    return found[0][1], found[1][0] - found[0][0] if len(found) > 1 else math.inf


def targets(edge, is_open, side, block, least, search):
    """For each block: frontier voxels, and the open cell nearest to the middle of them (None), and its lead."""
    shape = [-(-n // block) for n in edge.shape]
    result = []
    for b in voxels((0, 0, 0), shape):
        low = [a * block for a in b]
        found = [v for v in voxels(low, [min(a + block, n) for a, n in zip(low, edge.shape, strict=True)]) if edge[v]]
        cell, lead = None, math.inf
        if len(found) >= least:
            middle = (np.array(found, dtype=np.float64) + 0.5).mean(0) / side
            cell, lead = nearest_open(is_open, middle, search)
        result.append((len(found), cell, lead))
    return result


def neighbours(c, shape, all26: bool):
    for d in itertools.product((-1, 0, 1), repeat=3):
        u = tuple(a + b for a, b in zip(c, d, strict=True))
        if any(d) and (all26 or sum(map(abs, d)) == 1) and inside(u, shape):
            yield u


def distances(is_open, start):
    """Least steps from a cell to all others, where odd steps go to the 6 neighbours and even ones to the 26: int
    [cx, cy, cz]. A cell that is come to in an even step is left in the next one straight, or in the one after askew."""
    found = np.full(is_open.shape, UNREACHED)
    if start is None:
        return found
    found[start] = 0
    step, last = 0, 0
    while step <= last + 2:
        step += 1
        for c in map(tuple, np.argwhere((found == step - 1) | ((found == step - 2) & (step % 2 == 0)))):
            for u in neighbours(c, is_open.shape, step % 2 == 0):
                if is_open[u] and found[u] == UNREACHED:
                    found[u] = last = step
    return found


def connected(is_open, start):
    """Cells that hang together with one over their 26 neighbours: a set."""
    been, left = {start}, [start]
    while left:
        for u in neighbours(left.pop(), is_open.shape, True):
            if is_open[u] and u not in been:
                been.add(u)
                left.append(u)
    return been
