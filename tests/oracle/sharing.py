"""Targets shared out among the robots of one team: float64, plain loops, nothing of ours."""

import math


def clash(i, k, j, taken, s) -> bool:
    """Whether what robot j has leaves robot i no room at its target k."""
    if j == i or taken[j] is None or not (s["hears"][i][j] or s["hears"][j][i]):
        return False
    a, b = s["point"][i][k], s["point"][j][taken[j]]
    return math.dist(a, b) < s["body"][i] + s["body"][j]


def free_targets(i, taken, s) -> list[int]:
    """Targets that robot i may have, the one that it likes best first."""
    reached = [k for k, liking in enumerate(s["preference"][i]) if liking > -math.inf]
    kept = [k for k in reached if not any(clash(i, k, j, taken, s) for j in range(len(taken)))]
    return sorted(kept, key=lambda k: -s["preference"][i][k])


def share(s) -> list[int | None]:
    """The target of each robot, None = none.

    `s` holds, for n robots and m targets: preference and way [n][m], point [n][m] (x, y), hears [n][n], body [n].
    """
    count = len(s["body"])
    wish = [max(range(len(row)), key=row.__getitem__) if max(row) > -math.inf else None for row in s["preference"]]
    turns = sorted((i for i in range(count) if wish[i] is not None), key=lambda i: s["way"][i][wish[i]])
    taken: list[int | None] = [None] * count
    for i in turns:
        if not any(clash(i, wish[i], j, taken, s) for j in range(count)):
            taken[i] = wish[i]
    for first in [i for i in turns if taken[i] is None]:
        i = first
        while i is not None:
            if free := free_targets(i, taken, s):
                taken[i], i = free[0], None
            else:
                i = oust(i, taken, s)
    return taken


def oust(i, taken, s) -> int | None:
    """Robot i takes the nearest target of a single robot that has another one to go to, or a longer way to this one (of
    equal ways, the later robot gives in); returns who has none now."""
    offers = []
    for k, liking in enumerate(s["preference"][i]):
        holders = [j for j in range(len(taken)) if clash(i, k, j, taken, s)]
        if liking == -math.inf or len(holders) != 1:
            continue
        j, without = holders[0], list(taken)
        without[i], without[j] = k, None
        nearer = (s["way"][i][k], i) < (s["way"][j][taken[j]], j)
        if nearer or free_targets(j, without, s):
            offers.append((s["way"][i][k], k, j))
    if not offers:
        return None
    _, k, j = min(offers)
    taken[i], taken[j] = k, None
    return j
