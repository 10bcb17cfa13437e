"""Warm start: the clone acts like its teacher, the pull towards it is what it says, and a run goes on from it."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from metrics_file import read_metrics
from tiny_training import TINY, assert_same
from toy_env import OFFSET, SMALL_MODEL, ToyEnv

from maexp.agents import ALGORITHMS, make_policy
from maexp.agents.algorithms.updaters import Meter
from maexp.agents.cli import main
from maexp.agents.models.actor import ALIVE, MAP
from maexp.agents.models.distributions import OFFSET as OFFSET_KEY
from maexp.agents.models.distributions import REGION
from maexp.agents.policies.pretrained import load_chooser
from maexp.agents.training.checkpoint import find_checkpoint, load_checkpoint
from maexp.agents.training.imitation import imitate, negative_log_likelihood

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("somewhere", "no_pictures")]  # trainings

WARM = [*TINY, "planner=wavefront", "warm_start=nearest_frontier", "warm_start_frames=12", "checkpoint_keep=9"]


def run(folder: str, *words: str) -> Path:
    assert main(["train", *WARM, f"hydra.run.dir={folder}", *words]) == 0
    return Path(folder)


def build(name, env):
    row = ALGORITHMS[name]
    settings = row.configure(minibatch_size=32, anchor_coeff=0.5)
    policy, critic = make_policy(env, SMALL_MODEL), row.make_critic(env, SMALL_MODEL, settings)
    loss = row.make_loss(policy, critic, settings)
    return policy, loss, row.make_updater(loss, settings)


def expert(td):
    """The lit region, and the offset that pays most."""
    lit = td[MAP][..., 0, :, :].flatten(-2).argmax(-1)
    side = td[MAP].shape[-1]
    x, y = lit // side // (side // 2), lit % side // (side // 2)
    td[REGION] = 2 * x + y
    td[OFFSET_KEY] = torch.tensor(OFFSET).expand(*lit.shape, 2).clone()
    return td


@pytest.mark.parametrize("name", ["ippo", "itrpo", "vda2c"])
def test_a_clone_earns_what_its_teacher_earns(name):
    torch.manual_seed(0)
    env = ToyEnv(num_envs=32)
    policy, loss, updater = build(name, env)
    optimizer = torch.optim.Adam(policy.parameters(), lr=1e-2)
    batch = env.rollout(4, expert, break_when_any_done=False)
    assert batch["next", "agents", "reward"].mean() == 2
    values, losses = Meter(), []
    steps = [updater.prepare(batch)]
    for _ in range(25):
        meter = Meter()
        imitate(SimpleNamespace(policy=policy, updater=updater), optimizer, steps, meter)
        updater.learn_values(steps, values)
        losses.append(meter.means()["nll"])
    assert losses[-1] < 0 < losses[0]
    assert ("agents", "params") not in steps[0].keys(True), "the teacher has no parameters"
    with torch.no_grad():
        earned = env.rollout(4, policy, break_when_any_done=False)["next", "agents", "reward"].mean()
    assert earned > 1.7
    assert values.means()["loss_critic"] > 0


def test_collided_robots_are_no_example():
    env = ToyEnv(num_envs=6)
    policy, _, _ = build("ippo", env)
    batch = env.rollout(2, expert, break_when_any_done=False).flatten()
    batch[ALIVE][:, 1] = False
    before = negative_log_likelihood(policy, batch)
    batch[REGION][:, 1] = (batch[REGION][:, 1] + 1) % 4
    batch[OFFSET_KEY][:, 1] += 3
    after = negative_log_likelihood(policy, batch)
    assert set(before) == {"region", "offset"}
    assert all(torch.equal(before[head], after[head]) for head in before)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_the_pull_is_the_divergence_from_the_clone(name):
    """Zero at first, then its weight times the mean over the living, in all six; and it falls with the progress."""
    torch.manual_seed(0)
    env = ToyEnv(num_envs=8)
    policy, loss, updater = build(name, env)
    with torch.no_grad():
        batch = env.rollout(4, policy, break_when_any_done=False)
    batch[ALIVE][::2, 2:, 0] = False
    assert "loss_anchor" not in loss(updater.prepare(batch)).keys()
    updater.set_anchor()
    updater.set_progress(0.2)
    steps = updater.prepare(batch)
    assert anchor_term(loss, steps) == pytest.approx(0, abs=1e-6)
    with torch.no_grad():
        clone = policy.get_dist_params(steps.copy())["agents", "params"].clone()
        for p in policy.parameters():
            p.add_(0.1 * torch.randn(p.shape))
        expected = policy.get_dist(steps.copy()).divergence_from(clone)[steps[ALIVE]].mean()
    assert anchor_term(loss, steps) == pytest.approx(0.4 * expected.item(), rel=1e-4)
    assert expected > 1e-3


def anchor_term(loss, steps) -> float:
    if hasattr(loss, "surrogate"):
        return loss.surrogate(steps)[2]["loss_anchor"].item()
    return loss(steps)["loss_anchor"].item()


def test_a_run_imitates_before_it_learns(capsys):
    folder = run("warm", "total_frames=12", "warm_start_frames=72")
    rows = read_metrics(folder / "warm_start.csv")
    assert [row["frames"] for row in rows] == list(range(6, 73, 6))
    assert sum(row["nll"] for row in rows[-4:]) < sum(row["nll"] for row in rows[:4])
    assert "loss_anchor" in read_metrics(folder / "metrics.csv")[0]
    first = load_checkpoint(folder / "checkpoints" / "iteration_000000.pt")
    anchor, weights = first["updater"]["anchor"], first["policy"]
    assert len(anchor) == len(weights)
    assert all(torch.equal(anchor[name], weights[name]) for name in weights)
    assert not all(torch.equal(find_checkpoint(folder)[1]["policy"][name], weights[name]) for name in weights)


def test_a_resumed_run_does_not_imitate_again():
    whole = run("whole", "total_frames=24")
    parts = Path(shutil.copytree(whole, "parts"))
    (parts / "checkpoints" / "iteration_000004.pt").unlink()
    assert main(["train", f"resume={parts}"]) == 0
    first, second = (find_checkpoint(folder)[1] for folder in (whole, parts))
    assert first["iteration"] == second["iteration"] == 4
    for name in ("policy", "updater"):
        assert_same(first[name], second[name])


def test_a_trained_team_of_another_size_of_network_is_a_teacher_too():
    teacher = run("teacher", "total_frames=6", "warm_start=null")
    folder = run("pupil", "total_frames=6", f"warm_start={teacher}", "model.channels=8")
    assert (folder / "warm_start.csv").is_file()


@pytest.mark.parametrize("algorithm", ["mappo", "expert_iteration"])
def test_a_teacher_with_the_same_network_hands_over_its_weights(algorithm, capsys):
    words = ["action=targets", "warm_start=universal", f"algorithm={algorithm}", "total_frames=6"]
    folder = run("learned_on", *words)
    assert "The policy begins with the weights of universal." in capsys.readouterr().out
    own = load_chooser("universal")[0].state_dict()
    first = load_checkpoint(folder / "checkpoints" / "iteration_000000.pt")["policy"]
    begun = {name: value for name, value in first.items() if name.endswith(tuple(own))}
    assert len(begun) == len(own)
    assert all(torch.equal(value, next(own[end] for end in own if name.endswith(end))) for name, value in begun.items())
    assert (folder / "warm_start.csv").is_file() == (algorithm == "mappo"), "what has no critic need not watch"
    other = run("imitated", *words, "model.score_weight=20")
    assert (other / "warm_start.csv").is_file(), "the same sizes, and another network"


@pytest.mark.parametrize(
    "words, sentence",
    [
        (["warm_start=nobody"], "warm_start=nobody is unknown: choose one of random"),
        (["warm_start=voronoi", "planner=direct"], "planner=direct takes controls, and voronoi picks goals"),
        (["warm_start=voronoi", "action=targets"], "voronoi chooses regions, which a policy with action=targets"),
        (["warm_start=voronoi", "warm_start_frames=0"], "warm_start_frames=0 must be a whole number, 1 or more"),
    ],
)
def test_teachers_that_cannot_be_are_named(words, sentence, capsys):
    assert main(["train", *TINY, "total_frames=6", *words]) == 2
    assert sentence in capsys.readouterr().err
