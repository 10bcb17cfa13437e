"""Reward terms, milestones and the end of an episode (docs/concepts.md; paper, section III-D)."""

import warp as wp

from maexp.kernels.launches import Launch
from maexp.kernels.radio import UNION
from maexp.kernels.shards import Shard
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.types import Maps

wp.set_module_options(MODULE_OPTIONS)

REWARD_TERMS = ("explore", "overlap", "time", "success", "collision")
"""The last axis of ``terms`` and ``unscaled``."""
EXPLORE, OVERLAP, TIME, SUCCESS, COLLISION = range(len(REWARD_TERMS))
UNCOVERED = 0
COVERED = 1
GAINED = 2
"""What the time term counts: -(1 - coverage), -coverage as the paper prints, or what is gained for the rest."""
MARKS = (85, 95, 99)
"""Coverages [%] whose first moment is noted: the last axis of the milestones."""
_SHARES = wp.types.vector(len(MARKS), float)(*(mark / 100 for mark in MARKS))


@wp.struct
class RewardWeights:
    """Coefficients of the reward (configuration)."""

    explore: float
    overlap: float
    time: float
    unfinished: float  # joins the time term's share of what is not covered, as long as the team is not done
    success: float
    collision: float
    points: float  # w = points / total weight scales explore and overlap
    events: float  # v = events scales time, success, collision; 0: points / |free| (the paper's way)
    time_on: int  # UNCOVERED, COVERED or GAINED
    success_coverage: float
    length: int  # local steps of an episode
    charge_rest: int  # whether what is left of them is charged when all have collided


@wp.func
def add_term(
    terms: wp.array3d(dtype=wp.float32),
    unscaled: wp.array3d(dtype=wp.float32),
    e: int,
    i: int,
    term: int,
    value: float,
    scale: float,
):
    terms[e, i, term] = terms[e, i, term] + scale * value
    unscaled[e, i, term] = unscaled[e, i, term] + value


@wp.func
def all_collided(e: int, collided: wp.array2d(dtype=wp.int32)) -> bool:
    """Whether nobody of the team moves any more."""
    for i in range(collided.shape[1]):
        if collided[e, i] == 0:
            return False
    return True


@wp.kernel
def _reward_robots(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    weights: RewardWeights,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    collided: wp.array2d(dtype=wp.int32),  # [env, robot]
    covered: wp.array(dtype=wp.int32),  # [env]
    covered_before: wp.array(dtype=wp.int32),  # [env]
    local_step: wp.array(dtype=wp.int32),  # [env]
    # Scratch in:
    discovered: wp.array2d(dtype=wp.int32),  # [env, robot]
    overlap: wp.array2d(dtype=wp.int32),  # [env, robot]
    crashed: wp.array2d(dtype=wp.int32),  # [env, robot]
    # State in and out:
    terms: wp.array3d(dtype=wp.float32),  # [env, robot, term]
    unscaled: wp.array3d(dtype=wp.float32),  # [env, robot, term]
):
    """Add this local step's reward terms of robot (e, i): weighted in ``terms``, plain in ``unscaled``.

    ``terms`` is summed over the macro step, ``unscaled`` over the episode. When the last robot has collided, the steps
    that are left are charged at once, as if the wrecks stayed there until the end: no team gains by crashing.
    """
    e, i = wp.tid()
    if active[e] == 0:
        return
    m = map_id[e]
    total = float(maps.total_weight[m])
    w = weights.points / total
    v = weights.events
    if v <= 0.0:  # events are no points: where density varies, the weights' unit must not scale them
        v = weights.points / float(maps.free_begin[m + 1] - maps.free_begin[m])
    before = float(covered_before[e]) / total
    after = float(covered[e]) / total
    done = before < weights.success_coverage and after >= weights.success_coverage
    rest = float(wp.max(weights.length - local_step[e] - 1, 0))
    left = float(0.0)
    if weights.charge_rest != 0 and after < weights.success_coverage and all_collided(e, collided):
        left = rest
    lapse = -(1.0 - before) - left * (1.0 - after) - weights.unfinished * (1.0 + left)
    if weights.time_on == COVERED:
        lapse = -before - left * after - weights.unfinished * (1.0 + left)
    if weights.time_on == GAINED:
        lapse = (after - before) * rest
        if done:
            lapse = lapse + (1.0 - after + weights.unfinished) * rest
    add_term(terms, unscaled, e, i, EXPLORE, weights.explore * float(discovered[e, i]), w)
    add_term(terms, unscaled, e, i, OVERLAP, -weights.overlap * float(overlap[e, i]) * (1.0 + left), w)
    add_term(terms, unscaled, e, i, TIME, weights.time * lapse, v)
    if done:
        add_term(terms, unscaled, e, i, SUCCESS, weights.success, v)
    if crashed[e, i] != 0:
        add_term(terms, unscaled, e, i, COLLISION, -weights.collision, v)


@wp.kernel
def _close_step(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    success_coverage: float,
    done: int,
    # State in:
    collided: wp.array2d(dtype=wp.int32),  # [env, robot]
    covered: wp.array(dtype=wp.int32),  # [env]
    shared: wp.array(dtype=wp.int32),  # [env]
    path_length: wp.array2d(dtype=wp.float32),  # [env, robot]
    # Scratch in:
    counted: wp.array(dtype=wp.int32),  # [env]
    # State in and out:
    active: wp.array(dtype=wp.int32),  # [env]
    covered_sum: wp.array(dtype=wp.int64),  # [env]
    local_step: wp.array(dtype=wp.int32),  # [env]
    milestone_step: wp.array2d(dtype=wp.int32),  # [env, mark]
    # State out:
    covered_before: wp.array(dtype=wp.int32),  # [env]
    milestone_overlap: wp.array2d(dtype=wp.float32),  # [env, mark]
    milestone_path: wp.array3d(dtype=wp.float32),  # [env, robot, mark]
    terminated: wp.array(dtype=wp.int32),  # [env]
):
    """Count the local step, sum up the coverage, note which of `MARKS` are reached, end the episode on success or when
    all collided. Not what the team has seen but what is ``counted`` makes a success, where ``done`` says so."""
    e = wp.tid()
    if active[e] == 0:
        return
    step = local_step[e] + 1
    local_step[e] = step
    coverage = float(covered[e]) / float(maps.total_weight[map_id[e]])
    covered_before[e] = covered[e]
    covered_sum[e] = covered_sum[e] + wp.int64(covered[e])
    for k in range(milestone_step.shape[1]):
        if milestone_step[e, k] < 0 and coverage >= _SHARES[k]:
            milestone_step[e, k] = step
            milestone_overlap[e, k] = float(shared[e]) / float(covered[e])
            for i in range(collided.shape[1]):
                milestone_path[e, i, k] = path_length[e, i]
    alive = int(0)
    for i in range(collided.shape[1]):
        if collided[e, i] == 0:
            alive += 1
    if done != UNION:
        coverage = float(counted[e]) / float(maps.total_weight[map_id[e]])
    if coverage >= success_coverage or alive == 0:
        terminated[e] = 1
        active[e] = 0


def reward_robots(launch: Launch, shard: Shard) -> None:
    """Add this local step's reward."""
    shard.call(launch, _reward_robots)


def close_step(launch: Launch, shard: Shard) -> None:
    """Count the local step, note milestones, end episodes."""
    shard.call(launch, _close_step, shard.shape[0])
