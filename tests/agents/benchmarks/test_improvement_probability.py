"""Who is better than whom: the probability of improvement against SciPy and by hand."""

import numpy as np
import pytest
from scipy.stats import mannwhitneyu

from maexp.agents.benchmarks.report import compare_all, improvement, win_shares


def test_probability_of_improvement_is_mann_whitneys():
    rng = np.random.default_rng(0)
    x = {"a": rng.integers(0, 9, 40).astype(float), "b": rng.normal(size=30)}
    y = {"a": rng.integers(0, 9, 30).astype(float), "b": rng.normal(size=50) - 1, "only": rng.normal(size=3)}
    wanted = np.mean([mannwhitneyu(x[s], y[s]).statistic / (len(x[s]) * len(y[s])) for s in "ab"])
    found = improvement(x, y)
    assert found["mean"] == pytest.approx(wanted) and found["n"] == 2
    assert found["ci95"][0] < wanted < found["ci95"][1]
    turned = compare_all({"x": x, "y": y})["y", "x"]
    assert turned["mean"] == pytest.approx(1 - wanted) and turned["ci95"][0] < turned["mean"] < turned["ci95"][1]


def test_weights_of_a_resample_are_repetitions():
    x, y = np.array([1.0, 2.0, 5.0]), np.array([2.0, 3.0])
    share = win_shares(x, y, np.array([[2.0, 0.0, 1.0]]), np.array([[1.0, 3.0]]))[0]
    drawn = [(a > b) + 0.5 * (a == b) for a in (1, 1, 5) for b in (2, 3, 3, 3)]
    assert share == pytest.approx(np.mean(drawn))
