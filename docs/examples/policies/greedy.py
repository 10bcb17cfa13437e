"""Each robot for itself to the frontier of least cost: the greedy planner of m-explore (explore_lite), written anew.

A frontier is a group of connected unknown cells beside free ground that the robot can get to. Its cost grows with its
distance and falls with its length; the robot goes to the free cell nearest to its centroid, and gives up frontiers that
it does not get nearer to. Ground within the robot's radius of a wall is not free, as on a costmap. Source: J. Hörner,
Map-merging for multi-robot system (2016), and the parameters of its package explore_lite.
"""

import numpy as np

AROUND = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if (y, x) != (0, 0)]
POTENTIAL, GAIN = 3.0, 1.0  # weights of distance and length
PATIENCE = 30.0  # a frontier is given up after so long without getting nearer [s]
SHORTEST, SAME = 0.05, 0.05  # a frontier, and between two that are the same; shares of the radar's range


def beside(cells):
    """Cells with one of `cells` above, below, left or right."""
    wide = np.pad(cells, 1)
    return wide[2:, 1:-1] | wide[:-2, 1:-1] | wide[1:-1, 2:] | wide[1:-1, :-2]


def reach(free, start):
    """Free cells that can be got to from `start` (y, x), or from the free cell nearest to it."""
    cells = np.argwhere(free)
    reached = np.zeros_like(free)
    if len(cells):
        reached[tuple(cells[((cells - start) ** 2).sum(1).argmin()])] = True
    while True:
        before = reached.sum()
        for _ in range(16):
            reached |= beside(reached) & free
        if reached.sum() == before:
            return reached


def frontiers(unknown, reached):
    """Frontiers as arrays of cells [n, 2] (y, x)."""
    left = set(map(tuple, np.argwhere(unknown & beside(reached)).tolist()))
    while left:
        found = [left.pop()]
        for y, x in found:  # grows while it is read
            near = [(y + dy, x + dx) for dy, dx in AROUND if (y + dy, x + dx) in left]
            left.difference_update(near)
            found += near
        yield np.array(found)


class Greedy:
    def reset(self, episode):
        self.radius = episode["robot_radius"]
        self.patience = max(PATIENCE, 5 * episode["decision_seconds"])
        self.shortest, self.same = SHORTEST * episode["radar_range"], SAME * episode["radar_range"]
        self.given_up = [[] for _ in range(episode["num_robots"])]
        self.sought = [(np.full(2, np.inf), np.inf, 0.0)] * episode["num_robots"]  # goal, least distance, since when

    def act(self, observation):
        goals = np.full((len(observation["alive"]), 2), np.nan)
        for robot in np.flatnonzero(observation["alive"]):
            goals[robot] = self.choose(robot, observation)
        return goals

    def choose(self, robot, observation):
        """The goal of a robot [m]; NaN: there is no frontier left."""
        own, cell = observation["poses"][robot, robot, :2], observation["resolution"]
        grid, corner = observation["grid"][robot], np.asarray(observation["origin"])
        walls = grid == 100
        for _ in range(int(np.ceil(self.radius / cell))):
            walls |= beside(walls)
        reached = reach((grid == 0) & ~walls, (own - corner)[::-1] / cell - 0.5)
        free = corner + (np.argwhere(reached)[:, ::-1] + 0.5) * cell
        options = []
        for cells in frontiers(grid == -1, reached):
            points, length = corner + (cells[:, ::-1] + 0.5) * cell, len(cells) * cell
            distance = np.hypot(*(points - own).T).min()
            if length >= self.shortest:
                options.append((POTENTIAL * distance - GAIN * length, distance, points.mean(0)))
        for _, distance, centre in sorted(options, key=lambda option: option[0]):
            if self.is_worth(robot, centre, distance, observation["time"]):
                return free[np.hypot(*(free - centre).T).argmin()]
        return np.nan

    def is_worth(self, robot, goal, distance, time):
        """Whether it was not given up, and is not to be now."""
        if any(np.hypot(*(goal - old)) < self.same for old in self.given_up[robot]):
            return False
        sought, least, since = self.sought[robot]
        if np.hypot(*(goal - sought)) > self.same or distance < least:
            self.sought[robot] = goal, distance, time
        elif time - since > self.patience:
            self.given_up[robot].append(goal)
            return False
        return True
