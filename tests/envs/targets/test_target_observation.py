"""What a choice among frontier targets sees, and that naming a target drives there."""

import math

import pytest
import torch
from mazes import MAPS
from oracle.targets import columns as oracle_columns
from torchrl.envs.utils import check_env_specs, step_mdp
from worlds import ways_to_blocks

from maexp.agents.algorithms.registry import find_algorithm
from maexp.agents.config.model import ModelConfig
from maexp.agents.models.actor import TARGETS, TARGETS_MASK, make_policy
from maexp.agents.models.target_chooser import score_by_criteria
from maexp.agents.policies.classical import CLASSICAL, FrontierPlanner
from maexp.agents.training.collectors import make_collector
from maexp.envs import CommConfig, ExplorationEnv, ObservationConfig, PlannerConfig
from maexp.envs.targets.features import FEATURES, feature_names
from maexp.envs.targets.heuristics import BETA, rank_by_criteria

COUNT = 40  # no team knows more targets
ACTION = ("agents", "action", "target")


def make_env(num_envs: int = 4, targets: int = COUNT, maps=MAPS, **settings) -> ExplorationEnv:
    settings = {"seed": 5, "planner": PlannerConfig(name="wavefront")} | settings
    observation = ObservationConfig(targets=targets)
    return ExplorationEnv(maps, num_envs=num_envs, num_threads=1, observation=observation, **settings)


def column(td, name: str) -> torch.Tensor:
    return td[TARGETS][..., FEATURES.index(name)]


def choose(td) -> torch.Tensor:
    """The candidate with the highest classical score."""
    return torch.where(td[TARGETS_MASK], column(td, "score"), -math.inf).argmax(-1)


def play(env, steps: int, td=None) -> list:
    td, seen = env.reset() if td is None else td, []
    for _ in range(steps):
        td[ACTION] = choose(td)
        td = env.step(td)["next"]
        seen.append(td)
    return seen


def test_specs_hold_and_features_are_finite():
    env = make_env()
    check_env_specs(env)
    for td in play(env, 4):
        assert torch.isfinite(td[TARGETS]).all() and td[TARGETS].abs().max() < 20.0
        assert (td[TARGETS][~td[TARGETS_MASK]] == 0).all()
        assert td[TARGETS_MASK].any(-1)[td["agents", "observation", "alive"]].float().mean() > 0.5


@pytest.mark.parametrize("planner", ["wavefront", "dwa"])
def test_the_highest_score_is_what_cost_utility_takes(planner):
    """On the same episodes, to the bit: what a learned policy starts from is the classical planner."""
    env = make_env(planner=PlannerConfig(name=planner), targets=256)
    other = ExplorationEnv(MAPS, num_envs=4, seed=5, planner=PlannerConfig(name=planner), num_threads=1)
    planner, td = FrontierPlanner(other, CLASSICAL["cost_utility"]), other.reset()
    mine = env.reset()
    for _ in range(5):
        td["agents", "action", "goal"] = planner.goals()
        mine, td = play(env, 1, mine)[0], step_mdp(other.step(td))
        assert torch.equal(env.simulation.tensors["goal"], other.simulation.tensors["goal"])
        assert torch.equal(mine["agents", "observation", "pose"], td["agents", "observation", "pose"])


def test_columns_mean_what_their_names_say():
    env = make_env()
    td = play(env, 3)[-1]
    view, mask = env.target_view, td[TARGETS_MASK]
    nav, reach = view.tracker.nav, 10.0
    gap = view.state["point"] - nav.centers().unsqueeze(2)
    assert mask.any()
    torch.testing.assert_close(column(td, "distance")[mask], gap.norm(dim=-1)[mask] / reach)
    travel, gain = column(td, "travel").expm1(), column(td, "gain")
    assert (travel >= column(td, "distance") - 0.2)[mask].all(), "a way is no shorter than the straight line"
    torch.testing.assert_close(column(td, "value")[mask], (gain - BETA * travel)[mask])
    torch.testing.assert_close(column(td, "score")[mask], (gain * (1 - column(td, "claimed")) - BETA * travel)[mask])
    heading = torch.atan2(gap[..., 1], gap[..., 0]) - nav.state["pose"][..., 3:]
    torch.testing.assert_close(column(td, "ahead")[mask], heading.cos()[mask], atol=1e-5, rtol=0)
    torch.testing.assert_close(column(td, "aside")[mask], heading.sin()[mask], atol=1e-5, rtol=0)
    left = td["agents", "observation", "time_left"].expand_as(travel)
    torch.testing.assert_close(column(td, "time_left")[mask], left[mask])
    assert (column(td, "planned").sum(-1) == mask.any(-1)).all(), "every robot plans one target"
    rival = column(td, "rival")
    clear = mask & (rival < 8.0) & ((rival - travel).abs() > 1e-3)
    assert clear.any() and ((travel < rival) == (column(td, "nearest") > 0))[clear].all()


def test_one_more_env_changes_nothing():
    three, four = play(make_env(3), 4), play(make_env(4), 4)
    for a, b in zip(three, four, strict=True):
        assert torch.equal(a[TARGETS], b[TARGETS][:3]) and torch.equal(a[TARGETS_MASK], b[TARGETS_MASK][:3])


def test_a_reset_of_some_envs_leaves_the_others():
    env, alike = make_env(), make_env()
    td, same = play(env, 3)[-1], play(alike, 3)[-1]
    reset = torch.tensor([[False], [True], [False], [True]])
    after = env.reset(td.clone().set("_reset", reset))
    assert torch.equal(after[TARGETS][[0, 2]], td[TARGETS][[0, 2]])
    kept = play(env, 3, after)[-1]
    want = play(alike, 3, same)[-1]
    assert torch.equal(kept[TARGETS][[0, 2]], want[TARGETS][[0, 2]])


@pytest.mark.parametrize(("planner", "reach"), [("wavefront", math.inf), ("wavefront", 12.0), ("dwa", math.inf)])
def test_a_reset_of_some_envs_looks_at_these_alone(planner, reach):
    """What they show is what a look at all envs shows, and so is what is kept for later decisions."""
    env = make_env(planner=PlannerConfig(name=planner), comm=CommConfig(range=reach))
    td, nav = play(env, 3)[-1], env.target_view.tracker.nav
    nav.distance[[0, 2]] += 10
    before = nav.distance.clone()
    reset = torch.tensor([[False], [True], [False], [True]])
    after = env._reset(td.clone().set("_reset", reset))
    assert torch.equal(nav.distance[[0, 2]], before[[0, 2]]), "the ways of the others were searched again"
    assert not torch.equal(nav.distance[[1, 3]], before[[1, 3]])
    kept = env.target_view.state_dict()
    wanted = env.observe()
    for key in (TARGETS, TARGETS_MASK):
        assert torch.equal(after[key][[1, 3]], wanted[key][[1, 3]]) and wanted[key][[1, 3]].any()
        assert not after[key][[0, 2]].any()
    some = wanted[TARGETS_MASK]
    for name, value in env.target_view.state_dict().items():
        listed = value.shape[:3] == some.shape  # absent candidates stand for nothing
        assert torch.equal(kept[name][some], value[some]) if listed else torch.equal(kept[name], value), name


@pytest.mark.parametrize("planner", ["wavefront", "dwa"])
def test_a_saved_state_goes_on_bit_for_bit(planner):
    env, other = (make_env(planner=PlannerConfig(name=planner)) for _ in range(2))
    td = play(env, 3)[-1]
    other.load_state_dict(env.state_dict())
    for a, b in zip(play(env, 3, td.clone()), play(other, 3, td.clone()), strict=True):
        assert torch.equal(a[TARGETS], b[TARGETS])
    state = env.state_dict()
    wide = [name for name, value in state.items() if name.startswith("target") and value.dtype == torch.int32]
    state |= {name: state[name].long() for name in wide}
    assert wide
    other.load_state_dict(state)  # a kernel would read wider numbers as others
    assert all(value.dtype == env.state_dict()[name].dtype for name, value in other.state_dict().items())
    a, b = (play(either, 2, td.clone())[-1] for either in (env, other))
    assert torch.equal(a[TARGETS], b[TARGETS])
    with pytest.raises(ValueError, match="target"):
        other.load_state_dict(ExplorationEnv(MAPS, num_envs=4, num_threads=1).state_dict())


def test_robots_that_hear_nobody_know_of_no_plans():
    td = play(make_env(comm=CommConfig(range=0.1)), 2)[-1]
    mask = td[TARGETS_MASK]
    assert (column(td, "claimed")[mask] == 0).all() and (column(td, "mates")[mask] == 0).all()
    assert (column(td, "plan_gap")[mask] == 4.0).all() and (column(td, "nearest")[mask] == 1).all()


def test_bad_actions_and_settings_are_named():
    env = make_env(2, targets=8)
    td = env.reset()
    td[ACTION] = torch.full((2, 3), 8)
    with pytest.raises(ValueError, match="give 0 to 7"):
        env.step(td)
    plain = ExplorationEnv(MAPS, num_envs=2, num_threads=1)
    td = plain.reset()
    td[ACTION] = torch.zeros(2, 3, dtype=torch.long)
    with pytest.raises(ValueError, match=r"observation\.targets"):
        plain.step(td)
    with pytest.raises(ValueError, match=r"observation\.targets=-1"):
        make_env(targets=-1)
    with pytest.raises(ValueError, match="add action=regions"):
        make_env(targets=8, planner=PlannerConfig(name="direct"))


@pytest.mark.parametrize("reach", [math.inf, 12.0])
def test_features_agree_with_their_definitions(reach):
    env = make_env(comm=CommConfig(range=reach), decision_seconds="protocol")
    td = play(env, 3)[-1]
    view, robots = env.target_view, env.num_robots
    nav, state, sim = view.tracker.nav, view.state, env.simulation
    block = state["block"]
    theirs = [ways_to_blocks(nav)[:, j : j + 1].expand(-1, robots, -1).gather(2, block) for j in range(robots)]
    ways = torch.stack(theirs, -1)
    speed = sim.tensors["pose"][..., 2].abs()
    area, _ = nav.look_around(nav.radar_range)
    gain = area.expand(-1, robots, -1).gather(2, block) / (math.pi * 100.0)
    first = nav.points_on_way(torch.where(state["mask"], state["cell"], -1), 3.0)
    limit = sim.robot_tensors["max_speed"]
    arrays = {
        "point": state["point"],
        "some": state["mask"],
        "ways": ways,
        "gain": gain,
        "toward": state["toward"],
        "travel": ways.diagonal(dim1=1, dim2=3).permute(0, 2, 1),
        "first": first,
        "center": nav.centers(),
        "heading": sim.tensors["pose"][..., 3],
        "speed": speed,
        "limit": limit,
        "drive": torch.minimum(2.0 * speed + 0.5 * 2.0 * 4.0, 2.0 * limit),
        "alive": nav.alive(),
        "last": state["last"],
        "has_last": state["has_last"],
        "comm": sim.tensors["comm"],
    }
    scene = {name: value.double().numpy() for name, value in arrays.items()} | {"reach": 10.0, "least_gain": 0.3}
    checked = 0
    for e, i, k in state["mask"].nonzero().tolist():
        for name, wanted in oracle_columns(e, i, k, scene).items():
            got = column(td, name)[e, i, k].item()
            assert got == pytest.approx(wanted, abs=2e-4), (name, e, i, k)
            checked += 1
    assert checked > 200


@pytest.mark.parametrize("name", ["ippo", "mappo", "itrpo", "matrpo", "vdppo", "vda2c"])
def test_all_algorithms_learn_to_choose(name):
    """One update changes the policy; teams of any size use the same weights; nobody takes what is not there."""
    env = make_env(4, macro_steps=3)
    model = ModelConfig(action="targets")
    policy, row = make_policy(env, model), find_algorithm(name)
    settings = row.configure(minibatch_size=6)
    loss = row.make_loss(policy, row.make_critic(env, model, settings), settings)
    batch = make_collector(env, policy, 3).next()
    taken = batch[TARGETS_MASK].gather(-1, batch[ACTION].unsqueeze(-1)).squeeze(-1)
    assert taken[batch[TARGETS_MASK].any(-1)].all() and (batch[ACTION][~batch[TARGETS_MASK].any(-1)] == 0).all()
    before = policy.state_dict()["module.0.module.network.head.weight"].clone()
    logs = row.make_updater(loss, settings).update(batch)
    assert math.isfinite(logs["loss_critic"]) and not torch.equal(
        before, policy.state_dict()["module.0.module.network.head.weight"]
    )
    for size in (1, 5):
        other = make_env(2, num_robots=size)
        assert policy(other.reset())[ACTION].shape == (2, size)


def test_an_untrained_policy_is_the_classical_planner():
    env = make_env()
    policy = make_policy(env, ModelConfig(action="targets", starts_from="cost_utility"))
    for td in play(env, 3):
        some = td[TARGETS_MASK].any(-1)
        assert torch.equal(policy(td.clone())[ACTION][some], choose(td)[some])


def test_by_the_features_of_a_robot_alone_multi_criteria_thinks_the_same():
    """One robot has nobody to keep away from, and nobody claims anything before it."""
    env = make_env(4, num_robots=1)
    view, seen = env.target_view, 0
    for _ in play(env, 4):
        scene = view.tracker.look()
        shown, best = view.show(scene)
        there = view.state["mask"]
        planned, learned = rank_by_criteria(scene).gather(2, best), score_by_criteria(shown["features"])
        assert torch.allclose(planned[there], learned[there], atol=1e-5)
        seen += int(there.sum())
    assert seen > 8


def test_beside_others_a_policy_starts_from_what_they_leave_and_keeps_apart():
    features = torch.zeros(2, len(FEATURES))
    row = {"gain": 0.8, "claimed": 0.25, "travel": math.log(3.0), "unknown_far": 0.5, "plan_gap": 2.0, "score": 9.0}
    for name, value in row.items():
        features[0, FEATURES.index(name)] = value
    expected = 0.8 * 0.75 - 0.2 * math.log(3.0) + 0.3 * 0.5 + 0.06 * 2.0
    assert score_by_criteria(features).tolist() == pytest.approx([expected, 0.0], abs=1e-6)
    told = torch.zeros(2, len(feature_names(radio=True)))
    told[:, FEATURES.index("plan_gap")] = 4.0
    told[1, feature_names(radio=True).index("tells")] = 1.0  # who goes to tell keeps away from nobody
    assert score_by_criteria(told).tolist() == pytest.approx([0.24, 0.0], abs=1e-6)


def test_choices_are_drawn_in_a_collector_and_the_likeliest_elsewhere():
    env = make_env()
    policy = make_policy(env, ModelConfig(action="targets", score_weight=0.0))  # all alike
    collector = make_collector(env, policy, 4)
    batch = next(iter(collector))
    collector.shutdown()
    assert (batch[ACTION] > 0).any(), "drawn"
    assert (policy(batch.select(TARGETS, TARGETS_MASK, *policy.in_keys))[ACTION] == 0).all(), "the first of equals"
