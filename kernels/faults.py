"""Robots that fail: they stop where they are, see nothing, hear nobody and say nothing, for a time or for good.

A robot fails at the moment that is given for it, or with a probability at one drawn evenly over the episode. That
depends on (seed, env, episode, robot) alone, so nothing has to be remembered.
"""

import warp as wp

from maexp.kernels.cpp_snippets import keyed_uniform
from maexp.kernels.launches import Launch
from maexp.kernels.shards import Shard
from maexp.kernels.startup import MODULE_OPTIONS

wp.set_module_options(MODULE_OPTIONS)

FAULT_KEY = 1 << 25  # apart from the numbers of policies and radios


@wp.func
def lasts(step: int, first: int, steps: int) -> bool:
    """Whether a failure of so many steps that began with step ``first`` has begun and is not over."""
    return step >= first and step - first < steps


@wp.kernel
def _fail_robots(
    # Settings:
    fault_probability: float,
    fault_steps: int,
    episode_steps: int,
    # In:
    fault_at: wp.array(dtype=wp.int32),  # [robot]
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    seed: wp.array(dtype=wp.int32),  # [1]
    env_id: wp.array(dtype=wp.int32),  # [env]
    episode: wp.array(dtype=wp.int32),  # [env]
    local_step: wp.array(dtype=wp.int32),  # [env]
    # State in and out:
    pose: wp.array2d(dtype=wp.vec4),  # [env, robot]
    # State out:
    failed: wp.array2d(dtype=wp.int32),  # [env, robot]
    slip: wp.array2d(dtype=wp.float32),  # [env, robot]
    control: wp.array2d(dtype=wp.vec2),  # [env, robot]
):
    """Decide whether robot (e, i) has failed in this local step, and stop it if so, whatever it had planned."""
    e, i = wp.tid()
    if active[e] == 0:
        return
    step = local_step[e]
    down = fault_at[i] >= 0 and lasts(step, fault_at[i], fault_steps)
    if fault_probability > 0.0:
        if keyed_uniform(seed[0], env_id[e], episode[e], 0, FAULT_KEY + 2 * i) < fault_probability:
            moment = keyed_uniform(seed[0], env_id[e], episode[e], 0, FAULT_KEY + 2 * i + 1)
            down = down or lasts(step, int(moment * float(episode_steps)), fault_steps)
    failed[e, i] = wp.where(down, 1, 0)
    if down:
        pose[e, i] = wp.vec4(pose[e, i][0], pose[e, i][1], 0.0, pose[e, i][3])
        slip[e, i] = 0.0
        control[e, i] = wp.vec2(0.0, 0.0)


def fail_robots(launch: Launch, shard: Shard, running: wp.array) -> None:
    """Stop the robots that have failed, in the envs where ``running`` [env] is set, if any may fail."""
    if shard.settings.faults:
        shard.call(launch, _fail_robots, active=running)
