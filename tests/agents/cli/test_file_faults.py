"""Kills, full disks, damaged and hostile files: what was there before stays whole, and one sentence says what happened.

Checkpoints that are killed while they are written, and Ctrl-C: test_train_stopped.py. Damaged maps:
test_fuzz_import.py.
"""

import itertools
import json
import os
import random
import resource
import signal
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from small_run import SMALL

from maexp.agents.benchmarks.cell import read_result, write_result
from maexp.agents.benchmarks.plan import Cell, cell_folder
from maexp.agents.cli import main
from maexp.agents.errors import UserError
from maexp.agents.evaluation import results
from maexp.agents.evaluation.metric_format import Evidence
from maexp.agents.evaluation.results import FORMAT, write_results
from maexp.agents.training.checkpoint import find_checkpoint, save_checkpoint
from maexp.agents.training.logs import MetricsLog
from maexp.envs import ExplorationEnv, MapError, PointCloudMap, make_map

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("somewhere")]  # full disks, files that cannot be read

CELL = Cell("maze_small", "random", 0)
KILLS = int(os.environ.get("MAEXP_KILLS", 5))
RUN = [*SMALL, "episodes=2", "evaluate_episodes=2"]


# Killed while writing


class Results:
    """Stands in for an evaluation with a long summary."""

    policy, num_robots, place, learned = "one", 3, None, False
    evidence = Evidence("one", episodes=9, distinct=9, maps=9)

    def __init__(self, count: int = 1):
        self.count = count

    def summary(self) -> dict:
        return {f"metric_{k}": {"mean": 0.5, "std": 0.1, "ci95": [0.4, 0.6], "n": 9} for k in range(self.count)}


def state(number: int) -> dict:
    settings = {"scenario": {"name": "maze"}, "planner": {"name": "dwa"}}
    words = {"overrides": [], "settings": settings, "followers": [], "maps": {}}
    return words | {"iteration": number, "policy": {"weights": torch.full((100_000,), float(number))}}


def write(what: str, number: int) -> None:
    if what == "map":
        make_map("maze_small", number % 2).save("file.npz")
    elif what == "results":
        write_results(Path("file.json"), [Results(20_000)], {"seed": number})
    elif what == "cell":
        folder = cell_folder(Path("."), CELL)
        folder.mkdir(parents=True, exist_ok=True)
        values = np.full(50_000, float(number))
        arrays = {"coverage_step_85": values, "curve_seconds": values, "curve_coverage": values}
        arrays["maps"] = np.full(3, "a")
        write_result(
            folder,
            "held_out",
            arrays,
            {
                "random": {"coverage_step_85": {}},
                "run": {
                    "format": FORMAT,
                    "maps": [],
                    "commit": None,
                    "seconds": 1.0,
                    "num_robots": 3,
                    "success_coverage": 0.95,
                    "numbers": [number] * 20_000,
                },
            },
        )
    else:
        save_checkpoint(Path("."), state(number), number, keep=2, best=True)


def read_back(what: str) -> None:
    if what == "map":
        assert PointCloudMap.load("file.npz").name in ("maze_small_0", "maze_small_1")
    elif what == "results":
        assert len(json.loads(Path("file.json").read_text())["one"]) == 20_000
    elif what == "cell":
        result = read_result(Path("."), CELL, "held_out")
        for values in (result.times, result.coverage, *result.episodes.values()):
            assert values.shape == (50_000,) and (values == values[0]).all()
        assert len(set(result.run["numbers"])) == 1
    else:
        state = find_checkpoint(".")[1]
        assert (state["policy"]["weights"] == state["iteration"]).all()


@pytest.mark.parametrize("what", ["map", "results", "checkpoint", "cell"])
def test_kill_9_while_writing(what):
    """At any moment the file is the old one or the new one."""
    rng = random.Random(int(os.environ.get("MAEXP_KILL_SEED", 0)))
    write(what, 0)
    for kill in range(KILLS):
        process = os.fork()
        if process == 0:
            for number in itertools.count(1000 * kill + 1):
                write(what, number)
        time.sleep(rng.uniform(0.0, 0.2))
        os.kill(process, signal.SIGKILL)
        assert os.waitpid(process, 0)[1] == signal.SIGKILL
        read_back(what)


# A full disk


@contextmanager
def full_disk(size: int):
    """No file may grow beyond some bytes: the write fails in the middle, as on a full disk.

    Only around the write itself: pytest's own log may be longer than that.
    """
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


def test_a_full_disk_keeps_the_old_checkpoint(tmp_path):
    save_checkpoint(tmp_path / "checkpoints", state(1), 1, keep=3)
    told = "iteration_000002.pt could not be written .*free some space, then go on with maexp train resume=.* are whole"
    with full_disk(50_000), pytest.raises(UserError, match=told):
        save_checkpoint(tmp_path / "checkpoints", state(2), 2, keep=3)
    assert find_checkpoint(tmp_path)[1]["iteration"] == 1
    assert len(list((tmp_path / "checkpoints").iterdir())) == 1


def test_a_disk_that_is_full_at_the_first_checkpoint_speaks_of_no_others(tmp_path):
    told = r"iteration_000000.pt could not .*: free some space, then start again: there is no checkpoint yet\.$"
    with full_disk(50_000), pytest.raises(UserError, match=told):
        save_checkpoint(tmp_path / "checkpoints", state(0), 0, keep=3)


def test_a_folder_that_is_gone_is_no_full_disk(tmp_path, monkeypatch):
    """As where another process has removed what was being written."""
    save_checkpoint(tmp_path / "my run/checkpoints", state(1), 1, keep=3)
    monkeypatch.setattr(torch, "save", lambda *_: (_ for _ in ()).throw(FileNotFoundError(2, "No such file")))
    with pytest.raises(UserError) as told:
        save_checkpoint(tmp_path / "my run/checkpoints", state(2), 2, keep=3)
    assert "space" not in str(told.value) and "check that the folder is there" in str(told.value)
    assert "maexp train 'resume=my run';" in str(told.value)  # as a shell takes it


def test_a_full_disk_keeps_the_old_map(tmp_path):
    path = make_map("maze_small", 0).save(tmp_path / "x.npz")
    with full_disk(1000), pytest.raises(MapError, match="x.npz could not be written"):
        make_map("maze_small", 1).save(path)
    assert PointCloudMap.load(path).name == "maze_small_0" and len(list(tmp_path.iterdir())) == 1


def test_a_full_disk_keeps_the_old_results(tmp_path):
    write_results(tmp_path / "results.json", [Results()], {"seed": 0})
    old = (tmp_path / "results.json").read_text()
    with full_disk(20), pytest.raises(OSError):
        write_results(tmp_path / "results.json", [Results()], {"seed": 1})
    assert (tmp_path / "results.json").read_text() == old


@pytest.mark.parametrize("place", ["checkpoint", "metrics", "summary"])
def test_a_full_disk_during_a_run_is_one_sentence(place, monkeypatch, capsys):
    """The disk fills up while a run writes its checkpoint, its metrics or its summary."""
    home, name, size = {
        "checkpoint": (torch, "save", 5_000),
        "metrics": (MetricsLog, "write", 10),
        "summary": (results, "write_json", 100),
    }[place]
    old, calls = getattr(home, name), []

    def fill(*args, **settings):
        calls.append(1)
        if place != "checkpoint" or len(calls) > 1:
            filled.enter_context(full_disk(size))
        return old(*args, **settings)

    monkeypatch.setattr(home, name, fill)
    with ExitStack() as filled:
        assert main(["train", *RUN, "hydra.run.dir=run", "total_frames=8", "checkpoint_every=1"]) == 2
    told = capsys.readouterr().err.strip().splitlines()
    assert told[-1].startswith("maexp: ") and "Traceback" not in "\n".join(told)
    assert find_checkpoint("run")[1]["iteration"] >= 0


BENCHMARK = [
    "preset=smoke",
    "scenarios=maze_small",
    "policies=random,voronoi",
    "algorithms=[]",
    "seeds=0",
    "episodes=2",
    "num_envs=2",
    "num_robots=2",
    "scenario.local_steps=3",
    "workers=1",
    "estimate=false",
    "device=cpu",
]


def test_a_full_disk_during_a_benchmark_names_the_cells(capfd):
    words = [*BENCHMARK, "episodes=300", "hydra.run.dir=b"]
    with full_disk(10_000):  # enough for the plan, too little for a cell's arrays; workers inherit the limit
        assert main(["benchmark", *words]) in (1, 2)
    told = "".join(capfd.readouterr())
    assert told.count("free some space") > 1 and "2 cells are not done" in told
    assert "maze_small/random/seed_0 failed: " in told and "maze_small/voronoi/seed_0 failed: " in told
    assert "resume=b" in told and "Traceback" not in told
    files = [path.name for path in Path("b").rglob("*") if path.is_file()]
    assert not [name for name in files if "held_out" in name or name.endswith(".part")]
    assert main(["benchmark", "resume=b", "estimate=false"]) == 0
    assert read_result(Path("b"), CELL, "held_out").coverage.shape[0] == 300


def test_a_damaged_cell_is_named_and_can_be_played_again(capsys):
    assert main(["benchmark", *BENCHMARK, "hydra.run.dir=b"]) == 0
    folder = cell_folder(Path("b"), CELL)
    for name in ("held_out.npz", "held_out.json"):
        whole = (folder / name).read_bytes()
        for content in (whole[: len(whole) // 2], b"", b"[1, 2]", bytes(100)):
            (folder / name).write_bytes(content)
            capsys.readouterr()
            assert main(["benchmark", "resume=b", "report=true"]) == 2
            told = capsys.readouterr().err
            assert "random/seed_0/held_out.json" in told and "resume=b plays" in told and "Traceback" not in told
        (folder / name).write_bytes(whole)
    with np.load(folder / "held_out.npz") as file:
        arrays = {name: file[name] for name in file.files if name != "success_rate"}
    np.savez(folder / "held_out.npz", **arrays)
    assert main(["benchmark", "resume=b", "report=true"]) == 2
    assert "(KeyError)" in capsys.readouterr().err
    todo = cell_folder(Path("b"), Cell("maze_small", "voronoi", 0)) / "held_out.json"
    todo.unlink()
    (folder / "held_out.npz").write_bytes(b"")
    assert main(["benchmark", "resume=b", "estimate=false"]) == 2
    assert not todo.exists(), "named before the other cells are played"
    (folder / "held_out.json").unlink()
    assert main(["benchmark", "resume=b", "estimate=false"]) == 0
    assert read_result(Path("b"), CELL, "held_out").coverage.shape[0] == 2


# Hostile and foreign checkpoints


class Payload:
    def __reduce__(self):
        return (os.mkdir, ("payload-was-run",))


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The checkpoint of a small run."""
    folder = tmp_path_factory.mktemp("trained") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("maexp.agents.cli.train.finish", lambda done: None)
        assert main(["train", *RUN, f"hydra.run.dir={folder}", "total_frames=4"]) == 0
    return find_checkpoint(folder)[0]


def hostile_states(saved: dict) -> dict[str, object]:
    """Checkpoints that are not what they should be."""
    policy = saved["policy"]
    first = next(iter(policy))
    return {
        "a payload": saved | {"policy": Payload()},
        "a list": [1, 2],
        "no policy": {k: v for k, v in saved.items() if k != "policy"},
        "no list of overrides": saved | {"overrides": 7},
        "odd overrides": saved | {"overrides": ["num_envs=[", "seed=="]},
        "unknown overrides": saved | {"overrides": ["colour=red"]},
        "wrong values": saved | {"settings": saved["settings"] | {"num_robots": "three"}},
        "no settings": saved | {"settings": 7},
        "another format": saved | {"format": "maexp-checkpoint-0"},
        "settings without a scenario": saved | {"settings": {"planner": {"name": "dwa"}}},
        "another shape": saved | {"policy": policy | {first: torch.zeros(3)}},
        "no tensor": saved | {"policy": policy | {first: "weights"}},
        "a weight missing": saved | {"policy": {k: v for k, v in policy.items() if k != first}},
    }


def assert_one_sentence(words: list[str], capsys) -> None:
    assert main(words) == 2
    told = capsys.readouterr().err
    assert "maexp: " in told and "Traceback" not in told, told
    assert not Path("payload-was-run").exists()


def test_hostile_checkpoints(trained, tmp_path, capsys):
    saved = torch.load(trained, weights_only=True)
    path = tmp_path / "checkpoints" / "iteration_000002.pt"
    path.parent.mkdir()
    for number, (name, content) in enumerate(hostile_states(saved).items()):
        torch.save(content, path)
        print(name)
        assert_one_sentence(["evaluate", f"checkpoint={path}", f"hydra.run.dir=e{number}", "episodes=1"], capsys)
        assert_one_sentence(["train", f"resume={path}", "total_frames=8"], capsys)
    whole = trained.read_bytes()
    for number, content in enumerate((whole[: len(whole) // 2], b"", b"PK\x03\x04" + bytes(99), os.urandom(999))):
        path.write_bytes(content)
        assert_one_sentence(["evaluate", f"checkpoint={path}", f"hydra.run.dir=f{number}", "episodes=1"], capsys)
        assert_one_sentence(["train", f"resume={path}", "total_frames=8"], capsys)


@pytest.mark.parametrize("lost", ["updater", "collector", "random", "best"])
def test_a_checkpoint_that_cannot_go_on_says_what_is_missing(trained, tmp_path, capsys, lost):
    saved = torch.load(trained, weights_only=True)
    torch.save({k: v for k, v in saved.items() if k != lost}, tmp_path / "iteration_000001.pt")
    assert main(["train", f"resume={tmp_path / 'iteration_000001.pt'}", "total_frames=8"]) == 2
    assert f"holds no {lost}" in capsys.readouterr().err


def test_a_checkpoint_chooses_no_folder(trained, tmp_path):
    saved = torch.load(trained, weights_only=True)
    hostile = [*saved["overrides"], f"hydra.run.dir={tmp_path / 'chosen'}"]
    torch.save(saved | {"overrides": hostile}, tmp_path / "x.pt")
    assert main(["evaluate", f"checkpoint={tmp_path / 'x.pt'}", "episodes=1"]) == 0
    assert not (tmp_path / "chosen").exists()


# Settings and places that do not exist


def test_a_map_saved_to_no_folder():
    with pytest.raises(MapError, match="make nodir first"):
        make_map("maze_small", 0).save("nodir/x.npz")


def test_a_map_with_a_hostile_name_stays_in_the_run_folder(tmp_path, capsys):
    maze = make_map("maze_small", 0)
    world = PointCloudMap(maze.free, maze.obstacles, 1.0, name="../../../escaped", scenario="maze_small")
    path = world.save(tmp_path / "x.npz")
    for action in ("check", "show", "import"):
        assert main(["maps", action, str(path), f"hydra.run.dir={tmp_path / 'a' / 'b' / action}"]) == 0
        assert any("escaped" in file.name for file in (tmp_path / "a" / "b" / action).iterdir())
    assert not list(tmp_path.glob("escaped*")) and not list(tmp_path.glob("a/escaped*"))


@pytest.mark.parametrize("device", ["nonsense", "", "cuda:99", "meta", 5.5])
def test_a_device_that_is_not_there(device):
    with pytest.raises(ValueError, match="device="):
        ExplorationEnv(make_map("maze_small", 0), device=device)


@pytest.mark.skipif(torch.cuda.is_available(), reason="a CUDA device is here")
def test_cuda_without_a_gpu():
    with pytest.raises(ValueError, match="sees 0 CUDA devices"):
        ExplorationEnv(make_map("maze_small", 0), device="cuda")


def test_maps_list_takes_no_file(capsys):
    assert main(["maps", "list", "foo"]) == 2
    assert "leave foo out" in capsys.readouterr().err
