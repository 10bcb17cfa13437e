"""Values of occupancy grids that follow another convention than 0 to 100; NumPy only."""

from __future__ import annotations

import numpy as np


def read_ones(values: np.ndarray, notes: list[str], name: str = "grid") -> np.ndarray:
    """A grid of -1, 0 and 1, in which 1 is occupied, as one of -1, 0 and 100; any other grid as it is.

    The definition of `nav_msgs/OccupancyGrid` is often read as that. As percentages, a grid of nothing above 1 would be
    free everywhere, so its ones are taken as occupied.

    Args:
        values: numbers of any shape; -1, and whatever else lies outside of 0 to 100, is unknown.
        notes: a sentence is added if ones were taken as occupied.
        name: what the note calls the grid.
    """
    ones = values == 1
    count = int(np.count_nonzero(ones))
    if not count or ((values > 0) & (values <= 100) & ~ones).any():
        return values
    notes.append(f"{name}: {count} cells hold 1 and none more: 1 was taken as occupied; give 0 to 100 (occupied: 100)")
    return np.where(ones, values.dtype.type(100), values)
