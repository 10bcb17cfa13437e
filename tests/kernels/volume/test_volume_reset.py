"""Resets in volumes: where teams start, and that only (seed, env, episode) decide."""

import numpy as np
import pytest
import torch
from voxel_worlds import map_of, volume_env

from maexp.kernels.reset import EVALUATION
from maexp.kernels.types import START_CLEARANCE

pytestmark = pytest.mark.kernels

FIELDS = ("map_id", "center", "pose", "known_free", "known_surface", "covered", "covered_surface", "goal")


def start(env, episode: int, mask=None) -> dict:
    """What a reset to an episode gives."""
    s = env.simulation.tensors
    count = len(s["episode"])
    mask = torch.ones(count, dtype=torch.bool) if mask is None else mask
    s["episode"][mask] = episode
    env.simulation.reset(mask)
    return {name: s[name].clone() for name in FIELDS}


@pytest.mark.parametrize("episode", [0, 3, EVALUATION + 2])
@pytest.mark.parametrize("num_envs, threads", [(1, 1), (3, 2), (7, 3)])
def test_env_i_starts_the_same_in_any_batch(num_envs, threads, episode):
    want = start(volume_env(5), episode)
    got = start(volume_env(num_envs, num_threads=threads), episode)
    both = min(5, num_envs)
    for name in FIELDS:
        assert torch.equal(got[name][:both], want[name][:both]), name


def test_a_later_batch_goes_on_where_an_earlier_one_ends():
    want, got = start(volume_env(5), 2), start(volume_env(3, first_env=2), 2)
    for name in FIELDS:
        assert torch.equal(got[name], want[name][2:]), name


def test_what_was_before_does_not_matter():
    env = volume_env(4)
    want = start(env, 5)
    start(env, 1, torch.tensor([False, True, True, False]))
    env.simulation.tensors["center"] += 0.1
    again = start(env, 5, torch.tensor([True, True, False, False]))
    for name in FIELDS:
        assert torch.equal(again[name][:2], want[name][:2]), name
    assert not torch.equal(again["center"][3], want["center"][3])  # it was not reset


def test_seeds_envs_and_episodes_differ():
    found = [start(volume_env(6, seed=seed), episode)["center"] for seed in (4, 5) for episode in (0, 1)]
    starts = torch.cat(found)[:, 0]
    assert len({tuple(p) for p in starts.tolist()}) == 24
    env = volume_env(12)
    assert set(start(env, 0)["map_id"].tolist()) == {0, 1}
    evaluated = torch.stack([start(env, EVALUATION + k)["map_id"] for k in range(4)])
    assert ((evaluated == 0).sum(0) == 2).all()


@pytest.mark.parametrize("together", [False, True])
def test_teams_have_room(together):
    settings = {"starts": "together"} if together else {}
    env = volume_env(9, 4, **settings)
    s = env.simulation.tensors
    for episode in range(3):
        start(env, episode)
        assert not s["error"].any()
        for e in range(9):
            m, room = map_of(env, e), env.bank.room[int(s["map_id"][e])]
            index = np.floor((s["center"][e].double().numpy() - m.origin) / m.resolution).astype(int)
            assert room[tuple(index.T)].all()
            gaps = torch.cdist(s["center"][e], s["center"][e]) + 100.0 * torch.eye(4)
            threshold = env.robot_configs[0].collision_threshold
            assert gaps.min() >= START_CLEARANCE * threshold - 1e-5
            if together:
                assert gaps.min(0).values.max() <= 1.5 * START_CLEARANCE * threshold + 1e-5
        assert torch.allclose(s["center"][..., :2], s["pose"][..., :2])
        assert float(s["pose"][..., 3].abs().max()) <= np.pi and float(s["pose"][..., 3].std()) > 1.0
