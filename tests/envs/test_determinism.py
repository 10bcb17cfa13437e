"""What repeats: the same bits for any batch, threads and blocks, evaluation episodes by number, a saved state."""

import pytest
import torch
from episodes import actions, equal, play, step
from tensordict import TensorDict
from torchrl.envs import EnvBase

from maexp.envs import ExplorationEnv, PlannerConfig, make_map
from maexp.kernels import simulation as stepping


def test_same_bits_for_any_number_of_envs_and_threads(maps):
    plan = actions(6, 3, 4)
    many = play(ExplorationEnv(maps, num_envs=6, seed=3, num_threads=2, macro_steps=3), plan)
    few = play(
        ExplorationEnv(maps, num_envs=2, seed=3, num_threads=1, macro_steps=3),
        [{k: v[:2] for k, v in a.items()} for a in plan],
    )
    again = play(ExplorationEnv(maps, num_envs=6, seed=3, num_threads=1, macro_steps=3), plan)
    other = play(ExplorationEnv(maps, num_envs=6, seed=4, num_threads=1, macro_steps=3), plan)
    for a, b, c in zip(many, few, again, strict=True):
        assert equal(b, a[:2]) and equal(c, a)
    assert not equal(many[0], other[0])


@pytest.mark.parametrize("planner", ["dwa", "wavefront"])
def test_same_bits_in_blocks_of_any_size(maps, planner, monkeypatch):
    """Blocks of one env, taken by two threads as they get free, against all envs at once."""
    plan = actions(5, 3, 4)
    settings = {"num_envs": 5, "seed": 3, "macro_steps": 3, "planner": PlannerConfig(name=planner)}
    whole = ExplorationEnv(maps, num_threads=1, **settings)
    monkeypatch.setattr(stepping, "BLOCK_BYTES", 1)
    monkeypatch.setattr(stepping, "BLOCK_ROBOTS", 1)
    cut = ExplorationEnv(maps, num_threads=2, **settings)
    assert [len(env.simulation.blocks) for env in (whole, cut)] == [1, 4]
    for a, b in zip(play(whole, plan), play(cut, plan), strict=True):
        assert equal(a, b)


def test_episodes_of_an_env_differ_and_resets_are_partial(maps):
    env = ExplorationEnv(maps[0], num_envs=3, seed=0)
    first = env.reset()
    before = env.state_dict()
    mask = torch.tensor([[False], [True], [False]])
    env.reset(first.clone().set("_reset", mask))
    after = env.state_dict()
    for name in before:
        if name == "seed":
            continue
        assert torch.equal(before[name][[0, 2]], after[name][[0, 2]]), name
    assert not torch.equal(before["pose"][1], after["pose"][1])


@pytest.mark.parametrize("teams", [[], [1], [0, 2], [0, 1, 2]])
def test_a_reset_of_some_teams_gives_what_torchrl_would(maps, teams, monkeypatch):
    """Also where the tensordict holds other keys, or none; what it held stays as it was."""
    mask = torch.zeros(3, 1, dtype=torch.bool)
    mask[teams] = True
    found = []
    for own in (ExplorationEnv._reset_proc_data, EnvBase._reset_proc_data):
        monkeypatch.setattr(ExplorationEnv, "_reset_proc_data", own)
        env = ExplorationEnv(maps[:2], num_envs=3, seed=2, local_steps=5)
        after = step(env, env.reset().set("own", torch.ones(3, 2)), actions(3, 3, 1)[0])
        held = after.clone()
        again = env.reset(after.copy().set("_reset", mask))
        assert equal(after, held)
        found.append((again, env.reset(TensorDict({"_reset": mask}, [3]))))
    for ours, theirs in zip(*found, strict=True):
        assert set(ours.keys(True, True)) == set(theirs.keys(True, True)) and equal(ours, theirs)


def test_evaluation_episodes_depend_on_their_number_alone(maps):
    small, large = ExplorationEnv(maps, num_envs=2, seed=5), ExplorationEnv(maps, num_envs=4, seed=5)
    large.rollout(2)
    large.set_episodes(torch.tensor([9, 4, 7, 2]))
    small.set_episodes(torch.tensor([4, 2]))
    a, b = large.reset(), small.reset()
    assert equal(a[[1, 3]], b)
    assert torch.equal(large.simulation.tensors["map_id"][[1, 3]], small.simulation.tensors["map_id"])
    large.set_episodes(torch.arange(4))
    pose = ("agents", "observation", "pose")
    training = ExplorationEnv(maps, num_envs=4, seed=5).reset()
    assert not torch.equal(large.reset()[pose][0], training[pose][0]), "training must not meet the evaluation's starts"


def test_evaluation_plays_every_map_as_often_as_the_others():
    """Seven episodes on three maps, in any batch and where an env goes on after its first; seeds start elsewhere."""
    three = [make_map("maze_small", index) for index in range(3)]
    orders = set()
    for seed in range(8):
        large, small = (ExplorationEnv(three, num_envs=count, num_robots=1, seed=seed) for count in (7, 1))
        large.set_episodes(torch.arange(7))
        large.reset()
        played = large.simulation.tensors["map_id"].tolist()
        assert sorted(played.count(index) for index in range(3)) == [2, 2, 3]
        orders.add(tuple(played))
        for number in (6, 2):
            small.set_episodes(torch.tensor([number]))
            small.reset()
            assert small.simulation.tensors["map_id"].item() == played[number]
        small.reset()
        assert small.simulation.tensors["map_id"].item() == played[3]
    assert len(orders) == 3


def test_state_continues_bit_for_bit(maps):
    plan = actions(3, 3, 6)
    env = ExplorationEnv(maps, num_envs=3, macro_steps=4)
    td = env.reset()
    for a in plan[:2]:
        td = step(env, td, a)
    saved = {k: v.clone() for k, v in env.state_dict().items()}
    rest = [td := step(env, td, a) for a in plan[2:4]]
    other = ExplorationEnv(maps, num_envs=3, macro_steps=4, seed=77)
    other.reset()
    other.load_state_dict(saved)
    td = rest[0].clone()
    again = []
    for a in plan[2:4]:
        td = step(other, td, a)
        again.append(td)
    assert all(equal(x, y) for x, y in zip(rest, again, strict=True))
    with pytest.raises(ValueError, match="num_envs"):
        ExplorationEnv(maps, num_envs=2).load_state_dict(saved)
