"""What the losses compute: advantages by hand, ratios per robot, keys kept apart, terms that add up."""

import math

import pytest
import torch
from toy_env import TINY_MODEL, ToyEnv

from maexp.agents import make_critic, make_loss, make_policy
from maexp.agents.algorithms import ALGORITHMS
from maexp.agents.algorithms.gae import ADVANTAGE, TARGET, TEAM_TARGET, write_advantages
from maexp.agents.algorithms.losses import ClippedLoss, policy_divergence
from maexp.agents.models.actor import ALIVE, MAP
from maexp.agents.models.critics import TEAM_VALUE, VALUE

GAMMA, LAMBDA = 0.9, 0.7


def setup(name, envs=5, steps=7, robots=3, seed=0, **settings):
    """Policy, critic, loss and a rollout that holds terminated, truncated and cut-off episodes."""
    torch.manual_seed(seed)
    env = ToyEnv(num_envs=envs, num_robots=robots, steps=3, seed=seed)
    policy, critic = make_policy(env, TINY_MODEL), make_critic(name, env, TINY_MODEL)
    for p in (*policy.parameters(), *critic.parameters()):
        torch.nn.init.normal_(p, std=0.3)
    loss = make_loss(name, policy, critic, gamma=GAMMA, lmbda=LAMBDA, **settings)
    with torch.no_grad():
        batch = env.rollout(steps, policy, break_when_any_done=False)
    assert batch["next", "terminated"].any() and batch["next", "truncated"].any()
    assert not batch["next", "done"][:, -1].all()
    return policy, critic, loss, batch


def by_hand(value, following, reward, done, terminated):
    """GAE as Schulman et al. 2016 write it, one env and one value at a time, in plain Python."""
    advantage = [[0.0] * len(row) for row in value]
    for e, row in enumerate(value):
        trace = 0.0
        for t in reversed(range(len(row))):
            after = 0.0 if terminated[e][t] else following[e][t]
            error = reward[e][t] + GAMMA * after - row[t]
            trace = error + (0.0 if done[e][t] else GAMMA * LAMBDA * trace)
            advantage[e][t] = trace
    return torch.tensor(advantage)


def hand_made(critic, batch, key):
    """Values by calling the critic on every state and on every next state, then `by_hand` per robot."""
    with torch.no_grad():
        value = critic(batch.select("agents"))[key]
        following = critic(batch["next"].select("agents"))[key]
    reward = batch["next", "agents", "reward"]
    if key == TEAM_VALUE:
        reward, value, following = reward.sum(-2, keepdim=True), value.unsqueeze(-2), following.unsqueeze(-2)
    flags = [batch["next", name][..., 0].tolist() for name in ("done", "terminated")]
    columns = [
        by_hand(*(x[..., robot, 0].tolist() for x in (value, following, reward)), *flags)
        for robot in range(reward.shape[-2])
    ]
    return torch.stack(columns, -1).unsqueeze(-1), value


@pytest.mark.parametrize("name", ["ippo", "matrpo", "vdppo", "vda2c"])
@pytest.mark.parametrize("way", ["loss", "updater"])
@pytest.mark.parametrize("finite", [True, False])
def test_advantages_match_a_hand_written_gae(name, way, finite):
    """With a finite horizon nothing follows a truncated episode; a batch's end in the middle of one is no end."""
    _, critic, loss, batch = setup(name, finite_horizon=finite)
    team = ALGORITHMS[name].critic == "mixed"
    ended = batch.copy()
    if finite:
        ended["next"] = batch["next"].copy().set("terminated", batch["next", "done"])
    expected, value = hand_made(critic, ended, TEAM_VALUE if team else VALUE)
    if way == "updater":
        out = write_advantages(loss, batch.copy(), chunk=4)
    else:
        params = loss.critic_network_params.detach()
        out = loss.value_estimator(batch.copy(), params=params, target_params=params)
    torch.testing.assert_close(out[ADVANTAGE], expected.expand(5, 7, 3, 1), atol=1e-5, rtol=1e-4)
    target = (expected + value).squeeze(-2) if team else expected + value
    torch.testing.assert_close(out[TEAM_TARGET if team else TARGET], target, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_before_the_first_update_nothing_has_moved(name):
    policy, _, loss, batch = setup(name)
    with torch.no_grad():
        dist = policy.get_dist(batch.copy())
    again = dist.log_prob(batch)
    for head in ("region", "offset"):
        key = ("agents", "action", f"{head}_log_prob")
        torch.testing.assert_close(again[key], batch[key], atol=1e-5, rtol=1e-5)
    assert policy_divergence(batch, dist).abs().max() < 1e-5
    terms = loss(batch)
    if "clip_fraction" in terms.keys():
        assert terms["kl"].item() == pytest.approx(0, abs=1e-5) and terms["ESS"].item() == pytest.approx(1, rel=1e-4)
        assert terms["clip_fraction"].item() == 0


@pytest.mark.parametrize("name", ALGORITHMS)
def test_terms_are_finite_and_reach_their_own_network_only(name):
    policy, critic, loss, batch = setup(name)
    terms = loss(batch)
    for key, parameters, others in (("loss_objective", policy, critic), ("loss_critic", critic, policy)):
        assert math.isfinite(terms[key].item())
        grads = torch.autograd.grad(terms[key], list(parameters.parameters()), retain_graph=True, allow_unused=True)
        assert sum(g.abs().sum() for g in grads if g is not None) > 0
        grads = torch.autograd.grad(terms[key], list(others.parameters()), retain_graph=True, allow_unused=True)
        assert all(g is None for g in grads)


def acting_terms(loss, policy, batch, change=0.05):
    """Advantages, then a small change of the policy; returns log-ratios per robot summed over both heads."""
    batch = write_advantages(loss, batch.copy())
    with torch.no_grad():
        for p in policy.parameters():
            p.add_(change * torch.randn(p.shape))
        new = policy.get_dist(batch.copy()).log_prob(batch)
    keys = [("agents", "action", f"{head}_log_prob") for head in ("region", "offset")]
    return batch, sum(new[k] for k in keys), sum(new[k] - batch[k] for k in keys)


@pytest.mark.parametrize("name", ["ippo", "mappo", "vdppo"])
def test_clipped_objective_has_one_ratio_per_robot(name):
    policy, _, loss, batch = setup(name, normalize_advantage=False)
    batch, _, log_ratio = acting_terms(loss, policy, batch)
    ratio, advantage = log_ratio.exp(), batch[ADVANTAGE][..., 0]
    assert ratio.shape == (5, 7, 3) and (ratio - 1).abs().max() > 0.2
    expected = -torch.minimum(ratio * advantage, ratio.clamp(0.8, 1.2) * advantage).mean()
    assert loss(batch)["loss_objective"].item() == pytest.approx(expected.item(), rel=1e-4)


def test_trust_region_surrogate_is_unclipped_with_entropy_bonus():
    policy, _, loss, batch = setup("matrpo", normalize_advantage=False, entropy_coeff=0.5)
    batch, _, log_ratio = acting_terms(loss, policy, batch)
    dist = policy.get_dist(batch.copy())
    entropy = dist.entropy().mean()
    expected = -(log_ratio.exp() * batch[ADVANTAGE][..., 0]).mean() - 0.5 * entropy
    value, divergence, _ = loss.surrogate(batch)
    assert value.item() == pytest.approx(expected.item(), rel=1e-4)
    assert divergence.item() == pytest.approx(policy_divergence(batch, dist).mean().item(), rel=1e-5)
    assert divergence.item() > 1e-3


def test_actor_critic_objective_per_robot_over_both_heads():
    policy, _, loss, batch = setup("vda2c", normalize_advantage=False)
    batch, log_prob, _ = acting_terms(loss, policy, batch)
    terms = loss(batch)
    expected = -(log_prob * batch[ADVANTAGE][..., 0]).mean()
    assert terms["loss_objective"].item() == pytest.approx(expected.item(), rel=1e-4)
    dist = policy.get_dist(batch.copy())
    entropy = dist.entropy().mean()
    assert terms["entropy"].item() == pytest.approx(entropy.item(), rel=1e-4)
    assert set(loss.in_keys) >= {MAP, ("agents", "action", "region"), ("next", "agents", "reward")}


def test_divergence_is_from_the_acting_policy_in_closed_form():
    policy, _, loss, batch = setup("ippo", kl_coeff=0.2)
    batch, _, _ = acting_terms(loss, policy, batch)
    before = batch["agents", "params"].clone()
    new = policy.module[0](batch.copy())["agents", "params"]
    p, q = (x["region", "logits"].log_softmax(-1) for x in (before, new))
    (m, s), (n, r) = ((x["offset", "loc"], x["offset", "scale"]) for x in (before, new))
    within = ((r / s).log() + (s**2 + (m - n) ** 2) / (2 * r**2) - 0.5).sum(-1)
    expected = (p.exp() * (p - q + within)).sum(-1)
    terms = loss(batch)
    assert terms["loss_kl"].item() == pytest.approx(0.2 * expected.mean().item(), rel=1e-4)
    assert terms["loss_kl"].item() > 1e-4
    assert (batch["agents", "params"] == before).all(), "the loss overwrote what the acting policy wrote"


@pytest.mark.parametrize("divergence, factor", [(0.03, 1.5), (0.001, 0.5), (0.01, 1.0)])
def test_penalty_follows_the_divergence(divergence, factor):
    _, _, loss, _ = setup("mappo", kl_coeff=0.2)
    loss.adapt_penalty(divergence)
    assert loss.kl_coeff.item() == pytest.approx(0.2 * factor)


def test_a_batch_without_acting_parameters_is_refused_by_name():
    policy, _, loss, batch = setup("itrpo")
    batch = write_advantages(loss, batch.copy())
    del batch["agents", "params"]
    with pytest.raises(KeyError, match="params"):
        loss.surrogate(batch)


def test_value_error_in_units_of_the_returns():
    errors = []
    for scale in (1e3, 1e5):
        _, _, loss, batch = setup("matrpo")
        batch = write_advantages(loss, batch.copy())
        batch[TARGET] = batch[TARGET] * scale
        errors.append(loss(batch)["loss_critic"].item())
    assert errors[1] == pytest.approx(errors[0], rel=0.05)


def with_collisions(batch):
    """The batch, two robots of five having collided in its second half; and who is alive."""
    batch = batch.clone()
    alive = batch[ALIVE]
    alive[::2, 3:, 1] = False
    alive[1, 5:, :2] = False
    return batch, alive


def policy_gradient(name, loss, batch):
    terms = loss(batch)
    total = sum(terms[key] for key in terms.keys() if key in ("loss_objective", "loss_entropy", "loss_kl"))
    if hasattr(loss, "surrogate"):
        total = total + sum(loss.surrogate(batch)[:2]) + loss.divergence(batch)
    params = list(loss.actor_network_params.parameters())
    grads = torch.autograd.grad(total, params, allow_unused=True)
    return torch.cat([g.flatten() for g in grads if g is not None])


@pytest.mark.parametrize("name", ALGORITHMS)
def test_what_a_collided_robot_did_moves_no_policy(name):
    """Its advantage, its action's stored probability and its parameters may be anything."""
    settings = {"kl_coeff": 0.3} if ALGORITHMS[name].loss is ClippedLoss else {}
    policy, _, loss, batch = setup(name, **settings)
    batch, alive = with_collisions(batch)
    batch, _, _ = acting_terms(loss, policy, batch)
    before = policy_gradient(name, loss, batch)
    assert before.abs().max() > 1e-4
    other = batch.clone()
    other[ADVANTAGE][~alive] += 100 * torch.randn_like(other[ADVANTAGE][~alive])
    for head in ("region", "offset"):
        other["agents", "action", f"{head}_log_prob"][~alive] -= 5.0
    other["agents", "params", "region", "logits"][~alive] *= -3.0
    torch.testing.assert_close(policy_gradient(name, loss, other), before, atol=1e-6, rtol=1e-4)
    other[ADVANTAGE][alive] += 10 * torch.randn_like(other[ADVANTAGE][alive])
    assert not torch.allclose(policy_gradient(name, loss, other), before, atol=1e-4)
    loss.mask_collided = False
    assert not torch.allclose(policy_gradient(name, loss, batch), before, atol=1e-4)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_objective_and_entropy_are_means_over_the_living(name):
    policy, _, loss, batch = setup(name, normalize_advantage=True)
    batch, alive = with_collisions(batch)
    batch, log_prob, log_ratio = acting_terms(loss, policy, batch)
    advantage = batch[ADVANTAGE][..., 0].double()
    parts = [advantage] if name == "vda2c" else [advantage[..., robot] for robot in range(3)]
    masks = [alive] if name == "vda2c" else [alive[..., robot] for robot in range(3)]
    parts = [(part - part[mask].mean()) / part[mask].std() for part, mask in zip(parts, masks, strict=True)]
    advantage = parts[0] if name == "vda2c" else torch.stack(parts, -1)
    ratio = log_ratio.exp()
    if name == "vda2c":
        each = log_prob * advantage
    elif name in ("itrpo", "matrpo"):
        each = ratio * advantage
    else:
        each = torch.minimum(ratio * advantage, ratio.clamp(0.8, 1.2) * advantage)
    terms = loss(batch)
    assert terms["loss_objective"].item() == pytest.approx(-each[alive].mean().item(), rel=1e-4)
    dist = policy.get_dist(batch.copy())
    assert terms["entropy"].item() == pytest.approx(dist.entropy()[alive].mean().item(), rel=1e-5)
    if "clip_fraction" in terms.keys():
        share = ((ratio - 1).abs() > 0.2)[alive].float().mean().item()
        assert terms["clip_fraction"].item() == pytest.approx(share, abs=1e-6)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_minibatch_without_a_living_robot_teaches_the_critic_alone(name):
    policy, critic, loss, batch = setup(name)
    batch[ALIVE][:] = False
    batch, _, _ = acting_terms(loss, policy, batch)
    assert policy_gradient(name, loss, batch).abs().max() == 0
    terms = loss(batch)
    assert all(torch.isfinite(value).all() for value in terms.values())
    grads = torch.autograd.grad(terms["loss_critic"], list(critic.parameters()), allow_unused=True)
    assert sum(g.abs().sum() for g in grads if g is not None) > 0


def test_values_of_collided_robots_are_learned_too():
    _, _, loss, batch = setup("ippo", value_norm=False)
    batch, alive = with_collisions(batch)
    batch = write_advantages(loss, batch)
    before = loss(batch)["loss_critic"]
    batch[TARGET][~alive] += 1e3
    assert loss(batch)["loss_critic"] > 1.5 * before


@pytest.mark.parametrize("name", ALGORITHMS)
def test_the_weight_of_the_critics_loss(name):
    losses, moved = [], []
    for weight in (0.7, 1.4, 0.0):
        _, critic, loss, batch = setup(name, critic_coeff=weight)
        before = [parameter.detach().clone() for parameter in critic.parameters()]
        losses.append(loss(batch)["loss_critic"].item())
        ALGORITHMS[name].make_updater(loss, ALGORITHMS[name].configure(critic_coeff=weight)).update(batch)
        moved.append(
            any(not torch.equal(parameter, old) for parameter, old in zip(critic.parameters(), before, strict=True))
        )
    assert losses[1] == pytest.approx(2 * losses[0]) and losses[0] > 0 == losses[2]
    assert moved == [True, True, False]


def test_a_batch_of_one_env_without_advantages():
    """TorchRL's estimator takes any leading shape."""
    _, _, loss, batch = setup("mappo")
    assert loss(batch[0])["loss_critic"].item() == pytest.approx(loss(batch[:1])["loss_critic"].item(), rel=1e-4)
