"""Radars that miss returns or give false ones, by definition: plain loops; of ours the numbers of `oracle.radio`."""

from scipy.stats import norm

from oracle.radio import uniform


def chance(missed: float, noise: float, spacing: float) -> float:
    """Probability of a return whose range [m] is off by less than half the spacing of the points."""
    half = 0.5 * spacing
    return (1.0 - missed) * (norm.cdf(half / noise) - norm.cdf(-half / noise) if noise > 0.0 else 1.0)


class Looker:
    """One robot of an episode on a map of so many points: free ones first, then boundary points.

    Attributes:
        returns: of every point, those up to the one that made it known; less the false ones.
        known: points.
        walls: free points that it takes for walls.
    """

    def __init__(
        self,
        seed: int,
        env: int,
        episode: int,
        robot: int,
        points: int,
        chance: float,
        needed: int,
        false_alarm: float = 0.0,
        free: int = 0,
        robots: int = 1,
    ):
        self.key, self.robot, self.points = (seed, env, episode), robot, points
        self.chance, self.needed = chance, needed
        self.false_alarm, self.free, self.robots = false_alarm, free, robots
        self.returns, self.known, self.walls = [0] * points, set(), set()

    def draw(self, step: int, row: int, point: int) -> float:
        return uniform(*self.key, step, -1 - row * self.points - point)

    def look(self, view, step: int) -> set[int]:
        """Of the points in view in a scan (0: that of the reset), those that give a return and are known now."""
        found = set()
        for point in view:
            if point < self.free and self.draw(step, self.robots + self.robot, point) < self.false_alarm:
                if point not in self.known:
                    self.returns[point] = max(self.returns[point] - 1, -self.needed)
                    if self.returns[point] == -self.needed:
                        self.walls.add(point)
            elif self.draw(step, self.robot, point) < self.chance:
                self.returns[point] += point not in self.known
                if self.returns[point] >= self.needed:
                    self.known.add(point)
                if point in self.known:
                    found.add(point)
            if self.returns[point] == 0:
                self.walls.discard(point)
        return found
