"""Evaluation: the same episodes for everyone, every one to its end, and no trace in the random numbers."""

import pytest
import torch

from maexp.agents import make_policy
from maexp.agents.evaluate import evaluate, play
from maexp.agents.policies import POLICIES
from maexp.envs import ExplorationEnv, make_map


def build(num_envs=3, num_robots=2, seed=0, macro_steps=3):
    maps = [make_map("maze_small", index) for index in (70, 71)]
    return ExplorationEnv(maps, num_envs, num_robots, seed=seed, macro_steps=macro_steps, local_steps=10)


@pytest.fixture(scope="module")
def env():
    return build()


def still(state):
    """Every robot's goal is region 0: a policy without random numbers."""
    shape = state["agents", "observation", "pose"].shape[:2]
    state["agents", "action", "region"] = torch.zeros(shape, dtype=torch.int64)
    state["agents", "action", "offset"] = torch.zeros(*shape, 2)
    return state


@pytest.mark.parametrize("num_envs", [1, 2, 5])
def test_episodes_do_not_depend_on_the_batch(env, num_envs):
    wanted = evaluate(still, env, 5).episodes
    found = evaluate(still, build(num_envs), 5).episodes
    for name, values in wanted.items():
        assert len(values) == 5
        torch.testing.assert_close(torch.from_numpy(found[name]), torch.from_numpy(values), equal_nan=True)


def test_another_seed_gives_other_episodes(env):
    first, second = evaluate(still, env, 4).episodes, evaluate(still, build(seed=1), 4).episodes
    assert (first["exploration_ratio"] != second["exploration_ratio"]).any()


def test_the_final_info_is_that_of_the_episodes_end(env):
    """An env that ends early keeps the numbers of its end while the others play on."""
    env.set_episodes(torch.arange(3))
    state, ends = env.reset(), {}
    for step in range(env.macro_steps):
        state = env.step(still(state))
        for index in torch.nonzero(state["next", "done"].squeeze(-1)).flatten().tolist():
            ends.setdefault(index, (step, state["next", "info", "coverage"][index].item()))
        state = state["next"].exclude("agents").update({"agents": state["next", "agents"]})
    final = play(still, env, torch.arange(3))
    assert [ends[index][1] for index in range(3)] == final["coverage"].squeeze(-1).tolist()


def test_random_numbers_go_on_as_if_nothing_had_happened(env):
    policy = make_policy(env)
    torch.manual_seed(3)
    wanted = torch.rand(4)
    torch.manual_seed(3)
    first = evaluate(policy, env, 4, seed=1).episodes["path_length"]
    assert torch.equal(torch.rand(4), wanted)
    assert (evaluate(policy, env, 4, seed=1).episodes["path_length"] == first).all()
    assert (evaluate(policy, env, 4, seed=2).episodes["path_length"] != first).any()


@pytest.mark.parametrize("name", ["random", "nearest_frontier"])
def test_classical_policies_play(env, name):
    summary = evaluate(POLICIES[name](env), env, 3, name=name).summary()
    assert 0 < summary["exploration_ratio"]["mean"] <= 1
    assert summary["coverage_step_95"]["n"] <= summary["exploration_ratio"]["n"] == 3


def test_one_policy_for_every_team_size(env):
    policy = make_policy(env)
    for size in (1, 4):
        assert evaluate(policy, build(2, size), 2).num_robots == size
