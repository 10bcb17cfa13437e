"""What a `Navigation` keeps from one look to the next is what one that starts anew finds, to the bit."""

import math

import pytest
import torch

from maexp.agents.models.actor import TARGETS, TARGETS_MASK
from maexp.agents.policies import POLICIES
from maexp.envs import CommConfig, ExplorationEnv, ObservationConfig, PlannerConfig, make_map
from maexp.envs.targets.features import FEATURES
from maexp.envs.targets.navigation import Navigation

MAPS = [make_map("maze_small", 0), make_map("maze", 1)]


def assert_up_to_date(nav: Navigation, env: ExplorationEnv) -> None:
    fresh = Navigation(env)
    fresh.update()
    for name in ("known", "frontier", "size", "target", "block", "cell", "distance"):
        assert torch.equal(getattr(nav, name), getattr(fresh, name)), name
    assert torch.equal(nav.known_count, (nav.known != 0).sum(-1).int())
    for kept, found in zip(nav.look_from_targets(), fresh.look_around(nav.radar_range, nav.cell), strict=True):
        assert torch.equal(kept, found)


@pytest.mark.parametrize("reach", [math.inf, 9.0])
def test_what_is_kept_is_what_is_there(reach):
    """Over decisions, resets of some envs and other episodes."""
    env = ExplorationEnv(
        MAPS,
        num_envs=4,
        num_robots=2,
        seed=3,
        macro_steps=5,
        num_threads=1,
        comm=CommConfig(range=reach),
        planner=PlannerConfig(name="wavefront"),
        observation=ObservationConfig(targets=12, pictures=False),
    )
    td, nav, kept = env.reset(), env.target_view.tracker.nav, 0
    for step in range(8):
        scores = td[TARGETS][..., FEATURES.index("score")]
        td["agents", "action", "target"] = torch.where(td[TARGETS_MASK], scores, -math.inf).argmax(-1)
        before = nav.known.clone()
        td = env.step_and_maybe_reset(td)[1]
        changed = (nav.known != before).flatten(1).any(1)
        if step in (1, 5):
            reset = torch.tensor([[step == 1], [False], [step == 5], [False]])
            td = env.reset(td.set("_reset", reset))
        nav.some(torch.tensor([0, 3])).update()  # leaves the others, and what has changed of them counts later
        nav.update()
        kept += int((wp_array(nav, "cached_from") >= 0).sum()) if changed.any() else 0
        assert_up_to_date(nav, env)
    assert kept > 20, "nothing was ever kept"


def wp_array(nav: Navigation, name: str) -> torch.Tensor:
    return torch.from_numpy(getattr(nav.blocks, name).numpy())


def test_nothing_is_kept_of_another_map():
    """Not even from a target that has the number of a cell it had there, whatever its rays had crossed."""
    env = ExplorationEnv(MAPS, 4, 2, seed=3, num_threads=1, planner=PlannerConfig(name="wavefront"))
    env.reset()
    nav = Navigation(env)
    nav.update()
    env.reset()
    fresh = Navigation(env)
    fresh.update()
    width = torch.from_numpy(nav.grids.width.numpy())[env.simulation.tensors["map_id"].long()]
    wp_array(nav, "cached_from").copy_(fresh._target.flatten(0, 1))
    wp_array(nav, "cached_window")[..., 0] = width.view(-1, 1) - 1  # corners that enclose nothing on this map
    wp_array(nav, "cached_window")[..., 1] = width.view(-1, 1)
    assert (wp_array(nav, "cached_from") >= 0).sum() > 10
    nav.update()
    assert (wp_array(nav, "cached_from") < 0).all()
    assert_up_to_date(nav, env)


def test_what_was_kept_of_another_state_is_dropped():
    """A state of the past, and one of another batch, into a policy that has looked at a later one."""
    env = ExplorationEnv(MAPS, num_envs=3, num_robots=2, seed=3, num_threads=1, planner=PlannerConfig(name="wavefront"))
    policy, td = POLICIES["cost_utility"](env), env.reset()
    nav, states = policy.module.tracker.nav, []
    for _ in range(4):
        states.append(env.state_dict())
        td = env.step(policy(td))["next"].exclude("reward")
    for state in (states[1], states[3]):
        env.load_state_dict(state)
        nav.update()
        assert_up_to_date(nav, env)
