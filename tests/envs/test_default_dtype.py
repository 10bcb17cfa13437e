"""Another default dtype of torch changes nothing: what is float32 says so."""

from contextlib import contextmanager

import pytest
import torch

from maexp.agents import ModelConfig, make_critic, make_loss, make_policy
from maexp.agents.policies import POLICIES
from maexp.envs import CommConfig, ExplorationEnv, ObservationConfig, PlannerConfig, make_map
from maexp.envs.config import FaultsConfig, OdometryConfig

DTYPES = [torch.float64, torch.bfloat16]
STATION = CommConfig(range=8.0, base_station=True)
SETTINGS = {
    "regions": {},
    "targets": {"observation": ObservationConfig(targets=24)},
    "direct": {"planner": PlannerConfig(name="direct")},
    "signal": {"comm": CommConfig(signal=True)},
    "relay": {"comm": CommConfig(range=8.0, base_station=True, strategy="relay")},
    "radio": {"comm": STATION, "observation": ObservationConfig(targets=24, pictures=False, radio=True)},
    "faults": {"faults": FaultsConfig(probability=0.3)},
    "odometry": {"odometry": OdometryConfig(drift=0.05, turn=0.05, jump=0.1, jump_rate=1.0, map_errors=True)},
}


@contextmanager
def default(dtype: torch.dtype):
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


def make(settings: dict) -> ExplorationEnv:
    return ExplorationEnv([make_map("maze_small", 1)], num_envs=2, num_robots=3, seed=4, num_threads=1, **settings)


def play(env: ExplorationEnv, actions: list, policy=None) -> list:
    """What comes of each action, or of what a policy does."""
    td, found = env.reset(), []
    found.append(td.clone())
    for action in actions:
        td = policy(td) if policy is not None else td.update({"agents": {"action": action}})
        td = env.step(td)["next"]
        found.append(td.clone())
    return found


def check_same(ours: list, theirs: list) -> None:
    for one, other in zip(ours, theirs, strict=True):
        pairs = zip(one.items(True, True), other.items(True, True), strict=True)
        for (key, value), (_, wanted) in pairs:
            assert value.dtype == wanted.dtype, key
            assert torch.equal(value.nan_to_num(), wanted.nan_to_num()), key


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("name", SETTINGS)
def test_an_env_plays_the_same(name, dtype):
    env = make(SETTINGS[name])
    torch.manual_seed(0)
    actions = [env.action_spec.rand()["agents", "action"] for _ in range(3)]
    if SETTINGS[name].get("observation"):
        actions = [action.select("target") for action in actions]
        for action in actions:
            action["target"] = action["target"].clamp_max(2)
    wanted = play(env, actions)
    with default(dtype):
        late, early = play(make(SETTINGS[name]), actions), make(SETTINGS[name])
        assert early.fake_tensordict().dtype in (None, torch.float32)
    check_same(late, wanted)
    check_same(play(early, actions), wanted)  # made under another default, played under this one
    early = make(SETTINGS[name])
    with default(dtype):
        check_same(play(early, actions), wanted)


@pytest.mark.parametrize("name", ["cost_utility", "multi_criteria", "hungarian", "rrt_frontiers", "lookahead"])
def test_a_planner_plays_the_same(name):
    env = make({})
    wanted = play(env, [None] * 2, POLICIES[name](env))
    for dtype in DTYPES:
        with default(dtype):
            env = make({})
            check_same(play(env, [None] * 2, POLICIES[name](env)), wanted)


@pytest.mark.parametrize(
    "algorithm, action", [("mappo", "targets"), ("ippo", "regions"), ("vdppo", "targets"), ("itrpo", "targets")]
)
def test_losses_are_the_same(algorithm, action):
    def learn() -> dict:
        torch.manual_seed(3)
        env = make({"observation": ObservationConfig(targets=24 if action == "targets" else 0)})
        model = ModelConfig(action=action)
        policy, critic = make_policy(env, model), make_critic(algorithm, env, model)
        loss = make_loss(algorithm, policy, critic)
        torch.manual_seed(5)
        found = loss(env.rollout(2, policy))
        sum(value for key, value in found.items() if key.startswith("loss")).backward()
        size = sum(p.grad.abs().sum() for p in loss.parameters() if p.grad is not None)
        assert {p.dtype for p in loss.parameters()} == {torch.float32}
        return {key: value.detach() for key, value in found.items()} | {"gradient": size}

    wanted = learn()
    for dtype in DTYPES:
        with default(dtype):
            found = learn()
        for key, value in wanted.items():
            assert found[key].dtype == value.dtype and torch.equal(found[key], value), key
