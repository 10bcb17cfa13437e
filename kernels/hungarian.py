"""Assignment of targets to robots at the least total cost, one problem per env (the Hungarian method).

Robots are added one after the other along a shortest augmenting path over reduced costs (Jonker and Volgenant
1987): N * N * K steps for N robots and K targets. Costs are integers, so the optimum is exact.
"""

import torch
import warp as wp

from maexp.kernels.launches import launch_on
from maexp.kernels.startup import MODULE_OPTIONS

wp.set_module_options(MODULE_OPTIONS)

FORBIDDEN = 1 << 24  # cost of a pair that cannot be; the sums of 40 robots still fit in int32

ENDLESS = 1 << 30


@wp.kernel
def _assign_targets(
    # In:
    cost: wp.array3d(dtype=wp.int32),  # [env, robot, target], at least as many targets as robots
    # Scratch, entry 0 standing for "none":
    price_robot: wp.array2d(dtype=wp.int32),  # [env, 1 + robots]
    price_target: wp.array2d(dtype=wp.int32),  # [env, 1 + targets]
    owner: wp.array2d(dtype=wp.int32),  # [env, 1 + targets]
    before: wp.array2d(dtype=wp.int32),  # [env, 1 + targets], the target before on the augmenting path
    slack: wp.array2d(dtype=wp.int32),  # [env, 1 + targets]
    done: wp.array2d(dtype=wp.int32),  # [env, 1 + targets]
    # Out:
    match: wp.array2d(dtype=wp.int32),  # [env, robot], -1 = only forbidden targets were left
):
    e = wp.tid()
    robots = cost.shape[1]
    targets = cost.shape[2]
    for k in range(targets + 1):
        owner[e, k] = 0
        price_target[e, k] = 0
    for i in range(robots + 1):
        price_robot[e, i] = 0
    for i in range(1, robots + 1):
        owner[e, 0] = i
        for k in range(targets + 1):
            slack[e, k] = ENDLESS
            done[e, k] = 0
        here = wp.int32(0)
        while owner[e, here] != 0:
            done[e, here] = 1
            robot = owner[e, here]
            least = ENDLESS
            next = wp.int32(0)
            for k in range(1, targets + 1):
                if done[e, k] == 0:
                    reduced = cost[e, robot - 1, k - 1] - price_robot[e, robot] - price_target[e, k]
                    if reduced < slack[e, k]:
                        slack[e, k] = reduced
                        before[e, k] = here
                    if slack[e, k] < least:
                        least = slack[e, k]
                        next = k
            for k in range(targets + 1):
                if done[e, k] != 0:
                    price_robot[e, owner[e, k]] = price_robot[e, owner[e, k]] + least
                    price_target[e, k] = price_target[e, k] - least
                else:
                    slack[e, k] = slack[e, k] - least
            here = next
        while here != 0:
            owner[e, here] = owner[e, before[e, here]]
            here = before[e, here]
    for i in range(robots):
        match[e, i] = -1
    for k in range(1, targets + 1):
        i = owner[e, k] - 1
        if i >= 0:
            if cost[e, i, k - 1] < FORBIDDEN:
                match[e, i] = k - 1


def assign_targets(cost: torch.Tensor) -> torch.Tensor:
    """One target for every robot, no target twice, at the least total cost.

    Args:
        cost: integer [E, N, K], 0 to `FORBIDDEN` (2**24); that value and above = the pair cannot be.

    Returns:
        int64 [E, N]: the target of each robot; -1 for robots left without one (fewer targets than robots, or
        only forbidden ones).
    """
    envs, robots, targets = cost.shape
    if robots > 40:
        raise ValueError(f"num_robots={robots} is more than the 40 robots that assign_targets can add up")
    width = max(robots, targets)
    padded = torch.full((envs, robots, width), FORBIDDEN, dtype=torch.int32, device=cost.device)
    padded[..., :targets] = cost.clamp(max=FORBIDDEN)
    match = torch.empty((envs, robots), dtype=torch.int32, device=cost.device)
    scratch = [torch.empty((envs, 1 + n), dtype=torch.int32, device=cost.device) for n in (robots, *[width] * 5)]
    launch_on(cost.device)(
        _assign_targets,
        envs,
        [wp.from_torch(padded), *map(wp.from_torch, scratch), wp.from_torch(match)],
    )
    return match.long()
