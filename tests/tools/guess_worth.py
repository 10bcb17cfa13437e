"""What a better guess of the unknown is worth to a search: `lookahead` plays in worlds that hold the truth within some
radar ranges of what its team knows, and free ground beyond.

    python tests/tools/guess_worth.py RANGES policy=cost_utility,lookahead scenario=indoor_medium ...

`RANGES`, as 0.5, 2 or inf, is the distance; the rest is as for `maexp evaluate`. A reference that cheats.
"""

import math
import sys

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt

from maexp.agents.cli import main
from maexp.agents.policies import rollouts
from maexp.envs.imagined.maps import FULL, Beliefs
from maexp.kernels.constants import FREE, OBSTACLE


class TruthNearby(Beliefs):
    """Worlds that hold the truth as far as `reach` radar ranges from what is known."""

    reach = math.inf

    def __init__(self, env, teams, copies, nav, unknown=None):
        super().__init__(env, teams, copies, nav, unknown=lambda known: known)
        grids, begin = self.true_grids, env.bank.arrays["free_begin"]
        walls = env.bank.arrays["boundary_begin"]
        self.truth = [self._truth(grids, m, begin, walls) for m in range(len(begin) - 1)]

    def _truth(self, grids, m: int, begin: np.ndarray, walls: np.ndarray) -> np.ndarray:
        """What stands in the cells of a map, bool [H, W]: whether it is free."""
        width, height = int(grids.width.numpy()[m]), int(grids.height.numpy()[m])
        free = np.zeros(width * height, bool)
        free[grids.free_cell.numpy()[begin[m] : begin[m + 1]]] = True
        free[grids.boundary_cell.numpy()[walls[m] : walls[m + 1]]] = False
        stand_in = grids.stand_in.numpy()[grids.cell_begin.numpy()[m] : grids.cell_begin.numpy()[m + 1]]
        return np.where(stand_in >= 0, free[stand_in.clip(0)], False).reshape(height, width)

    def _guess(self, count: int) -> None:
        place = self.place[:count].tolist()
        for world, m in enumerate(place):
            width, height, margin = (int(getattr(self.sizes, name)[m]) for name in ("width", "height", "margin"))
            inner = (height - 2 * margin, width - 2 * margin)
            known = self.known[world, : math.prod(inner)].view(inner).numpy()
            known, truth = np.pad(known, margin), np.pad(self.truth[m], margin)
            away = distance_transform_edt(known != FREE)
            reach = self.reach * self.nav.radar_range / float(self.sizes.edge[m])
            chance = np.where(away <= reach, truth, True)
            chance = np.where(known == FREE, True, np.where(known == OBSTACLE, False, chance))
            guess = torch.from_numpy(np.where(chance, FREE, OBSTACLE).astype(np.uint8)).flatten()
            self.guess[world, : width * height] = guess
            self.worth[world, : width * height] = torch.from_numpy((FULL * chance).astype(np.uint8)).flatten()


if __name__ == "__main__":
    TruthNearby.reach = float(sys.argv[1])
    rollouts.Beliefs = TruthNearby
    sys.exit(main(["evaluate", *sys.argv[2:]]))
