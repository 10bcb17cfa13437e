"""Radars that miss returns by their definition: plain loops, nothing of ours but the numbers of `oracle.radio`."""

from scipy.stats import norm

from oracle.radio import uniform


def chance(missed: float, noise: float, spacing: float) -> float:
    """Probability of a return whose range [m] is off by less than half the spacing of the points."""
    half = 0.5 * spacing
    return (1.0 - missed) * (norm.cdf(half / noise) - norm.cdf(-half / noise) if noise > 0.0 else 1.0)


class Looker:
    """One robot of an episode on a map of so many points: free ones first, then boundary points.

    Attributes:
        returns: of every point, those up to the one that made it known.
        known: points.
    """

    def __init__(self, seed: int, env: int, episode: int, robot: int, points: int, chance: float, needed: int):
        self.key, self.robot, self.points = (seed, env, episode), robot, points
        self.chance, self.needed = chance, needed
        self.returns, self.known = [0] * points, set()

    def look(self, view, step: int) -> set[int]:
        """Of the points in view in a scan (0: that of the reset), those that give a return and are known now."""
        found = set()
        for point in view:
            if uniform(*self.key, step, -1 - self.robot * self.points - point) < self.chance:
                self.returns[point] += point not in self.known
                if self.returns[point] >= self.needed:
                    self.known.add(point)
                if point in self.known:
                    found.add(point)
        return found
