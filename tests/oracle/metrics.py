"""Metrics of an episode and of many (docs/concepts.md, Metrics), from the values after every local step."""

import math


def step_reached(coverages, share: float) -> int:
    """Local steps until coverage `share`; coverages[k] is the coverage after k steps; -1: never."""
    for step, value in enumerate(coverages):
        if value >= share:
            return step
    return -1


def mean_coverage(coverages, length: int) -> float:
    """Mean over `length` local steps; coverages[k] is the coverage after k steps, and after its last the last stays."""
    return math.fsum(coverages[min(step, len(coverages) - 1)] for step in range(1, length + 1)) / length


def mean_of_reached(steps) -> tuple[float, int]:
    """Mean over the episodes that got there, and how many did; nan where none did."""
    reached = [s for s in steps if s >= 0]
    return (sum(reached) / len(reached) if reached else math.nan), len(reached)


def censored_mean(steps, limits) -> float:
    """Mean with the limit of the episode for those that never got there."""
    return sum(s if s >= 0 else limit for s, limit in zip(steps, limits, strict=True)) / len(steps)


def population_std(values) -> float:
    """Standard deviation with n in the denominator: reward variance over the robots of one episode."""
    mean = math.fsum(values) / len(values)
    return math.sqrt(math.fsum((v - mean) ** 2 for v in values) / len(values))


def path_length(positions) -> float:
    """Length [m] of a polyline of (x, y)."""
    return math.fsum(math.dist(a, b) for a, b in zip(positions, positions[1:], strict=False))
