"""Every algorithm on every scenario: a batch of the real env goes through its critic, loss and updater."""

import copy
import math
from functools import cache

import pytest
import torch
from worlds import room

from maexp.agents import ALGORITHMS, make_policy
from maexp.agents.build import load_maps, make_env
from maexp.agents.config.compose import compose_settings
from maexp.agents.training.collectors import make_collector
from maexp.envs import SCENARIOS
from maexp.envs.io.map_server import export_ros_map

TEAM = {"random_obstacles": 1, "maze": 2, "maze_small": 4}  # robots; three elsewhere


@cache
def experience(scenario: str, path: str | None):
    """The policy and the batch [2 envs, 3 macro steps] it collected, once per scenario."""
    torch.manual_seed(0)
    place = [f"scenario.path='{path}'"] if path else ["scenario.maps=[0]", "scenario.held_out=[0]"]
    small = ["action=regions", "model.channels=4", "scenario.local_steps=4", "num_envs=2", "device=cpu"]
    cfg = compose_settings("train", [f"scenario={scenario}", *place, *small])
    env = make_env(cfg, load_maps(cfg.scenario).held_out, TEAM.get(scenario, 3))
    policy = make_policy(env, cfg.model)
    batch = make_collector(env, policy, 3).next().clone()
    return env, policy, cfg.model, batch


@pytest.fixture(scope="module")
def own_map(tmp_path_factory) -> str:
    """A file for scenario=pointcloud and scenario=ir2."""
    path = tmp_path_factory.mktemp("map") / "room.yaml"
    export_ros_map(room(60, 42, spacing=0.2), path)
    return str(path)


@pytest.mark.parametrize("scenario", SCENARIOS)
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_an_update_on_the_real_env(scenario, algorithm, own_map):
    env, policy, model, batch = experience(scenario, own_map if SCENARIOS[scenario].build is None else None)
    torch.manual_seed(1)
    row, policy = ALGORITHMS[algorithm], copy.deepcopy(policy)
    settings = row.configure(minibatch_size=6)
    critic = row.make_critic(env, model, settings)
    before = [p.clone() for p in (*policy.parameters(), *critic.parameters())]
    logged = row.make_updater(row.make_loss(policy, critic, settings), settings).update(batch.clone())
    after = [*policy.parameters(), *critic.parameters()]
    assert all(math.isfinite(value) for value in logged.values()), logged
    assert all(torch.isfinite(p).all() for p in after)
    moved = [not torch.equal(a, b) for a, b in zip(before, after, strict=True)]
    assert sum(moved) > 0.8 * len(moved)
