"""Targets shared out: robots that hear each other go to different places, farther apart than their bodies.

A robot keeps what it wants where that is free. Of several that want the same, the one with the shortest way keeps it,
and the others take what they like best of the rest. Where too little is left, who is there first has it, and the others
get none.
"""

from typing import Any

import torch
import warp as wp

from maexp.kernels.launches import launch_on, view
from maexp.kernels.points import VECTORS, for_points
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.types import NOTHING

wp.set_module_options(MODULE_OPTIONS)


@wp.func
def find_holder(
    e: int,
    i: int,
    k: int,
    point: wp.array3d(dtype=Any),
    hears: wp.array3d(dtype=wp.bool),
    body: wp.array2d(dtype=wp.float32),
    taken: wp.array2d(dtype=wp.int64),
) -> int:
    """The robot whose target leaves no room for robot i at its target k; -1: it is free, -2: there are several."""
    holder = wp.int32(-1)
    for j in range(point.shape[1]):
        if j != i and taken[e, j] >= wp.int64(0) and (hears[e, i, j] or hears[e, j, i]):
            gap = point[e, i, k] - point[e, j, int(taken[e, j])]
            apart = body[e, i] + body[e, j]
            if wp.dot(gap, gap) < apart * apart:
                holder = wp.where(holder == -1, j, -2)
    return holder


@wp.func
def find_best_free(
    e: int,
    i: int,
    preference: wp.array3d(dtype=wp.float32),
    point: wp.array3d(dtype=Any),
    hears: wp.array3d(dtype=wp.bool),
    body: wp.array2d(dtype=wp.float32),
    taken: wp.array2d(dtype=wp.int64),
) -> int:
    """What a robot likes best of the targets that are free, the first of equals; -1: none."""
    highest = wp.float32(NOTHING)
    best = wp.int32(-1)
    for k in range(preference.shape[2]):
        if preference[e, i, k] > highest:
            if find_holder(e, i, k, point, hears, body, taken) == -1:
                highest = preference[e, i, k]
                best = k
    return best


@wp.func
def take_over(
    e: int,
    i: int,
    preference: wp.array3d(dtype=wp.float32),
    way: wp.array3d(dtype=wp.float32),
    point: wp.array3d(dtype=Any),
    hears: wp.array3d(dtype=wp.bool),
    body: wp.array2d(dtype=wp.float32),
    taken: wp.array2d(dtype=wp.int64),
) -> int:
    """Give robot i, for whom nothing is free, the nearest target of a robot that can go elsewhere or has a longer way
    there; returns that robot, which has none then, or -1: there is no such target.
    """
    nearest = wp.float32(wp.inf)
    best = wp.int32(-1)
    loser = wp.int32(-1)
    for k in range(preference.shape[2]):
        if preference[e, i, k] > NOTHING and way[e, i, k] < nearest:
            j = find_holder(e, i, k, point, hears, body, taken)
            if j >= 0:
                had = taken[e, j]
                theirs = way[e, j, int(had)]
                yields = way[e, i, k] < theirs or (way[e, i, k] == theirs and i < j)
                if not yields:
                    taken[e, i] = wp.int64(k)
                    taken[e, j] = wp.int64(-1)
                    yields = find_best_free(e, j, preference, point, hears, body, taken) >= 0
                    taken[e, i] = wp.int64(-1)
                    taken[e, j] = had
                if yields:
                    nearest = way[e, i, k]
                    best = k
                    loser = j
    if loser >= 0:
        taken[e, loser] = wp.int64(-1)
        taken[e, i] = wp.int64(best)
    return loser


@wp.func
def find_next(
    e: int,
    way: wp.array3d(dtype=wp.float32),
    wish: wp.array2d(dtype=wp.int32),
    waiting: wp.array2d(dtype=wp.bool),
) -> int:
    """Of the robots that wait, the first of those with the shortest way to what they want; -1: nobody waits."""
    next = wp.int32(-1)
    for i in range(way.shape[1]):
        if waiting[e, i]:
            if next < 0:
                next = i
            elif way[e, i, wish[e, i]] < way[e, next, wish[e, next]]:
                next = i
    return next


@wp.kernel
def _share_targets(
    # In:
    preference: wp.array3d(dtype=wp.float32),  # [env, robot, target], below `NOTHING`: out of reach
    way: wp.array3d(dtype=wp.float32),  # [env, robot, target] [m]
    point: wp.array3d(dtype=Any),  # [env, robot, target] [m]
    hears: wp.array3d(dtype=wp.bool),  # [env, robot, robot]
    body: wp.array2d(dtype=wp.float32),  # [env, robot], radius [m]
    # Scratch:
    wish: wp.array2d(dtype=wp.int32),  # [env, robot], what it wants most
    waiting: wp.array2d(dtype=wp.bool),  # [env, robot]
    # Out:
    taken: wp.array2d(dtype=wp.int64),  # [env, robot]; -1 = none
):
    e = wp.tid()
    robots = preference.shape[1]
    for i in range(robots):
        taken[e, i] = wp.int64(-1)
    for i in range(robots):
        wish[e, i] = wp.int32(-1)
        highest = wp.float32(NOTHING)
        for k in range(preference.shape[2]):
            if preference[e, i, k] > highest:
                highest = preference[e, i, k]
                wish[e, i] = k
        waiting[e, i] = wish[e, i] >= 0
    for _turn in range(robots):  # what each wants
        robot = find_next(e, way, wish, waiting)
        if robot >= 0:
            waiting[e, robot] = False
            if find_holder(e, robot, wish[e, robot], point, hears, body, taken) == -1:
                taken[e, robot] = wp.int64(wish[e, robot])
    for i in range(robots):
        waiting[e, i] = wish[e, i] >= 0 and taken[e, i] < wp.int64(0)
    for _turn in range(robots):  # what is left
        robot = find_next(e, way, wish, waiting)
        if robot >= 0:
            waiting[e, robot] = False
        for _step in range(robots * robots):  # each finds a place for one more robot, or one that is nearer
            if robot >= 0:
                free = find_best_free(e, robot, preference, point, hears, body, taken)
                if free >= 0:
                    taken[e, robot] = wp.int64(free)
                    robot = wp.int32(-1)
                else:
                    robot = take_over(e, robot, preference, way, point, hears, body, taken)


_SHARE_TARGETS = for_points(_share_targets)


def share_targets(
    preference: torch.Tensor, way: torch.Tensor, point: torch.Tensor, hears: torch.Tensor, body: torch.Tensor
) -> torch.Tensor:
    """Targets of a team that are distinct and farther apart than the bodies of the robots that have them.

    Robots that do not hear each other may take the same.

    Args:
        preference: float32 [E, N, K], what each robot thinks of each target, the highest is what it wants; -inf: out of
            reach.
        way: float32 [E, N, K], way from robot to target [m].
        point: float32 [E, N, K, 2] or [E, N, K, 3], where the targets are [m].
        hears: bool [E, N, N], who hears whom.
        body: float32 [E, N], radii of the robots [m].

    Returns:
        int64 [E, N], the target of each robot; -1: none is left for it, or it gets to none.
    """
    preference, way, point, body = (tensor.float().contiguous() for tensor in (preference, way, point, body))
    hears = hears.bool().contiguous()
    taken = torch.empty(preference.shape[:2], dtype=torch.int64, device=preference.device)
    wish, waiting = torch.empty_like(taken, dtype=torch.int32), torch.empty_like(taken, dtype=torch.bool)
    launch_on(preference.device)(
        _SHARE_TARGETS[point.shape[-1]],
        len(taken),
        [
            view(preference),
            view(way),
            view(point, VECTORS[point.shape[-1]]),
            view(hears),
            view(body),
            view(wish),
            view(waiting),
            view(taken),
        ],
    )
    return taken
