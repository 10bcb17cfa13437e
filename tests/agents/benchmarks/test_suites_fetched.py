"""Suites on published maps: played from where `maexp maps fetch` keeps them, and only if as they were frozen."""

import csv
import hashlib
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from file_server import Server
from worlds import room

from maexp.agents import map_sets
from maexp.agents.benchmarks.suites.frozen import check_maps, freeze, read_frozen
from maexp.agents.benchmarks.suites.play import SuitePolicy, build_env, build_maps, play_batch
from maexp.agents.benchmarks.suites.suite import FOLDER, load_suite
from maexp.agents.cli import main
from maexp.agents.errors import UserError
from maexp.envs import ObservationConfig

pytestmark = pytest.mark.slow  # whole runs of suites

REAL = FOLDER / "real-1.yaml"
SMALLER = {"floors/test": "halls/test", "episodes: 12": "episodes: 4", "macro_steps: 60": "macro_steps: 3"}
HALLS = [("training", "small"), ("test", "wide"), ("test", "long")]


@pytest.fixture
def halls(tmp_path, monkeypatch) -> Path:
    """A frozen suite of short episodes on two halls of a set that has been fetched; the folder of the set is there."""
    sets = tmp_path / "sets"
    sets.mkdir()
    (sets / "halls.yaml").write_text("about: halls\naddress: http://127.0.0.1:9\n")
    rows = ["split,file,address,bytes,sha256,licence,building,resolution,free_thresh"]
    rows += [f"{split},{name}.pgm,a/b/{name},1,0,MIT,{name},0.2,0.2" for split, name in HALLS]
    (sets / "halls.csv").write_text("\n".join(rows) + "\n")
    monkeypatch.setattr(map_sets, "SETS", sets)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for entry in map_sets.load_set("halls").maps:
        save_hall(entry, 40)
    path = tmp_path / "own.yaml"
    text = REAL.read_text().partition("\n# Frozen")[0]
    for large, less in SMALLER.items():
        assert large in text
        text = text.replace(large, less)
    path.write_text(text)
    freeze(load_suite(str(path)), {})
    return path


def save_hall(entry, width: int) -> None:
    path = map_sets.load_set("halls").kept / entry.map_place
    path.parent.mkdir(parents=True, exist_ok=True)
    room(width + len(entry.name), 30 if entry.name == "long" else 41, spacing=0.25).save(path)


def play(suite: Path, where: Path, *words: str) -> int:
    return main(["suite", "run", str(suite), "policy=random", f"hydra.run.dir={where}", *words])


def test_it_plays_the_split_in_order_and_is_verified(halls, tmp_path, capsys):
    part = load_suite(str(halls)).parts["floors"]
    assert part.map_names() == part.map_names(7) == ["wide", "long"]
    assert play(halls, tmp_path / "run") == 0
    assert main(["suite", "verify", str(tmp_path / "run"), f"suite={halls}"]) == 0
    content = json.loads((tmp_path / "run" / "results.json").read_text())
    assert list(content["maps"]["floors"]) == ["wide", "long"] and content["score"]["normalised"] == 0.0
    assert main(["leaderboard", str(tmp_path / "run"), f"suite={halls}", f"out={tmp_path / 'site'}"]) == 0
    capsys.readouterr()
    assert main(["suite", "show", str(halls)]) == 0
    told = capsys.readouterr().out
    assert "| floors | halls/test: wide, long |" in told and "maexp maps fetch halls: a/b (MIT)" in told


def test_another_seed_draws_other_starts_on_the_same_maps(halls, tmp_path, capsys):
    for seed in ("", "seed=7"):
        assert play(halls, tmp_path / f"run{seed}", *[seed] * bool(seed)) == 0
    assert "Other starts, of seed 7: not the score of real-1." in capsys.readouterr().out
    own, other = (json.loads((tmp_path / name / "results.json").read_text()) for name in ("run", "runseed=7"))
    assert own["maps"] == other["maps"] and not other["suite"]["frozen_maps"]
    assert own["episodes"]["floors"]["coverage_auc"] != other["episodes"]["floors"]["coverage_auc"]
    assert main(["suite", "verify", str(tmp_path / "runseed=7"), f"suite={halls}"]) == 0


@pytest.mark.parametrize("words", [[], ["seed=7"]])
def test_maps_with_other_points_and_absent_ones_are_refused(halls, tmp_path, words, capsys):
    """As another version of the importer would make them."""
    assert play(halls, tmp_path / "run", *words) == 0
    entry = load_suite(str(halls)).parts["floors"].floors[1]
    save_hall(entry, 44)
    told = "floors has maps with other points than were frozen (long): remove "
    refused(halls, tmp_path, words, capsys, told, "and import anew with maexp maps fetch halls; or use the version")
    (map_sets.load_set("halls").kept / entry.map_place).unlink()
    told = "floors plays maps of halls/test, and 1 of 2 are not in "
    refused(halls, tmp_path, words, capsys, told, "fetch them with maexp maps fetch halls.")


def refused(halls: Path, tmp_path: Path, words: list[str], capsys, *told: str) -> None:
    """By `run` and by `verify`, which does not blame the run."""
    new = ["run", str(halls), "policy=random", f"hydra.run.dir={tmp_path / 'other'}", *words]
    for task in (new, ["verify", str(tmp_path / "run"), f"suite={halls}"]):
        shutil.rmtree(tmp_path / "other", ignore_errors=True)
        capsys.readouterr()
        assert main(["suite", *task]) == 2
        err = capsys.readouterr().err
        lines = [line for line in err.splitlines() if line.startswith("maexp: ")]
        assert len(lines) == 1 and all(text in lines[0] for text in told), err
    assert not list(tmp_path.glob("other/actions/*"))


def test_real_1_says_what_to_fetch(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert main(["suite", "run", "real-1", "policy=random", f"hydra.run.dir={tmp_path / 'run'}"]) == 2
    err = capsys.readouterr().err
    assert "4 of 4 are not in" in err and "fetch them with maexp maps fetch floors." in err
    assert err.count("\n") == 1 and not list(tmp_path.iterdir()), "told before a folder is made"


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (("floors/test", "floors/all"), "parts.floors.fetched=floors/all is unknown: choose dungeons/training, "),
        (("floors/test", "[floors]"), "parts.floors.fetched=['floors'] is unknown"),
        (("fetched:", "first: 1\n    fetched:"), "parts.floors.first is unknown: choose among fetched, "),
        (("fetched:", "fetch:"), "leaves parts.floors.scenario open"),
    ],
)
def test_a_file_that_defines_no_suite_is_told_in_a_sentence(tmp_path, change, told):
    path = tmp_path / "own.yaml"
    path.write_text(REAL.read_text().replace(*change, 1))
    with pytest.raises(UserError, match=re.escape(told)):
        load_suite(str(path))


@pytest.fixture(scope="module")
def fetched(data_dir, tmp_path_factory):
    """The test split of `floors`, fetched from a server on this machine: of the others nothing."""
    where = tmp_path_factory.mktemp("floors")
    rows = [row for row in csv.DictReader(open(map_sets.SETS / "floors.csv")) if row["split"] in ("test", "licences")]
    files = [path for name in ("maps2d", "licences") for path in (data_dir / name).iterdir()]
    content = {hashlib.sha256(file.read_bytes()).hexdigest(): file.read_bytes() for file in files}
    server = Server({row["address"]: content[row["sha256"]] for row in rows})
    (where / "sets").mkdir()
    (where / "sets" / "floors.yaml").write_text((map_sets.SETS / "floors.yaml").read_text())
    with open(where / "sets" / "floors.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    with pytest.MonkeyPatch.context() as patch, server.serving():
        patch.setenv("XDG_CACHE_HOME", str(where / "cache"))
        patch.setattr(map_sets, "SETS", where / "sets")
        assert main(["maps", "fetch", "floors", f"mirror={server.address}"]) == 0
        patch.undo()
        patch.setenv("XDG_CACHE_HOME", str(where / "cache"))
        yield


def test_real_1_is_as_it_was_frozen(fetched):
    """The importer makes the same points of the published floors, and the simulator plays the same episodes."""
    suite = load_suite("real-1")
    part = suite.parts["floors"]
    maps = build_maps(part)
    check_maps(suite, part, maps)
    assert [world.name for world in maps] == part.map_names()
    frozen = read_frozen(suite)["random"]["floors"]
    env = build_env(part, maps, 4, suite.seed, ObservationConfig(pictures=False), device="cpu")
    with SuitePolicy("random").open(env) as policy:
        again = play_batch(suite, env, policy, 0)
    assert sorted(again.maps) == sorted(part.map_names()) and again.maps.tolist() == frozen.maps[:4].tolist()
    assert np.abs(again.metrics["coverage_auc"] - frozen.episodes["coverage_auc"][:4]).max() < 0.02
