"""Where experience comes from: teams of several sizes, worker processes, two devices, Ray."""

import importlib.util
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from maexp.agents.build import load_maps
from maexp.agents.checkpoint import find_checkpoint
from maexp.agents.cli import main
from maexp.agents.collect import Teams, WorkerLost, batch_statistics, divide_teams
from maexp.agents.compose import compose_config
from maexp.agents.errors import UserError
from maexp.agents.logs import read_metrics
from maexp.agents.overrides import make_overrides
from maexp.agents.train import make_both
from maexp.envs import ExplorationEnv, make_map

ROBOTS, STEPS = 2, 5


def play(first: int, count: int) -> list[torch.Tensor]:
    """What teams `first` to `first + count` - 1 of 8 see and earn, over resets, all taking planned actions."""
    env = ExplorationEnv(
        [make_map("maze_small", 0), make_map("maze_small", 1)], num_envs=count, num_robots=ROBOTS, seed=3,
        local_steps=4, macro_steps=2, num_threads=1, first_env=first,
    )  # fmt: skip
    plan = torch.Generator().manual_seed(1)
    regions = torch.randint(64, (STEPS, 8, ROBOTS), generator=plan)[:, first : first + count]
    td, seen = env.reset(), []
    for region in regions:
        td["agents", "action", "region"] = region
        td["agents", "action", "offset"] = torch.zeros(count, ROBOTS, 2)
        stepped, td = env.step_and_maybe_reset(td)
        seen += [stepped["next", "agents", "reward"], td["agents", "observation", "map"]]
    return seen


def test_two_envs_of_four_teams_play_what_one_of_eight_plays():
    whole, halves = play(0, 8), (play(0, 4), play(4, 4))
    for one, *parts in zip(whole, *halves, strict=True):
        assert torch.equal(one, torch.cat(parts))
    assert not torch.equal(halves[0][1], halves[1][1]), "the halves must not repeat each other"
    with pytest.raises(ValueError, match="first_env=-1"):
        play(-1, 4)


def test_teams_are_shared_among_sizes_and_workers():
    assert divide_teams(8, [3]) == [Teams(3, 8, 0)]
    for count, sizes, workers in ((32, [2, 3, 4], 1), (32, [2, 3, 4], 2), (9, [1, 5], 3), (6, [4, 1, 2], 2)):
        teams = divide_teams(count, sizes, workers)
        numbers = [one.first_env + k for one in teams for k in range(one.num_envs)]
        assert numbers == list(range(count)), "every team once"
        assert [one.num_robots for one in teams] == sizes
        counts = [one.num_envs for one in teams]
        assert max(counts) - min(counts) <= workers and all(one % workers == 0 for one in counts)
        shares = teams[-1].split(workers)
        assert len({one.num_envs for one in shares}) == 1 and shares[-1].first_env + shares[-1].num_envs == count
    with pytest.raises(UserError, match="num_envs=7 cannot be shared evenly by collector.workers=2"):
        divide_teams(7, [3], 2)
    with pytest.raises(UserError, match="num_envs=4 is too few for 3 team sizes .* choose 6 or more"):
        divide_teams(4, [2, 3, 4], 2)


def test_statistics_of_several_sizes_are_those_of_all_robots_and_episodes():
    envs = [
        ExplorationEnv(make_map("maze_small", 0), num_envs=n, num_robots=robots, local_steps=4, macro_steps=m)
        for n, robots, m in ((3, 1, 2), (2, 3, 4))
    ]
    torch.manual_seed(0)
    batches = [env.rollout(4, break_when_any_done=False) for env in envs]
    found = batch_statistics(*batches)
    robots = [one for b in batches for one in b["next", "agents", "reward"].flatten().tolist()]
    assert len(robots) == 3 * 4 * 1 + 2 * 4 * 3
    assert found["reward"] == pytest.approx(sum(robots) / len(robots), rel=1e-5)
    ends = [b["next"][e, t] for b in batches for e, t in grid(*b.shape) if bool(b["next", "done"][e, t])]
    assert found["episodes"] == len(ends) == 3 * 2 + 2 * 1
    for name, value in (
        ("coverage", lambda end: float(end["info", "coverage"])),
        ("collisions", lambda end: float(end["info", "collided"].sum())),
        ("path_length", lambda end: float(end["info", "path_length"].mean())),
    ):
        assert found[name] == pytest.approx(sum(map(value, ends)) / len(ends), rel=1e-5)


def grid(*sizes: int) -> list[tuple]:
    return [tuple(place.tolist()) for place in torch.cartesian_prod(*map(torch.arange, sizes))]


# Worker processes

TINY = [
    "scenario.maps=[0,1]", "scenario.held_out=[70]", "scenario.macro_steps=3", "scenario.local_steps=5",
    "num_envs=4", "num_robots=2", "collector.steps=2", "checkpoint_every=2", "episodes=0", "device=cpu",
]  # fmt: skip
BATCH = 8


@pytest.fixture
def make_experience():
    """A function from settings to (learner, experience); the workers end with the test."""
    made = []

    def make(*words: str):
        torch.manual_seed(0)
        cfg = compose_config("train", make_overrides("train", [*TINY, *words]))
        learner, experience = make_both(cfg, load_maps(cfg.scenario).train)
        made.append(experience)
        return learner, experience

    yield make
    for one in made:
        one.shutdown()


def differing(first, second) -> set[str]:
    """The entries in which two lists of batches are not the same bits; the rest is TorchRL's."""
    return {
        str(key)
        for a, b in zip(first, second, strict=True)
        for key in a.exclude("collector").keys(True, True)
        if not torch.equal(a[key], b[key])
    }


def change(policy) -> None:
    """Weights that act quite differently."""
    with torch.no_grad():
        for p in policy.parameters():
            p.add_(torch.randn(p.shape, generator=torch.Generator().manual_seed(1)))


def test_two_workers_gather_what_their_teams_see_and_a_killed_one_is_named(make_experience):
    learner, experience = make_experience("collector=processes")
    _, alone = make_experience()
    begins = [one.next()[0][:, 0] for one in (experience, alone)]
    for key in (("agents", "observation", "map"), ("agents", "observation", "pose"), ("info", "coverage")):
        assert torch.equal(*(one[key] for one in begins)), "team i is team i, whoever simulates it"

    state = experience.state_dict()
    first = [one.clone() for one in experience.next()]
    second = [one.clone() for one in experience.next()]
    experience.load_state_dict(state)
    assert not differing(experience.next(), first)
    assert not differing(experience.next(), second)

    experience.load_state_dict(state)
    change(learner.policy)  # in the learner's memory alone
    assert not differing(experience.next(), first)
    experience.load_state_dict(state)  # hands over the weights too
    changed = experience.next()
    assert differing(changed, first)
    with torch.no_grad():
        again = learner.policy.get_dist_params(changed[0][:, 0].clone())
    torch.testing.assert_close(again["agents", "params"], changed[0][:, 0]["agents", "params"])

    victim = experience.groups[0].pids[1]
    os.kill(victim, signal.SIGKILL)
    begin = time.monotonic()
    with pytest.raises(WorkerLost, match=rf"collector worker 2 of 2 \(process {victim}\) was killed by SIGKILL"):
        experience.update_policy_weights_()
    experience.shutdown()
    assert time.monotonic() - begin < 30
    assert not any(Path(f"/proc/{pid}").exists() for pid in experience.groups[0].pids)


@pytest.mark.slow
def test_one_batch_ahead_the_policy_is_one_batch_old(make_experience):
    learner, experience = make_experience("collector=two_devices", "num_robots=1,2")
    assert experience.lag == 1
    experience.next()
    state = experience.state_dict()
    change(learner.policy)
    experience.update_policy_weights_()
    old, new = ([one.clone() for one in experience.next()] for _ in range(2))
    assert [one["agents", "params"].shape[2] for one in new] == [1, 2]

    def acting(batches) -> list:
        with torch.no_grad():
            return [learner.policy.get_dist_params(one.clone())["agents", "params"] for one in batches]

    for batch, params in zip(new, acting(new), strict=True):
        torch.testing.assert_close(params["region"], batch["agents", "params", "region"])
    for batch, params in zip(old, acting(old), strict=True):
        assert not torch.allclose(params["region"]["logits"], batch["agents", "params", "region", "logits"], atol=1e-3)
    experience.load_state_dict(state)
    assert not differing(experience.next(), old)
