"""What robots make of each other's targets: who chooses what in turn, who is nearer, where the others go.

All pairs of robots are compared, so each comparison is kept small: nothing here is a tensor over pairs.
"""

from typing import Any

import torch
import warp as wp

from maexp.kernels.launches import launch_on, view
from maexp.kernels.points import VECTORS, for_points
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.types import NOTHING

wp.set_module_options(MODULE_OPTIONS)

CLOSE = 1.000001  # more than what rounding may add to a squared distance


@wp.func
def squared(gap: wp.vec2) -> float:
    """Squared length, rounded as in torch's `norm`: the second product is added as it is."""
    return wp.float32(wp.float64(gap[0] * gap[0]) + wp.float64(gap[1]) * wp.float64(gap[1]))


@wp.func
def squared(gap: wp.vec3) -> float:  # noqa: F811
    """The same in space."""
    return wp.dot(gap, gap)


@wp.func
def rest_of(gain: float, value: float) -> float:
    """What does not change of a candidate's value, whoever claims a part of its gain."""
    return wp.where(value > NOTHING, value, 0.0) - gain


@wp.func
def find_best(
    e: int,
    i: int,
    gain: wp.array3d(dtype=wp.float32),
    value: wp.array3d(dtype=wp.float32),
    left: wp.array3d(dtype=wp.float32),
    best: wp.array2d(dtype=wp.float32),
    index: wp.array2d(dtype=wp.int64),
):
    """The first of a robot's best candidates, as things stand."""
    highest = wp.float32(NOTHING)
    place = wp.int32(0)
    for k in range(gain.shape[2]):
        if value[e, i, k] > NOTHING:
            now = gain[e, i, k] * left[e, i, k] + rest_of(gain[e, i, k], value[e, i, k])
            if now > highest:
                highest = now
                place = k
    best[e, i] = highest
    index[e, i] = wp.int64(place)


@wp.kernel
def _choose_in_turn(
    # In:
    gain: wp.array3d(dtype=wp.float32),  # [env, robot, candidate]
    value: wp.array3d(dtype=wp.float32),  # [env, robot, candidate], below `NOTHING`: there is none
    point: wp.array3d(dtype=Any),  # [env, robot, candidate] [radar ranges]
    hears: wp.array3d(dtype=wp.bool),  # [env, robot, robot]
    # Scratch:
    left: wp.array3d(dtype=wp.float32),  # [env, robot, candidate], share of the gain that nobody has claimed
    waiting: wp.array2d(dtype=wp.bool),  # [env, robot]
    best: wp.array2d(dtype=wp.float32),  # [env, robot]
    # Out:
    taken: wp.array2d(dtype=wp.int64),  # [env, robot]
    score: wp.array3d(dtype=wp.float32),  # [env, robot, candidate]
    claimed: wp.array3d(dtype=wp.float32),  # [env, robot, candidate]
):
    e = wp.tid()
    robots = gain.shape[1]
    for i in range(robots):
        for k in range(gain.shape[2]):
            left[e, i, k] = 1.0
            score[e, i, k] = 0.0
            claimed[e, i, k] = 0.0
        find_best(e, i, gain, value, left, best, taken)
        waiting[e, i] = best[e, i] > NOTHING
    for _turn in range(robots):
        next = wp.int32(-1)
        for i in range(robots):
            if waiting[e, i]:
                if next < 0:
                    next = i
                elif best[e, i] > best[e, next]:
                    next = i
        if next < 0:
            return
        waiting[e, next] = False
        for k in range(gain.shape[2]):
            rest = rest_of(gain[e, next, k], value[e, next, k])
            score[e, next, k] = gain[e, next, k] * left[e, next, k] + rest
            claimed[e, next, k] = 1.0 - left[e, next, k]
        at = point[e, next, int(taken[e, next])]
        for i in range(robots):
            if waiting[e, i] and hears[e, i, next]:
                changed = wp.bool(False)
                for k in range(gain.shape[2]):
                    gap = point[e, i, k] - at
                    if wp.abs(gap[0]) < 1.0 and wp.abs(gap[1]) < 1.0:
                        left[e, i, k] = left[e, i, k] * wp.min(wp.sqrt(squared(gap)), 1.0)
                        changed = wp.bool(True)
                if changed:
                    find_best(e, i, gain, value, left, best, taken)


_CHOOSE_IN_TURN = for_points(_choose_in_turn)


def choose_in_turn(
    gain: torch.Tensor, value: torch.Tensor, point: torch.Tensor, hears: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Robots choose one after the other (`maexp.envs.targets.tracker.plan_in_turn` says how).

    Args:
        gain, value: float32 [E, N, M]; value -inf: there is none.
        point: float32 [E, N, M, 2 or 3] [radar ranges].
        hears: bool [E, N, N].

    Returns:
        score float32 [E, N, M], taken int64 [E, N], claimed float32 [E, N, M].
    """
    gain, value, point = (tensor.float().contiguous() for tensor in (gain, value, point))
    hears = hears.bool().contiguous()
    score, claimed, left = torch.empty((3, *gain.shape), dtype=torch.float32, device=gain.device)
    taken = torch.empty(gain.shape[:2], dtype=torch.int64, device=gain.device)
    waiting, best = torch.empty_like(taken, dtype=torch.bool), torch.empty_like(taken, dtype=torch.float32)
    launch_on(gain.device)(
        _CHOOSE_IN_TURN[point.shape[-1]],
        len(gain),
        [
            view(gain),
            view(value),
            view(point, VECTORS[point.shape[-1]]),
            view(hears),
            *(view(tensor) for tensor in (left, waiting, best, taken, score, claimed)),
        ],
    )
    return score, taken, claimed


@wp.kernel
def _compare_with_others(
    # In:
    point: wp.array3d(dtype=Any),  # [env, robot, candidate] [m]
    best: wp.array3d(dtype=wp.int64),  # [env, robot, candidate], which of the targets it is
    ways: wp.array3d(dtype=wp.float32),  # [env, robot, target]
    hears: wp.array3d(dtype=wp.bool),  # [env, robot, robot]
    plan: wp.array2d(dtype=Any),  # [env, robot], where it would go [m]
    has_plan: wp.array2d(dtype=wp.bool),  # [env, robot]
    last: wp.array2d(dtype=Any),  # [env, robot], its last target [m]
    has_last: wp.array2d(dtype=wp.bool),  # [env, robot]
    # Out:
    rival: wp.array3d(dtype=wp.float32),  # [env, robot, candidate], the least way of another that is heard
    plan_gap: wp.array3d(dtype=wp.float32),  # [env, robot, candidate], distance to the nearest plan of those [m]
    own_last: wp.array3d(dtype=wp.float32),  # [env, robot, candidate], distance to the own last target [m]
    mates_last: wp.array3d(dtype=wp.float32),  # [env, robot, candidate], to the nearest of those that are heard [m]
):
    e, i = wp.tid()
    for k in range(point.shape[2]):
        rival[e, i, k] = wp.inf
        plan_gap[e, i, k] = wp.inf
        mates_last[e, i, k] = wp.inf
        own_last[e, i, k] = wp.inf
        if has_last[e, i]:
            own_last[e, i, k] = wp.sqrt(squared(point[e, i, k] - last[e, i]))
    for j in range(point.shape[1]):
        if j != i and hears[e, i, j]:
            for k in range(point.shape[2]):
                rival[e, i, k] = wp.min(rival[e, i, k], ways[e, j, int(best[e, i, k])])
            if has_plan[e, j]:
                for k in range(point.shape[2]):
                    gap = point[e, i, k] - plan[e, j]
                    if wp.dot(gap, gap) <= CLOSE * plan_gap[e, i, k]:
                        plan_gap[e, i, k] = wp.min(plan_gap[e, i, k], squared(gap))
            if has_last[e, j]:
                for k in range(point.shape[2]):
                    gap = point[e, i, k] - last[e, j]
                    if wp.dot(gap, gap) <= CLOSE * mates_last[e, i, k]:
                        mates_last[e, i, k] = wp.min(mates_last[e, i, k], squared(gap))
    for k in range(point.shape[2]):
        plan_gap[e, i, k] = wp.sqrt(plan_gap[e, i, k])
        mates_last[e, i, k] = wp.sqrt(mates_last[e, i, k])


_COMPARE_WITH_MATES = for_points(_compare_with_others)


def compare_with_mates(
    point: torch.Tensor,
    best: torch.Tensor,
    ways: torch.Tensor,
    hears: torch.Tensor,
    plans: tuple[torch.Tensor, torch.Tensor],
    last: tuple[torch.Tensor, torch.Tensor],
) -> list[torch.Tensor]:
    """Each robot's candidates against the ways, plans and last targets of the robots that it hears.

    Args:
        point: float32 [E, N, M, 2 or 3], where the candidates are [m].
        best: int64 [E, N, M], which of the T targets they are.
        ways: float32 [E, N, T], from every robot to every target, in any unit; infinite: none.
        hears: bool [E, N, N].
        plans, last: where robots would go and where they last went, float32 [E, N, 2 or 3] [m], and whether: bool
            [E, N].

    Returns:
        Four times float32 [E, N, M], infinite where there is nothing to compare with: the least way of another; the
        distance [m] to the nearest plan of another, to the own last target, to the nearest last target of another.
    """
    found = [torch.empty(best.shape, dtype=torch.float32, device=point.device) for _ in range(4)]
    point, goes, went = (values.contiguous() for values in (point, plans[0], last[0]))
    best, ways, hears, plans_some, last_some = (
        values.contiguous() for values in (best, ways, hears, plans[1], last[1])
    )
    launch_on(point.device)(
        _COMPARE_WITH_MATES[point.shape[-1]],
        tuple(best.shape[:2]),
        [
            view(point, VECTORS[point.shape[-1]]),
            *map(view, (best, ways, hears)),
            view(goes, VECTORS[point.shape[-1]]),
            view(plans_some),
            view(went, VECTORS[point.shape[-1]]),
            view(last_some),
            *map(view, found),
        ],
    )
    return found


@wp.kernel
def _gather_gain(
    # In:
    point: wp.array3d(dtype=Any),  # [env, robot, candidate] [m]
    gain: wp.array3d(dtype=wp.float32),  # [env, robot, candidate]
    # Settings:
    reach: float,  # [m]
    near: float,  # [reach]
    around: float,  # [reach]
    # Out:
    near_gain: wp.array4d(dtype=wp.float32),  # [env, robot, candidate, candidate], 0 beyond `near`
    around_gain: wp.array4d(dtype=wp.float32),  # [env, robot, candidate, candidate], 0 beyond `around`
):
    e, i, k = wp.tid()
    for j in range(point.shape[2]):
        gap = wp.sqrt(squared(point[e, i, k] - point[e, i, j])) / reach
        near_gain[e, i, k, j] = wp.where(gap < near, gain[e, i, j], 0.0)
        around_gain[e, i, k, j] = wp.where(gap < around, gain[e, i, j], 0.0)


_GATHER_GAIN = for_points(_gather_gain)


def gather_gain(
    point: torch.Tensor, gain: torch.Tensor, reach: float, near: float, around: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """The gain of a robot's candidates within ``near`` and within ``around`` [``reach``] of each, float32 [E, N, M].

    Args:
        point: float32 [E, N, M, 2 or 3] [m].
        gain: float32 [E, N, M].
        reach: [m].
    """
    parts = [torch.empty((*gain.shape, gain.shape[-1]), dtype=torch.float32, device=gain.device) for _ in range(2)]
    point, gain = point.contiguous(), gain.contiguous()
    launch_on(gain.device)(
        _GATHER_GAIN[point.shape[-1]],
        tuple(gain.shape),
        [
            view(point, VECTORS[point.shape[-1]]),
            view(gain),
            reach,
            near,
            around,
            *map(view, parts),
        ],
    )
    return parts[0].sum(-1), parts[1].sum(-1)
