"""Suites: frozen for good, and the words that name them."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from maexp.agents.benchmarks.suites import score
from maexp.agents.benchmarks.suites.frozen import check_maps, read_frozen, sums
from maexp.agents.benchmarks.suites.play import SuitePolicy, build_env, build_maps, play_batch
from maexp.agents.benchmarks.suites.suite import load_suite, suite_names
from maexp.agents.cli import main
from maexp.agents.errors import UserError
from maexp.envs import ObservationConfig

pytestmark = pytest.mark.slow  # whole runs of suites


def test_there_is_a_quick_suite_and_its_name_is_its_file():
    assert suite_names()[0] == "minival"
    for name in suite_names():
        assert load_suite(name).name == name


@pytest.mark.parametrize("name", suite_names())
def test_a_suite_is_as_it_was_frozen(name):
    """Its file, its episodes and the points of all its maps; of those to fetch see test_suites_fetched.py."""
    suite = load_suite(name)
    suite.check()
    for part in suite.parts.values():
        if not part.fetched:
            check_maps(suite, part, build_maps(part))
    frozen = read_frozen(suite)
    for policy, results in frozen.items():
        values = {part: result.episodes[suite.score] for part, result in results.items()}
        assert score.mean_of(values) == suite.frozen["scores"][policy]["score"]
    scores = suite.frozen["scores"]
    assert 0.1 < scores["random"]["score"] < scores[suite.reference]["score"] - 0.05


def test_the_simulator_still_plays_the_frozen_episodes():
    """`random` depends on nothing else. Other processors round differently."""
    suite = load_suite("minival")
    frozen = read_frozen(suite)["random"]["indoor_small"]
    part = suite.parts["indoor_small"]
    env = build_env(part, build_maps(part), 4, suite.seed, ObservationConfig(pictures=False), device="cpu")
    with SuitePolicy("random").open(env) as policy:
        again = play_batch(suite, env, policy, 0)
    assert again.maps.tolist() == frozen.maps[:4].tolist()
    assert np.abs(again.metrics["coverage_auc"] - frozen.episodes["coverage_auc"][:4]).max() < 0.02


@pytest.mark.parametrize(
    "change",
    [
        ("range: 10.0", "range: 11.0"),
        ("version: 1", "version: 2"),
        ("decision_limit: 60.0", "decision_limit: 6.0"),
        ("first: 1000", "first: 1001"),
        ("'1000': ", "'1000': 0"),
        ("random: {score: 0.", "random: {score: 0.0"),
    ],
)
def test_an_edited_suite_is_refused(small_suite, tmp_path, change):
    path = Path(shutil.copy(small_suite, tmp_path))
    shutil.copy(small_suite.with_suffix(".csv"), tmp_path)
    load_suite(str(path)).check()
    assert change[0] in path.read_text()
    path.write_text(path.read_text().replace(*change, 1))
    with pytest.raises(UserError, match="was changed since it was frozen"):
        load_suite(str(path)).check()


def test_edited_episodes_and_a_suite_that_is_not_frozen_are_refused(small_suite, tmp_path):
    path, rows = Path(shutil.copy(small_suite, tmp_path)), small_suite.with_suffix(".csv").read_text()
    (tmp_path / "small.csv").write_text(rows.replace("0.", "0.1", 1))
    with pytest.raises(UserError, match="small.csv is not the file"):
        load_suite(str(path)).check()
    path.write_text(path.read_text().partition("\nfrozen:")[0])
    with pytest.raises(UserError, match="is not frozen"):
        load_suite(str(path)).check()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (("seed: 0 ", "seed: -1 "), "seed=-1 must be a whole number, 0 or more"),
        (("    num_robots: 3\n", ""), "leaves parts.maze_small.num_robots open"),
        (("length: 1.5, ", ""), "leaves parts.maze_small.robot.length open"),
        (("length: 1.5,", "lenght: 1.5, length: 1.5,"), "parts.maze_small.robot.lenght is unknown"),
        (("score: coverage_auc", "score: auc"), "score=auc must be one of the metrics"),
        (("starts: drawn", "starts: anywhere"), "starts=anywhere is unknown"),
        (("scenario: maze_small", "scenario: pointcloud"), "scenario=pointcloud builds no maps"),
        (("parts:", "parts: ["), "cannot be read as YAML"),
    ],
)
def test_a_file_that_defines_no_suite_is_told_in_a_sentence(small_suite, tmp_path, change, told):
    path = Path(shutil.copy(small_suite, tmp_path))
    assert change[0] in path.read_text()
    path.write_text(path.read_text().replace(*change, 1))
    with pytest.raises(UserError, match=re.escape(told)) as error:
        load_suite(str(path))
    assert "\n" not in str(error.value)


def test_another_seed_plays_other_maps(small_suite):
    part = load_suite(str(small_suite)).parts["maze_small"]
    others = [part.indices(7), part.indices(8), load_suite(str(small_suite)).parts["indoor_small"].indices(7)]
    assert part.indices() == [1000, 1001] and part.indices(7) == others[0]
    assert len({number for several in others for number in several}) == 6 and min(map(min, others)) >= 10_000
    assert sums(part, build_maps(part, 7), 7) != sums(part, build_maps(part, 8), 8)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["show"], "needs a name: minival"),
        (["run", "minival"], "give policy=NAME"),
        (["verify"], "the folder of a run"),
        (["show", "maxival"], "maxival is no suite: choose one of minival"),
        (["list", "minival"], "leave minival out"),
        (["run", "minival", "policy=nobody"], "nobody"),
        (["run", "minival", "policy=random", "num_envs=0"], "num_envs=0"),
        (["verify", "nowhere"], "nowhere is no folder"),
        (["run", "minival", "policy=random", "seed=-1"], "seed=-1"),
    ],
)
def test_bad_words_get_a_sentence(words, told, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["suite", *words]) == 2
    err = capsys.readouterr().err
    assert told in err and err.count("\n") == 1 and not list(tmp_path.rglob("*.json"))


def test_list_and_show(capsys):
    assert main(["suite", "list"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == suite_names()
    assert main(["suite", "show", "minival"]) == 0
    told = capsys.readouterr().out
    assert load_suite("minival").checksum[:16] in told and "| outdoor | outdoor 1000 to 1007 |" in told
