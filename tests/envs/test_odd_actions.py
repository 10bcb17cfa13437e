"""What an env is given that it cannot take is refused; and where an env is made does not matter."""

import pytest
import torch

from maexp.envs import ExplorationEnv, ObservationConfig, make_map, parallel_env


@pytest.fixture
def small():
    return make_map("maze_small", 0)


@pytest.mark.parametrize("region", [-1, 64, 10**9])
def test_regions_that_are_none_are_refused(small, region):
    env = ExplorationEnv([small], num_envs=3, num_robots=2, num_threads=1)
    td = env.reset()
    action = env.action_spec.rand()
    action["agents", "action", "region"][1, 1] = region
    with pytest.raises(ValueError, match="the action of env 1 names a region that is none: give 0 to 63"):
        env.step(td.update(action))
    action["agents", "action", "region"][1, 1] = 63
    env.step(env.reset().update(action))


@pytest.mark.parametrize("seed", ["1", 1.5, -1, True, float("nan")])
def test_seeds_that_are_none_are_refused(small, seed):
    from maexp.envs.wrappers.gymnasium import TeamVectorEnv

    for env in (parallel_env(small, num_robots=2, num_threads=1), TeamVectorEnv(small, 2, 2, num_threads=1)):
        with pytest.raises(ValueError, match="seed=.* must be a whole number, 0 or more"):
            env.reset(seed=seed)
        env.reset(seed=3)


@pytest.mark.parametrize("targets", [0, 24])
def test_an_env_is_used_within_inference_mode_and_outside(small, targets):
    def make() -> ExplorationEnv:
        shown = ObservationConfig(targets=targets)
        return ExplorationEnv([small], num_envs=2, num_robots=2, seed=3, num_threads=1, observation=shown)

    def play(env: ExplorationEnv) -> torch.Tensor:
        torch.manual_seed(1)
        env.set_seed(3)
        return env.rollout(3)["next", "info", "coverage"].clone()

    wanted = play(make())
    with torch.inference_mode():
        env = make()
        assert torch.equal(play(env), wanted)
    assert torch.equal(play(env), wanted)
    state = env.state_dict()
    with torch.inference_mode():
        env.load_state_dict(state)
    assert torch.equal(play(env), wanted)
