"""Metrics of an episode and of many (docs/concepts.md, Metrics), from the values after every local step."""

import math


def mean_coverage(coverages, length: int) -> float:
    """Mean over `length` local steps; coverages[k] is the coverage after k steps, and after its last the last stays."""
    return math.fsum(coverages[min(step, len(coverages) - 1)] for step in range(1, length + 1)) / length


def path_length(positions) -> float:
    """Length [m] of a polyline of (x, y)."""
    return math.fsum(math.dist(a, b) for a, b in zip(positions, positions[1:], strict=False))
