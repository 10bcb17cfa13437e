"""An earlier evaluation as a baseline: the same episodes, and what was changed in between."""

import csv
import json

import numpy as np
import pytest

from maexp.agents.cli import main
from maexp.agents.errors import UserError
from maexp.agents.evaluation.baseline import ALIKE, Baseline, describe_changes, load_baseline, write_episodes
from maexp.agents.evaluation.evaluate import EvaluationResult
from maexp.agents.evaluation.results import FORMAT

TINY = [
    "evaluate",
    "policy=random,nearest_frontier",
    "scenario.held_out=[70,71]",
    "scenario.macro_steps=2",
    "scenario.local_steps=5",
    "num_robots=2",
    "num_envs=6",
    "episodes=6",
    "device=cpu",
    "num_threads=1",
]
RUN = {"format": FORMAT, "scenario": "maze_small", "maps": ["a", "b"], "seed": 0, "episodes": 2, "steps": [300]}
MAPS = np.repeat(["a", "b"], 5)
ONE = np.linspace(0.1, 0.8, 10)


def result(coverage: list, size: int = 3, place: str = "", policy: str = "voronoi") -> EvaluationResult:
    count = len(coverage)
    episodes = {
        "coverage_auc": np.array(coverage),
        "coverage_step_95": np.array([7.0] + [np.nan] * (count - 1)),
        "coverage_step_95_censored": np.arange(count, dtype=float),
        "collisions": np.zeros(count),
    }
    return EvaluationResult(policy, size, episodes, 1.0, np.full(count, place) if place else MAPS, place=place)


@pytest.fixture
def saved(tmp_path):
    """A folder with an earlier evaluation of two team sizes."""
    write_episodes(tmp_path / "episodes.csv", [result(ONE), result(ONE, size=2)])
    (tmp_path / "results.json").write_text(json.dumps({"run": RUN}))
    return tmp_path


def test_episodes_come_back_as_they_were(saved):
    before, wanted = load_baseline(str(saved)), result(ONE)
    assert list(before.results) == [("voronoi", 3), ("voronoi", 2)] and before.run == RUN
    for metric, values in wanted.episodes.items():
        np.testing.assert_array_equal(before.results["voronoi", 3].episodes[metric], values)
    assert before.results["voronoi", 3].maps.tolist() == MAPS.tolist()


def test_changes_are_paired_and_maps_have_their_own(saved):
    """Episodes differ far more than the two runs do, and the change is certain all the same."""
    now = [
        result(ONE + 0.1),
        result(ONE[:5] + 0.1, place="a"),
        result(ONE[5:] + 0.1, place="b"),
        result([0.9] * 10, policy="hungarian"),
        result(ONE - 0.1, size=2),
    ]
    found = load_baseline(str(saved)).changes(now)
    assert list(found) == ["voronoi N=3", "voronoi on a N=3", "voronoi on b N=3", "voronoi N=2"]
    for name in list(found)[:3]:
        assert found[name]["coverage_auc"]["ci95"] == [pytest.approx(0.1)] * 2
    assert found["voronoi on b N=3"]["coverage_auc"]["n"] == 5 and found["voronoi N=2"]["coverage_auc"]["n"] == 10
    assert describe_changes({"voronoi N=2": found["voronoi N=2"]}, saved, 0.95) == [
        f"voronoi N=2 less {saved}: -10.0 points of coverage over time [-10.0, -10.0], "
        "+0 steps to 95 % [+0, +0], +0.000 robots lost [+0.000, +0.000]."
    ]


def test_results_of_another_format_are_a_sentence(saved):
    (saved / "results.json").write_text(json.dumps({"run": RUN | {"format": "maexp-results-0"}}))
    with pytest.raises(UserError, match=f"no folder of maexp evaluate with episodes.csv and .* of kind {FORMAT}"):
        load_baseline(str(saved))


@pytest.mark.parametrize("name", ALIKE)
def test_other_episodes_are_no_baseline(saved, name):
    before = load_baseline(str(saved))
    before.check(RUN, [("voronoi", 3), ("random", 3)])
    with pytest.raises(UserError, match=f"played other episodes .{name}: "):
        before.check(RUN | {name: "another"}, [("voronoi", 3)])


def test_nothing_in_common_is_no_baseline(saved):
    with pytest.raises(UserError, match="holds voronoi with num_robots=3, voronoi with num_robots=2: evaluate one"):
        Baseline(saved, RUN, load_baseline(str(saved)).results).check(RUN, [("voronoi", 4), ("random", 3)])


def test_the_command_compares_settings(tmp_path, monkeypatch, capsys):
    """A setting that changes nothing gives zeros, one that slows robots down does not, and another seed is refused."""
    monkeypatch.chdir(tmp_path)
    assert main([*TINY, "hydra.run.dir=old"]) == 0
    assert "results.json, episodes.csv, " in capsys.readouterr().out
    with open("old/episodes.csv") as file:
        rows = list(csv.DictReader(file))
    assert [row["policy"] for row in rows] == ["random"] * 6 + ["nearest_frontier"] * 6
    assert [row["map"] for row in rows[:4]] == ["maze_small_70", "maze_small_71"] * 2
    assert main([*TINY, "hydra.run.dir=same", "baseline=old"]) == 0
    assert "random less old: +0.0 points of coverage over time [+0.0, +0.0]," in capsys.readouterr().out
    changes = json.loads((tmp_path / "same" / "changes.json").read_text())
    assert changes["nearest_frontier"]["path_length"]["mean"] == 0 and changes["baseline"]["folder"].endswith("old")
    slow = ["evaluate", "policy=random", *TINY[2:], "robot.max_speed=0.5"]
    assert main([*slow, "hydra.run.dir=slow", "baseline=old"]) == 0
    changes = json.loads((tmp_path / "slow" / "changes.json").read_text())
    assert set(changes) == {"random", "baseline"} and changes["random"]["path_length"]["ci95"][1] < 0
    capsys.readouterr()
    assert main([*TINY, "baseline=old", "seed=1"]) == 2
    assert capsys.readouterr().err == (
        "maexp: baseline=old played other episodes (seed: 0 there, 1 here): evaluate both with the same.\n"
    )
    assert main([*TINY, "baseline=gone"]) == 2
    assert "baseline=gone is no folder of maexp evaluate" in capsys.readouterr().err
