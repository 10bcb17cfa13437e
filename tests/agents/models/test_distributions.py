"""How actions are drawn: against formulas written out in float64, against samples, and what a clone can learn."""

import math

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Categorical
from torchrl.modules import IndependentNormal
from torchrl.objectives.multiagent import MAPPOLoss
from toy_env import TINY_MODEL, ToyEnv

from maexp.agents import ModelConfig, make_critic, make_loss, make_policy
from maexp.agents.algorithms.gae import write_advantages
from maexp.agents.models.actor import REGION_HEADS
from maexp.agents.models.distributions import OFFSET, REGION, Heads, RegionHeads, divergence

BATCH, ROBOTS, REGIONS = 5, 3, 7
REGION_LOG_PROB, OFFSET_LOG_PROB = (("agents", "action", f"{head}_log_prob") for head in ("region", "offset"))


def parameters(seed, per_region=True) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)
    offsets = (BATCH, ROBOTS, REGIONS, 2) if per_region else (BATCH, ROBOTS, 2)
    return TensorDict(
        {
            "region": {"logits": 2 * torch.randn(BATCH, ROBOTS, REGIONS, generator=generator)},
            "offset": {
                "loc": torch.randn(offsets, generator=generator),
                "scale": 0.2 + torch.rand(offsets, generator=generator),
            },
        },
        batch_size=[BATCH],
    )


def normal_log_density(x, loc, scale) -> float:
    return sum(
        -0.5 * ((a - m) / s) ** 2 - math.log(s) - 0.5 * math.log(2 * math.pi)
        for a, m, s in zip(x, loc, scale, strict=True)
    )


def normal_divergence(loc, scale, other_loc, other_scale) -> float:
    return sum(
        math.log(r / s) + (s * s + (m - n) ** 2) / (2 * r * r) - 0.5
        for m, s, n, r in zip(loc, scale, other_loc, other_scale, strict=True)
    )


def rows(params):
    """(log-probabilities, means, scales) of every robot as plain float64 lists."""
    logits = params["region", "logits"].double().log_softmax(-1)
    values = (logits, params["offset", "loc"].double(), params["offset", "scale"].double())
    for b in range(BATCH):
        for i in range(ROBOTS):
            yield tuple(value[b, i].tolist() for value in values)


def test_joint_log_probability_entropy_and_divergence_by_hand():
    params, before = parameters(0), parameters(1)
    dist = RegionHeads(params, REGION_HEADS)
    action = RegionHeads(before, REGION_HEADS).sample()
    assert action[REGION].shape == (BATCH, ROBOTS) and action[OFFSET].shape == (BATCH, ROBOTS, 2)
    regions, offsets = action[REGION].flatten().tolist(), action[OFFSET].double().flatten(0, 1).tolist()
    each = (rows(params), rows(before), regions, offsets)
    log_prob, entropy, divergence = [], [], []
    for (p, loc, scale), (q, old_loc, old_scale), r, x in zip(*each, strict=True):
        log_prob.append([p[r], normal_log_density(x, loc[r], scale[r])])
        normals = [sum(math.log(s) + 0.5 * math.log(2 * math.pi * math.e) for s in row) for row in scale]
        entropy.append(sum(math.exp(a) * (h - a) for a, h in zip(p, normals, strict=True)))
        within = [normal_divergence(*parameters) for parameters in zip(old_loc, old_scale, loc, scale, strict=True)]
        divergence.append(sum(math.exp(a) * (a - b + d) for a, b, d in zip(q, p, within, strict=True)))
    out = dist.log_prob(action)
    found = torch.stack((out[REGION_LOG_PROB], out[OFFSET_LOG_PROB]), -1).flatten(0, 1)
    torch.testing.assert_close(found.double(), torch.tensor(log_prob).double(), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(dist.entropy().flatten(), torch.tensor(entropy), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(dist.divergence_from(before).flatten(), torch.tensor(divergence), atol=1e-4, rtol=1e-5)


@pytest.mark.parametrize("kind", [RegionHeads, Heads])
def test_samples_agree_with_entropy_and_divergence(kind):
    """Means over many draws: of -log p the entropy, of log(p / q) the divergence."""
    torch.manual_seed(0)
    dist, other = (kind(parameters(seed, kind is RegionHeads), REGION_HEADS) for seed in (0, 1))
    draws = dist.sample((20_000,))
    assert draws.batch_size == (20_000, BATCH, ROBOTS)
    own, others = (sum(distribution.log_prob(draws).values(True, True)) for distribution in (dist, other))
    torch.testing.assert_close(-own.mean(0), dist.entropy(), atol=0.05, rtol=0)
    ratio = own - others
    error = (ratio.mean(0) - other.divergence_from(parameters(0, kind is RegionHeads))).abs()
    assert (error < 5 * ratio.std(0) / 20_000**0.5).all()


def test_offsets_are_drawn_from_the_region_that_was_drawn():
    torch.manual_seed(0)
    params = parameters(0)
    draws = RegionHeads(params, REGION_HEADS).sample((50_000,))
    region, offset = draws[REGION][:, 0, 0], draws[OFFSET][:, 0, 0]
    for r in range(REGIONS):
        inside = offset[region == r]
        share = params["region", "logits"][0, 0].softmax(-1)[r]
        assert len(inside) / 50_000 == pytest.approx(share.item(), abs=0.01)
        if len(inside) > 100:
            spread = params["offset", "scale"][0, 0, r]
            assert ((inside.mean(0) - params["offset", "loc"][0, 0, r]).abs() < 5 * spread / len(inside) ** 0.5).all()
            torch.testing.assert_close(inside.std(0), spread, atol=0, rtol=0.3)


def test_torchrls_own_loss_takes_the_policy_with_one_ratio_per_robot():
    torch.manual_seed(0)
    env = ToyEnv(num_envs=6)
    policy, critic = make_policy(env, TINY_MODEL), make_critic("mappo", env, TINY_MODEL)
    ours = make_loss("mappo", policy, critic, entropy_coeff=0.01, value_norm=False)
    plain = MAPPOLoss(policy, critic, entropy_coeff=0.01)
    names = ("advantage", "value_target", "value", "reward")
    plain.set_keys(**{name: getattr(ours.tensor_keys, name) for name in names})
    with torch.no_grad():
        batch = write_advantages(ours, env.rollout(4, policy, break_when_any_done=False))
        for p in policy.parameters():
            p.add_(0.1 * torch.randn(p.shape))
    a, b = ours(batch), plain(batch)
    for name in ("loss_objective", "loss_entropy", "loss_critic", "clip_fraction"):
        torch.testing.assert_close(a[name], b[name], atol=1e-5, rtol=1e-4)
    assert a["clip_fraction"] > 0


def clone(kind, steps=120):
    """Negative log-likelihood of the offsets of a teacher whose offset depends on the region it chose at random."""
    torch.manual_seed(0)
    env = ToyEnv(num_envs=12)
    policy = make_policy(env, ModelConfig(channels=4, grid_features=4, critic_hidden=4, offsets=kind))
    state = env.reset()
    wanted = torch.tensor([[-0.6, 0.6], [0.6, 0.6], [0.6, -0.6], [-0.6, -0.6]])
    optimizer = torch.optim.Adam(policy.parameters(), lr=2e-2)
    for _ in range(steps):
        region = torch.randint(4, (12, 3))
        action = TensorDict({REGION: region, OFFSET: wanted[region]}, batch_size=[12, 3])
        loss = -policy.get_dist(state.copy()).log_prob(action)[OFFSET_LOG_PROB].mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return loss.item()


def test_a_clone_tells_the_offsets_of_different_regions_apart():
    shared, per_region = clone("shared"), clone("per_region")
    uniform = math.log(4)  # of an offset in [-1, 1]^2
    assert shared > uniform > 0 > per_region


def test_heads_without_regions_are_plain():
    loc, scale = torch.randn(2, 3, 2), torch.rand(2, 3, 2) + 0.1
    params = TensorDict({"control": {"loc": loc, "scale": scale}}, batch_size=[2])
    dist = Heads(params, {"control": IndependentNormal})
    assert torch.equal(dist.mode["agents", "action", "control"], loc)
    torch.testing.assert_close(dist.entropy(), torch.distributions.Normal(loc, scale).entropy().sum(-1))
    assert isinstance(RegionHeads(parameters(0), REGION_HEADS).region, Categorical)


def test_divergence_stays_finite_where_a_probability_vanishes():
    """KL from the logits by hand in float64; torch's own is infinite where float32 has no such small probability."""
    before, now = torch.tensor([[0.0, -95.0, -1e9]]), torch.tensor([[-120.0, 0.0, -1e9]])
    p, q = (logits.double().log_softmax(-1) for logits in (before, now))
    expected = (p.exp() * (p - q)).sum(-1)
    found = divergence(Categorical(logits=before), Categorical(logits=now))
    torch.testing.assert_close(found.double(), expected)
