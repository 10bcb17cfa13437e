"""What scans add to the maps of one team in volumes, and what robots tell each other: sets of voxels, plain loops."""

import math

import numpy as np


def bits(words, layers: int):
    """Voxels (x, y, z) whose bits are set: words int32 [X, Y, W], bit b of word w is layer 32 * w + b."""
    found = set()
    for x in range(words.shape[0]):
        for y in range(words.shape[1]):
            for z in range(layers):
                if (int(words[x, y, z // 32]) >> (z % 32)) & 1:
                    found.add((x, y, z))
    return found


def merge(team, free, solid, counted, counted_surface, limited):
    """Add what robots see now to what a team has seen. Voxels are sets.

    team: dict of seen [N], known and known_surface [rows], team, team_surface, twice; changed.
    free, solid: [N], what each robot sees now. counted, counted_surface: what coverage counts.

    Returns:
        discovered and overlap, [N].
    """
    count = len(free)
    discovered, overlap = [0] * count, [0] * count
    for i in range(count):
        others = set().union(*(free[j] for j in range(count) if j != i))
        for v in free[i] & counted:
            discovered[i] += v not in team["team"]
            overlap[i] += v in others
    for i in range(count):
        row = i if limited else 0
        for v in free[i]:
            if v in team["team"] and v not in team["seen"][i]:
                team["twice"].add(v)
            team["team"].add(v)
            team["seen"][i].add(v)
            team["known"][row].add(v)
        team["team_surface"] |= solid[i]
        team["known_surface"][row] |= solid[i]
    team["covered"] = len(team["team"] & counted)
    team["covered_surface"] = len(team["team_surface"] & counted_surface)
    team["shared"] = len(team["twice"] & counted)
    return discovered, overlap


def hears(occupied, points, failed, reach, sight, resolution):
    """Who hears whom without loss: bool [N, N]; None where a wall is so nearly touched that both may be.

    points: float64 [N, 3] [voxels]; reach [m]; occupied: bool [X, Y, Z]. A wall is in the way if the line between two
    robots is in one of its voxels for more than a corner.
    """
    count = len(points)
    result = [[i == j for j in range(count)] for i in range(count)]
    for i in range(count):
        for j in range(count):
            if i == j or failed[i] or failed[j]:
                continue
            gap = math.dist(points[i], points[j])
            heard = gap * resolution <= reach
            if heard and sight:
                heard = blocked(occupied, points[i], points[j])
                heard = None if heard is None else not heard
            result[i][j] = heard
    return result


def blocked(occupied, a, b, corner=0.03):
    """Whether occupied voxels cut more than two corners' length off the line from a to b; None: some, but less."""
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    share = [0.0, 1.0]
    for axis in range(3):
        for plane in range(int(min(a[axis], b[axis])), int(max(a[axis], b[axis])) + 2):
            if a[axis] != b[axis]:
                t = (plane - a[axis]) / (b[axis] - a[axis])
                if 0.0 < t < 1.0:
                    share.append(t)
    share.sort()
    most = 0.0
    for first, last in zip(share, share[1:], strict=False):
        v = np.floor(a + 0.5 * (first + last) * (b - a)).astype(int)
        if ((v >= 0) & (v < occupied.shape)).all() and occupied[tuple(v)]:
            most = max(most, (last - first) * math.dist(a, b))
    return True if most > 2.0 * corner else None if most > 1e-6 else False


def share(known, known_surface, comm, counted):
    """What each robot knows once it has heard those that it hears: both by robot; news counted; voxels sent."""
    count = len(known)
    after = [set().union(*(known[j] for j in range(count) if comm[i][j]), known[i]) for i in range(count)]
    solid = [
        set().union(*(known_surface[j] for j in range(count) if comm[i][j]), known_surface[i]) for i in range(count)
    ]
    news = [len((after[i] - known[i]) & counted) for i in range(count)]
    sent = 0
    for j in range(count):
        sent += len(set().union(*(known[j] - known[i] for i in range(count) if i != j and comm[i][j])))
    return after, solid, news, sent
