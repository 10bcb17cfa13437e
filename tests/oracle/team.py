"""Maps of the robots and of the team, reward and end of an episode (docs/concepts.md), by counting."""

import math

import numpy as np


def merge_maps(seen, comm) -> np.ndarray:
    """(E, N, n) bool: what each robot knows after hearing once: its own flags and those of each j it hears.

    seen (E, N, n), comm (E, N, N) bool; comm[e, i, j]: i hears j. A robot always has its own.
    One exchange: what j heard from others in the same step does not travel on.
    """
    seen, comm = np.asarray(seen, bool), np.asarray(comm, bool)
    known = np.zeros_like(seen)
    for e in range(seen.shape[0]):
        for i in range(seen.shape[1]):
            for j in range(seen.shape[1]):
                if i == j or comm[e, i, j]:
                    for p in range(seen.shape[2]):
                        if seen[e, j, p]:
                            known[e, i, p] = True
    return known


def wall_gap(a, b, boundary) -> float:
    """Least distance of boundary points (B, 2) to the segment from a to b [m]; inf where there are none."""
    a, along = np.asarray(a, np.float64), np.asarray(b, np.float64) - np.asarray(a, np.float64)
    least = math.inf
    for point in np.asarray(boundary, np.float64):
        t = min(max(np.dot(point - a, along) / max(np.dot(along, along), 1e-12), 0.0), 1.0)
        least = min(least, float(np.linalg.norm(point - a - t * along)))
    return least


def area_weights(spacing) -> np.ndarray:
    """Weight of each free point: spacing squared [m^2]."""
    return np.asarray([float(s) ** 2 for s in spacing])


def coverage(seen, weights) -> float:
    """Seen area of the team / all area; seen (N, n) bool."""
    covered = math.fsum(weights[p] for p in range(len(weights)) if any(row[p] for row in seen))
    return covered / math.fsum(weights)


def counts(seen_before, visible, weights) -> tuple[np.ndarray, np.ndarray]:
    """`(new, overlap)` (N,): weight that i sees now and the team never had; that i and another see now."""
    robots, points = np.shape(visible)
    new, overlap = np.zeros(robots), np.zeros(robots)
    for i in range(robots):
        for p in range(points):
            if visible[i][p]:
                if not any(seen_before[j][p] for j in range(robots)):
                    new[i] += weights[p]
                if any(visible[j][p] for j in range(robots) if j != i):
                    overlap[i] += weights[p]
    return new, overlap


def mutual_overlap(seen, weights) -> float:
    """Weight of the points seen by two or more robots / weight of the points seen; 0 when nothing is seen."""
    times = [sum(bool(row[p]) for row in seen) for p in range(len(weights))]
    total = math.fsum(w for w, t in zip(weights, times, strict=True) if t >= 1)
    return math.fsum(w for w, t in zip(weights, times, strict=True) if t >= 2) / total if total else 0.0


def steps_charged(collided, coverage_now: float, local_step: int, horizon: int, success_coverage: float = 0.95) -> int:
    """Local steps charged at once after local step number `local_step` (1 for the first).

    All that are left of `horizon` where the last robot has collided and the team has not succeeded, else none.
    """
    if coverage_now >= success_coverage:
        return 0
    for hit in collided:
        if not hit:
            return 0
    return max(horizon - local_step, 0)


def reward_terms(
    new,
    overlap,
    coverage_before: float,
    succeeded: bool,
    collided_now,
    num_free: float,
    *,
    explore: float = 0.3,
    overlap_weight: float = 0.01,
    success: float = 100.0,
    collision: float = 200.0,
    paper: bool = False,
    coverage_now: float = 1.0,
    charged: int = 0,
    unfinished: float = 0.0,
    gained_for: int | None = None,
) -> dict[str, np.ndarray]:
    """The terms of one local step, each (N,), signed and weighted as they enter the reward (docs/concepts.md, Reward).

    succeeded: coverage reached its threshold in this very step; collided_now: bool (N,), in this step;
    charged: steps left that are charged too, at `coverage_now` (`steps_charged`); unfinished: weight of the time
    itself; gained_for: the steps after this one: what is gained pays for them at once, and nothing else is charged.
    """
    w = 60.0 / num_free
    v = w if paper else 60.0 / 7000.0
    robots = len(new)
    time = -v * (1.0 - coverage_before + unfinished)
    shared = [-w * overlap_weight * overlap[i] for i in range(robots)]
    for _ in range(charged):  # nobody moves any more: each step costs the same
        time -= v * (1.0 - coverage_now + unfinished)
    if gained_for is not None:
        time = sum(v * (coverage_now - coverage_before) for _ in range(gained_for))
        if succeeded:  # and so does what need not be waited for any more
            time += sum(v * (1.0 - coverage_now + unfinished) for _ in range(gained_for))
    return {
        "explore": np.asarray([w * explore * new[i] for i in range(robots)]),
        "overlap": np.asarray([(1 + charged) * value for value in shared]),
        "time": np.asarray([time] * robots),
        "success": np.asarray([v * success * bool(succeeded)] * robots),
        "collision": np.asarray([-v * collision * bool(collided_now[i]) for i in range(robots)]),
    }


def terminated(coverage_now: float, collided, success_coverage: float = 0.95) -> bool:
    """Coverage reached, or no robot left."""
    return coverage_now >= success_coverage or all(bool(c) for c in collided)


def truncated(macro_step: int, macro_steps: int) -> bool:
    """Out of macro steps."""
    return macro_step >= macro_steps
