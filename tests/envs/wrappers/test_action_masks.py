"""Targets under other projects' interfaces: what may be chosen, masks, batches that others make, Stable-Baselines3."""

import copy
import warnings

import numpy as np
import pytest
import torch
from episodes import SHORT
from torchrl.envs import ActionMask, TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.modules import MaskedCategorical
from worlds import room

from maexp.agents import ModelConfig
from maexp.agents.models.actor import TARGETS_MASK
from maexp.agents.models.target_chooser import TargetChooser, TargetReader
from maexp.agents.policies import POLICIES
from maexp.envs import ExplorationEnv, ObservationConfig, PlannerConfig, RobotConfig, parallel_env, team_env, vector_env
from maexp.envs.targets.observation import first_if_none

SHOWN = ObservationConfig(targets=8, pictures=False)
TARGET = ("agents", "action", "target")
WITHOUT = "THE EXTRA maexp[{}] IS NOT INSTALLED: {} is not tested"


@pytest.fixture(scope="module")
def world():
    return room(30, 21)


def make_env(world, **settings) -> ExplorationEnv:
    return ExplorationEnv(world, 3, 3, seed=2, **SHORT | {"observation": SHOWN} | settings)


def taken(mask: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Whether each robot chose what it may."""
    return mask.gather(-1, target.unsqueeze(-1)).squeeze(-1)


# The TorchRL env


def test_the_spec_shows_what_the_env_takes(world):
    env = make_env(world)
    check_env_specs(env)
    assert list(env.full_action_spec.keys(True, True)) == [TARGET] and env.full_action_spec[TARGET].n == 8
    other = make_env(world, observation=ObservationConfig()).full_action_spec["agents", "action"]
    assert list(other.keys()) == ["region", "offset"]


def test_random_actions_are_legal(world):
    env = make_env(world)
    steps = env.rollout(4, break_when_any_done=False)
    assert taken(steps[TARGETS_MASK], steps[TARGET]).all() and not steps[TARGETS_MASK].all()
    td = env.rand_step(env.reset())
    assert taken(td[TARGETS_MASK], td[TARGET]).all()
    drawn = torch.stack([env.rand_action(td.clone())[TARGET] for _ in range(60)])
    assert (drawn.amax(0) == td[TARGETS_MASK].sum(-1) - 1).all(), "every one of them is drawn"
    env.fake_tensordict().update(env.rand_action(env.fake_tensordict()))  # shows none: no error


def test_torchrls_mask_of_actions_fits(world):
    env = TransformedEnv(make_env(world), ActionMask(TARGET, TARGETS_MASK))
    check_env_specs(env)
    steps = env.rollout(4, break_when_any_done=False)
    assert taken(steps[TARGETS_MASK], steps[TARGET]).all()


def test_a_robot_without_targets_has_one_choice(world):
    """The first stands for driving anywhere, so that a masked distribution is one."""
    wide = [RobotConfig(collision_threshold=0.75), RobotConfig(), RobotConfig()]
    env = make_env(world, robot=wide, local_steps=20, macro_steps=60)
    env.set_starts([[3.0, 3.0, 3.1], [20.0, 8.0, 0.0], [22.0, 12.0, 0.0]])
    td = env.reset()
    state = env.simulation.tensors
    state["collided"][:, 0] = 1
    td = env.step(env.rand_action(td))["next"]
    assert not td["agents", "observation", "alive"][:, 0].any()
    assert td[TARGETS_MASK][:, 0].tolist() == [[True] + [False] * 7] * 3
    assert not td["agents", "observation", "targets"][:, 0].any()
    choice = MaskedCategorical(logits=torch.zeros(3, 3, 8), mask=td[TARGETS_MASK])
    assert torch.isfinite(choice.log_prob(choice.sample())).all() and torch.isfinite(choice.entropy()).all()
    td[TARGET] = torch.where(td[TARGETS_MASK].sum(-1) > 1, td[TARGETS_MASK].sum(-1) - 1, 0)
    env.step(td)
    chosen = env.target_view.tracker.state["chosen"].squeeze(-1)
    assert (chosen[:, 0] == -1).all() and (chosen[:, 1:] >= 0).any()


def test_networks_think_of_it_as_of_none(world):
    """Policies and critics of before say the same, to the bit: features that are 0 stand for no target."""
    td = make_env(world).rollout(3, break_when_any_done=False).reshape(-1)
    features, comm = (td["agents", "observation", name] for name in ("targets", "comm"))
    features[::2, 0] = 0.0
    none = td[TARGETS_MASK].clone()
    none[::2, 0] = False
    shown = first_if_none(none)
    assert shown.any(-1).all() and not none.any(-1).all()
    torch.manual_seed(0)
    config = ModelConfig(action="targets", critic_encoder="shared")
    chooser, reader = TargetChooser(config), TargetReader(config, team=True)
    torch.nn.init.normal_(chooser.head.weight)
    extra = (td["agents", "observation", "time_left"], td["agents", "observation", "alive"], td["info", "coverage"])
    for before, now in zip(chooser.look(features, none, comm), chooser.look(features, shown, comm), strict=True):
        assert torch.equal(before, now)
    assert torch.equal(reader(features, none, comm, *extra), reader(features, shown, comm, *extra))


def test_classical_planners_write_goals_all_the_same(world):
    """What an env shows changes nothing in what a planner of goals does there."""
    ends = []
    for observation in (SHOWN, ObservationConfig()):
        env = make_env(world, observation=observation)
        steps = env.rollout(4, POLICIES["cost_utility"](env), break_when_any_done=False)
        ends.append(steps["next", "agents", "observation", "pose"])
    assert torch.equal(*ends)


# PettingZoo and Gymnasium


@pytest.fixture
def interfaces():
    for name in ("pettingzoo", "gymnasium"):
        pytest.importorskip(name, reason=WITHOUT.format(name, "its interface"))


def test_agents_choose_targets(world, interfaces):
    env, twin = (
        parallel_env(world, 3, action="targets", **SHORT),
        ExplorationEnv(world, 1, 3, observation=ObservationConfig(targets=24, pictures=False), **SHORT),
    )
    twin._set_seed(5)
    seen, infos = env.reset(seed=5)
    expected = twin.reset()
    assert env.action_space("robot_0").n == 24 and env.state_space.contains(env.state())
    for _ in range(SHORT["macro_steps"]):
        for i, name in enumerate(env.agents):
            mask = expected[TARGETS_MASK][0, i].numpy()
            assert env.observation_space(name).contains(seen[name]) and "targets_mask" not in seen[name]
            assert np.array_equal(seen[name]["action_mask"], mask) and np.array_equal(infos[name]["action_mask"], mask)
            assert np.array_equal(seen[name]["targets"], expected["agents", "observation", "targets"][0, i].numpy())
        actions = {name: env.action_space(name).sample(infos[name]["action_mask"]) for name in env.agents}
        expected[TARGET] = torch.tensor([list(map(int, actions.values()))])
        seen, rewards, _, _, infos = env.step(actions)
        expected = twin.step(expected)["next"]
        assert list(rewards.values()) == expected["agents", "reward"].flatten().tolist()
        assert env.state_space.contains(env.state()) and env.state()[-1] == expected["info", "coverage"].item()


def test_the_env_says_what_agents_take(world, interfaces):
    """Where nothing is said of the action it is the env's own."""
    direct = PlannerConfig(name="direct")
    spaces = [
        parallel_env(world, 2, **SHORT, **settings).action_space("robot_0")
        for settings in (
            {},
            {"observation": SHOWN},
            {"planner": direct},
            {"action": "targets", "observation": ObservationConfig()},
            {"action": "targets", "observation": SHOWN},
            {"action": "goal", "observation": SHOWN},
        )
    ]
    assert [getattr(space, "n", space.shape) for space in spaces] == [None, 8, (2,), 24, 8, (2,)]
    kept = parallel_env(world, 2, action="targets", observation=ObservationConfig(targets=4), **SHORT)
    assert kept.reset()[0]["robot_1"]["map"].any() and kept.state().shape == (3, 125, 125)
    other = parallel_env(world, 2, action="goal", observation=SHOWN, **SHORT)
    assert "targets_mask" in other.reset()[0]["robot_0"]
    with pytest.raises(ValueError, match="planner=direct takes controls, action='targets'"):
        parallel_env(world, 2, action="targets", planner=direct, **SHORT)


@pytest.mark.parametrize("action", [8, -1, 1.5])
def test_targets_that_are_none_are_refused(world, interfaces, action):
    env = parallel_env(world, 2, action="targets", observation=SHOWN, **SHORT)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"target=\[\[0.*must hold whole numbers of 0 to 7"):
        env.step({"robot_0": 0, "robot_1": action})


def test_a_batch_tells_its_masks(world, interfaces):
    batch = vector_env(world, 3, 2, action="targets", **SHORT)
    seen, info = batch.reset(seed=1)
    for _ in range(6):
        assert batch.observation_space.contains(seen) and "team_map" not in seen
        mask = info["action_mask"]
        assert mask.shape == (3, 2, 24) and np.array_equal(mask, seen["action_mask"]) and mask.any(-1).all()
        actions = np.stack([batch.single_action_space.sample(mask=tuple(row)) for row in mask])
        assert np.take_along_axis(mask, actions[..., None], -1).all()
        seen, reward, _, _, info = batch.step(actions)
        assert np.allclose(reward, info["robot_reward"].sum(1))


@pytest.mark.parametrize("action", ["targets", "region_offset", "region", "goal"])
def test_one_team_is_the_batchs_first(world, interfaces, action):
    from gymnasium.utils.env_checker import check_env

    env, batch = team_env(world, 2, action=action, **SHORT), vector_env(world, 1, 2, action=action, **SHORT)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*infinity.*")
        check_env(env, skip_render_check=True)
    env.reset(seed=3)
    batch.reset(seed=3)
    for _ in range(SHORT["macro_steps"]):
        sampled = env.action_space.sample()
        many = {name: value[None] for name, value in sampled.items()} if isinstance(sampled, dict) else sampled[None]
        seen, reward, ended, cut, info = env.step(sampled)
        expected = batch.step(many)
        assert env.observation_space.contains(seen) and type(reward) is float
        assert all(np.array_equal(value, expected[0][name][0]) for name, value in seen.items())
        assert [reward, ended, cut] == [value[0] for value in expected[1:4]]
        assert info["coverage"] == expected[4]["coverage"][0] and info["path_length"].shape == (2,)
    assert cut
    if action == "targets":
        assert np.array_equal(env.action_masks(), info["action_mask"].astype(bool).ravel())
    else:
        with pytest.raises(RuntimeError, match="there is no mask"):
            env.action_masks()


def test_batches_that_gymnasium_makes(world, interfaces):
    """An env made here, sent to processes that each play a copy."""
    from gymnasium.vector import AsyncVectorEnv

    env = team_env(world, 2, action="targets", **SHORT)
    batch = AsyncVectorEnv([lambda: copy.deepcopy(env)] * 2, context="fork")
    try:
        seen, info = batch.reset(seed=[3, 4])
        assert info["action_mask"].shape == (2, 2, 24) and not np.array_equal(*seen["pose"])
        actions = np.zeros((2, 2), int)
        after = batch.step(actions)
    finally:
        batch.close()
    for k in range(2):
        env.reset(seed=3 + k)
        expected = env.step(actions[k])
        assert after[1][k] == expected[1]
        assert np.array_equal(after[0]["targets"][k], expected[0]["targets"])
