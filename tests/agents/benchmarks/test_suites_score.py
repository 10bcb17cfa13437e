"""The score of a suite, its interval and its profile."""

import numpy as np
import pytest

from maexp.agents.benchmarks.suites import score
from maexp.agents.evaluation.evaluate import EvaluationResult


def result(values: list[float], maps: list[str]) -> EvaluationResult:
    return EvaluationResult("one", 3, {"coverage_auc": np.array(values)}, 0.0, np.array(maps))


def test_the_score_and_its_interval_count_every_part_alike():
    parts = {"a": result([0.2, 0.4], ["x", "y"]), "b": result([0.8] * 6, list("zzuuvw"))}
    values = {name: part.episodes["coverage_auc"] for name, part in parts.items()}
    found = score.mean_over_parts(values, parts)
    assert found["mean"] == pytest.approx(0.55) and found["n"] == 8
    assert found["ci95"] == [pytest.approx(0.5), pytest.approx(0.6)]  # only the maps of `a` differ
    some = {"a": np.array([np.nan, 0.4]), "b": np.full(6, np.nan)}
    assert score.mean_over_parts(some, parts) | {"ci95": 0} == {"mean": 0.4, "ci95": 0, "n": 1}
    assert np.isnan(score.mean_over_parts(some, parts)["ci95"]).all()  # one episode
    assert score.place_between(0.5, 0.4, 0.6) == pytest.approx(0.5) and score.place_between(0.5, 0.4, 0.4) is None


def test_parts_are_resampled_apart():
    """Of parts that vary alike, the mean varies less than each."""
    rng = np.random.default_rng(0)
    values, maps = rng.uniform(size=40).tolist(), [str(k) for k in range(40)]
    parts = {name: result(values, maps) for name in "abcd"}
    each = score.mean_over_parts({"a": np.array(values)}, {"a": parts["a"]})["ci95"]
    both = score.mean_over_parts({name: np.array(values) for name in parts}, parts)["ci95"]
    assert both[1] - both[0] == pytest.approx((each[1] - each[0]) / 2, rel=0.15)


def test_a_profile_falls_from_all_to_none():
    levels = score.profile({"a": np.array([0.0, 0.5]), "b": np.array([1.0, 1.0])})
    assert levels[0] == 0.75 and levels[49] == 0.75 and levels[50] == 0.5 and levels[99] == 0.5 and levels[100] == 0.0
