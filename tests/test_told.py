"""Branches that count what the base station, or the robot that knows least, learns: what comes of them comes in the env."""

import pytest
import torch
from torchrl.envs.utils import step_mdp
from worlds import room

from maexp.agents.networks.actor import TARGETS, TARGETS_MASK
from maexp.agents.networks.distributions import ACTION
from maexp.agents.policies.classical import FrontierPlanner
from maexp.agents.training.branching import NEVER, SCORE, BranchPlayer
from maexp.envs import CommConfig, ExplorationEnv, ObservationConfig, make_map
from maexp.envs.choices import rank_by_utility

REACH = 6.0


def make_env(strategy: str = "return_to_base", radio: bool = True, **settings) -> ExplorationEnv:
    settings = {"num_envs": 4, "num_robots": 2, "seed": 2, "local_steps": 10, "macro_steps": 8} | settings
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


@pytest.mark.parametrize("learner", ["base", "everyone"])
@pytest.mark.parametrize("strategy", ["return_to_base", "opportunistic"])
def test_a_branch_is_worth_what_comes_of_it(learner, strategy):
    """Some decisions, the first as tried, then cost_utility with the strategy: in the branch and in the env itself."""
    env = make_env(strategy)
    td = env.reset()
    for _ in range(3):
        likes = prefer(td)
        td = begin(env, td, likes, likes.argmax(-1))
    horizon = 3
    player = BranchPlayer(env, candidates=4, horizon=horizon, seed=0, learn_from=learner)
    likes = prefer(td)
    index, advantage = player.try_candidates(td[TARGETS], likes)
    own, saved, disc = index[..., 0].clamp_min(0), env.state_dict(), env.strategy._disc()[:, 0]
    trackers = {name: one.clone() for name, one in env.target_view.tracker.state.items()}
    worth, compared, telling = {}, 0, 0
    for robot in range(2):
        for k in range(4):
            env.load_state_dict(saved)
            env.strategy.name = strategy
            named = own.clone()
            named[:, robot] = index[:, robot, k].clamp_min(0)
            wanted = torch.where(torch.arange(9) == named.unsqueeze(-1), -NEVER, likes)
            known, summed = told(env, learner)
            begin(env, td.clone(), wanted, named)
            if strategy == "opportunistic":
                env.strategy.name = "return_to_base"
            follower = FrontierPlanner(env, rank_by_utility)
            follower.tracker.state.update({name: one.clone() for name, one in trackers.items()})
            follower.tracker.state["chosen"] = env.target_view.tracker.state["chosen"].clone()
            follower.tracker.state["stood"] = env.target_view.tracker.state["stood"].clone()
            for _ in range(horizon - 1):
                region, offset = follower(None)
                step = env.rand_action(td.clone())
                del step[(*ACTION, "target")]
                step[(*ACTION, "region")], step[(*ACTION, "offset")] = region, offset
                env.step(step)
            now, total = told(env, learner)
            s, steps = env.simulation.tensors, horizon * env.local_steps
            played = s["local_step"] - 30
            gained = (now - known).double()
            after = min((8 - 3 - horizon) / horizon, 1.0)
            over = total - summed - played * known.long() + (steps - played) * gained
            lost = (s["collided"] != saved["collided"]).sum(-1)
            worth[robot, k] = (over / steps + after * gained) / disc - lost
            for team in range(4):
                if index[team, robot, k] >= 0 and torch.isfinite(advantage[team, robot, k]):
                    more = float((worth[robot, k] - worth[robot, 0])[team])
                    print(team, robot, k, int(index[team, robot, k]), float(advantage[team, robot, k]), more)
                    compared += k > 0
                    telling += int(index[team, robot, k]) == 8
                    assert float(advantage[team, robot, k]) == pytest.approx(more, abs=2e-4)
    env.load_state_dict(saved)
    assert compared >= 6 and telling >= 1, "hardly anything was tried"
