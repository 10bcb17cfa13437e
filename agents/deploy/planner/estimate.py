"""Where the maps of a team lie to each other, kept up to date from the maps themselves."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

from maexp.agents.deploy.planner.align import Alignment, align_grids
from maexp.agents.deploy.planner.frames import NOWHERE, OccupancyGrid, Pose, compose

ESTIMATE = ("estimate",)
"""Instead of offsets: they are estimated."""
AGAIN = 10.0  # seconds between two looks at a map: each takes a third of a second


class MapEstimate:
    """Places of maps in the frame of the first of them.

    A map that shares too little with those that are placed, or that fits in several places, waits. One that is placed
    is looked at again, and moves where the maps share more than when it was placed.

    Args:
        names: of the maps; the first that comes stays where it is.

    Attributes:
        places: poses of the frames of maps, by their names: x, y [m], yaw [rad].
    """

    def __init__(self, names: Iterable[Any]):
        self.names = tuple(names)
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self.places: dict[Any, Pose] = {}
        self.shared: dict[Any, float] = {}  # length of walls that a place rests on [m]
        self.looked: dict[Any, float] = {}  # when each was looked at last [s]

    def look(self, grids: Mapping[Any, OccupancyGrid], now: float) -> list[str]:
        """Place maps at `now` [s]; returns what is not known yet, or has changed, in sentences."""
        notes: list[str] = []
        for name in (name for name in self.names if name in grids):
            if not self.places:
                self.places[name], self.shared[name] = NOWHERE, math.inf
            if self.shared.get(name, 0.0) < math.inf and not 0.0 <= now - self.looked.get(name, -math.inf) < AGAIN:
                self.looked[name] = now
                notes += self._place(name, grids)
            if name not in self.places:
                notes.append(f"{name}: where it lies is not known yet: it shares too little with the other maps")
        return notes

    def _place(self, name: Any, grids: Mapping[Any, OccupancyGrid]) -> list[str]:
        found: tuple[Alignment, Pose] | None = None
        for other, place in self.places.items():
            if other == name or other not in grids:
                continue
            alignment = align_grids(grids[other], grids[name])
            if alignment is not None and (found is None or alignment.shared > found[0].shared):
                found = alignment, compose(place, alignment.pose)
        if found is None or found[0].shared <= self.shared.get(name, 0.0):
            return []
        self.places[name], self.shared[name] = found[1], found[0].shared
        x, y, yaw = found[1]
        return [f"{name} lies at {x:.2f} {y:.2f} {yaw:.3f}, confidence {found[0].confidence:.2f}"]
