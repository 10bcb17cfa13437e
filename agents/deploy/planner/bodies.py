"""Team mates that SLAM has drawn as obstacles: cells where a robot stands, or has stood, are no walls."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import replace

import numpy as np
from scipy.ndimage import label

from maexp.agents.deploy.planner.grid import KnownGrid
from maexp.agents.deploy.planner.grid_search import CORNERS
from maexp.agents.deploy.planner.team import Team
from maexp.kernels.constants import FREE, OBSTACLE

INNER = 0.5  # radii around its centre that a body covers for certain
FARTHEST = 4.0  # radii between two calls within which a robot has driven straight


class BodyTrails:
    """Where the robots of a team have been."""

    def __init__(self):
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self.last: dict[Hashable, np.ndarray] = {}
        self.places: dict[tuple[int, int], tuple[float, float, float]] = {}  # x, y, radius [m], half a radius apart

    def look(self, team: Team) -> None:
        """Note where the robots are now, and what lies between that and where they were."""
        for name, at, radius in zip(team.names, team.at, team.radius, strict=True):
            if not np.isfinite(at).all():
                continue
            before = self.last.get(name, at)
            gap = float(np.linalg.norm(at - before))
            steps = int(gap / (0.5 * radius)) + 1 if gap <= FARTHEST * radius else 1
            for share in np.arange(1, steps + 1) / steps:
                x, y = before + share * (at - before)
                key = (round(x / (0.5 * radius)), round(y / (0.5 * radius)))
                self.places.setdefault(key, (float(x), float(y), float(radius)))
            self.last[name] = at.copy()

    def clear(self, grid: KnownGrid) -> KnownGrid:
        """The grid without the robots: what their bodies have covered for certain is free, and so are obstacles that
        lie where they were as a whole. A wall that goes on beyond that stays."""
        if len(self.last) < 2 or not self.places:
            return grid
        places = np.array(list(self.places.values()))
        wide = self._cover(grid, places, places[:, 2] + grid.cell) & (grid.known == OBSTACLE)
        if not wide.any():
            return grid
        parts, count = label(grid.known == OBSTACLE, CORNERS)
        beyond = np.zeros(count + 1, bool)
        beyond[np.unique(parts[~wide])] = True
        ghosts = wide & (~beyond[parts] | self._cover(grid, places, INNER * places[:, 2]))
        return replace(grid, known=np.where(ghosts, np.uint8(FREE), grid.known)) if ghosts.any() else grid

    @staticmethod
    def _cover(grid: KnownGrid, places: np.ndarray, reach: np.ndarray) -> np.ndarray:
        """Cells whose middles lie within `reach` [n] of places [n, 2 and more] [m], bool [H, W]."""
        found = np.zeros(grid.known.shape, bool)
        at = grid.from_map(places[:, :2]) / grid.cell
        for cells in np.unique(reach / grid.cell):
            size = int(cells) + 1
            span = np.arange(-size, size + 1)
            base = np.floor(at[reach / grid.cell == cells]).astype(np.int64)
            rest = at[reach / grid.cell == cells] - base - 0.5
            dx = span[None, None, :] - rest[:, 0, None, None]
            dy = span[None, :, None] - rest[:, 1, None, None]
            which, row, column = np.nonzero(dx**2 + dy**2 <= cells**2)
            x, y = base[which, 0] + span[column], base[which, 1] + span[row]
            inside = (x >= 0) & (x < grid.width) & (y >= 0) & (y < grid.height)
            found[y[inside], x[inside]] = True
        return found
