"""How often robots decide: what follows the pace, and what must not depend on it."""

import math

import pytest
import torch
from tensordict import TensorDict

from maexp.agents.algorithms.updaters import Updater
from maexp.agents.config.algorithms import TUNINGS
from maexp.agents.config.compose import compose_settings
from maexp.agents.config.env import algorithm_settings, decision_steps, episode_decisions
from maexp.agents.config.resolved import resolve
from maexp.agents.config.runs import continue_run
from maexp.envs import ExplorationEnv, make_map
from maexp.envs.scenarios import find_scenario


@pytest.mark.parametrize("seconds", [0.5, 1.0, 4.0])
def test_horizons_are_seconds_at_every_pace(seconds):
    found = TUNINGS["mappo"].configure(horizon_seconds=50.0, trace_seconds=8.0).at_pace(seconds, 4.0)
    assert found.gamma ** (1.0 / seconds) == pytest.approx(math.exp(-1.0 / 50.0))
    assert found.lmbda ** (1.0 / seconds) == pytest.approx(math.exp(-1.0 / 8.0))
    assert found.learn_share == seconds / 4.0


def test_what_is_set_per_decision_wins():
    found = TUNINGS["mappo"].configure(gamma=0.9, lmbda=0.5, learn_share=0.3).at_pace(1.0, 4.0)
    assert (found.gamma, found.lmbda, found.learn_share) == (0.9, 0.5, 0.3)


def test_a_slower_pace_learns_from_all():
    assert TUNINGS["mappo"].default.at_pace(8.0, 4.0).learn_share == 1.0


def test_the_command_line_turns_seconds_into_discounts():
    words = ["algorithm=mappo", "scenario=indoor_medium", "scenario.local_steps=10", "algorithm.trace_seconds=5"]
    found = algorithm_settings(compose_settings("train", words))
    assert (found.gamma, found.lmbda) == (1.0, pytest.approx(math.exp(-1.0 / 5.0)))  # action=targets sets gamma
    assert found.learn_share == 0.25  # its protocol decides every 4 s
    reference = algorithm_settings(compose_settings("train", [*words, "tuning=reference", "action=regions"]))
    assert (reference.gamma, reference.lmbda, reference.learn_share) == (0.99, 1.0, 1.0)


@pytest.mark.parametrize("share, count", [(1.0, 8), (0.25, 2), (0.01, 1)])
def test_a_pass_takes_its_share_of_the_minibatches(share, count):
    steps = [TensorDict({"number": torch.arange(64)}, [64]), TensorDict({"number": torch.arange(16)}, [16])]
    parts = list(Updater.minibatches(None, steps, 10, share))
    assert len(parts) == count
    for own, size in zip(zip(*parts, strict=True), (8, 2), strict=True):
        numbers = torch.cat([part["number"] for part in own])
        assert len(numbers) == count * size and len(numbers.unique()) == len(numbers)


@pytest.fixture(scope="module")
def office():
    return make_map("indoor_small", 0)


@pytest.mark.parametrize("seconds, steps, decisions", [(1.0, 10, 60), (2, 20, 30), (0.5, 5, 120), ("protocol", 40, 15)])
def test_an_episode_lasts_as_long_at_every_pace(office, seconds, steps, decisions):
    env = ExplorationEnv(office, 1, decision_seconds=seconds)
    assert (env.local_steps, env.macro_steps) == (steps, decisions)
    assert env.lookahead_config.local_steps == 40  # imagined decisions do not change with the pace


@pytest.mark.parametrize("seconds", [None, "protocol"])
def test_local_steps_win_and_keep_the_number_of_decisions(office, seconds):
    env = ExplorationEnv(office, 1, local_steps=7, decision_seconds=seconds)
    assert (env.local_steps, env.macro_steps, env.lookahead_config.local_steps) == (7, 15, None)


@pytest.mark.parametrize(
    "settings, words",
    [
        ({"local_steps": 10, "decision_seconds": 1.0}, ["local_steps=10", "decision_seconds=1.0", "give one"]),
        ({"decision_seconds": 0.25}, ["decision_seconds=0.25", "0.1 s", "protocol"]),
        ({"decision_seconds": 0.0}, ["decision_seconds=0.0"]),
        ({"decision_seconds": "often"}, ["decision_seconds='often'", "protocol"]),
    ],
)
def test_a_pace_that_is_none_is_refused(office, settings, words):
    with pytest.raises(ValueError) as caught:
        ExplorationEnv(office, 1, **settings)
    assert all(word in str(caught.value) for word in words)


def test_a_decision_of_many_steps_is_several_of_few(office):
    """The same goals held for as long: the same episode, whatever the pace."""
    slow, fast = (ExplorationEnv(office, 2, num_robots=2, seed=3, decision_seconds=s, num_threads=1) for s in (2, 1))
    goals = torch.tensor(office.free[[0, -1], :2]).float().expand(2, 2, 2)
    ends = []
    for env, count in ((slow, 1), (fast, 2)):
        state = env.reset()
        for _ in range(count):
            state["agents", "action", "goal"] = goals
            state = env.step(state)["next"]
        ends.append((state["info", "local_steps"], state["agents", "observation", "time_left"]))
    assert torch.equal(ends[0][0], ends[1][0]) and torch.allclose(ends[0][1], ends[1][1])


IR2 = ["algorithm=mappo", "scenario=ir2", "scenario.path=plan.png"]


def compose(*words: str):
    return compose_settings("train", ["algorithm=mappo", "scenario=indoor_medium", *words])


def test_a_run_stores_its_pace_as_steps():
    scenario = resolve(compose("scenario.decision_seconds=2"))["scenario"]
    assert (scenario["local_steps"], scenario["macro_steps"]) == (20, 30)
    assert "decision_seconds" not in scenario


def pace(cfg) -> tuple[int, int]:
    row = find_scenario(cfg.scenario.name)
    return decision_steps(cfg.scenario, row), episode_decisions(cfg.scenario, row)


@pytest.mark.parametrize(
    "run, new, wanted",
    [
        (["scenario.decision_seconds=2"], [], (20, 30)),
        (["scenario.decision_seconds=2"], ["scenario.local_steps=5"], (5, 30)),
        (["scenario.decision_seconds=2"], ["scenario.decision_seconds=0.5"], (5, 120)),
        (["scenario.local_steps=5"], ["scenario.decision_seconds=0.5", "scenario.macro_steps=7"], (5, 7)),
        (["scenario.local_steps=8"], [], (8, 15)),
        (["scenario.decision_seconds=2"], ["scenario=maze_small"], (10, 30)),
    ],
)
def test_a_run_keeps_its_pace(run, new, wanted, tmp_path):
    words = ["algorithm=mappo", "scenario=indoor_medium", *run]
    cfg = compose_settings("train", words)
    saved = {"settings": resolve(cfg), "overrides": words, "followers": list(cfg.followers)}
    for verb in ("train", "evaluate"):
        again = compose_settings(verb, continue_run(tmp_path, saved, new, verb))
        assert pace(again) == wanted


@pytest.mark.parametrize("verb, words", [("train", ["preset=paper"]), ("bench", ["task=env"]), ("train", IR2)])
def test_protocols_and_throughput_keep_their_pace(verb, words):
    cfg = compose_settings(verb, words)
    row = find_scenario(cfg.scenario.name)
    assert pace(cfg) == (row.local_steps, row.macro_steps)
