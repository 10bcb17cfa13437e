"""Branches that count what the base station, or the worst robot, learns: what comes of them comes in the env."""

from functools import partial

import pytest
import torch
from torchrl.envs.utils import step_mdp
from worlds import room

from maexp.agents.models.actor import TARGETS, TARGETS_MASK
from maexp.agents.models.distributions import ACTION
from maexp.agents.models.target_chooser import NEVER, SCORE
from maexp.agents.policies.classical import FrontierPlanner
from maexp.agents.training.branch_rollouts import BranchRollouts
from maexp.envs import CommConfig, ExplorationEnv, ObservationConfig, make_map
from maexp.envs.targets.heuristics import rank_by_criteria

REACH, DECISIONS, BEFORE, HORIZON = 6.0, 8, 3, 3


def make_env(strategy: str = "return_to_base", radio: bool = True, **settings) -> ExplorationEnv:
    settings = {"num_envs": 4, "num_robots": 2, "seed": 2, "local_steps": 10, "macro_steps": DECISIONS} | settings
    comm = settings.pop("comm", CommConfig(range=REACH, base_station=True, strategy=strategy, period=2))
    return ExplorationEnv(
        [make_map("maze_small", 1), room(45, 36, "rotated")],
        comm=comm,
        observation=ObservationConfig(pictures=False, targets=8, radio=radio),
        **settings,
    )


def prefer(td, count: int = 8) -> torch.Tensor:
    """As cost_utility, and to tell only where nothing else is left, [E, N, M]."""
    likes = torch.where(td[TARGETS_MASK], td[TARGETS][..., SCORE], NEVER)
    likes[..., count:] = likes[..., count:].clamp_max(NEVER / 10)
    return likes


def begin(env: ExplorationEnv, td, likes: torch.Tensor, index: torch.Tensor):
    td[(*ACTION, "preference")], td[(*ACTION, "target")] = likes, index
    return step_mdp(env.step(td))


def told(env: ExplorationEnv, learner: str) -> tuple[torch.Tensor, torch.Tensor]:
    s, robots = env.simulation.tensors, env.num_robots
    if learner == "base":
        return s["known_weight"][:, robots].clone(), s["base_sum"].clone()
    return s["known_weight"][:, :robots].amin(1), s["worst_sum"].clone()


def play_branch(env: ExplorationEnv, strategy: str, td, likes: torch.Tensor, named: torch.Tensor) -> None:
    """What a branch plays: a decision as named, int64 [E, N], then multi_criteria with the strategy."""
    trackers = {name: tensor.clone() for name, tensor in env.target_view.tracker.state.items()}
    wanted = torch.where(torch.arange(9) == named.unsqueeze(-1), -NEVER, likes)
    begin(env, td.clone(), wanted, named)
    env.strategy.name = "return_to_base"  # whatever it was
    follower, now = FrontierPlanner(env, rank_by_criteria), env.target_view.tracker.state
    follower.tracker.state.update(trackers | {name: now[name].clone() for name in ("chosen", "stood")})
    for _ in range(HORIZON - 1):
        step = env.rand_action(td.clone())
        del step[(*ACTION, "target")]
        step[(*ACTION, "goal")] = follower.goals()
        env.step(step)
    env.strategy.name = strategy


def worth_of(env: ExplorationEnv, saved: dict, learner: str, play) -> torch.Tensor:
    """What `play` from a saved state is worth to the learner [radar discs], float64 [E]."""
    env.load_state_dict(saved)
    known, summed = told(env, learner)
    play()
    now, total = told(env, learner)
    s, steps = env.simulation.tensors, HORIZON * env.local_steps
    played = s["local_step"] - BEFORE * env.local_steps
    gained = (now - known).double()
    over_time = total - summed - played * known.long() + (steps - played) * gained
    after = min((DECISIONS - BEFORE - HORIZON) / HORIZON, 1.0)
    lost = (s["collided"] != saved["collided"]).sum(-1)
    return (over_time / steps + after * gained) / env.strategy._disc()[:, 0] - lost


@pytest.mark.parametrize("learner", ["base", "everyone"])
@pytest.mark.parametrize("strategy", ["return_to_base", "opportunistic"])
def test_a_branch_is_worth_what_comes_of_it(learner, strategy):
    """Robot by robot and candidate by candidate, to go and tell among them, in the branch and in the env itself."""
    env = make_env(strategy)
    td = env.reset()
    for _ in range(BEFORE):
        likes = prefer(td)
        td = begin(env, td, likes, likes.argmax(-1))
    likes, saved = prefer(td), env.state_dict()
    rollouts = BranchRollouts(env, candidates=4, horizon=HORIZON, seed=0, learn_from=learner)
    index, advantage = rollouts.try_candidates(td[TARGETS], likes)
    after = env.state_dict()
    assert all(torch.equal(tensor, after[name]) for name, tensor in saved.items()), "the episode was touched"
    own, worth, compared, telling = index[..., 0].clamp_min(0), {}, 0, 0
    for robot in range(2):
        for k in range(4):
            named = own.clone()
            named[:, robot] = index[:, robot, k].clamp_min(0)
            worth[k] = worth_of(env, saved, learner, partial(play_branch, env, strategy, td, likes, named))
            there = (index[:, robot, k] >= 0) & advantage[:, robot, k].isfinite()
            more = (worth[k] - worth[0])[there].float()
            torch.testing.assert_close(advantage[:, robot, k][there], more, atol=2e-4, rtol=0)
            compared += int(there.sum()) * (k > 0)
            telling += int((index[:, robot, k] == 8).sum())
    assert compared >= 6 and telling >= 1, "hardly anything was tried"


def test_who_is_on_its_way_to_tell_tries_nothing():
    env = make_env()
    td = env.reset()
    for _ in range(BEFORE):
        likes = prefer(td)
        td = begin(env, td, likes, likes.argmax(-1))
    rollouts, likes = BranchRollouts(env, candidates=3, horizon=1, seed=0, learn_from="base"), prefer(td)
    tried = rollouts.try_candidates(td[TARGETS], likes)[0][..., 1:] >= 0
    env.strategy.state["duty"][:] = True
    fewer = rollouts.try_candidates(td[TARGETS], likes)[0][..., 1:] >= 0
    can = env.strategy.can_tell()
    assert can.any() and tried[can].any()
    assert not fewer[can].any() and torch.equal(fewer[~can], tried[~can])


@pytest.mark.parametrize(
    "comm, learner, sentence",
    [
        (CommConfig(), "base", "radios that do not reach"),
        (CommConfig(range=REACH), "base", "add comm.base_station=true"),
        (CommConfig(range=REACH, base_station=True), "base", "observation.radio=true"),
    ],
)
def test_what_nobody_could_learn_is_told(comm, learner, sentence):
    with pytest.raises(ValueError, match=f"algorithm.learn_from={learner}.*{sentence}"):
        BranchRollouts(make_env(radio=False, comm=comm), candidates=2, horizon=1, learn_from=learner)
