"""What is to be seen from a cell, in plain loops: unknown voxels of cells on the branches of a tree of rays."""

import math


def looked_at(tree, unknown, cell):
    """Entries of a tree that are reached from a cell: numbers, with what is unknown there.

    tree: offsets [K][3], skips [K] (numbers of the next entry that no ray through this one passes) and weights [K];
    unknown: int [cx, cy, cz], 255 where it blocks rays.
    """
    hidden_until, found = 0, []
    for n, offset in enumerate(tree["offset"]):
        if n < hidden_until:
            continue
        c = tuple(int(a) + int(b) for a, b in zip(cell, offset, strict=True))
        if not all(0 <= a < size for a, size in zip(c, unknown.shape, strict=True)) or unknown[c] == 255:
            hidden_until = int(tree["skip"][n])
        else:
            found.append((n, int(unknown[c])))
    return found


def turn_of(offset, headings):
    """The heading of an offset among so many."""
    return math.floor(math.atan2(float(offset[1]), float(offset[0])) / (2.0 * math.pi) * headings + 0.5) % headings


def gain(tree, unknown, cell, edge, whole, fov, headings=36):
    """Gain, as a share of a whole view; where its middle is from the cell [m]; and the heading of the greatest [rad].

    edge: side of a cell [m]; fov: to the sides [rad], 0 for all around.
    """
    found = looked_at(tree, unknown, cell)
    best = 0.0
    if fov > 0.0:
        half = math.floor(0.5 * fov / (2.0 * math.pi) * headings + 1e-6)
        worth = [0.0] * headings
        for n, left in found:
            worth[turn_of(tree["offset"][n], headings)] += float(tree["weight"][n]) * left
        totals = [sum(worth[(k + d) % headings] for d in range(-half, half + 1)) for k in range(headings)]
        taken = max(range(headings), key=lambda k: totals[k] - 1e-9 * k)
        best = 2.0 * math.pi * taken / headings
        off = [abs(turn_of(tree["offset"][n], headings) - taken) for n, _ in found]
        found = [pair for pair, gap in zip(found, off, strict=True) if min(gap, headings - gap) <= half]
    total = sum(float(tree["weight"][n]) * left for n, left in found)
    middle = [
        edge
        * sum(float(tree["weight"][n]) * left * float(tree["offset"][n][axis]) for n, left in found)
        / max(total, 1e-12)
        for axis in range(3)
    ]
    return total / whole, middle, best
