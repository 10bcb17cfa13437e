"""Where experience comes from: teams of several sizes, worker processes, two devices, Ray."""

import pytest
import torch

from maexp.agents.collect import Teams, batch_statistics, divide_teams
from maexp.agents.errors import UserError
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
