"""Robots that decide when they arrive (`decide=arrival`)."""

import numpy as np
import pytest
import torch

from maexp.agents import make_critic, make_loss, make_policy
from maexp.agents.algorithms.gae import write_advantages
from maexp.agents.algorithms.registry import find_algorithm
from maexp.agents.config.model import ModelConfig
from maexp.envs import CommConfig, ExplorationEnv, ObservationConfig, make_map
from maexp.envs.recorder import CoverageRecorder

SHOWN = ObservationConfig(pictures=False, targets=24)


@pytest.fixture(scope="module")
def office():
    return make_map("indoor_small", 0)


def make(office, teams=3, **settings) -> ExplorationEnv:
    settings = {"decision_seconds": "protocol", "decide": "arrival", "observation": SHOWN} | settings
    return ExplorationEnv(office, teams, seed=5, num_threads=1, **settings)


def play(env, name="multi_criteria", steps=None):
    """What each decision came to, until all teams are done."""
    policy, state, rows = make_policy(name, env), env.reset(), []
    while not bool(state["done"].all()) and (steps is None or len(rows) < steps):
        before = state.clone()
        state = env.step(policy(state))["next"]
        rows.append((before, state.clone()))
    return rows


@pytest.mark.parametrize("name", ["multi_criteria", "universal", "random"])
def test_an_episode_ends_after_its_seconds(office, name):
    env = make(office, success_coverage=1.0)
    last = play(env, name)[-1][1]
    assert (last["info", "local_steps"] <= env.settings.episode_steps).all()
    assert (last["truncated"] == (last["info", "local_steps"] == env.settings.episode_steps)).all()


def test_decisions_end_early_at_arrivals_and_mates_go_on(office):
    env = make(office)
    shorter = held = 0
    for before, after in play(env):
        spent = (after["info", "local_steps"] - before["info", "local_steps"]).squeeze(-1)
        deciding, going = after["agents", "deciding"], ~after["done"].squeeze(-1)
        assert (spent[~before["done"].squeeze(-1)] > 0).all() and (spent <= env.local_steps).all()
        assert deciding.any(-1)[going].all()  # else nobody would have stopped the team
        shorter += int((spent[going] < env.local_steps).sum())
        held += int((~deciding)[going].sum())
    assert shorter > 20 and held > 20


def test_a_robot_decides_after_its_seconds_whether_it_has_arrived_or_not(office):
    env, longest = make(office, decision_seconds=1.0), 0
    policy, after = make_policy("multi_criteria", env), env.reset()
    for _ in range(20):
        after = env.step(policy(after))["next"]
        since = env.arrivals.state["since"]
        due = (since >= env.local_steps) & after["agents", "observation", "alive"] & ~after["done"]
        longest = max(longest, int(since.max()))
        assert (since <= env.local_steps).all()
        assert after["agents", "deciding"][due].all()
    assert longest == env.local_steps


def test_who_does_not_decide_keeps_its_goal_and_target(office):
    env = make(office)
    policy, state = make_policy("multi_criteria", env), env.reset()
    held = 0
    for _ in range(25):
        goal, deciding = env.simulation.tensors["goal"].clone(), state["agents", "deciding"]
        going = env.simulation.tensors["active"].bool().unsqueeze(-1)
        aim = env.arrivals.state["aim"].clone()
        state = env.step(policy(state))["next"]
        same = (env.simulation.tensors["goal"] == goal).all(-1)
        assert same[~deciding & going].all() and torch.equal(env.arrivals.state["aim"][~deciding], aim[~deciding])
        held += int((~deciding & going).sum())
    assert held


def test_the_bits_do_not_depend_on_who_plays_beside_or_on_a_copy(office):
    env, alone = make(office, 2), make(office, 1)
    both, one = play(env, "universal", 8), play(alone, "universal", 8)
    for (_, a), (_, b) in zip(both, one, strict=True):
        assert torch.equal(a["info", "coverage"][:1], b["info", "coverage"])
        assert torch.equal(a["agents", "deciding"][:1], b["agents", "deciding"])
    again = make(office, 2)
    again.reset()
    again.load_state_dict(env.state_dict())
    policy = make_policy("universal", env)
    action = policy(both[-1][1].clone())
    first, second = env.step(action.clone())["next"], again.step(action.clone())["next"]
    assert torch.equal(first["info", "coverage"], second["info", "coverage"])
    assert torch.equal(first["agents", "deciding"], second["agents", "deciding"])


def test_curves_of_teams_at_moments_of_their_own(office):
    env = make(office)
    with CoverageRecorder(env, every=5) as recorder:
        rows = play(env)
    seconds, coverage = recorder.curves()
    assert (np.diff(seconds) > 0).all() and (np.diff(coverage, axis=1) >= -1e-6).all()
    assert np.allclose(coverage[:, -1], rows[-1][1]["info", "coverage"].squeeze(-1))


@pytest.mark.parametrize(
    "settings, word",
    [
        ({"comm": CommConfig(range=1.0, base_station=True, strategy="return_to_base")}, "comm.strategy=return_to_base"),
        ({"decide": "sometimes"}, "decide='sometimes'"),
    ],
)
def test_what_does_not_go_with_arrivals_is_refused(office, settings, word):
    with pytest.raises(ValueError, match=word):
        make(office, **settings)


def is_frontier(known, x, y) -> bool:
    height, width = known.shape
    around = ((x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1))
    return known[y, x] == 1 and any(0 <= u < width and 0 <= v < height and known[v, u] == 0 for u, v in around)


def expect_arrivals(env, reach, clearance):
    """From the definition, in plain loops."""
    arrivals, sim = env.arrivals, env.simulation.tensors
    grids, found = arrivals.known.grids, np.zeros((env.num_envs, env.num_robots), bool)
    for e in range(env.num_envs):
        m = int(sim["map_id"][e])
        width, height, cell = int(grids.width.numpy()[m]), int(grids.height.numpy()[m]), float(grids.cell.numpy()[m])
        known = arrivals.known.known.numpy()[e][: width * height].reshape(height, width)
        for i in range(env.num_robots):
            if not sim["active"][e] or sim["collided"][e, i] or not arrivals.state["has_aim"][e, i]:
                continue
            aim = arrivals.state["aim"][e, i].numpy().astype(np.float64)
            for j in range(env.num_robots):
                gap = np.hypot(*(sim["center"][e, j, :2].numpy().astype(np.float64) - aim))
                found[e, i] |= not sim["collided"][e, j] and gap <= max(1.5 * cell, clearance)
            x, y = np.floor((aim - grids.origin.numpy()[m]) / cell).astype(int)
            window = [
                (u, v)
                for u in range(max(x - reach[m], 0), min(x + reach[m], width - 1) + 1)
                for v in range(max(y - reach[m], 0), min(y + reach[m], height - 1) + 1)
            ]
            found[e, i] |= not any(is_frontier(known, u, v) for u, v in window)
    return found


def test_arrivals_are_those_of_the_definition(office):
    env = make(office, 4)
    policy, state, seen = make_policy("multi_criteria", env), env.reset(), 0
    for step in range(12):
        if step == 6:
            env.simulation.tensors["collided"][1, 0] = 1
        state = env.step(policy(state))["next"]
        found = env.arrivals._look().numpy()
        expected = expect_arrivals(env, env.arrivals._reach.numpy(), env.arrivals.clearance)
        assert (found == expected).all()
        seen += int(expected.sum())
    assert 5 < seen < 4 * 3 * 12


def batch_of(env, policy):
    with torch.no_grad():
        return env.rollout(30, policy, break_when_any_done=False)


@pytest.mark.parametrize("name", ["mappo", "vdppo", "matrpo"])
def test_what_comes_later_counts_by_the_time_that_passes(office, name):
    env, model = make(office, 4), ModelConfig(action="targets")
    policy, row = make_policy(env, model), find_algorithm(name)
    loss = make_loss(name, policy, make_critic(name, env, model), gamma=0.9, lmbda=0.7)
    batch = batch_of(env, policy)
    usual = write_advantages(loss, batch.clone())
    loss.decision_steps = env.local_steps
    found = write_advantages(loss, batch.clone())
    key = loss.tensor_keys
    e, value, after = 1, found[key.value][1], found["next", *key.value][1]
    reward, done = batch["next", "agents", "reward"][e], batch["next", "done"][e].squeeze(-1)
    reward = reward.sum(-2) if loss.team_value else reward
    length = (batch["next", "info", "local_steps"] - batch["info", "local_steps"])[e].squeeze(-1).double()
    last, expected = 0.0, []
    for t in reversed(range(len(done))):
        passed = float(length[t]) / env.local_steps
        go_on = 0.0 if done[t] else 1.0
        error = reward[t] + 0.9**passed * go_on * after[t] - value[t]
        last = error + (0.9 * 0.7) ** passed * go_on * last
        expected.insert(0, last)
    expected = torch.stack(expected)
    expected = expected.unsqueeze(-2).expand_as(found[key.advantage][e]) if loss.team_value else expected
    assert torch.allclose(found[key.advantage][e], expected.float(), atol=1e-4)
    batch["next", "info", "local_steps"] = batch["info", "local_steps"] + env.local_steps  # all alike: as ever
    alike = write_advantages(loss, batch.clone())
    assert torch.allclose(alike[key.advantage], usual[key.advantage], atol=1e-4)
    updater = row.make_updater(loss, row.configure(minibatch_size=40))
    assert np.isfinite(updater.update(batch)["entropy"])


def test_only_who_decides_teaches_the_policy(office):
    env, model = make(office, 4), ModelConfig(action="targets")
    policy = make_policy(env, model)
    loss = make_loss("mappo", policy, make_critic("mappo", env, model))
    batch = write_advantages(loss, batch_of(env, policy)).flatten()
    living = loss.find_living(batch)
    assert torch.equal(living, batch["agents", "observation", "alive"] & batch["agents", "deciding"])
    assert 0 < living.sum() < batch["agents", "observation", "alive"].sum()
