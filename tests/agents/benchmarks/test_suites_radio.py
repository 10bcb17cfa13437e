"""Suites with limited radios: parts that are scored by what a base station knows, or the robot that knows least."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from maexp.agents.benchmarks import leaderboard
from maexp.agents.benchmarks.suites.frozen import freeze, read_frozen
from maexp.agents.benchmarks.suites.play import build_env, build_maps, build_replay
from maexp.agents.benchmarks.suites.suite import FOLDER, load_suite
from maexp.agents.cli import main
from maexp.agents.errors import UserError
from maexp.envs import ObservationConfig

pytestmark = pytest.mark.slow  # whole runs of suites

SCORES = {"maze_small": "base_coverage_auc", "indoor_small": "worst_coverage_auc"}


def write(path: Path, change=lambda content: None) -> Path:
    """Two parts of `minival` under limited radios, four short episodes each."""
    content = yaml.safe_load((FOLDER / "minival.yaml").read_text().partition("\n# Frozen")[0])
    content |= {"name": path.stem, "score": SCORES["maze_small"], "episodes": 4}
    content["metrics"] = [*SCORES.values(), "coverage_auc", "exploration_ratio", "collisions"]
    content["parts"] = parts = {name: content["parts"][name] | {"count": 2, "macro_steps": 6} for name in SCORES}
    report = {"signal": True, "base_station": True, "strategy": "return_to_base", "period": 2}
    parts["maze_small"] |= {"starts": "together", "done": "base", "comm": report}
    parts["indoor_small"] |= {"starts": "together", "done": "everyone", "score": SCORES["indoor_small"]}
    parts["indoor_small"]["comm"] = {"range": 3.0, "line_of_sight": True}
    change(content)
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> Path:
    path = write(tmp_path_factory.mktemp("suite") / "small.yaml")
    freeze(load_suite(str(path)), {})
    return path


@pytest.fixture(scope="module")
def played(small, tmp_path_factory) -> Path:
    """The folder of a run of it."""
    where = tmp_path_factory.mktemp("runs") / "run"
    assert main(["suite", "run", str(small), "policy=nearest_frontier", f"hydra.run.dir={where}"]) == 0
    return where


def test_what_was_sent_is_not_directed_again(small):
    """Goals are noted as the strategy of the radios left them."""
    suite = load_suite(str(small))
    part, maps = suite.parts["maze_small"], build_maps(suite.parts["maze_small"])
    played = build_env(part, maps, 2, suite.seed, ObservationConfig(pictures=False))
    env = build_replay(part, maps, 2, suite.seed)
    assert played.strategy is not None and env.strategy is None and env.comm_config.has_base
    assert env.settings.limited and env.settings.done == "base"


def test_each_part_has_its_own_score(small, played, capsys):
    assert main(["suite", "verify", str(played), f"suite={small}"]) == 0
    content, frozen = json.loads((played / "results.json").read_text()), read_frozen(load_suite(str(small)))
    own = [np.array(content["episodes"][part][metric], dtype=float) for part, metric in SCORES.items()]
    theirs = [frozen["cost_utility"][part].episodes[metric] for part, metric in SCORES.items()]
    assert content["score"]["mean"] == pytest.approx(np.mean([values.mean() for values in own]))
    assert content["reference"]["score"] == pytest.approx(np.mean([values.mean() for values in theirs]))
    less = np.mean([(mine - reference).mean() for mine, reference in zip(own, theirs, strict=True)])
    assert content["reference"]["difference"]["score"]["mean"] == pytest.approx(less)
    for (part, metric), values in zip(SCORES.items(), own, strict=True):
        seen = np.array(content["episodes"][part]["coverage_auc"])
        assert content["parts"][part]["score"]["mean"] == pytest.approx(values.mean())
        assert (values <= seen + 1e-6).all() and (values < seen - 0.01).any(), metric
    assert set(content["episodes"]["indoor_small"]["base_coverage_auc"]) == {None}, "it has no base station"
    capsys.readouterr()
    assert main(["suite", "show", str(small)]) == 0
    told = capsys.readouterr().out
    assert "base_coverage_auc, the share of the place that the base station knows (maze_small); worst_cov" in told
    assert "| signal=True, base_station=True, strategy=return_to_base, period=2 | 99% of base |" in told


@pytest.mark.parametrize(("part", "metric"), SCORES.items())
def test_an_edited_score_is_named(part, metric, small, played, tmp_path, capsys):
    copy = tmp_path / "copy"
    copy.mkdir()
    (copy / "actions").symlink_to(played / "actions")
    content = json.loads((played / "results.json").read_text())
    content["episodes"][part][metric][1] += 1e-7
    (copy / "results.json").write_text(json.dumps(content))
    assert main(["suite", "verify", str(copy), f"suite={small}"]) == 1
    assert f"episodes.{part}.{metric}[1]" in capsys.readouterr().out


def test_a_row_and_the_page_say_what_is_scored(small, played, tmp_path):
    out = tmp_path / "site"
    assert main(["leaderboard", str(played), f"out={out}", f"suite={small}"]) == 0
    row = leaderboard.read_row(out / "small" / "nearest_frontier.json")
    assert leaderboard.scores_of(row) == SCORES
    told = "mean base_coverage_auc, the share of the place that the base station knows (maze_small); worst_coverage_auc"
    assert f"Score: {told}" in (out / "README.md").read_text() and told in (out / "index.html").read_text()
    row["parts"]["maze_small"]["metric"] = 3
    (out / "small" / "nearest_frontier.json").write_text(json.dumps(row))
    with pytest.raises(UserError, match="metric of a part is of another kind"):
        leaderboard.read_row(out / "small" / "nearest_frontier.json")


@pytest.mark.parametrize("name", ["score", "done"])
def test_score_and_end_of_a_part_are_in_the_checksum(name, small, tmp_path):
    changed = {"score": "coverage_auc", "done": "union"}[name]
    path = write(tmp_path / "small.yaml", lambda content: content["parts"]["indoor_small"].update({name: changed}))
    content = yaml.safe_load(path.read_text()) | {"frozen": load_suite(str(small)).frozen}
    path.write_text(yaml.safe_dump(content))
    (tmp_path / "small.csv").write_bytes(small.with_suffix(".csv").read_bytes())
    with pytest.raises(UserError, match="was changed since it was frozen"):
        load_suite(str(path)).check()


def in_part(name: str, **values):
    return lambda content: content["parts"][name].update(values)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (in_part("indoor_small", score="auc"), "parts.indoor_small.score=auc must be one of the metrics"),
        (in_part("indoor_small", done="all"), "parts.indoor_small.done=all is unknown: choose union, base, everyone"),
        (in_part("indoor_small", score="base_coverage_auc"), "and has no base station: set its comm.base_station"),
        (in_part("indoor_small", comm={}), "is scored by worst_coverage_auc, and all know the same: limit its comm"),
        (in_part("indoor_small", comm={"range": -1.0}), "parts.indoor_small: comm.range=-1.0 must"),
    ],
)
def test_a_file_that_defines_no_suite_is_told_in_a_sentence(change, told, tmp_path):
    with pytest.raises(UserError, match=re.escape(told)) as error:
        load_suite(str(write(tmp_path / "small.yaml", change)))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda content: content["metrics"].append("speed"), "metrics has speed, which is none: choose among"),
        (in_part("indoor_small", done="base"), "base"),
    ],
)
def test_what_nobody_can_play_is_told_in_a_sentence(change, told, tmp_path, capsys):
    assert main(["suite", "freeze", str(write(tmp_path / "small.yaml", change))]) == 2
    err = capsys.readouterr().err
    assert told in err and "Traceback" not in err
