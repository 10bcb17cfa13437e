"""The six algorithms as a whole: each learns a toy, saves and restores itself, and says what is wrong."""

import copy
import math

import pytest
import torch
from torchrl.collectors import Collector
from toy_env import SMALL_MODEL, ToyEnv

from maexp.agents import ALGORITHMS, make_critic, make_loss, make_policy
from maexp.agents.algorithms.losses import NonFiniteLoss
from maexp.agents.algorithms.registry import find_algorithm

FAST = {  # the toy's best settings in few steps; the defaults are for long runs on real maps
    "clipped": dict(lr=4e-3, critic_lr=3e-3, minibatch_size=64),
    "trust": dict(fisher_size=64, max_kl=0.06, critic_epochs=2, minibatch_size=64),
    "actor": dict(lr=4e-3, critic_lr=3e-3, minibatch_size=64, gamma=0.99, lmbda=0.95, entropy_coeff=3e-3),
}
STYLE = dict(ippo="clipped", mappo="clipped", vdppo="clipped", itrpo="trust", matrpo="trust", vda2c="actor")
RANDOM, BEST = 0.67, 2.0


def build(name, env, model="small", **settings):
    row = ALGORITHMS[name]
    settings = row.configure(**settings)
    policy, critic = make_policy(env, model), row.make_critic(env, model, settings)
    loss = row.make_loss(policy, critic, settings)
    return policy, critic, row.make_updater(loss, settings)


def batches(env, policy, count, steps=4):
    for _ in range(count):
        with torch.no_grad():
            batch = env.rollout(steps, policy, break_when_any_done=False)
        yield batch


@pytest.mark.slow
@pytest.mark.parametrize("name", ALGORITHMS)
@pytest.mark.parametrize("seed", range(3))
def test_learns_the_toy_in_seconds(name, seed):
    """From 0.67 (random) to more than half the way to 2 (the optimum), in well under five seconds."""
    torch.manual_seed(seed)
    env = ToyEnv(num_envs=64, seed=seed)
    policy, _, updater = build(name, env, **FAST[STYLE[name]])
    rewards = []
    for batch in batches(env, policy, 24):
        rewards.append(batch["next", "agents", "reward"].mean().item())
        if rewards[-1] > 0.5 * (RANDOM + BEST):
            break
        updater.update(batch)
    assert abs(rewards[0] - RANDOM) < 0.1
    assert max(rewards) > 0.5 * (RANDOM + BEST), f"stuck at {rewards[-1]:.2f} after {len(rewards)} batches"


@pytest.mark.parametrize("name", ALGORITHMS)
def test_one_update_moves_policy_and_critic_and_reports(name):
    torch.manual_seed(0)
    env = ToyEnv(num_envs=8)
    policy, critic, updater = build(name, env, SMALL_MODEL)
    before = [p.clone() for p in (*policy.parameters(), *critic.parameters())]
    (batch,) = batches(env, policy, 1)
    stored = batch.clone()
    metrics = updater.update(batch)
    after = [*policy.parameters(), *critic.parameters()]
    moved = [not torch.equal(a, b) for a, b in zip(before, after, strict=True)]
    assert sum(moved) > 0.9 * len(moved)
    shared = {"kl", "entropy", "loss_objective", "loss_critic", "explained_variance", "critic_gradient_norm"}
    assert shared | {"advantage", "update"} <= set(metrics)
    assert all(isinstance(v, float) and math.isfinite(v) for v in metrics.values())
    assert metrics["advantage"] > 0 and metrics["update"] > 0
    assert (batch == stored).all(), "the batch belongs to the caller"


@pytest.mark.parametrize("name", ALGORITHMS)
def test_reference_settings_run(name):
    torch.manual_seed(0)
    env = ToyEnv(num_envs=8)
    policy, _, updater = build(name, env, SMALL_MODEL, tuning="reference")
    (batch,) = batches(env, policy, 1)
    assert all(math.isfinite(v) for v in updater.update(batch).values())


@pytest.mark.parametrize("name", ["ippo", "matrpo", "vda2c"])
def test_a_restored_updater_goes_on_bit_for_bit(name):
    torch.manual_seed(0)
    env = ToyEnv(num_envs=8)
    policy, _, updater = build(name, env, SMALL_MODEL)
    first, second = batches(env, policy, 2)
    updater.update(first)
    saved = copy.deepcopy(updater.state_dict())
    torch.manual_seed(5)
    updater.update(second)
    other_policy, _, other = build(name, env, SMALL_MODEL)
    other.load_state_dict(saved)
    torch.manual_seed(5)
    other.update(second)
    for a, b in zip(policy.parameters(), other_policy.parameters(), strict=True):
        assert torch.equal(a, b)
    flat, again = updater.state_dict()["loss"], other.state_dict()["loss"]
    assert all(torch.equal(flat[k], again[k]) for k in flat if isinstance(flat[k], torch.Tensor))


@pytest.mark.parametrize("name", ["mappo", "itrpo", "vda2c"])
def test_teams_of_several_sizes_share_one_update(name):
    torch.manual_seed(0)
    policy, _, updater = build(name, ToyEnv(num_envs=8), SMALL_MODEL, minibatch_size=16)
    mixed = [next(batches(ToyEnv(num_envs=6, num_robots=n), policy, 1)) for n in (1, 2, 4)]
    assert all(math.isfinite(v) for v in updater.update(*mixed).values())


@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_loss_takes_a_collector_batch_in_user_code(name):
    """Design 2: make_policy, make_critic, make_loss, one Collector batch, an optimizer of one's own."""
    torch.manual_seed(0)
    env = ToyEnv(num_envs=4)
    policy, critic = make_policy(env, SMALL_MODEL), make_critic(name, env, SMALL_MODEL)
    loss = make_loss(name, policy, critic)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    assert sum(p.numel() for p in loss.parameters()) == sum(
        p.numel() for net in (policy, critic) for p in net.parameters()
    )
    for batch in Collector(env, policy, frames_per_batch=12, total_frames=24, auto_register_policy_transforms=False):
        terms = loss(batch)
        optimizer.zero_grad()
        sum(value for key, value in terms.items() if key.startswith("loss_")).backward()
        optimizer.step()
    assert math.isfinite(terms["loss_objective"].item())


def test_learning_rates_decay_with_progress():
    env = ToyEnv(num_envs=4)
    policy, _, updater = build("ippo", env, SMALL_MODEL, lr=1e-3, critic_lr=2e-3, final_lr_share=0.1)
    (batch,) = batches(env, policy, 1)
    updater.update(batch, progress=0.5)
    assert updater.policy_optimizer.param_groups[0]["lr"] == pytest.approx(5.5e-4)
    assert updater.critic_optimizer.param_groups[0]["lr"] == pytest.approx(1.1e-3)


def test_first_returns_set_the_critics_scale():
    torch.manual_seed(0)
    env = ToyEnv(num_envs=32)
    policy, critic, updater = build("mappo", env, SMALL_MODEL)
    (batch,) = batches(env, policy, 1)
    batch["next", "agents", "reward"] = batch["next", "agents", "reward"] * 50 + 300
    updater.prepare(batch)
    value = critic(batch.copy())["agents", "state_value"]
    assert 300 < value.mean() < 3000 and critic.module.calibrated
    scale = critic.module.scale.clone()
    updater.prepare(batch)
    assert critic.module.scale == scale, "only the first batch sets it"


@pytest.mark.parametrize("name", ["ippo", "itrpo", "vda2c"])
def test_numbers_that_are_none_stop_the_update_by_name(name):
    torch.manual_seed(0)
    env = ToyEnv(num_envs=4)
    policy, critic, updater = build(name, env, SMALL_MODEL)
    (batch,) = batches(env, policy, 1)
    bad = batch.clone()
    bad["next", "agents", "reward"][0, 0, 0] = float("nan")
    with pytest.raises(NonFiniteLoss, match="advantage"):
        updater.update(bad)
    with torch.no_grad():
        next(policy.parameters()).fill_(float("inf"))
    with pytest.raises(NonFiniteLoss, match="loss_|gradient"):
        updater.update(batch)


def test_the_table_names_the_six():
    kinds = {name: row.critic for name, row in ALGORITHMS.items()}
    assert kinds == dict(ippo="local", mappo="team", itrpo="local", matrpo="team", vdppo="mixed", vda2c="mixed")
    assert ALGORITHMS["itrpo"].reference.max_kl == 0.06 and ALGORITHMS["ippo"].reference.kl_coeff == 0.2


def test_unknown_names_are_answered_with_the_choices():
    with pytest.raises(ValueError, match="algorithm='ppo'.*ippo"):
        find_algorithm("ppo")
    with pytest.raises(ValueError, match="ippo has no setting 'clip'.*clip_epsilon"):
        ALGORITHMS["ippo"].configure(clip=0.1)
    with pytest.raises(ValueError, match="tuning='paper'.*reference"):
        ALGORITHMS["ippo"].configure("paper")
