"""What robots think of targets: the classical planners of `maexp.agents.policies`, for one team in NumPy."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import linear_sum_assignment

from .frontiers import STRIDE
from .grid import FREE, UNKNOWN
from .scene import Scene
from .values import LEAST_GAIN, plan_in_turn, value_targets
from .ways import cells_ahead

RRT_SAMPLES = 512
RRT_HYSTERESIS = 1.5  # rrt_frontiers: gain of targets within a radar range counts this much more
DECAY = 1.0  # potential_field: a target pulls with its frontier cells over its way to this power
REPULSION = 1.0  # potential_field: push of a robot one radar range away, in pulls of a target there
UNREACHABLE = 1e12  # stands for no way where numbers must be finite [m]
FAR = 1e5  # longer than any way [m]: puts targets that a robot takes for want of better ones behind all others


def rank_nearest(scene: Scene) -> np.ndarray:
    """Each robot its nearest target (Yamauchi 1997)."""
    return rank(scene, -scene.travel, _worthwhile(scene))


def rank_by_utility(scene: Scene) -> np.ndarray:
    """Unknown area around the target against the way there; a target taken lowers what others near it offer."""
    gain = np.broadcast_to(scene.gain, scene.travel.shape)
    return _rank_in_turn(scene, gain, np.isfinite(scene.travel))


def _rank_in_turn(scene: Scene, gain: np.ndarray, among: np.ndarray) -> np.ndarray:
    """The values of the targets `among` all when it is their robot's turn (`plan_in_turn`)."""
    value = np.where(among, value_targets(gain, scene.travel, scene.radar_range), -np.inf)
    points = np.broadcast_to(scene.points / scene.radar_range, (*gain.shape, 2))
    return rank(scene, plan_in_turn(gain, value, points)[0], among)


def rank_by_area(scene: Scene) -> np.ndarray:
    """The nearest target that no other robot is nearer to; the nearest of all for robots without one (Voronoi)."""
    worth = _worthwhile(scene)
    travel = np.where(worth, scene.travel, np.inf)
    mine = worth & (travel.argmin(0) == np.arange(len(scene.at))[:, None])
    mine |= ~mine.any(-1, keepdims=True)
    return rank(scene, np.where(mine, -travel, -FAR - travel), worth)


def rank_by_assignment(scene: Scene) -> np.ndarray:
    """All robots different targets with the least total way (Hungarian method); surplus robots the nearest."""
    worth = _worthwhile(scene)
    score = -scene.travel
    robot, target = linear_sum_assignment(np.where(worth, scene.travel, UNREACHABLE))
    score[robot, target] = FAR
    return rank(scene, score, worth)


def rank_by_force(scene: Scene) -> np.ndarray:
    """The target whose way starts off closest to the force: pulls along the ways, pushes between robots.

    As in MMPF (Yu et al. 2021) a target pulls with its frontier cells over the way to it, around the walls.
    """
    worth = _worthwhile(scene)
    cells = np.tile(scene.targets.cell, (len(scene.at), 1))
    first = cells_ahead(scene.passable, scene.distance, cells, 3.0)
    ways = scene.grid.centers(np.maximum(first, 0)) - scene.at[:, None]
    ways /= np.maximum(np.linalg.norm(ways, axis=-1, keepdims=True), 1e-6)
    with np.errstate(invalid="ignore"):
        pull = np.where(worth, scene.targets.size / np.maximum(scene.travel / scene.grid.cell, 1.0) ** DECAY, 0.0)
    force = (pull[..., None] * ways).sum(1)
    apart = scene.at[:, None] - scene.at
    gap = np.maximum(np.linalg.norm(apart, axis=-1, keepdims=True), 1e-6)
    push = REPULSION * np.maximum(1.0 - gap / scene.radar_range, 0.0)
    force += pull.sum(-1, keepdims=True) * (push * apart / gap).sum(1)
    along = (ways * force[:, None]).sum(-1) / np.maximum(np.linalg.norm(force, axis=-1, keepdims=True), 1e-6)
    return rank(scene, pull * (1.0 + along), worth)


def rank_by_tree(scene: Scene) -> np.ndarray:
    """Of the frontiers that random trees come upon, the best revenue (Umari and Mukhopadhyay 2017)."""
    ends = _grow_trees(scene)
    shift = scene.targets.block_of(ends % scene.grid.width, ends // scene.grid.width)
    found = (scene.targets.block[:, None] == shift).all(-1).any(1) & np.isfinite(scene.travel)
    found |= ~found.any(-1, keepdims=True)  # no tree of the team found any: all frontiers count
    near = np.linalg.norm(scene.points - scene.at[:, None], axis=-1) <= scene.radar_range
    gain = (scene.gain * np.where(near, RRT_HYSTERESIS, 1.0)).astype(np.float32)
    return _rank_in_turn(scene, gain, found & np.isfinite(scene.travel))


def _grow_trees(scene: Scene) -> np.ndarray:
    """Free cells where the branches of the robots' trees left what is known, int64 [n].

    All trees grow at once, and x + iy stands for a place in cells: what this takes is mostly the number of calls.
    """
    grid, robots = scene.grid, len(scene.at)
    size = np.array([grid.width, grid.height])
    draw = np.minimum(scene.rng.random((robots, RRT_SAMPLES, 2)) * size, size - 1e-6)
    branch = 0.5 * scene.radar_range / grid.cell
    node = np.full((robots, RRT_SAMPLES + 1), np.inf, complex)
    node[:, 0] = (scene.at / grid.cell) @ (1, 1j)
    flat, known, first_node = node.ravel(), grid.known.ravel(), np.arange(robots) * node.shape[1]
    numbers, row, count, ends = np.arange(int(2.0 * branch) + 3), np.arange(robots), [1] * robots, []
    for point in (draw @ (1, 1j)).T:
        away = node[:, : max(count)] - point[:, None]
        gap = away.real**2 + away.imag**2
        start = flat.take(gap.argmin(1) + first_node)
        length = np.sqrt(gap.min(1))
        way = (point - start) * np.minimum(1.0, branch / np.maximum(length, 1e-9))
        steps = np.minimum(2.0 * length, 2.0 * branch).astype(np.int64)
        shares = np.minimum(numbers / (steps[:, None] + 1), 1.0)  # where a branch is looked at; its end fills the row
        at = start[:, None] + way[:, None] * shares
        cells = at.imag.astype(np.int64) * grid.width + at.real.astype(np.int64)
        state = known.take(cells)
        first = (state != FREE).argmax(1)
        for robot, (k, end) in enumerate(zip(first.tolist(), state[row, first].tolist(), strict=True)):
            if end == FREE:  # all along
                node[robot, count[robot]] = start[robot] + way[robot]
                count[robot] += 1
            elif end == UNKNOWN and k > 0:
                ends.append(cells[robot, k - 1])
    return np.array(ends, np.int64)


def rank_any(scene: Scene) -> np.ndarray:
    """Each robot any target that it can get to, and that one again as long as it is there."""
    start = scene.rng.bit_generator.seed_seq.entropy
    draw = [
        np.random.default_rng([start, robot, *block]).random()
        for robot in scene.robots.tolist()
        for block in (scene.targets.block + STRIDE).tolist()
    ]
    return rank(scene, np.reshape(draw, scene.travel.shape), np.isfinite(scene.travel))


def _worthwhile(scene: Scene) -> np.ndarray:
    """Targets in reach, bool [n, K]; those that offer little only for robots that get to none that offers more."""
    reached = np.isfinite(scene.travel)
    worth = reached & (scene.gain >= LEAST_GAIN)
    return np.where(worth.any(-1, keepdims=True), worth, reached)


def rank(scene: Scene, score: np.ndarray, among: np.ndarray) -> np.ndarray:
    """Targets by their `score` where they are `among` those that count, the others in reach behind, -inf the rest."""
    reached = np.isfinite(scene.travel)
    return np.where(among & reached, score, np.where(reached, -2.0 * FAR - scene.travel, -np.inf))


CHOICES: dict[str, Callable[[Scene], np.ndarray]] = {
    "random": rank_any,
    "nearest_frontier": rank_nearest,
    "cost_utility": rank_by_utility,
    "potential_field": rank_by_force,
    "rrt_frontiers": rank_by_tree,
    "voronoi": rank_by_area,
    "hungarian": rank_by_assignment,
}
"""Name -> `Scene` to what each robot thinks of each target, float [n, K]; -inf: out of reach."""
