"""The trust-region step against dense matrices, and what it promises: inside the region, better, or nothing."""

import pytest
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from toy_env import TINY_MODEL, ToyEnv

from maexp.agents import make_policy
from maexp.agents.algorithms.registry import ALGORITHMS, make_critic, make_loss
from maexp.agents.algorithms.trust_region import TRPO, conjugate_gradient, flatten


class Bandit:
    """A small softmax policy over 4 arms with 3 features, its surrogate and its divergence."""

    def __init__(self, seed=0):
        torch.manual_seed(seed)
        self.net = torch.nn.Sequential(torch.nn.Linear(3, 5), torch.nn.Tanh(), torch.nn.Linear(5, 4))
        self.x = torch.randn(200, 3)
        with torch.no_grad():
            self.old = self.net(self.x).log_softmax(-1)
        self.actions = torch.distributions.Categorical(logits=self.old).sample()
        self.advantage = torch.randn(200) + (self.actions == 1) * 1.0

    def closure(self):
        new = self.net(self.x).log_softmax(-1)
        ratio = (new - self.old).gather(1, self.actions[:, None])[:, 0].exp()
        return -(ratio * self.advantage).mean(), (self.old.exp() * (self.old - new)).sum(-1).mean()

    def dense_fisher(self):
        """Mean over states of J^T (diag p - p p^T) J, from the Jacobian of the logits."""
        params = list(self.net.parameters())
        size = sum(p.numel() for p in params)
        fisher = torch.zeros(size, size)
        for state in self.x:
            logits = self.net(state)
            rows = [flatten(torch.autograd.grad(l, params, retain_graph=True), params) for l in logits]
            jacobian, p = torch.stack(rows), logits.softmax(-1).detach()
            fisher += jacobian.T @ (p.diag() - p[:, None] * p) @ jacobian
        return fisher / len(self.x)


def values(net):
    return [p.clone() for p in net.parameters()]


def test_fisher_products_match_the_dense_matrix():
    bandit = Bandit()
    optimizer = TRPO(bandit.net.parameters(), damping=0.3)
    params = list(bandit.net.parameters())
    product = optimizer._fisher_product(bandit.closure()[1], params)
    dense = bandit.dense_fisher()
    assert dense.norm() > 0.1
    for vector in torch.randn(5, len(dense)):
        torch.testing.assert_close(product(vector), dense @ vector + 0.3 * vector, atol=1e-5, rtol=1e-4)


def test_conjugate_gradient_solves():
    torch.manual_seed(0)
    root = torch.randn(8, 8, dtype=torch.float64)
    matrix = root @ root.T + torch.eye(8, dtype=torch.float64)
    b = torch.randn(8, dtype=torch.float64)
    torch.testing.assert_close(conjugate_gradient(lambda v: matrix @ v, b, 20, 1e-24), torch.linalg.solve(matrix, b))


def test_first_try_follows_the_natural_gradient():
    bandit = Bandit()
    before = values(bandit.net)
    loss = bandit.closure()[0]
    gradient = flatten(torch.autograd.grad(loss, list(bandit.net.parameters())), before)
    matrix = bandit.dense_fisher() + 0.1 * torch.eye(len(gradient))
    direction = torch.linalg.solve(matrix, -gradient)
    full = direction * (2 * 1e-3 / (direction @ matrix @ direction)).sqrt()
    report = TRPO(bandit.net.parameters(), max_kl=1e-3, damping=0.1, cg_steps=50).step(bandit.closure)
    moved = flatten(values(bandit.net), before) - flatten(before, before)
    assert report["accepted"] == 1
    torch.testing.assert_close(moved, full * report["step_length"] / full.norm(), atol=1e-4, rtol=1e-2)


@pytest.mark.parametrize("max_kl", [1e-3, 1e-2, 0.1, 0.5])
def test_accepted_step_stays_inside_and_improves(max_kl):
    """Damping near 0 makes the first length tried overshoot the region in some of these cases."""
    for seed in range(10):
        bandit = Bandit(seed)
        before = bandit.closure()[0].item()
        optimizer = TRPO(bandit.net.parameters(), max_kl=max_kl, accept_ratio=0.1, damping=1e-4)
        report = optimizer.step(bandit.closure)
        loss, divergence = bandit.closure()
        assert report["accepted"] == 1
        assert 0 < divergence.item() <= max_kl
        assert before - loss.item() >= 0.1 * report["expected"] > 0
        assert report["kl"] == pytest.approx(divergence.item())


def test_rejected_step_restores_every_bit():
    bandit = Bandit()
    before = values(bandit.net)
    report = TRPO(bandit.net.parameters(), max_kl=0.01, accept_ratio=100.0).step(bandit.closure)
    assert report["accepted"] == 0 and report["kl"] == 0
    assert all(torch.equal(a, b) for a, b in zip(before, bandit.net.parameters(), strict=True))


def test_a_loss_without_numbers_moves_nothing():
    bandit = Bandit()
    before = values(bandit.net)
    bandit.advantage[0] = torch.nan
    assert TRPO(bandit.net.parameters()).step(bandit.closure)["accepted"] == 0
    assert all(torch.equal(a, b) for a, b in zip(before, bandit.net.parameters(), strict=True))


def team_batch(num_envs=24):
    torch.manual_seed(0)
    env = ToyEnv(num_envs=num_envs)
    policy, critic = make_policy(env, TINY_MODEL), make_critic("itrpo", env, TINY_MODEL)
    loss = make_loss("itrpo", policy, critic)
    updater = ALGORITHMS["itrpo"].make_updater(loss)
    with torch.no_grad():
        batch = env.rollout(6, policy, break_when_any_done=False)
    return loss, updater, updater.prepare(batch)


def test_fisher_of_the_target_generator_matches_scores():
    """F v from the divergence's second derivative against the score vectors' outer products, in expectation.

    Scores are drawn many times per state, so this needs no second derivative of attention at all.
    """
    loss, updater, steps = team_batch(4)
    params = updater.policy_params
    with sdpa_kernel(SDPBackend.MATH):
        divergence = loss.divergence(steps)
    product = updater.policy_optimizer._fisher_product(divergence, params)
    torch.manual_seed(1)
    direction = torch.cat([torch.randn(p.numel()) for p in params])
    exact = direction @ product(direction) - 0.1 * direction @ direction
    states = steps.select(*loss.actor_network.in_keys)
    moved, length = [p.detach().clone() for p in params], 1e-3
    dist = loss.actor_network.get_dist(states.copy())
    samples = [dist.sample() for _ in range(400)]
    ends = []
    with torch.no_grad():
        for reach in (length, -length, 0.0):
            TRPO._place(params, moved, direction, reach)
            shifted = loss.actor_network.get_dist(states.copy())
            ends.append(torch.stack([sum(shifted.log_prob(s).values(True, True)) for s in samples]))
    slopes = (ends[0] - ends[1]) / (2 * length)
    assert slopes.square().mean().item() == pytest.approx(exact.item(), rel=0.1)


def test_team_step_keeps_its_promises():
    loss, updater, steps = team_batch()
    metrics = updater.policy_optimizer.step(*updater._closures([steps])[:2])
    surrogate, divergence, _ = loss.surrogate(steps)
    assert metrics["accepted"] == 1
    assert 0 < divergence.item() <= ALGORITHMS["itrpo"].settings.max_kl
    assert divergence.item() > 1e-3, "the divergence must be from the policy that acted, not from itself"


def test_bad_settings_are_named():
    with pytest.raises(ValueError, match="max_kl=0"):
        TRPO(torch.nn.Linear(1, 1).parameters(), max_kl=0)
