"""The classical planners: what robots think of targets, for tensors of many teams as for NumPy arrays of one.

A planner is a function of a scene and a row of `CLASSICAL`. Scenes are `maexp.envs.targets.tracker.TensorScene`, in
torch, and `maexp.agents.deploy.planner.scene.ArrayScene`, in NumPy; `Scene` here says what both give. `scene.xp` is the
array
library: use what torch and NumPy call by the same name. Imports neither torch nor Warp.

Sources: docs/planners.md.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

Array = Any  # a torch tensor or a NumPy array

BETA = 0.03  # weight of a radar range of travel against a whole disc of unknown cells
LEAST_GAIN = 0.3  # targets with less to see, as a share of the radar's disc, are hardly worth a way of their own
RRT_SAMPLES = 512
RRT_HYSTERESIS = 1.5  # rrt_frontiers: gain of targets within a radar range counts this much more
DECAY = 1.0  # potential_field: a target pulls with its frontier cells over its way to this power
REPULSION = 1.0  # potential_field: push of a robot one radar range away, in pulls of a target there
WAY_AHEAD = 3.0  # cells from a robot to the point that tells where its way begins
FAR = 1e5  # longer than any way [m]: puts targets that a robot takes for want of better ones behind all others

# Weights of multi_criteria, in discs of unknown cells (docs/reports/planners.md).
WAY = 0.2  # taken off for log(1 + radar ranges of travel): the first metres of a way count most
BEYOND = 0.3  # for each radar range from the target to the middle of what is to be seen: open ground before corners
APART = 0.06  # for each radar range to the nearest target that another robot wants
FARTHEST = 4.0  # radar ranges up to which that distance counts


class Scene(Protocol):
    """What targets are chosen from. N robots, K targets each; lengths in metres; `...` are the teams, where there are
    several.

    Attributes:
        xp: torch or numpy.
        radar_range: how far robots see.
        cell: edge of a cell of the grid, float or [..., 1, 1].
        at: [..., N, 2], where the robots are.
        alive: bool [..., N], robots that still move.
        travel: [..., N, K], way from robot to target; infinite where there is none.
        points: [..., N, K, 2] or [K, 2], where the targets are.
        size: [..., N, K] or [K], frontier cells behind each.
        gain: [..., N, K] or [K], unknown cells in radar range and sight of each, as a share of the radar's disc.
        middle: [..., N, K, 2] or [K, 2], the middle of those, from the target.
    """

    xp: Any
    radar_range: float
    cell: Any
    at: Array
    alive: Array
    travel: Array
    points: Array
    size: Array
    gain: Array
    middle: Array

    def ways_ahead(self, cells: float) -> Array:
        """[..., N, K, 2], from each robot to the point so many cells along its way to each target."""

    def total(self, values: Array) -> Array:
        """Sum over the targets, [..., N, K, *] -> [..., N, *]."""

    def in_turn(self, gain: Array, value: Array) -> Array:
        """[..., N, K], what targets are worth when it is their robot's turn, after those that it hears have chosen
        (`maexp.envs.targets.tracker.plan_in_turn`)."""

    def match(self, among: Array) -> Array:
        """bool [..., N, K]: different targets `among` those given for all robots, with the least total way; a robot
        plans for those that it hears."""

    def heard(self, values: Array, blank: Any) -> Array:
        """Values [..., N, *] of the robots that each one hears, `blank` for the others, [..., N, N, *]; [..., 1, N, *]
        where all hear all."""

    def found_by_trees(self, samples: int, branch: float) -> Array:
        """bool, to be broadcast to [..., N, K]: targets that random trees come upon, with branches of at most so many
        metres."""


def value_targets(scene: Scene) -> Array:
    """What every target is worth to every robot by itself, in radar discs, [..., N, K]; -inf: out of reach.

    Unknown area against the way there (Burgard et al. 2005).
    """
    return scene.gain - BETA * scene.travel / scene.radar_range


def rank_nearest(scene: Scene) -> Array:
    """Each robot its nearest target (Yamauchi 1997)."""
    return rank(scene, -scene.travel, worthwhile(scene))


def rank_by_utility(scene: Scene) -> Array:
    """Unknown area around the target against the way there; a target taken lowers what others near it offer."""
    return _rank_in_turn(scene, scene.gain, value_targets(scene), scene.xp.isfinite(scene.travel))


def rank_by_criteria(scene: Scene) -> Array:
    """A weighted sum of criteria: what is to be seen, the way there, what lies beyond, how far the others stay.

    In the manner of Basilico and Amigoni (2011). Robots choose in turn as in `rank_by_utility`; then each keeps away
    from where the others would go.
    """
    xp, some = scene.xp, scene.xp.isfinite(scene.travel)
    travel = xp.where(some, scene.travel, 0.0) / scene.radar_range
    beyond = xp.linalg.norm(scene.middle, axis=-1) / scene.radar_range
    value = scene.gain - WAY * xp.log1p(travel) + BEYOND * beyond
    score = scene.in_turn(scene.gain, xp.where(some, value, -xp.inf))
    return rank(scene, score + APART * _gap_to_plans(scene, score, some), some)


def rank_by_tree(scene: Scene) -> Array:
    """Of the frontiers that random trees come upon, the best revenue (Umari and Mukhopadhyay 2017)."""
    xp = scene.xp
    found = scene.found_by_trees(RRT_SAMPLES, 0.5 * scene.radar_range) & xp.isfinite(scene.travel)
    found = found | ~xp.any(found, axis=-1, keepdims=True)  # no tree of the team found any: all frontiers count
    near = xp.linalg.norm(scene.points - scene.at[..., None, :], axis=-1) <= scene.radar_range
    gain = xp.where(near, RRT_HYSTERESIS * scene.gain, scene.gain)
    return _rank_in_turn(scene, gain, value_targets(scene) + gain - scene.gain, found)


def rank_by_area(scene: Scene) -> Array:
    """The nearest target that no other robot is nearer to; the nearest of all for robots without one (Voronoi)."""
    xp, worth = scene.xp, worthwhile(scene)
    travel = xp.where(worth & scene.alive[..., None], scene.travel, xp.inf)
    heard = scene.heard(travel, xp.inf)
    least = heard == xp.amin(heard, axis=-2, keepdims=True)
    first = least & (xp.cumsum(least, axis=-2) == 1)  # of robots equally near the first
    mine = of_each(xp, first) & xp.isfinite(travel)
    mine = mine | ~xp.any(mine, axis=-1, keepdims=True)
    return rank(scene, xp.where(mine, -travel, -FAR - travel), worth)


def rank_by_assignment(scene: Scene) -> Array:
    """All robots different targets with the least total way (Hungarian method); surplus robots the nearest."""
    worth = worthwhile(scene)
    return rank(scene, scene.xp.where(scene.match(worth), FAR, -scene.travel), worth)


def rank_by_force(scene: Scene) -> Array:
    """The target whose way starts off closest to the force: pulls along the ways, pushes between robots.

    As in MMPF (Yu et al. 2021) a target pulls with its frontier cells over the way to it, around the walls.
    """
    xp, worth = scene.xp, worthwhile(scene)
    ways = scene.ways_ahead(WAY_AHEAD)
    ways = ways / _length(xp, ways)
    pull = xp.where(worth, scene.size / xp.clip(scene.travel / scene.cell, 1.0, None) ** DECAY, 0.0)
    force = scene.total(pull[..., None] * ways)
    apart = scene.at[..., :, None, :] - scene.at[..., None, :, :]
    gap = _length(xp, apart)
    push = REPULSION * xp.clip(1.0 - gap / scene.radar_range, 0.0, None) * scene.heard(scene.alive[..., None], False)
    force = force + scene.total(pull)[..., None] * xp.sum(push * apart / gap, axis=-2)
    along = xp.sum(ways * force[..., None, :], axis=-1) / _length(xp, force)
    return rank(scene, pull * (1.0 + along), worth)


def _gap_to_plans(scene: Scene, score: Array, some: Array) -> Array:
    """From each target to the nearest one that another robot would take by the `score` [radar ranges], at most
    `FARTHEST`, [..., N, K]."""
    xp = scene.xp
    score = xp.where(some, score, -xp.inf)
    best = some & (score == xp.amax(score, axis=-1, keepdims=True))
    best = best & (xp.cumsum(best, axis=-1) == 1)  # of equals the first
    plan = xp.sum(xp.where(best[..., None], scene.points, 0.0), axis=-2)
    plan = xp.where(xp.any(some, axis=-1)[..., None], plan, xp.inf)
    plans = scene.heard(plan, xp.inf)[..., None, :, :]  # [..., N or 1, 1, N, 2]
    gap = xp.linalg.norm(scene.points[..., None, :] - plans, axis=-1) / scene.radar_range
    number = xp.cumsum(scene.alive | True, axis=-1)
    others = number[..., :, None] != number[..., None, :]
    return xp.clip(xp.amin(xp.where(others[..., :, None, :], gap, xp.inf), axis=-1), None, FARTHEST)


def of_each(xp: Any, values: Array) -> Array:
    """What is each robot's own of values in the team of those that it hears: `Scene.heard` -> [..., N, K]."""
    index = xp.arange(values.shape[-2])
    return values[..., 0, :, :] if values.shape[-3] == 1 else values[..., index, index, :]


def _length(xp: Any, vectors: Array) -> Array:
    """Never 0, [..., 1]."""
    return xp.clip(xp.linalg.norm(vectors, axis=-1, keepdims=True), 1e-6, None)


def _rank_in_turn(scene: Scene, gain: Array, value: Array, among: Array) -> Array:
    """The values of the targets `among` all when it is their robot's turn."""
    value = scene.xp.where(among, value, -scene.xp.inf)
    return rank(scene, scene.in_turn(gain, value), among)


def worthwhile(scene: Scene) -> Array:
    """Targets in reach, bool [..., N, K]; those that offer little only for robots that get to none that offers more."""
    reached = scene.xp.isfinite(scene.travel)
    worth = reached & (scene.gain >= LEAST_GAIN)
    return scene.xp.where(scene.xp.any(worth, axis=-1, keepdims=True), worth, reached)


def rank(scene: Scene, score: Array, among: Array) -> Array:
    """Targets by their `score` where they are `among` those that count, the others in reach behind, -inf the rest."""
    xp, reached = scene.xp, scene.xp.isfinite(scene.travel)
    return xp.where(among & reached, score, xp.where(reached, -2.0 * FAR - scene.travel, -xp.inf))


CLASSICAL: dict[str, Callable[[Scene], Array]] = {
    "nearest_frontier": rank_nearest,
    "cost_utility": rank_by_utility,
    "multi_criteria": rank_by_criteria,
    "potential_field": rank_by_force,
    "rrt_frontiers": rank_by_tree,
    "voronoi": rank_by_area,
    "hungarian": rank_by_assignment,
}
"""Name -> what each robot thinks of each target, [..., N, K]: it wants the highest; -inf: out of reach."""
