"""Memory: what is counted before a batch is made is what it takes."""

import pytest
import torch
import warp as wp
from torchrl.data import Bounded

from maexp.agents.errors import UserError
from maexp.agents.memory import check_batch_memory
from maexp.envs import CommConfig, ExplorationEnv, PlannerConfig, make_map
from maexp.envs.simulation import bytes_per_env
from maexp.kernels.geodesic import DistanceSearch
from maexp.kernels.known_grid import KnownGrids
from maexp.kernels.passable import PassableGrids
from maexp.kernels.wavefront import PathSearch


@pytest.mark.parametrize("limited", [False, True])
def test_memory_is_counted_before_it_is_taken(limited):
    """What `check_memory` counts is what state, scratch and the planner's grids take, within 2 %."""
    comm = CommConfig(range=20.0) if limited else CommConfig()
    env = ExplorationEnv(
        make_map("maze_small", 0), num_envs=6, num_robots=3, planner=PlannerConfig("wavefront"), comm=comm,
        num_threads=2,
    )  # fmt: skip
    taken = sum(tensor.nbytes for tensor in env.simulation.tensors.values())
    for block in env.simulation.blocks:
        taken += sum(grid.capacity for grid in arrays_of(block.wavefront))
    assert bytes_per_env(env.settings, env.bank) * 6 == pytest.approx(taken, rel=0.02)


def arrays_of(*owners) -> list[wp.array]:
    """Arrays that the planner's objects own (what they share with the simulation is marked as not their own)."""
    found, queue, done = {}, list(owners), set()
    while queue:
        owner = queue.pop()
        done.add(id(owner))
        for value in vars(owner).values():
            if isinstance(value, KnownGrids | PassableGrids | PathSearch | DistanceSearch) and id(value) not in done:
                queue.append(value)
            entries = [one for pair in value for one in pair] if name_of_rings(value) else [value]
            found |= {one.ptr: one for one in entries if isinstance(one, wp.array) and one.deleter is not None}
    return list(found.values())


def name_of_rings(value) -> bool:
    """`PassableGrids.rings`: pairs of an array and a value."""
    return isinstance(value, list) and bool(value) and isinstance(value[0], tuple)


def test_a_batch_too_large_is_refused_before_it_is_made():
    with pytest.raises(ValueError, match=r"num_envs=100000000 needs .* GiB .*: lower num_envs to \d+"):
        ExplorationEnv(make_map("maze_small", 0), num_envs=100_000_000, planner=PlannerConfig("wavefront"))


def test_a_batch_to_train_on_counts_the_simulation():
    env = ExplorationEnv(make_map("maze_small", 0), num_envs=4, planner=PlannerConfig("wavefront"))
    check_batch_memory(env, 4)
    with pytest.raises(UserError, match=r"collector.steps=100000000 needs .* for the simulation\).*: lower num_envs"):
        check_batch_memory(env, 100_000_000)


def test_specs_cost_no_more_than_the_pictures_they_describe():
    """Bounds of pictures compared pixel by pixel took eleven times as long as all the rest of building an env."""
    env = ExplorationEnv(make_map("maze_small", 0), num_envs=2)
    picture = env.observation_spec["agents", "observation", "map"]
    assert picture.dtype == torch.uint8 and not isinstance(picture, Bounded)
    assert (int(picture.space.low.min()), int(picture.space.high.max())) == (0, 255)
