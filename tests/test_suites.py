"""Suites: frozen for good, played, believed only as far as their actions carry them."""

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from small_suite import make_small_suite

from maexp.agents.cli import main
from maexp.agents.errors import UserError
from maexp.agents.evaluation.evaluate import EvaluationResult
from maexp.agents.locking import lock
from maexp.agents.suites import folder, score
from maexp.agents.suites.frozen import check_maps, read_frozen, sums
from maexp.agents.suites.play import build_env, build_maps, play_batch
from maexp.agents.suites.players import Player
from maexp.agents.suites.run import SuiteRun
from maexp.agents.suites.suite import load_suite, suite_names
from maexp.agents.suites.verify import verify
from maexp.envs import ObservationConfig

pytestmark = pytest.mark.slow  # whole runs of suites


@pytest.fixture(scope="session")
def small(tmp_path_factory) -> Path:
    """The file of a frozen suite of two parts, four short episodes each: not to be changed."""
    return make_small_suite(tmp_path_factory.mktemp("suite") / "small.yaml")


@pytest.fixture(scope="session")
def played(small, tmp_path_factory) -> Path:
    """The folder of a run of it: not to be changed."""
    where = tmp_path_factory.mktemp("runs") / "run"
    assert main(["suite", "run", str(small), "policy=nearest_frontier", "num_envs=3", f"hydra.run.dir={where}"]) == 0
    return where


@pytest.fixture
def copy(played, tmp_path) -> Path:
    """A copy of it that a test may change."""
    return Path(shutil.copytree(played, tmp_path / "copy"))


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
        values = {part: one.episodes[suite.score] for part, one in results.items()}
        assert score.mean_of(values) == suite.frozen["scores"][policy]["score"]
    scores = suite.frozen["scores"]
    assert 0.1 < scores["random"]["score"] < scores[suite.reference]["score"] - 0.05


def test_the_simulator_still_plays_the_frozen_episodes():
    """`random` depends on nothing else. Other processors round differently."""
    suite = load_suite("minival")
    frozen = read_frozen(suite)["random"]["indoor_small"]
    part = suite.parts["indoor_small"]
    env = build_env(part, build_maps(part), 4, suite.seed, ObservationConfig(pictures=False), device="cpu")
    with Player("random").open(env) as policy:
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
def test_an_edited_suite_is_refused(small, tmp_path, change):
    path = Path(shutil.copy(small, tmp_path))
    shutil.copy(small.with_suffix(".csv"), tmp_path)
    load_suite(str(path)).check()
    assert change[0] in path.read_text()
    path.write_text(path.read_text().replace(*change, 1))
    with pytest.raises(UserError, match="was changed since it was frozen"):
        load_suite(str(path)).check()


def test_edited_episodes_and_a_suite_that_is_not_frozen_are_refused(small, tmp_path):
    path, rows = Path(shutil.copy(small, tmp_path)), small.with_suffix(".csv").read_text()
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
def test_a_file_that_defines_no_suite_is_told_in_a_sentence(small, tmp_path, change, told):
    path = Path(shutil.copy(small, tmp_path))
    assert change[0] in path.read_text()
    path.write_text(path.read_text().replace(*change, 1))
    with pytest.raises(UserError, match=re.escape(told)) as error:
        load_suite(str(path))
    assert "\n" not in str(error.value)


def test_another_seed_plays_other_maps(small):
    part = load_suite(str(small)).parts["maze_small"]
    others = [part.indices(7), part.indices(8), load_suite(str(small)).parts["indoor_small"].indices(7)]
    assert part.indices() == [1000, 1001] and part.indices(7) == others[0]
    assert len({one for several in others for one in several}) == 6 and min(map(min, others)) >= 10_000
    assert sums(part, build_maps(part, 7), 7) != sums(part, build_maps(part, 8), 8)


# Results


def test_a_run_is_believed(played, small, capsys):
    capsys.readouterr()
    assert main(["suite", "verify", str(played), f"suite={small}"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["verified"] and json.loads(out)["same_platform"] and "follows from its actions" in err
    content = json.loads((played / "results.json").read_text())
    assert content["policy"] == "nearest_frontier" and content["suite"]["frozen_maps"]
    assert len(content["suite"]["checksum"]) == 64 and content["run"]["machine"]["cores"] >= 1
    assert [len(rows["coverage_auc"]) for rows in content["episodes"].values()] == [4, 4]
    parts = ("indoor_small", "maze_small")
    assert sorted(content["files"]) == [f"actions/{part}-000{k}.npz" for part in parts for k in (0, 3)]
    mean = np.mean([x for rows in content["episodes"].values() for x in rows["coverage_auc"]])
    assert content["score"]["mean"] == pytest.approx(mean, abs=1e-12)
    low, high = content["random"]["score"], content["reference"]["score"]
    assert content["score"]["normalised"] == pytest.approx((mean - low) / (high - low))
    assert content["decisions"]["count"] > 20 and content["decisions"]["mean_seconds"] > 0


def test_actions_give_the_same_bits_played_in_other_batches(played, small):
    """Also those of a policy that chooses among targets."""
    suite = load_suite(str(small))
    part, player = suite.parts["maze_small"], Player("small_mazes")
    env = build_env(part, build_maps(part), 2, suite.seed, player.observation(), device="cpu")
    with player.open(env) as policy:
        noted = [play_batch(suite, env, policy, first) for first in (0, 2)]
    whole = build_env(part, build_maps(part), 4, suite.seed, ObservationConfig(pictures=False), device="cpu")
    from maexp.agents.suites.play import Batch, replay_batch

    rows = {name: np.concatenate([getattr(one, name) for one in noted]) for name in (*folder.ARRAYS,)}
    metrics = {name: np.concatenate([one.metrics[name] for one in noted]) for name in suite.metrics}
    again = replay_batch(suite, whole, Batch(0, metrics=metrics, **rows))
    for name, values in metrics.items():
        assert np.array_equal(values, again.metrics[name], equal_nan=True), name
    assert np.array_equal(rows["region"], again.region) and np.array_equal(rows["offset"], again.offset)
    assert (rows["offset"] != 0).any() and np.array_equal(rows["maps"], again.maps)


def edit_json(change):
    def edit(where: Path) -> None:
        content = json.loads((where / "results.json").read_text())
        change(content)
        (where / "results.json").write_text(json.dumps(content))

    return edit


def edit_actions(change, name: str = "maze_small-0003"):
    """Changes the arrays of a file of actions, and the checksum that `results.json` gives for it."""

    def change_file(where: Path) -> None:
        path = where / "actions" / f"{name}.npz"
        with np.load(path) as file:
            arrays = dict(file)
        change(arrays)
        np.savez_compressed(path, **arrays)

    return edit_files(change_file)


def edit_files(change):
    """Changes files of actions, and the checksums that `results.json` gives for them."""

    def edit(where: Path) -> None:
        change(where)
        edit_json(lambda content: content["files"].update(folder.list_files(where)))(where)

    return edit


def pick(episodes: list[int]):
    """What a file has of these episodes, in this order."""
    return lambda arrays: arrays.update({name: one[episodes] for name, one in arrays.items()})


def swap_files(where: Path) -> None:
    one, other = (where / "actions" / f"{part}-0000.npz" for part in ("maze_small", "indoor_small"))
    kept = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(kept)


def other_action(arrays: dict) -> None:
    arrays["region"][0, 0] = 63 - arrays["region"][0, 0]


def set_metric(content: dict) -> None:
    content["episodes"]["maze_small"]["coverage_auc"][1] += 1e-7


def set_map(content: dict) -> None:
    content["maps"]["maze_small"]["1000"] = "0" * 16


def cut_off(where: Path) -> None:
    path = where / "actions" / "indoor_small-0000.npz"
    path.write_bytes(path.read_bytes()[:900])


EDITS = {
    "a metric": (edit_json(set_metric), "results.json", "episodes.maze_small.coverage_auc[1]"),
    "an action": (edit_actions(other_action), "actions/maze_small-0003.npz", "episode 3: coverage_auc"),
    "an action, its file as it was told": (
        lambda where: edit_json(lambda one: one["files"].update({"actions/maze_small-0003.npz": "0" * 64}))(where),
        "actions/maze_small-0003.npz",
        "SHA-256: the file was changed",
    ),
    "a metric in the file of actions": (
        edit_actions(lambda arrays: arrays["metrics"].__iadd__(0.01)),
        "actions/maze_small-0003.npz",
        "episode 3: coverage_auc",
    ),
    "an episode that ends earlier": (
        edit_actions(lambda arrays: arrays["decisions"].__isub__(1)),
        "actions/maze_small-0003.npz",
        "episode 3: coverage_auc",
    ),
    "another map": (edit_json(set_map), "results.json", "maps.maze_small.1000"),
    "another map of an episode": (
        edit_json(lambda one: one["episodes"]["maze_small"]["map"].reverse()),
        "results.json",
        "episodes.maze_small.map",
    ),
    "another version of the suite": (
        edit_json(lambda one: one["suite"].update(version=2)),
        "results.json",
        "suite.version",
    ),
    "another checksum": (
        edit_json(lambda one: one["suite"].update(checksum="0" * 64)),
        "results.json",
        "suite.checksum",
    ),
    "another seed": (edit_json(lambda one: one["suite"].update(seed=5)), "results.json", "suite.seed"),
    "a score": (edit_json(lambda one: one["score"].update(mean=0.99)), "results.json", "score.mean"),
    "an interval": (edit_json(lambda one: one["score"]["ci95"].reverse()), "results.json", "score.ci95[0]"),
    "a mean of a part": (
        edit_json(lambda one: one["parts"]["maze_small"]["path_length"].update(mean=1.0)),
        "results.json",
        "parts.maze_small.path_length.mean",
    ),
    "a difference": (
        edit_json(lambda one: one["reference"]["difference"]["coverage_auc"].update(mean=0.1)),
        "results.json",
        "reference.difference.coverage_auc.mean",
    ),
    "a profile": (
        edit_json(lambda one: one["profile"]["policy"].__setitem__(3, 0.5)),
        "results.json",
        "profile.policy[3]",
    ),
    "a time": (edit_json(lambda one: one["decisions"].update(mean_seconds=1e-9)), "results.json", "decisions.mean_sec"),
    "a reference": (edit_json(lambda one: one["reference"].update(score=0.1)), "results.json", "reference.score"),
    "a part left out": (edit_json(lambda one: one["parts"].pop("maze_small")), "results.json", "parts.maze_small"),
    "a damaged file": (cut_off, "actions/indoor_small-0000.npz", "is damaged or holds something else"),
    "a missing file": (
        lambda where: (where / "actions" / "maze_small-0000.npz").unlink(),
        "actions/maze_small-0000.npz",
        "not in both",
    ),
    "a file more": (
        lambda where: shutil.copy(where / "actions" / "maze_small-0000.npz", where / "actions" / "x.npz"),
        "actions/x.npz",
        "not in both",
    ),
    "a file more, which is told": (
        edit_files(lambda where: shutil.copy(where / "actions" / "maze_small-0000.npz", where / "actions" / "x.npz")),
        "actions/x.npz",
        "no episode of the suite is in it",
    ),
    "two episodes in each other's place": (
        edit_actions(pick([1, 0, 2]), "maze_small-0000"),
        "actions/maze_small-0000.npz",
        "episode 0: ",
    ),
    "two files in each other's place": (edit_files(swap_files), "actions/maze_small-0000.npz", "episode 0: map"),
    "an episode more": (
        edit_actions(pick([0, 0])),
        "actions/maze_small-0003.npz",
        "holds episodes after the last, 3",
    ),
    "a seed that is none": (
        edit_json(lambda one: one["suite"].update(seed="x", frozen_maps=False)),
        "results.json",
        "an entry is missing or of another kind",
    ),
    "a seed below 0": (
        edit_json(lambda one: one["suite"].update(seed=-1, frozen_maps=False)),
        "results.json",
        "an entry is missing or of another kind",
    ),
    "no JSON": (lambda where: (where / "results.json").write_text("{"), "results.json", "is missing, damaged"),
    "an entry of another kind": (edit_json(lambda one: one.update(episodes=3)), "results.json", "episodes"),
}


@pytest.mark.parametrize("kind", EDITS)
def test_an_edited_run_is_not_believed_and_what_differs_is_named(copy, small, kind, capsys):
    edit, file, where = EDITS[kind]
    edit(copy)
    assert main(["suite", "verify", str(copy), f"suite={small}"]) == 1
    out, err = capsys.readouterr()
    report = json.loads(out)
    assert not report["verified"] and err.count("\n") == 1 and "is not what it says" in err
    assert any(one["file"] == file and where in one["where"] for one in report["differences"]), report["differences"]


def test_a_stopped_run_goes_on_to_the_same_results(small, played, tmp_path, monkeypatch, capsys):
    where = tmp_path / "run"
    words = ["suite", "run", str(small), "policy=nearest_frontier", "num_envs=3", f"hydra.run.dir={where}"]
    words += ["name=our nearest mark 2"]
    play, batches = SuiteRun._play_part, []

    def stop_in_the_second_part(self, name):
        if name == "indoor_small":
            self.advance = lambda count: (_ for _ in ()).throw(KeyboardInterrupt)
        return play(self, name)

    monkeypatch.setattr(SuiteRun, "_play_part", stop_in_the_second_part)
    assert main(words) == 130
    assert f"maexp suite run resume={where}" in capsys.readouterr().err
    monkeypatch.undo()
    assert sorted(one.name for one in (where / "actions").iterdir()) == [
        "indoor_small-0000.npz",
        "maze_small-0000.npz",
        "maze_small-0003.npz",
    ]
    kept = (where / "actions" / "indoor_small-0000.npz").stat().st_mtime_ns
    assert main(["suite", "run", f"resume={where}"]) == 0
    assert (where / "actions" / "indoor_small-0000.npz").stat().st_mtime_ns == kept
    one, other = (json.loads((place / "results.json").read_text()) for place in (played, where))
    for name in ("suite", "score", "parts", "reference", "episodes", "maps", "profile"):
        assert one[name] == other[name], name
    assert (one["policy"], other["policy"]) == ("nearest_frontier", "our nearest mark 2")
    assert verify(where, str(small))["verified"] and not batches


def test_a_damaged_batch_is_named_with_the_way_to_play_it_again(copy, capsys):
    path = copy / "actions" / "indoor_small-0000.npz"
    path.write_bytes(path.read_bytes()[:500])
    assert main(["suite", "run", f"resume={copy}"]) == 2
    err = capsys.readouterr().err
    assert path.name in err and "remove it, and it is played again" in err and err.count("\n") >= 1
    path.unlink()
    assert main(["suite", "run", f"resume={copy}"]) == 0


def test_a_full_disk_is_one_sentence(copy, monkeypatch, capsys):
    (copy / "actions" / "indoor_small-0000.npz").unlink()

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("maexp.agents.suites.folder.np.savez_compressed", full)
    assert main(["suite", "run", f"resume={copy}"]) == 2
    assert "free some space" in capsys.readouterr().err
    assert not [one for one in (copy / "actions").iterdir() if "indoor_small-0000" in one.name]


def test_two_runs_cannot_hold_one_folder_and_resume_keeps_what_was_played(copy, capsys):
    with lock(copy, "maexp suite"):
        assert main(["suite", "run", f"resume={copy}"]) == 2
    assert "is in use by maexp suite, process " in capsys.readouterr().err
    assert main(["suite", "run", f"resume={copy}", "policy=random"]) == 2
    assert "leave policy out" in capsys.readouterr().err


def test_other_maps_and_starts_are_told_and_verified(small, tmp_path, capsys):
    where = tmp_path / "other"
    assert main(["suite", "run", str(small), "policy=random", "seed=7", f"hydra.run.dir={where}"]) == 0
    assert "Other maps and starts, of seed 7: not the score of small." in capsys.readouterr().out
    content = json.loads((where / "results.json").read_text())
    assert not content["suite"]["frozen_maps"]
    assert content["score"]["normalised"] == 0.0  # `random` was played there, too
    assert verify(where, str(small))["verified"]


# The score


def result(values: list[float], maps: list[str]) -> EvaluationResult:
    return EvaluationResult("one", 3, {"coverage_auc": np.array(values)}, 0.0, np.array(maps))


def test_the_score_and_its_interval_count_every_part_alike():
    parts = {"a": result([0.2, 0.4], ["x", "y"]), "b": result([0.8] * 6, list("zzuuvw"))}
    values = {name: one.episodes["coverage_auc"] for name, one in parts.items()}
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


# The command line


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


def test_a_hostile_policy_loses_its_episodes_and_the_rest_is_played_and_verified(small, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(Path(__file__).resolve().parent)
    where = tmp_path / "run"
    assert main(["suite", "run", str(small), "policy=hostile:Exits", "workers=2", f"hydra.run.dir={where}"]) == 0
    out, err = capsys.readouterr()
    assert "ended early" in out and err.count("ended early: it ended with status 3.\n") == 1, "told at once, and once"
    content = json.loads((where / "results.json").read_text())
    for part in content["episodes"].values():
        lost = {int(number) for number in part["lost"]}
        assert [count == 1 for count in part["decisions"]] == [number in lost for number in range(4)]
        assert all(reason == "it ended with status 3" for reason in part["lost"].values())
    assert 0 < sum(len(part["lost"]) for part in content["episodes"].values()) < 8
    assert json.loads((where / "run.json").read_text())["settings"]["num_envs"] == 2
    assert verify(where, str(small))["verified"]


def test_a_policy_that_deletes_the_folder_it_is_in_does_not_end_the_run(small, tmp_path, monkeypatch, capsys):
    here = tmp_path / "here"
    here.mkdir()
    shutil.copy(Path(__file__).with_name("hostile.py"), here)
    monkeypatch.chdir(here)
    where = tmp_path / "run"
    assert main(["suite", "run", str(small), "policy=hostile:Deletes", "workers=1", f"hydra.run.dir={where}"]) == 0
    assert not here.exists() and "it gave up: RuntimeError in hostile.py" in capsys.readouterr().out
    monkeypatch.chdir(tmp_path)
    assert verify(where, str(small))["verified"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_run_that_is_told_to_end_leaves_nobody_behind_and_can_go_on(number, small, tmp_path):
    """As a cluster does it, or a terminal that is closed."""
    words = ["suite", "run", str(small), "policy=hostile:Sleeps", "workers=2", f"hydra.run.dir={tmp_path / 'run'}"]
    run = subprocess.Popen(
        [sys.executable, "-c", "import sys; from maexp.agents.cli import main; sys.exit(main())", *words],
        cwd=Path(__file__).parent,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(number, signal.SIG_DFL),  # tests under nohup would hand on that it is ignored
    )
    try:
        end = time.monotonic() + 120
        while len(guests := find_guests(run.pid)) < 2:
            assert time.monotonic() < end and run.poll() is None
            time.sleep(0.05)
        run.send_signal(number)
        told = run.communicate(timeout=60)[1]
    finally:
        run.kill()
        run.wait()
    assert run.returncode == 130 and "Go on with: maexp suite run resume=" in told
    end = time.monotonic() + 30
    while left := [one for one in guests if Path(f"/proc/{one}").exists()]:  # killed, and perhaps not yet gone
        assert time.monotonic() < end, left
        time.sleep(0.05)


def find_guests(parent: int) -> list[int]:
    """Processes of policies that `parent` has started."""
    found = []
    for one in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            mine = int((one / "stat").read_text().rpartition(")")[2].split()[1]) == parent
            if mine and b"maexp.agents.policies.guest" in (one / "cmdline").read_bytes():
                found.append(int(one.name))
    return found
