"""Robot by robot, the nearest open cell beside unknown ground that no robot before it goes near."""

import numpy as np


def near(cells):
    """The cells and their eight neighbours."""
    wide = np.pad(cells, 1)
    height, width = cells.shape
    return np.any([wide[y : y + height, x : x + width] for y in range(3) for x in range(3)], axis=0)


class Nearest:
    def reset(self, episode):
        self.reach = episode["radar_range"]

    def act(self, observation):
        goals = np.full((len(observation["alive"]), 2), np.nan)  # NaN: the robot stays
        for robot in np.flatnonzero(observation["alive"]):
            grid, own = observation["grid"][robot], observation["poses"][robot, robot, :2]
            cells = np.argwhere((grid == 0) & near(grid == -1) & ~near(near(grid == 100)))[:, ::-1]  # x, y
            points = observation["origin"] + (cells + 0.5) * observation["resolution"]
            for place in [own, *goals[:robot]]:
                apart = np.hypot(*(points - place).T) > 0.7 * self.reach
                points = points[apart] if apart.any() else points
            if len(points):
                goals[robot] = points[np.hypot(*(points - own).T).argmin()]
        return goals
