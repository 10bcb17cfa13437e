"""What a team has really seen: by true poses, whatever the robots believe."""

from __future__ import annotations

import numpy as np

from maexp.envs import PointCloudMap

from .mapping import TeamGrid
from .simulator import Scan


class Coverage:
    """Free points of a map that beams have passed.

    Args:
        world: whose points count.
    """

    def __init__(self, world: PointCloudMap):
        self.points = world.free[:, :2].astype(np.float64)
        self.weight = world.free_spacing.astype(np.float64) ** 2
        self.seen = np.zeros(len(self.points), bool)

    def add(self, pose: np.ndarray, scan: Scan, reach: float) -> None:
        """Points within `reach` [m] that the nearest beam of a robot at `pose` went past."""
        left = np.flatnonzero(~self.seen)
        offset = self.points[left] - pose[:2]
        distance = np.hypot(offset[:, 0], offset[:, 1])
        near = distance <= reach
        left, offset, distance = left[near], offset[near], distance[near]
        angle = np.arctan2(offset[:, 1], offset[:, 0]) - pose[2] - scan.angles[0]
        beam = np.rint((angle % (2 * np.pi)) / (scan.angles[1] - scan.angles[0])).astype(int) % len(scan.angles)
        self.seen[left[distance <= scan.ranges[beam]]] = True

    @property
    def share(self) -> float:
        """Weight of what was seen / weight of all, as in our simulator."""
        return float(self.weight[self.seen].sum() / self.weight.sum())


def map_errors(grid: TeamGrid, world: PointCloudMap) -> float:
    """Share of the map's free points in known cells that the team's grid calls occupied."""
    cells = np.floor((world.free[:, :2] - grid.low) / grid.cell).astype(int)
    height, width = grid.touched.shape
    cells = cells[((cells >= 0) & (cells < (width, height))).all(axis=1)]
    values = grid.values()[cells[:, 1], cells[:, 0]]
    known = values >= 0
    return float((values[known] >= 50).mean()) if known.any() else 0.0
