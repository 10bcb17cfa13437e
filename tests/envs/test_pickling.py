"""Envs that are pickled or copied go on bit for bit, in their own class and under other projects' interfaces."""

import copy
import pickle

import numpy as np
import pytest
import torch
from episodes import SHORT
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import RewardSum
from worlds import room

from maexp.envs import CommConfig, ExplorationEnv, ObservationConfig, PlannerConfig, RadarConfig, RobotConfig

TARGETS = ObservationConfig(targets=8, pictures=False)
MIXED = [RobotConfig(kind="differential", max_yaw_rate=1.0), RobotConfig(wheelbase="length"), RobotConfig()]
CASES = {
    "as it comes": {},
    "targets": {"observation": TARGETS},
    "targets with dwa": {"observation": TARGETS, "planner": PlannerConfig(name="dwa")},
    "controls": {"planner": PlannerConfig(name="direct")},
    "limited radios": {"comm": CommConfig(range=6.0), "observation": ObservationConfig(map="known")},
    "mixed robots": {"robot": MIXED, "radar": RadarConfig(range=7.0), "collision": "footprint", "first_env": 5},
    "fixed starts": {"starts": "fixed"},
    "given starts": {"starts": [[7.0, 8.0, 0.0], [9.0, 12.0, 1.0], [11.0, 8.0, 2.0]]},
}
WAYS = {"pickle": lambda original: pickle.loads(pickle.dumps(original)), "deepcopy": copy.deepcopy, "copy": copy.copy}


@pytest.fixture(scope="module")
def maps():
    return [room(30, 21), room(24, 17, "jittered", seed=2)]


def play(env: ExplorationEnv, td: TensorDictBase, steps: int = 6) -> list[TensorDictBase]:
    """Steps and resets with random actions of the same numbers."""
    torch.manual_seed(3)
    seen = []
    for _ in range(steps):
        stepped, td = env.step_and_maybe_reset(env.rand_action(td))
        seen += [stepped["next"].clone(), td.clone()]
    return seen


def assert_same(ours: list, theirs: list) -> None:
    assert len(ours) == len(theirs)
    for first, second in zip(ours, theirs, strict=True):
        assert set(first.keys(True, True)) == set(second.keys(True, True))
        for key in first.keys(True, True):
            assert torch.equal(first[key], second[key]), key


@pytest.mark.parametrize("case", CASES)
def test_a_copy_goes_on_bit_for_bit(maps, case):
    env = ExplorationEnv(maps, 2, 3, seed=4, **SHORT | CASES[case])
    td = play(env, env.reset(), 2)[-1]
    copies = {name: way(env) for name, way in WAYS.items()}
    expected = play(env, td.clone())
    for name, other in copies.items():
        assert other.settings == env.settings and other is not env, name
        assert_same(play(other, td.clone()), expected)
    assert_same(play(env, td.clone()), play(copies["pickle"], td.clone()))  # and on, into later episodes


def test_a_copy_shares_nothing_that_changes(maps):
    env = ExplorationEnv(maps, 2, 3, seed=4, **SHORT)
    td = env.reset()
    other = copy.deepcopy(env)
    before = {name: value.clone() for name, value in other.state_dict().items()}
    play(env, td)
    assert all(torch.equal(before[name], value) for name, value in other.state_dict().items())
    assert other.maps[0] is env.maps[0], "maps do not change: one will do"


def test_an_env_that_was_never_reset_can_be_sent(maps):
    for settings in ({}, {"observation": TARGETS}):
        env = ExplorationEnv(maps, 2, 3, seed=4, **SHORT | settings)
        other = pickle.loads(pickle.dumps(env))
        assert_same([env.reset()], [other.reset()])


def test_evaluation_episodes_go_on(maps):
    env = ExplorationEnv(maps, 2, 3, seed=4, **SHORT)
    env.set_episodes(torch.tensor([7, 4]))
    other = pickle.loads(pickle.dumps(env))
    assert_same([env.reset()], [other.reset()])


def test_a_hook_stays_behind(maps):
    env = ExplorationEnv(maps, 1, 2, seed=4, **SHORT)
    calls = []
    env.set_step_hook(lambda env: calls.append(1))
    other = copy.deepcopy(env)
    play(other, other.reset())
    assert not calls


def test_transformed_envs_are_sent_too(maps):
    env = TransformedEnv(ExplorationEnv(maps, 2, 3, seed=4, **SHORT), RewardSum(reset_keys=["_reset"]))
    td = env.reset()
    other = pickle.loads(pickle.dumps(env))
    assert_same(play(env, td.clone()), play(other, td.clone()))


def same(first, second) -> bool:
    """Whether nested results hold the same numbers."""
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(same(first[name], second[name]) for name in first)
    if isinstance(first, tuple | list):
        return len(first) == len(second) and all(map(same, first, second))
    return np.array_equal(first, second)


@pytest.mark.parametrize("action", ["targets", "region_offset"])
@pytest.mark.parametrize("interface", ["parallel_env", "team_env", "vector_env"])
def test_other_interfaces_go_on(maps, interface, action):
    pytest.importorskip("pettingzoo", reason="THE EXTRA maexp[pettingzoo] IS NOT INSTALLED: its copies are not tested")
    import maexp.envs

    sizes = {"num_envs": 2} if interface == "vector_env" else {}
    env = getattr(maexp.envs, interface)(maps, num_robots=3, seed=4, action=action, **SHORT | sizes)

    def draw():
        if interface == "parallel_env":
            return {name: env.action_space(name).sample() for name in env.agents}
        return env.action_space.sample()

    env.reset(seed=6)
    env.step(draw())
    copies = [way(env) for way in WAYS.values() if way is not copy.copy]
    for _ in range(3):
        action = draw()
        expected = env.step(action)
        assert all(same(other.step(action), expected) for other in copies)
    expected = env.reset()
    assert all(same(other.reset(), expected) for other in copies), "the next episodes"
