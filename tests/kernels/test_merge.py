"""Map merging and who sees whom against the oracle, and the laws of merging."""

import math

import numpy as np
import pytest
import torch
import warp as wp
from oracle import team
from worlds import room

import maexp.kernels as mk
from maexp.envs import CommConfig, ExplorationEnv, RadarConfig, RobotConfig
from maexp.kernels.api import _pack
from maexp.kernels.launches import launch_named, launch_on
from maexp.kernels.merge import _share_points
from maexp.kernels.types import Maps

pytestmark = pytest.mark.kernels

SIZES = [(1, 1, 7), (2, 3, 11), (3, 5, 2), (2, 31, 5), (1, 32, 6), (3, 33, 4), (2, 40, 9), (1, 65, 3)]


def draw(envs: int, robots: int, points: int, heard: float = 0.3):
    """`(seen, comm)` at random."""
    rng = np.random.default_rng(envs + 7 * robots)
    return rng.random((envs, robots, points)) < 0.2, rng.random((envs, robots, robots)) < heard


def merge(seen, comm) -> np.ndarray:
    got = mk.merge_maps(torch.from_numpy(np.ascontiguousarray(seen)), torch.from_numpy(np.ascontiguousarray(comm)))
    assert got.dtype == torch.bool and got.shape == seen.shape
    return got.numpy()


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("heard", [0.0, 0.3, 1.0])
def test_agrees_with_the_oracle(size, heard):
    seen, comm = draw(*size, heard)
    got = merge(seen, comm)
    np.testing.assert_array_equal(got, team.merge_maps(seen, comm))
    if heard == 0.0:
        np.testing.assert_array_equal(got, seen)
    if heard == 1.0:
        np.testing.assert_array_equal(got, np.broadcast_to(seen.any(1, keepdims=True), seen.shape))


@pytest.mark.parametrize("size", SIZES)
def test_monotone(size):
    seen, comm = draw(*size)
    got = merge(seen, comm)
    assert not (seen & ~got).any()  # nobody forgets
    more = seen | (np.random.default_rng(1).random(size) < 0.1)
    assert not (got & ~merge(more, comm)).any()
    wider = comm | (np.random.default_rng(2).random(comm.shape) < 0.2)
    assert not (got & ~merge(seen, wider)).any()


@pytest.mark.parametrize("size", SIZES)
def test_idempotent_where_hearing_is_transitive(size):
    """Among groups in which everyone hears everyone, telling twice tells nothing new."""
    seen, _ = draw(*size)
    group = np.random.default_rng(3).integers(0, 3, (size[0], size[1]))
    comm = group[:, :, None] == group[:, None, :]
    once = merge(seen, comm)
    np.testing.assert_array_equal(merge(once, comm), once)


def test_one_exchange_is_one_hop():
    seen = np.eye(4, dtype=bool)[None]
    chain = np.zeros((1, 4, 4), bool)
    chain[0, 1, 0] = chain[0, 2, 1] = chain[0, 3, 2] = True  # i hears i - 1
    once = merge(seen, chain)[0]
    assert once.astype(int).tolist() == [[1, 0, 0, 0], [1, 1, 0, 0], [0, 1, 1, 0], [0, 0, 1, 1]]
    thrice = merge(merge(merge(seen, chain), chain), chain)[0]
    assert thrice[3].all() and not thrice[0, 1:].any()  # news travels one way only


@pytest.mark.parametrize("lanes", [1, 7])
@pytest.mark.parametrize(("robots", "points"), [(3, 63), (4, 64), (4, 65), (5, 1000), (32, 200), (40, 130), (300, 70)])
def test_what_is_known_already_is_passed_over(robots, points, lanes):
    """Teams in parts, whose members know the same, and a little that is new: against the definition, with what is told.

    Of 300 robots, radios after the first 256 are looked at in another way.
    """
    rng = np.random.default_rng(robots)
    envs = 6
    group = rng.integers(0, 3, (envs, robots)) + 3 * (np.arange(robots) >= 256)
    hears = group[:, :, None] == group[:, None, :]
    hears[0] = np.eye(robots, dtype=bool)  # nobody hears anybody
    hears[1] &= rng.random((robots, robots)) < 0.7  # not all both ways
    hears[3] = np.eye(robots, dtype=bool)
    hears[3, 0, -1] = True  # the first hears only the last
    hears[:, range(robots), range(robots)] = True
    part = rng.random((envs, 6, points)) < 0.5
    known = np.take_along_axis(part, group[:, :, None], 1)
    known[2] = rng.random((robots, points)) < 0.5  # nor the same
    seen = (known & (rng.random(known.shape) < 0.5)) | (rng.random(known.shape) < 0.3 / points)
    knew = known | seen
    lacks = hears[:, :, :, None] & ~knew[:, :, None] & knew[:, None]  # [env, listener, teller, point]
    words = [_pack(torch.from_numpy(flags), 1) for flags in (seen, known)]
    told, sent = torch.zeros_like(words[0]), torch.zeros(envs, dtype=torch.int64)
    active = torch.ones(envs, dtype=torch.int32)
    values = {
        "active": wp.from_torch(active),
        "hears": wp.from_torch(_pack(torch.from_numpy(hears), 2)),
        "seen": wp.from_torch(words[0]),
        "known": wp.from_torch(words[1]),
        "told": wp.from_torch(told),
        "cells_sent": wp.from_torch(sent),
        "known_weight": wp.from_torch(torch.zeros(envs, robots, dtype=torch.int32)),
        "maps": Maps(),
        "map_id": wp.from_torch(active),
        "weighed": 0,
        "lanes": lanes,
    }
    launch_named(launch_on(told.device), _share_points, (envs, lanes), values)
    got = mk.unpack_flags(words[1], robots).numpy()
    np.testing.assert_array_equal(got, knew | lacks.any(2))
    np.testing.assert_array_equal(sent.numpy(), lacks.any(1).sum((1, 2)))


@pytest.mark.parametrize("size", SIZES)
def test_permuting_robots_points_or_envs_permutes_the_result(size):
    seen, comm = draw(*size)
    rng, got = np.random.default_rng(4), merge(seen, comm)
    env, robot, point = (rng.permutation(n) for n in size)
    np.testing.assert_array_equal(merge(seen[:, robot], comm[:, robot][:, :, robot]), got[:, robot])
    np.testing.assert_array_equal(merge(seen[:, :, point], comm), got[:, :, point])
    np.testing.assert_array_equal(merge(seen[env], comm[env]), got[env])


@pytest.mark.parametrize("size", [(0, 3, 5), (2, 3, 0), (0, 1, 0)])
def test_nothing_to_merge(size):
    assert merge(np.zeros(size, bool), np.ones((size[0], size[1], size[1]), bool)).shape == size


def test_inputs_are_left_alone_and_misfits_refused():
    seen, comm = (torch.from_numpy(a) for a in draw(2, 3, 5))
    kept = seen.clone(), comm.clone()
    mk.merge_maps(seen, comm)
    assert torch.equal(seen, kept[0]) and torch.equal(comm, kept[1])
    for bad in (comm[:1], comm[:, :2], comm[:, :, :2]):
        with pytest.raises(ValueError, match="do not fit"):
            mk.merge_maps(seen, bad)


@pytest.mark.parametrize("robots", [1, 31, 32, 33, 64, 70])
def test_flags_of_any_team_survive_packing(robots):
    seen = torch.from_numpy(draw(2, robots, 9)[0])
    from maexp.kernels.api import _pack

    words = _pack(seen, 1)
    assert words.shape == (2, -(-robots // 32), 9) and words.dtype == torch.int32
    assert torch.equal(mk.unpack_flags(words, robots), seen)


@pytest.mark.parametrize("reach", [1.5, 6.0, 40.0])
@pytest.mark.parametrize("kind", ["lattice", "rotated"])
def test_walls_block_sight_between_robots(kind, reach):
    """A boundary point within half a diagonal of the spacing of the line; cells of any size, any direction."""
    world = room(26, 19, kind, 4)
    env = ExplorationEnv(
        world,
        3,
        12,
        seed=5,
        robot=RobotConfig(length=0.4, width=0.3, collision_threshold=0.2),
        radar=RadarConfig(range=reach),
        comm=CommConfig(line_of_sight=True),
        num_threads=1,
    )
    env.reset()
    center, comm = (env.simulation.tensors[name].numpy() for name in ("center", "comm"))
    width, blocked, pairs = math.sqrt(0.5) * world.resolution, 0, 0
    for e in range(3):
        for i in range(12):
            for k in range(i):
                gap = team.wall_gap(center[e, i, :2], center[e, k, :2], world.boundary[:, :2])
                if abs(gap - width) > 1e-5:
                    assert comm[e, i, k] == comm[e, k, i] == (gap > width), (gap, width)
                    blocked, pairs = blocked + (gap < width), pairs + 1
    assert 20 < blocked < pairs - 20
