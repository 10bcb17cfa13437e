"""Shares of the headroom: leads over cost_utility, measured by the lead of the search on the true map."""

import numpy as np
import pytest

from maexp.agents.evaluation.evaluate import EvaluationResult
from maexp.agents.evaluation.results import describe_shares, headroom_shares


def result(policy: str, *auc: float, size: int = 3) -> EvaluationResult:
    return EvaluationResult(policy, size, {"coverage_auc": np.array(auc)}, 0.0, np.array(["a", "a", "b", "b", "b"]))


def test_a_share_is_a_lead_by_that_of_the_search_that_cheats():
    results = [
        result("cost_utility", 0.5, 0.6, 0.7, 0.8, 0.1),
        result("clairvoyant", 0.6, 0.7, 0.8, 0.9, 0.2),
        result("mine", 0.52, 0.62, 0.72, 0.82, 0.12),
        result("worse", 0.4, 0.6, 0.7, 0.8, 0.075),
    ]
    found = headroom_shares(results, [played.policy for played in results])
    assert set(found) == {"mine", "worse"}
    assert found["mine"]["mean"] == pytest.approx(0.2) and found["mine"]["ci95"] == pytest.approx([0.2, 0.2])
    assert found["worse"]["mean"] == pytest.approx(-0.25) and found["worse"]["n"] == 5
    assert found["worse"]["ci95"][0] < -0.25 < found["worse"]["ci95"][1]
    first = describe_shares(results[:3], ["cost_utility", "clairvoyant", "mine"])
    assert first == [
        "mine wins 20 % [20, 20] of the headroom, the lead of clairvoyant over cost_utility in coverage over time."
    ]


def test_no_share_where_there_is_no_clear_headroom():
    base, mine = result("cost_utility", 0.5, 0.6, 0.7, 0.8, 0.9), result("mine", 0.6, 0.6, 0.7, 0.8, 0.9)
    mixed = result("clairvoyant", 0.9, 0.9, 0.6, 0.7, 0.8)
    assert headroom_shares([base, mixed, mine], ["cost_utility", "clairvoyant", "mine"]) == {}
    assert headroom_shares([base, mine], ["cost_utility", "mine"]) == {}
    other_size = result("clairvoyant", 0.9, 0.9, 0.9, 0.9, 1.0, size=2)
    assert headroom_shares([base, other_size, mine], ["cost_utility", "clairvoyant N=2", "mine"]) == {}


def test_copies_of_an_episode_are_no_headroom():
    """Five copies of one lead by 0.1: of another episode that says nothing."""
    results = [
        EvaluationResult(name, 3, {"coverage_auc": np.full(5, auc)}, 0.0, np.repeat("a", 5))
        for name, auc in (("cost_utility", 0.5), ("clairvoyant", 0.6), ("mine", 0.55))
    ]
    assert headroom_shares(results, [played.policy for played in results]) == {}
