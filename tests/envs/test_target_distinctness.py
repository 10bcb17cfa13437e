"""While there are targets to spare, robots that hear each other go to different places, whoever chooses."""

import numpy as np
import pytest
import torch
from mazes import MAPS
from tensordict.nn import InteractionType
from tools.distinct import steps_to

from maexp.agents.config.model import ModelConfig
from maexp.agents.evaluation.evaluate import EvaluationResult
from maexp.agents.models.actor import TARGETS_MASK, make_policy
from maexp.agents.policies.classical import CLASSICAL, POLICIES
from maexp.agents.policies.pretrained import load_policy_folder
from maexp.envs import CommConfig, ExplorationEnv, ObservationConfig, PlannerConfig, TargetsConfig
from maexp.envs.targets.tracker import TargetTracker

TARGET = ("agents", "action", "target")
PREFERENCE = ("agents", "action", "preference")


def make_env(num_envs=4, num_robots=3, shown=24, **settings) -> ExplorationEnv:
    """Teams whose robots begin close to each other, so that they want the same."""
    settings = {
        "planner": PlannerConfig(name="wavefront"),
        "success_coverage": 0.999,
        "decision_seconds": "protocol",
    } | settings
    env = ExplorationEnv(
        MAPS[0],
        num_envs=num_envs,
        num_robots=num_robots,
        num_threads=1,
        macro_steps=60,
        seed=3,
        observation=ObservationConfig(pictures=False, targets=shown),
        **settings,
    )
    free = torch.as_tensor(MAPS[0].free[:, :2])
    edge = torch.cdist(free, torch.as_tensor(MAPS[0].obstacles[:, :2])).amin(-1)
    room = free[edge > 1.5]
    first = room[0]
    starts = [first]
    for place in room[(room - first).norm(dim=-1).argsort()]:
        if len(starts) < num_robots and min(float((place - start).norm()) for start in starts) >= 2.0:
            starts.append(place)
    env.set_starts(torch.cat([torch.stack(starts), torch.zeros(num_robots, 1)], -1))
    return env


class Watch:
    """What a tracker shares out, checked against where the robots are then sent."""

    def __init__(self, tracker: TargetTracker, monkeypatch):
        self.pairs = self.same = self.needless = self.shared = self.waits = 0
        share = tracker.share

        def watched(preference, travel, points):
            chosen, waits = share(preference, travel, points)
            self.note(tracker, preference, points, chosen, waits)
            return chosen, waits

        monkeypatch.setattr(tracker, "share", watched)

    def note(self, tracker, preference, points, chosen, waits):
        body, hears = tracker.body[0, 0], tracker.nav.state["comm"]
        wanted = preference.argmax(-1)
        for e in range(len(chosen)):
            placed = [i for i in range(chosen.shape[1]) if chosen[e, i] >= 0]
            at = {i: points[e, i, chosen[e, i]] for i in placed}
            self.waits += int(waits[e].sum())
            for i in placed:
                self.same += int(chosen[e, i] == wanted[e, i])
                assert preference[e, i, chosen[e, i]] > -torch.inf
                for j in placed:
                    if j < i and hears[e, i, j]:
                        self.pairs += 1
                        self.shared += int((points[e, i, wanted[e, i]] - points[e, j, wanted[e, j]]).norm() < 2 * body)
                        self.needless += int((at[i] - at[j]).norm() < 2 * body)
            for i in waits[e].nonzero().squeeze(-1).tolist():  # nothing is free
                for k in (preference[e, i] > -torch.inf).nonzero().squeeze(-1).tolist():
                    assert any(hears[e, i, j] and (points[e, i, k] - at[j]).norm() < 2 * body for j in placed)


@torch.no_grad()
def play(env, policy, steps=25):
    td = env.reset()
    for _ in range(steps):
        td = env.step(policy(td))["next"].exclude("reward")
    return td


@pytest.mark.parametrize("limited", [False, True])
@pytest.mark.parametrize("name", [*CLASSICAL, "oracle"])
def test_planners_send_robots_to_different_places(name, limited, monkeypatch):
    env = make_env(shown=0, comm=CommConfig(range=12.0) if limited else None)
    policy = POLICIES[name](env)
    watch = Watch(policy.module.tracker, monkeypatch)
    play(env, policy)
    assert watch.needless == 0 and watch.pairs > 80
    assert watch.shared > 0 or name == "hungarian", "robots never wanted the same: nothing is tested"
    assert watch.same > watch.pairs / 2, "robots keep what they want where that is free"


@pytest.mark.parametrize("policy", ["universal", "untrained", "sampled", "by hand"])
def test_actions_that_name_targets_twice_send_robots_to_different_places(policy, monkeypatch):
    env = make_env()
    if policy == "universal":
        chooser = load_policy_folder(policy, env)
    elif policy == "by hand":

        def chooser(td):
            return td.set(TARGET, torch.zeros(4, 3, dtype=torch.long))
    else:
        torch.manual_seed(0)
        chooser = make_policy(env, ModelConfig(action="targets"))
        chooser[-1].default_interaction_type = getattr(
            InteractionType, "RANDOM" if policy == "sampled" else "DETERMINISTIC"
        )
    watch = Watch(env.target_view.tracker, monkeypatch)
    play(env, chooser)
    assert watch.needless == 0 and watch.pairs > 80 and watch.shared > 0


def test_without_the_setting_robots_go_where_they_like_best(monkeypatch):
    env = make_env(shown=0, targets=TargetsConfig(distinct=False))
    policy = POLICIES["cost_utility"](env)
    watch = Watch(policy.module.tracker, monkeypatch)
    play(env, policy)
    assert watch.needless == watch.shared > 0 and watch.waits == 0


@torch.no_grad()
def test_a_network_says_what_a_robot_gets_instead():
    """Its logits rank the rest; without them the classical values do."""
    env = make_env(1, 2)
    td = env.reset()
    count = int(td[TARGETS_MASK][0, 0].sum())
    assert count >= 3 and torch.equal(td[TARGETS_MASK][0, 0], td[TARGETS_MASK][0, 1])
    block = env.target_view.state["block"][0]
    assert torch.equal(block[0][td[TARGETS_MASK][0, 0]].sort().values, block[1][td[TARGETS_MASK][0, 1]].sort().values)
    same = int((block[1] == block[0, 0]).nonzero()[0])  # what is first for one robot, as the other counts it
    td[TARGET] = torch.tensor([[0, same]])
    chosen = {}
    for name in ("values", "logits"):
        given = td.clone()
        if name == "logits":
            given[PREFERENCE] = torch.arange(24.0).expand(1, 2, -1).clone()  # the last first
        env.target_view.take(given[TARGET], given.get(PREFERENCE, None))
        chosen[name] = env.target_view.tracker.state["chosen"][0, :, 0].tolist()
    for blocks in chosen.values():
        assert blocks[0] != blocks[1] and int(block[0, 0]) in blocks
    assert chosen["values"] != chosen["logits"]


@pytest.mark.parametrize("spare", ["wait", "home"])
def test_robots_for_which_no_target_is_left(spare):
    env = make_env(1, 3, shown=8, targets=TargetsConfig(spare=spare))
    td = play(env, POLICIES["cost_utility"](env), 3)
    view, tracker = env.target_view, env.target_view.tracker
    view.state["mask"][..., 1:] = False  # one target each, and that the same
    for name in ("block", "cell", "point", "way"):
        view.state[name][:] = view.state[name][:, :1].clone()
    view.state["way"][0, :, 0] = torch.tensor([5.0, 3.0, 4.0])
    td[TARGET] = torch.zeros(1, 3, dtype=torch.long)
    at, home = tracker.nav.centers().clone(), tracker.state["home"].clone()
    assert (at - home).norm(dim=-1).max() > 2.0
    env.step(td)
    goal = env.simulation.tensors["goal"][0]
    assert (tracker.state["chosen"][0, :, 0] >= 0).tolist() == [False, True, False]
    for robot in (0, 2):
        torch.testing.assert_close(goal[robot], (home if spare == "home" else at)[0, robot], atol=1e-3, rtol=0.0)


@pytest.mark.parametrize(("name", "value"), [("spare", "away"), ("distinct", "yes")])
def test_wrong_settings_are_named(name, value):
    with pytest.raises(ValueError, match=f"targets.{name}='{value}'"):
        make_env(targets=TargetsConfig(**{name: value}))


def test_the_table_counts_steps_however_early_all_episodes_end():
    """Curves end with the last episode: their length is no limit."""
    curves = np.array([[0.1, 0.5, 0.996, 0.996], [0.1, 0.2, 0.3, 0.995], [0.1, 0.2, 0.2, 0.2]])
    result = EvaluationResult("p", 3, {}, 0.0, np.array(["m"] * 3), times=np.arange(4.0), coverage=curves)
    assert steps_to(result, 0.995, 1200).tolist() == [20.0, 30.0, 1200.0]
