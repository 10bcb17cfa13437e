"""People who walk from place to place and wait for whoever stands in their way."""

from __future__ import annotations

import numpy as np
from skimage.graph import MCP_Geometric

from .floor import FloorCells

PERSON_RADIUS, PERSON_SPEED = 0.25, 0.8  # [m], [m/s]
POLITE = 0.8  # [m] to the edge of another before a person stops
PATIENCE = 2.0  # [s] until a person who waits goes elsewhere
CHOICES = 4  # ways that a person thinks of
FAR = 6.0  # [m] from robots at the start


class Walkers:
    """Places of people [m], [count, 2], and the ways they are on.

    Args:
        floor: where they walk.
        count: how many.
        robots: starts [m], [N, 2], that they keep away from.
        rng: chooses where they start and where they go.
    """

    def __init__(self, floor: FloorCells, count: int, robots: np.ndarray, rng: np.random.Generator):
        self.floor, self.rng = floor, rng
        self.roomy = floor.roomy(PERSON_RADIUS + 0.1)
        cells = np.argwhere(self.roomy)
        away = np.linalg.norm(floor.centre(cells)[:, None] - robots, axis=-1).min(axis=1)
        cells = cells[away >= min(FAR, 0.5 * away.max())] if count else cells[:0]
        if count > len(cells):
            raise ValueError(f"people={count} find no room on this floor: ask for fewer")
        self.places = floor.centre(cells[rng.choice(len(cells), count, replace=False)]) if count else np.empty((0, 2))
        self.ways: list[np.ndarray] = [np.empty((0, 2))] * count
        self.waited = np.zeros(count)

    def step(self, robots: np.ndarray, dt: float) -> np.ndarray:
        """Velocities [m/s] of all for the next `dt` [s], [count, 2]."""
        walks = np.zeros_like(self.places)
        for i, place in enumerate(self.places):
            if not len(self.ways[i]) or self.waited[i] > PATIENCE:
                self.ways[i], self.waited[i] = self._way_out(place, robots), 0.0
            while len(self.ways[i]) and np.linalg.norm(self.ways[i][0] - place) < 0.15:
                self.ways[i] = self.ways[i][1:]
            if not len(self.ways[i]):
                continue
            ahead = self.ways[i][0] - place
            ahead /= np.linalg.norm(ahead)
            others = np.concatenate([robots, np.delete(self.places, i, axis=0)]) - place
            distance = np.linalg.norm(others, axis=1)
            blocked = ((others @ ahead > 0.3 * distance) & (distance < POLITE + PERSON_RADIUS)).any()
            self.waited[i] = self.waited[i] + dt if blocked else 0.0
            walks[i] = 0.0 if blocked else PERSON_SPEED * ahead
        return walks

    def _way_out(self, place: np.ndarray, robots: np.ndarray) -> np.ndarray:
        """Of some ways the one that begins most away from the nearest robot."""
        ways = [way for way in (self._way(place) for _ in range(CHOICES)) if len(way)]
        away = place - robots[np.linalg.norm(robots - place, axis=1).argmin()]
        return max(ways, key=lambda way: (way[min(len(way), 3) - 1] - place) @ away, default=np.empty((0, 2)))

    def _way(self, place: np.ndarray) -> np.ndarray:
        """Corners [m] of the shortest way to somewhere else."""
        cells = np.argwhere(self.roomy)
        goal = cells[self.rng.integers(len(cells))]
        costs = np.where(self.roomy, 1.0, np.where(self.floor.free, 20.0, -1.0))
        start = self.floor.index(place)
        search = MCP_Geometric(costs)
        search.find_costs([tuple(start)], [tuple(goal)])
        try:
            return self.floor.centre(np.array(search.traceback(tuple(goal)))[1:])
        except ValueError:  # not to be reached
            return np.empty((0, 2))
