"""Critics of targets that read what the policy's encoder made of the observation (`model.critic_encoder`)."""

import copy

import pytest
import torch
from mazes import MAPS

from maexp.agents.algorithms.gae import write_advantages
from maexp.agents.algorithms.registry import find_algorithm
from maexp.agents.algorithms.updaters import Meter
from maexp.agents.config.model import ModelConfig
from maexp.agents.models import target_chooser
from maexp.agents.models.actor import COMM, SEEN, TARGETS, TARGETS_MASK, make_policy
from maexp.agents.models.critics import TEAM_VALUE, VALUE
from maexp.agents.training.collectors import make_collector
from maexp.envs import ExplorationEnv, ObservationConfig, PlannerConfig

BIAS = "module.0.module.network.encoder.inputs.0.bias"
SHARING = ["ippo", "mappo", "vdppo", "vda2c"]


def build(name: str, critic_encoder: str = "shared"):
    """An env, a policy with some opinion, the loss, and a batch in which episodes end before its end."""
    torch.manual_seed(3)
    env = ExplorationEnv(
        MAPS,
        num_envs=4,
        num_threads=1,
        macro_steps=2,
        seed=5,
        observation=ObservationConfig(targets=24),
        planner=PlannerConfig(name="wavefront"),
    )
    model, row = ModelConfig(action="targets", target_width=8, critic_encoder=critic_encoder), find_algorithm(name)
    policy = make_policy(env, model)
    torch.nn.init.normal_(policy.module[0].module.network.head.weight)
    loss = row.make_loss(policy, row.make_critic(env, model))
    return loss, row, make_collector(env, policy, 3).next()


def encoder_gradient(loss, batch) -> float:
    """What the critic's loss alone moves in the policy's encoder."""
    loss.zero_grad()
    loss(batch)["loss_critic"].backward()
    grads = [
        parameter.grad for key, parameter in loss.actor_network_params.flatten_keys(".").items() if "encoder" in key
    ]
    return sum(float(grad.abs().sum()) for grad in grads if grad is not None)


@pytest.mark.parametrize("name", SHARING)
def test_what_the_critic_learns_trains_the_shared_encoder(name):
    loss, _, batch = build(name)
    assert encoder_gradient(loss, batch) > 0
    loss, _, batch = build(name, "own")
    assert encoder_gradient(loss, batch) == 0


@pytest.mark.parametrize("name", ["mappo", "vdppo"])
def test_values_are_those_of_the_states(name):
    """With what the acting policy kept, or looked at anew; those after a state are those of the next one."""
    loss, _, batch = build(name)
    key = TEAM_VALUE if loss.team_value else VALUE
    kept, anew = write_advantages(loss, batch.copy()), write_advantages(loss, batch.copy().exclude(SEEN))
    assert torch.allclose(kept[key], anew[key], atol=1e-5) and kept[key].std() > 0
    loss.finite_horizon = False  # the horizon is no end: what follows a state is valued
    kept = write_advantages(loss, batch.copy())
    following, done = kept["next", *key], batch["next", "done"]
    assert done[:, 1].all() and not batch["next", "terminated"].any()
    shape = (-1,) + (1,) * (following.ndim - 2)
    assert torch.equal(following[:, 0], torch.where(done[:, 0].view(shape), following[:, 0], kept[key][:, 1]))
    look = loss.actor_network.get_dist_params(batch["next"].select(TARGETS, TARGETS_MASK, COMM))[SEEN]
    with loss.critic_network_params.to_module(loss.critic_network):
        value = loss.critic_network(batch["next"].copy().set(SEEN, look))[key]
    assert torch.allclose(following, value, atol=1e-4)


@pytest.mark.parametrize("name", SHARING)
def test_a_loss_can_be_copied_after_an_update(name):
    """It keeps no graph of what it looked at last."""
    loss, row, batch = build(name)
    row.make_updater(loss).update(batch)
    assert torch.equal(copy.deepcopy(loss)(batch)["loss_critic"], loss(batch)["loss_critic"])


@pytest.mark.parametrize("name", SHARING)
def test_a_loss_estimates_advantages_that_are_absent(name):
    loss, _, batch = build(name)
    values = loss(batch), loss(write_advantages(loss, batch.copy()))
    assert torch.equal(values[0]["loss_objective"], values[1]["loss_objective"])
    assert loss.tensor_keys.advantage not in batch.keys(True)


@pytest.mark.parametrize("name", ["itrpo", "matrpo"])
def test_beside_a_trust_region_the_critic_has_an_encoder_of_its_own(name):
    loss, *_ = build(name)
    assert SEEN not in loss.critic_network.in_keys and encoder_keys(loss)
    assert not encoder_keys(build("mappo")[0])


def encoder_keys(loss) -> list[str]:
    return [key for key in loss.critic_network_params.flatten_keys(".").keys() if "among_targets" in key]


def test_an_encoder_is_shared_only_where_asked_for():
    default = ModelConfig(action="targets").critic_encoder
    loss, *_ = build("mappo", default)
    assert default == "own" and encoder_keys(loss)


def test_a_critic_alone_learns_from_what_the_policy_sees_now(monkeypatch):
    """In a warm start the policy moves between the look at the batch and the critic's pass."""
    loss, row, batch = build("mappo")
    updater, seen = row.make_updater(loss), []
    steps = updater.prepare(batch)
    monkeypatch.setattr(updater, "descend", lambda terms, parts, side: seen.append(parts[0][SEEN].sum().item()) or {})
    for moved in (0.0, 0.0, 1.0):
        with torch.no_grad():
            loss.actor_network_params.flatten_keys(".")[BIAS].add_(moved)
        updater.learn_values([steps], Meter())
    assert abs(seen[0] - seen[1]) < 1e-3 < abs(seen[2] - seen[1])


def test_teams_are_looked_at_in_parts(monkeypatch):
    """Parts of teams with few candidates give what the whole batch gives, gradients too."""
    torch.manual_seed(1)
    chooser = target_chooser.TargetChooser(ModelConfig(action="targets"))
    torch.nn.init.normal_(chooser.head.weight)
    reader = target_chooser.TargetReader(ModelConfig(action="targets"), team=False)
    features, counts = torch.randn(7, 3, 12, len(target_chooser.FEATURES)), torch.tensor([0, 3, 12, 1, 7, 4, 2])
    mask = (torch.arange(12) < counts.view(7, 1, 1)) & (torch.rand(7, 3, 12) < 0.8)
    comm = torch.rand(7, 3, 3) < 0.5
    results = {}
    for part in (100, 2):
        monkeypatch.setattr(target_chooser, "PART", part)
        assert len(target_chooser.split_teams(features, mask, comm)[0]) == (1 if part > 7 else 4)
        chooser.zero_grad()
        logits, seen = chooser.look(features, mask, comm)
        (logits[mask].square().sum() + seen.square().sum()).backward()
        there = logits > target_chooser.NEVER
        grads = [parameter.grad.clone() for parameter in chooser.parameters()]
        reader.zero_grad()
        read = reader(features, mask, comm, torch.zeros(7, 3, 1), torch.ones(7, 3, dtype=torch.bool))
        read.square().sum().backward()
        grads += [parameter.grad.clone() for parameter in reader.parameters()]
        results[part] = [there.float(), logits[there].detach(), seen.detach(), read.detach(), *grads]
        with torch.no_grad():
            assert torch.equal(chooser.look(features, mask, comm)[0], chooser(features, mask, comm)[0])
    assert len(results[2]) > 20
    for whole, parts in zip(results[100], results[2], strict=True):
        assert (whole - parts).abs().max() <= 1e-4 * whole.abs().max()  # sums in another order
