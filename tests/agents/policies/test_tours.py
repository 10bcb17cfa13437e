"""The example of teams that plan tours: what its tours are, and that it plays."""

import runpy
from types import SimpleNamespace

import numpy as np
import pytest
from paths import ROOT

from maexp.agents.deploy.planner.scene import ArrayScene
from maexp.agents.runtime import CHOICES
from maexp.kernels.constants import OPEN

EXAMPLE = ROOT / "docs" / "examples" / "policies" / "tours.py"
INF = np.inf


@pytest.fixture
def example(monkeypatch):
    for name in ("tours", "gain_tours"):
        monkeypatch.setitem(CHOICES, name, None)  # gone again afterwards
    return runpy.run_path(str(EXAMPLE))


def corridor(robots: list[int], targets: list[int], gain=None, lost=()) -> ArrayScene:
    """Robots and targets in a corridor of one metre and 100 cells; a range is 10 m."""
    travel = np.abs(np.subtract.outer(robots, targets)).astype(float)
    travel[list(lost)] = INF
    passable = np.full((1, 100), OPEN, np.uint8)
    gain = np.ones(len(targets)) if gain is None else np.array(gain)
    cells = SimpleNamespace(cell=np.array(targets))
    return SimpleNamespace(passable=[passable], targets=cells, cell=1.0, radar_range=10.0, travel=travel, gain=gain)


def test_tours_share_the_way_and_visit_in_order(example):
    """Two robots at 40 and 60: the left and the right half are one's each, near stops first."""
    tours = example["plan"](corridor([40, 60], [10, 30, 70, 90, 20]), False)
    assert tours == [[1, 4, 0], [2, 3]]
    ways, (alone,) = (
        example["Ways"](scene := corridor([50], [10, 30, 70, 90, 20]), False),
        example["plan"](scene, False),
    )
    assert ways.cost(0, alone) == pytest.approx(12.0), "one end first, then back to the other"


def test_gain_comes_soon_where_tours_count_it(example):
    scene = corridor([50], [47, 42, 60], gain=[0.1, 0.1, 1.0])
    assert example["plan"](scene, False)[0][-1] == 2, "the shorter end first"
    assert example["plan"](scene, True) == [[2, 0, 1]], "the end with much to see first"


def test_robots_without_a_way_get_no_stop(example):
    assert example["plan"](corridor([40, 60], [10, 90], lost=[0]), False)[0] == []


def test_the_longest_tour_is_short_rather_than_all_together(example):
    """A robot could visit both, with 30 m of way; two need 35 m, and 25 m at most."""
    assert example["plan"](corridor([50, 15], [40, 60]), False) == [[1], [0]]


def test_the_first_stop_is_liked_best_and_none_out_of_reach(example, monkeypatch):
    scene = corridor([40, 60], [10, 30, 70, 90])
    scene.travel[0, 0] = INF  # it could go on to there, but must not begin with it
    monkeypatch.setitem(example["rank_by_tours"].__globals__, "plan", lambda scene, fades: [[1, 0], [2, 3]])
    score = CHOICES["tours"](scene)
    assert score.argmax(1).tolist() == [1, 2] and score[0, 0] == -INF
    assert score[0].argsort()[::-1].tolist() == [1, 2, 3, 0] and score[0, 2] < -1e5, "then those of others, by the way"


def test_two_opt_turns_parts_round(example):
    ways = example["Ways"](corridor([0], [10, 20, 30, 40]), False)
    tours = [[0, 2, 1, 3]]
    costs = [ways.cost(0, tours[0])]
    example["reverse_parts"](ways, tours, costs)
    assert tours == [[0, 1, 2, 3]] and costs == [pytest.approx(4.0)]
