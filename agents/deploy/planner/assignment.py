"""Assignment of targets to robots in NumPy, as the kernels do it: sequential choice and distinct targets."""

from __future__ import annotations

import numpy as np


def plan_in_turn(gain: np.ndarray, value: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Robots choose one after the other, the one with the most to win first; a target taken lowers the gain of others
    that can be seen from there (Burgard et al. 2005).

    Args:
        gain: float32 [n, M], what is to be seen from a candidate.
        value: float32 [n, M], what it is worth as long as nobody has claimed any of that; -inf: there is none.
        point: float [n, M, 2], where they are [radar ranges].

    Returns:
        each candidate's value when it is its robot's turn, float32 [n, M]; the candidate taken, int64 [n] (0 for robots
        without any); the share of the gain that was claimed before, float32 [n, M].
    """
    some = value > -np.inf
    rest = np.where(some, value, 0.0) - gain
    score, claimed, left = np.zeros_like(gain), np.zeros_like(gain), np.ones_like(gain)
    taken, waiting = np.zeros(len(gain), np.int64), np.any(some, axis=-1)
    while waiting.any():
        now = np.where(some & waiting[:, None], gain * left + rest, -np.inf)
        robot, k = np.unravel_index(now.argmax(), now.shape)
        score[robot], claimed[robot] = (gain * left + rest)[robot], 1.0 - left[robot]
        taken[robot], waiting[robot] = k, False
        gap = np.linalg.norm(point - point[robot, k], axis=-1)
        left = left * np.minimum(gap, 1.0).astype(np.float32)
    return score, taken, claimed


def share_targets(preference: np.ndarray, way: np.ndarray, points: np.ndarray, body: np.ndarray) -> np.ndarray:
    """Targets that are distinct and farther apart than the bodies of the robots that have them.

    A robot keeps what it wants where that is free. Of several that want the same, the one with the shortest way keeps
    it, and the others take what they like best of the rest. Where too little is left, who is there first has it.

    Args:
        preference: float [n, K], what each robot thinks of each target, the highest is what it wants; -inf: out of
            reach.
        way: float [n, K], from robot to target [m].
        points: float [K, 2], where the targets are [m].
        body: float [n], radii of the robots [m].

    Returns:
        int64 [n], -1 = none.
    """
    return DistinctTargets(preference, way, points, body).settle()


class DistinctTargets:
    """Who has which target, and what that leaves the others.

    Args:
        preference, way, points, body: as for `share_targets`.
        distinct: else all may have the same.

    Attributes:
        taken: int64 [n], the target of each robot; -1 = none.
    """

    def __init__(
        self, preference: np.ndarray, way: np.ndarray, points: np.ndarray, body: np.ndarray, distinct: bool = True
    ):
        self.preference, self.way, self.points, self.body, self.distinct = preference, way, points, body, distinct
        self.taken = np.full(len(preference), -1)

    @property
    def reached(self) -> np.ndarray:
        """Targets in reach, bool [n, K]."""
        return self.preference > -np.inf

    def settle(self) -> np.ndarray:
        """`taken`, after all have got what they can."""
        return self.settle_for(np.flatnonzero(self.reached.any(-1)))

    def settle_for(self, robots: np.ndarray) -> np.ndarray:
        """`settle` for some robots that have nothing yet, int [m], and get to targets."""
        wish = self.preference.argmax(-1) if self.preference.size else self.taken
        turns = robots[np.argsort(self.way[robots, wish[robots]], kind="stable")]
        for robot in turns:
            if self.free(robot)[wish[robot]]:
                self.taken[robot] = wish[robot]
        for robot in turns[self.taken[turns] < 0]:
            while robot >= 0:  # each finds a place for one more robot, or one that is nearer
                robot = self.find_place(robot)
        return self.taken

    def find_place(self, robot: int) -> int:
        """Give a robot what it likes best of what is free, or else what another one has; returns who has none now."""
        free = self.free(robot)
        if free.any():
            self.taken[robot] = np.where(free, self.preference[robot], -np.inf).argmax()
            return -1
        return self.take_over(robot)

    def free(self, robot: int) -> np.ndarray:
        """Targets in reach where the others leave room, bool [K]."""
        return self.reached[robot] & (self.holders(robot) == 0)

    def holders(self, robot: int) -> np.ndarray:
        """How many others leave a robot no room at each target, int64 [K]."""
        return sum((self.too_near(robot, j) for j in self.others(robot)), np.zeros(len(self.points), np.int64))

    def others(self, robot: int) -> list[int]:
        """Those that have a target, and leave this one no room there."""
        if not self.distinct:
            return []
        return [int(j) for j in np.flatnonzero(self.taken >= 0) if j != robot]

    def too_near(self, robot: int, other: int) -> np.ndarray:
        """Targets nearer to what another robot has than their bodies are wide, bool [K]."""
        gap = np.linalg.norm(self.points - self.points[self.taken[other]], axis=-1)
        return gap < self.body[robot] + self.body[other]

    def take_over(self, robot: int) -> int:
        """Give a robot, for whom nothing is free, the nearest target of one that can go elsewhere or has a longer way
        there; returns that one, -1: there is none."""
        own, offers = self.way[robot], []
        single = self.reached[robot] & (self.holders(robot) == 1)
        for other in self.others(robot):
            for target in np.flatnonzero(single & self.too_near(robot, other)).tolist():
                theirs = self.way[other, self.taken[other]]
                if (own[target], robot) < (theirs, other) or self.can_move(other, robot, target):
                    offers.append((own[target], target, other))
        if not offers:
            return -1
        _, target, other = min(offers)
        self.taken[other], self.taken[robot] = -1, target
        return other

    def can_move(self, other: int, robot: int, target: int) -> bool:
        """Whether something is left for a robot if another one takes its target."""
        before = self.taken.copy()
        self.taken[other], self.taken[robot] = -1, target
        found = self.free(other).any()
        self.taken = before
        return bool(found)
