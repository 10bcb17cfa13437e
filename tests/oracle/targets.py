"""Features of frontier targets from their definitions: float64, plain loops, nothing of ours."""

import math

import numpy as np

FAR = 4.0


def columns(e, i, k, s) -> dict[str, float]:
    """What candidate k of robot i in env e looks like.

    `s` holds float64 arrays: point, toward and first (where the way begins) [E, N, M, 2]; some, gain and travel (of the
    robot itself) [E, N, M]; ways (of each robot to that candidate) [E, N, M, N]; center and last [E, N, 2]; heading,
    speed, limit, drive, alive and has_last [E, N]; comm [E, N, N]; and numbers: reach, least_gain.
    """
    reach, here = s["reach"], s["point"][e, i, k]
    mates = [j for j in range(s["alive"].shape[1]) if j != i and s["comm"][e, i, j]]
    to = here - s["center"][e, i]
    travel, distance = s["travel"][e, i, k] / reach, math.hypot(*to) / reach
    rival = min([s["ways"][e, i, k, j] / reach for j in mates if s["alive"][e, j]], default=math.inf)
    gaps = [np.hypot(*(here - p)) / reach for p in s["point"][e, i]]
    gains = [g if there else 0.0 for g, there in zip(s["gain"][e, i], s["some"][e, i], strict=True)]
    result = {
        "travel": math.log(1.0 + travel),
        "nearness": 1.0 / (1.0 + travel),
        "distance": distance,
        "detour": min(travel / max(distance, 0.1), FAR) - 1.0,
        "gain": s["gain"][e, i, k],
        "worth": float(s["gain"][e, i, k] >= s["least_gain"]),
        "gain_near": sum(g for g, gap in zip(gains, gaps, strict=True) if gap <= 1.0 + 1e-4),
        "gain_around": sum(g for g, gap in zip(gains, gaps, strict=True) if gap <= 2.5 + 1e-4) / 4.0,
        "unknown_far": math.hypot(*s["toward"][e, i, k]) / reach,
        "rival": min(rival, 2 * FAR),
        "lead": max(min(rival - travel, FAR), -FAR),
        "own_last": gap_to_last(e, i, [i], here, s),
        "mates_last": gap_to_last(e, i, mates, here, s),
        "count": sum(s["some"][e, i]) / 10.0,
        "speed": s["speed"][e, i] / s["limit"][e, i],
        "drive": s["drive"][e, i] / reach,
        "mates": sum(bool(s["alive"][e, j]) for j in mates) / 4.0,
    }
    way = s["first"][e, i, k] - s["center"][e, i]
    for name, vector in (("", to), ("way_", way), ("unknown_", s["toward"][e, i, k])):
        turn = math.atan2(vector[1], vector[0]) - s["heading"][e, i]
        result[f"{name}ahead"], result[f"{name}aside"] = math.cos(turn), math.sin(turn)
    return result


def gap_to_last(e, i, robots, here, s) -> float:
    """Distance to the nearest last target of `robots`, in radar ranges, at most `FAR`."""
    gaps = [np.hypot(*(here - s["last"][e, j])) / s["reach"] for j in robots if s["has_last"][e, j]]
    return min([*gaps, FAR])
