"""How often robots decide: what follows the pace, and what must not depend on it."""

import math

import pytest
import torch
from tensordict import TensorDict

from maexp.agents.algorithms.updaters import Updater
from maexp.agents.settings.algorithms import TUNINGS
from maexp.agents.settings.compose import compose_config
from maexp.agents.settings.resolved import algorithm_settings


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
    found = algorithm_settings(compose_config("train", words))
    assert (found.gamma, found.lmbda) == (1.0, pytest.approx(math.exp(-1.0 / 5.0)))  # action=targets sets gamma
    assert found.learn_share == 0.25  # its protocol decides every 4 s
    reference = algorithm_settings(compose_config("train", [*words, "tuning=reference", "action=regions"]))
    assert (reference.gamma, reference.lmbda, reference.learn_share) == (0.99, 1.0, 1.0)


@pytest.mark.parametrize("share, count", [(1.0, 8), (0.25, 2), (0.01, 1)])
def test_a_pass_takes_its_share_of_the_minibatches(share, count):
    steps = [TensorDict({"number": torch.arange(64)}, [64]), TensorDict({"number": torch.arange(16)}, [16])]
    parts = list(Updater.minibatches(None, steps, 10, share))
    assert len(parts) == count
    for own, size in zip(zip(*parts, strict=True), (8, 2), strict=True):
        numbers = torch.cat([part["number"] for part in own])
        assert len(numbers) == count * size and len(numbers.unique()) == len(numbers)
