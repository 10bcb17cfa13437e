"""Pictures are drawn where somebody looks at them, and only there."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs
from worlds import act, room

from maexp.agents import make_policy
from maexp.agents.policies import POLICIES
from maexp.envs import ExplorationEnv, ObservationConfig, parallel_env
from maexp.kernels import observe

PICTURES = [("agents", "observation", "map"), ("team", "map")]


def make(pictures: bool = True, **settings) -> ExplorationEnv:
    worlds = [room(23, 18), room(20, 26, "rotated")]
    observation = ObservationConfig(pictures=pictures)
    return ExplorationEnv(worlds, num_envs=4, num_robots=2, seed=3, local_steps=5, observation=observation, **settings)


def test_without_pictures_all_else_is_the_same():
    with_them, without = make(), make(False)
    check_env_specs(make(False))
    generators = [torch.Generator().manual_seed(1) for _ in range(2)]
    a, b = with_them.reset(), without.reset()
    for _ in range(4):
        a = with_them.step_and_maybe_reset(a.update(act(with_them, generators[0])))[1]
        b = without.step_and_maybe_reset(b.update(act(without, generators[1])))[1]
        keys = set(a.keys(True, True))
        assert keys - set(b.keys(True, True)) == set(PICTURES) and "team" not in b.keys()
        assert all(torch.equal(a[key], b[key]) for key in keys - set(PICTURES))
    assert not any(key in without.observation_spec.keys(True, True) for key in PICTURES)


def test_classical_planners_need_none_and_networks_say_so():
    env = make(False)
    regions = []
    for either in (env, make()):
        policy, td = POLICIES["cost_utility"](either), either.reset()
        regions.append(policy(td)["agents", "action", "region"])
    assert torch.equal(*regions)
    with pytest.raises(ValueError, match="observation.pictures=true"):
        make_policy(env)
    with pytest.raises(ValueError, match="observation.pictures=3 must be true or false"):
        make(3)


def test_the_state_of_a_parallel_env_without_pictures_is_numbers():
    pytest.importorskip("pettingzoo")
    made = parallel_env(room(20, 20), num_robots=2, observation=ObservationConfig(pictures=False))
    made.reset(seed=0)
    assert made.state().ndim == 1 and made.state().dtype == np.float32


def test_a_reset_of_two_envs_draws_two(monkeypatch):
    env = make()
    td, generator = env.reset(), torch.Generator().manual_seed(2)
    for _ in range(3):
        td = env.step_and_maybe_reset(td.update(act(env, generator)))[1]
    before = td.clone()
    mask = torch.tensor([[False], [True], [False], [True]])
    own = env._reset(TensorDict({**td.clone(), "_reset": mask}, batch_size=[4]))
    drawn = own["agents", "observation", "map"].flatten(1).any(1)
    assert drawn.tolist() == mask[:, 0].tolist()
    assert own["team", "map"].flatten(1).any(1).tolist() == mask[:, 0].tolist()
    # What TorchRL makes of that: the others keep what they had.
    after = env.reset(td.set("_reset", mask))
    whole = env.observe()
    for key in PICTURES:
        assert torch.equal(after[key][~mask[:, 0]], before[key][~mask[:, 0]])
        assert torch.equal(after[key], whole[key])


def test_no_pictures_no_drawing(monkeypatch):
    """Not one launch that draws."""
    import warp as wp

    launched, launch = [], wp.launch

    def noted(kernel, *args, **kwargs):
        launched.append(kernel.key)
        return launch(kernel, *args, **kwargs)

    monkeypatch.setattr(wp, "launch", noted)
    drawing = {observe._draw_points.key, observe._list_bodies.key, observe._draw_robots.key}
    make(False).reset()
    assert not drawing & set(launched) and observe._observe_pose.key in launched
    make().reset()
    assert drawing <= set(launched)
