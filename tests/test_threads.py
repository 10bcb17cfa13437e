"""A busy machine: what one env does is not split over threads."""

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten

from maexp.envs import ExplorationEnv, PlannerConfig, make_map


class LargeOperations(TorchDispatchMode):
    """Names of the torch operations that work on so many numbers that torch splits them over its threads."""

    GRAIN = 32768  # numbers that a thread gets at least (at::internal::GRAIN_SIZE)

    def __init__(self):
        super().__init__()
        self.met = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        views = any(one.alias_info and not one.alias_info.is_write for one in func._schema.returns)
        tensors = [one for one in tree_flatten((args, kwargs, out))[0] if isinstance(one, torch.Tensor)]
        if not views and any(one.numel() > self.GRAIN for one in tensors):
            self.met.append(func.name())
        return out


@pytest.mark.parametrize("planner", ["dwa", "wavefront"])
def test_one_env_does_not_wait_for_threads_of_torch(planner):
    """Where another process has the other core, an operation split over both waits for a thread that is not running."""
    env = ExplorationEnv(make_map("maze_small", 0), 1, 3, planner=PlannerConfig(name=planner))
    assert env.simulation.threads.pool is None
    td = env.reset()
    with LargeOperations() as operations:
        for _ in range(3):
            _, td = env.step_and_maybe_reset(env.rand_action(td))
        env.reset()
        assert not operations.met
        torch.zeros(200, 200)  # and it would be noticed
    assert operations.met == ["aten::zeros"]
