"""Radios by their definition: float64, plain loops, nothing of ours."""

import math

NUDGE, LEAST = 1e-4, 5e-5  # cells


def cells_on_line(free, edge: float, a, b) -> tuple[int, bool]:
    """Blocked cells on the line from a to b [m] over a grid `free[y][x]` with its lower corner at (0, 0), and whether
    that is certain: no point that decides lies about where float32 may round it to another cell. A point on an edge
    counts with the greater cell."""
    ax, ay, bx, by = (float(x) / edge for x in (*a, *b))
    across = max(abs(bx - ax), abs(by - ay))
    pieces = max(math.ceil(across - NUDGE), 1)
    sure = across < 1.0 or abs(across - NUDGE - round(across - NUDGE)) > LEAST
    blocked = 0
    for k in range(pieces):
        share = (k + 0.5) / pieces
        x, y = ax + (bx - ax) * share + NUDGE, ay + (by - ay) * share + NUDGE
        sure = sure and min(abs(v - round(v)) for v in (x, y)) > LEAST
        column, row = math.floor(x), math.floor(y)
        inside = 0 <= row < len(free) and 0 <= column < len(free[0])
        blocked += not (inside and free[row][column])
    return blocked, sure


def power(free, edge: float, a, b, cell: float, sent: float = -20.0, fading=(0.0, 0.0)) -> tuple[float, bool]:
    """Received power [dBm] and whether it is certain: P = P_tx - 31 - 40 log10(blocked) - 20 log10(clear / 35)."""
    count, sure = cells_on_line(free, edge, a, b)
    blocked = count * edge / cell
    clear = math.dist(a, b) / cell - blocked
    received = sent - 31.0
    if blocked > 0:
        received -= 40.0 * math.log10(max(blocked, 1.0)) + fading[0]
    if clear > 35.0:
        received -= 20.0 * math.log10(clear / 35.0) + fading[1]
    return received, sure


def uniform(seed: int, env: int, episode: int, step: int, index: int) -> float:
    """The number in [0, 1) that belongs to a key: splitmix64's finaliser over its parts, upper 24 bits."""
    key, mask = 0, 2**64 - 1
    for part in (seed, env, episode, step, index):
        key = (key + part + 0x9E3779B97F4A7C15) & mask
        key = ((key ^ (key >> 30)) * 0xBF58476D1CE4E5B9) & mask
        key = ((key ^ (key >> 27)) * 0x94D049BB133111EB) & mask
        key ^= key >> 31
    return (key >> 40) / 2**24


def connected_with(links, start: int) -> set[int]:
    """Radios that `start` reaches over any number of others; links[i] holds whom i hears."""
    reached, queue = {start}, [start]
    while queue:
        for other in links[queue.pop()]:
            if other not in reached:
                reached.add(other)
                queue.append(other)
    return reached
