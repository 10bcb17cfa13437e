"""Teams that plan tours: every frontier target gets a place on the tour of one robot, and each goes to its first stop.

Open vehicle routing over the targets, as TARE (Cao et al. 2021) and RACER (Zhou et al. 2023) plan: targets are inserted
one after another where that costs least; then stops are moved and parts of tours reversed (2-opt) as long as that
helps. `Tours` makes the longest tour short, `GainTours` wants to see much soon. Both plan anew at every decision.
"""

import numpy as np

from maexp.agents.deploy.planner.arena_policy import TeamAgent
from maexp.agents.deploy.planner.grid_search import flood
from maexp.agents.deploy.planner.scene import CHOICES
from maexp.kernels.constants import STRAIGHT, UNREACHED

MOST = 40  # targets on tours, those with the most to see; planning takes about 20 ms then
PASSES = 4  # at most so many rounds of improvement
FADE = 4.0  # radar ranges of way after which what is to be seen counts 1 / e


class Ways:
    """Lengths of ways on the known grid of a scene [radar ranges], and what tours along them cost."""

    def __init__(self, scene, fades):
        between = flood(scene.passable[0], scene.targets.cell).reshape(len(scene.targets.cell), -1)
        between = between[:, scene.targets.cell] * (scene.cell / STRAIGHT / scene.radar_range)
        self.first = np.where(np.isfinite(scene.travel), scene.travel / scene.radar_range, UNREACHED).tolist()
        self.between, self.gain, self.fades = between.tolist(), scene.gain.tolist(), fades

    def cost(self, robot, tour):
        """Its length; or what is to be seen, less the later."""
        way = seen = 0.0
        for place, stop in enumerate(tour):
            way += self.between[tour[place - 1]][stop] if place else self.first[robot][stop]
            seen += self.gain[stop] * 2.718281828 ** (-way / FADE)
        return -seen if self.fades else way

    def whole(self, costs):
        """What all tours cost: the longest, then the sum; or the sum."""
        return sum(costs) if self.fades else max(costs) + 0.01 * sum(costs)


def insertions(tours, stop):
    """(robot, its tour with a stop more) for every place."""
    for robot, tour in enumerate(tours):
        for place in range(len(tour) + 1):
            yield robot, [*tour[:place], stop, *tour[place:]]


def insert(ways, tours, costs, stop):
    """Puts a stop where that costs least."""

    def whole(option):
        robot, tour = option
        return ways.whole([*costs[:robot], ways.cost(robot, tour), *costs[robot + 1 :]])

    robot, tour = min(insertions(tours, stop), key=whole)
    tours[robot], costs[robot] = tour, ways.cost(robot, tour)


def reverse_parts(ways, tours, costs):
    """2-opt: turns parts of tours round where that is better."""
    for robot, tour in enumerate(tours):
        for i in range(len(tour)):
            for j in range(i + 2, len(tour) + 1):
                other = tours[robot][:i] + tours[robot][i:j][::-1] + tours[robot][j:]
                if (cost := ways.cost(robot, other)) < costs[robot] - 1e-9:
                    tours[robot], costs[robot] = other, cost


def plan(scene, fades):
    """The tours of a team through all targets that it gets to, lists of targets."""
    ways, reached = Ways(scene, fades), np.isfinite(scene.travel)
    stops = np.flatnonzero(reached.any(0))
    stops = np.sort(stops[np.argsort(-scene.gain[stops], kind="stable")[:MOST]])
    nearest = np.where(reached, scene.travel, np.inf).min(0)[stops]
    tours = [[] for _ in scene.travel]
    costs = [0.0] * len(tours)
    for stop in stops[np.argsort(nearest if fades else -nearest, kind="stable")].tolist():
        insert(ways, tours, costs, stop)
    for _ in range(PASSES):
        before = ways.whole(costs)
        reverse_parts(ways, tours, costs)
        for stop in stops.tolist():
            robot = next(robot for robot, tour in enumerate(tours) if stop in tour)
            tours[robot] = [other for other in tours[robot] if other != stop]
            costs[robot] = ways.cost(robot, tours[robot])
            insert(ways, tours, costs, stop)
        if ways.whole(costs) > before - 1e-9:
            break
    return tours


def rank_by_tours(scene, fades):
    """What each robot thinks of each target: its own stops in their order, then the others, the nearest first."""
    score = np.where(np.isfinite(scene.travel), -1e6 - scene.travel, -np.inf)
    for robot, tour in enumerate(plan(scene, fades)):
        score[robot, tour] = -np.arange(len(tour))
    return np.where(np.isfinite(scene.travel), score, -np.inf)


CHOICES["tours"] = lambda scene: rank_by_tours(scene, fades=False)
CHOICES["gain_tours"] = lambda scene: rank_by_tours(scene, fades=True)


class Tours(TeamAgent):
    def __init__(self):
        super().__init__("tours")


class GainTours(TeamAgent):
    def __init__(self):
        super().__init__("gain_tours")
