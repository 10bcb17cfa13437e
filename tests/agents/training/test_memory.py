"""Memory: what is counted before a batch is made is what it takes."""

import math

import pytest
import torch
import warp as wp
from torchrl.data import Bounded

from maexp.agents.errors import UserError
from maexp.agents.memory import check_batch_memory
from maexp.agents.policies import POLICIES
from maexp.envs import CommConfig, ExplorationEnv, ObservationConfig, PlannerConfig, make_map, simulation
from maexp.envs.simulation import bytes_per_env, navigation_bytes
from maexp.envs.targets.tracker import TargetTracker
from maexp.kernels.geodesic import DistanceSearch
from maexp.kernels.occupancy_grid import KnownGrids
from maexp.kernels.traversability import PassableGrids
from maexp.kernels.wavefront import PathSearch


@pytest.mark.parametrize("limited", [False, True])
def test_memory_is_counted_before_it_is_taken(limited):
    """What `check_memory` counts is what state, scratch and the planner's grids take, within 2 %."""
    comm = CommConfig(range=20.0) if limited else CommConfig()
    env = ExplorationEnv(
        make_map("maze_small", 0),
        num_envs=6,
        num_robots=3,
        planner=PlannerConfig("wavefront"),
        comm=comm,
        num_threads=2,
    )
    taken = sum(tensor.nbytes for tensor in env.simulation.tensors.values())
    for block in env.simulation.blocks:
        taken += sum(grid.capacity for grid in arrays_of(block.wavefront))
    assert bytes_per_env(env.settings, env.bank) * 6 == pytest.approx(taken, rel=0.02)


@pytest.mark.parametrize("reach", [math.inf, 20.0])
def test_what_a_policy_keeps_is_counted_before_it_is_taken(reach):
    """Its navigation, and how often each robot went to each target in vain; maps of two sizes."""
    env = ExplorationEnv(
        [make_map("maze_small", 0), make_map("maze", 0)], num_envs=40, num_robots=3, comm=CommConfig(range=reach)
    )
    tracker = TargetTracker(env)
    nav = tracker.nav
    taken = sum(array.capacity for array in arrays_of(nav.known_grids, nav.passable, nav.paths, nav.blocks))
    taken += sum(value.nbytes for value in tracker.state.values())
    assert navigation_bytes(env.settings, env.bank) * 40 == pytest.approx(taken, rel=0.02)


def test_a_policy_too_large_is_refused(monkeypatch):
    env = ExplorationEnv(make_map("maze_small", 0), num_envs=4)
    need = navigation_bytes(env.settings, env.bank)
    monkeypatch.setattr(simulation, "free_memory", lambda device: 3 * need)
    with pytest.raises(ValueError, match=r"num_envs=4 needs 0.0 GiB .*: lower num_envs to 3"):
        POLICIES["cost_utility"](env)


def test_an_env_that_shows_targets_counts_what_they_need():
    sizes = []
    for shown in (ObservationConfig(), ObservationConfig(targets=6)):
        env = ExplorationEnv(make_map("maze_small", 0), num_envs=2, observation=shown)
        sizes.append(bytes_per_env(env.settings, env.bank))
    assert sizes[1] - sizes[0] == navigation_bytes(env.settings, env.bank) > 40_000


def arrays_of(*owners) -> list[wp.array]:
    """Arrays that the planner's objects own (what they share with the simulation is marked as not their own)."""
    found, queue, done = {}, list(owners), set()
    while queue:
        owner = queue.pop()
        done.add(id(owner))
        for value in vars(owner).values():
            if isinstance(value, KnownGrids | PassableGrids | PathSearch | DistanceSearch) and id(value) not in done:
                queue.append(value)
            entries = [array for pair in value for array in pair] if name_of_rings(value) else [value]
            found |= {
                entry.ptr: entry for entry in entries if isinstance(entry, wp.array) and entry.deleter is not None
            }
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
