"""Runs of suites that are stopped, whose disk is full, or whose policy does harm."""

import json
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from maexp.agents.benchmarks.suites.run import SuiteRun
from maexp.agents.benchmarks.suites.verify import verify
from maexp.agents.cli import main
from maexp.agents.files import lock

pytestmark = pytest.mark.slow  # whole runs of suites


def test_a_stopped_run_goes_on_to_the_same_results(small_suite, suite_run, tmp_path, monkeypatch, capsys):
    where = tmp_path / "run"
    words = ["suite", "run", str(small_suite), "policy=nearest_frontier", "num_envs=3", f"hydra.run.dir={where}"]
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
    assert sorted(path.name for path in (where / "actions").iterdir()) == [
        "indoor_small-0000.npz",
        "maze_small-0000.npz",
        "maze_small-0003.npz",
    ]
    kept = (where / "actions" / "indoor_small-0000.npz").stat().st_mtime_ns
    assert main(["suite", "run", f"resume={where}"]) == 0
    assert (where / "actions" / "indoor_small-0000.npz").stat().st_mtime_ns == kept
    ours, theirs = (json.loads((place / "results.json").read_text()) for place in (suite_run, where))
    for name in ("suite", "score", "parts", "reference", "episodes", "maps", "profile"):
        assert ours[name] == theirs[name], name
    assert (ours["policy"], theirs["policy"]) == ("nearest_frontier", "our nearest mark 2")
    assert verify(where, str(small_suite))["verified"] and not batches


def test_a_damaged_batch_is_named_with_the_way_to_play_it_again(copied_run, capsys):
    path = copied_run / "actions" / "indoor_small-0000.npz"
    path.write_bytes(path.read_bytes()[:500])
    assert main(["suite", "run", f"resume={copied_run}"]) == 2
    err = capsys.readouterr().err
    assert path.name in err and "remove it, and it is played again" in err and err.count("\n") >= 1
    path.unlink()
    assert main(["suite", "run", f"resume={copied_run}"]) == 0


def test_a_full_disk_is_one_sentence(copied_run, monkeypatch, capsys):
    (copied_run / "actions" / "indoor_small-0000.npz").unlink()

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("maexp.agents.benchmarks.suites.run_files.np.savez_compressed", full)
    assert main(["suite", "run", f"resume={copied_run}"]) == 2
    assert "free some space" in capsys.readouterr().err
    assert not [path for path in (copied_run / "actions").iterdir() if "indoor_small-0000" in path.name]


def test_two_runs_cannot_hold_one_folder_and_resume_keeps_what_was_played(copied_run, capsys):
    with lock(copied_run, "maexp suite"):
        assert main(["suite", "run", f"resume={copied_run}"]) == 2
    assert "is in use by maexp suite, process " in capsys.readouterr().err
    assert main(["suite", "run", f"resume={copied_run}", "policy=random"]) == 2
    assert "leave policy out" in capsys.readouterr().err


def test_a_hostile_policy_loses_its_episodes_and_the_rest_is_played_and_verified(
    small_suite, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(Path(__file__).resolve().parents[2] / "helpers")
    where = tmp_path / "run"
    assert main(["suite", "run", str(small_suite), "policy=hostile:Exits", "workers=2", f"hydra.run.dir={where}"]) == 0
    out, err = capsys.readouterr()
    assert "ended early" in out and err.count("ended early: it ended with status 3.\n") == 1, "told at once, and once"
    content = json.loads((where / "results.json").read_text())
    for part in content["episodes"].values():
        lost = {int(number) for number in part["lost"]}
        assert [count == 1 for count in part["decisions"]] == [number in lost for number in range(4)]
        assert all(reason == "it ended with status 3" for reason in part["lost"].values())
    assert 0 < sum(len(part["lost"]) for part in content["episodes"].values()) < 8
    assert json.loads((where / "run.json").read_text())["settings"]["num_envs"] == 2
    assert verify(where, str(small_suite))["verified"]


def test_a_policy_that_deletes_the_folder_it_is_in_does_not_end_the_run(small_suite, tmp_path, monkeypatch, capsys):
    here = tmp_path / "here"
    here.mkdir()
    shutil.copy(Path(__file__).parents[2] / "helpers" / "hostile.py", here)
    monkeypatch.chdir(here)
    where = tmp_path / "run"
    assert (
        main(["suite", "run", str(small_suite), "policy=hostile:Deletes", "workers=1", f"hydra.run.dir={where}"]) == 0
    )
    assert not here.exists() and "it gave up: RuntimeError in hostile.py" in capsys.readouterr().out
    monkeypatch.chdir(tmp_path)
    assert verify(where, str(small_suite))["verified"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_run_that_is_told_to_end_leaves_nobody_behind_and_can_go_on(number, small_suite, tmp_path):
    """As a cluster does it, or a terminal that is closed."""
    words = [
        "suite",
        "run",
        str(small_suite),
        "policy=hostile:Sleeps",
        "workers=2",
        f"hydra.run.dir={tmp_path / 'run'}",
    ]
    run = subprocess.Popen(
        [sys.executable, "-c", "import sys; from maexp.agents.cli import main; sys.exit(main())", *words],
        cwd=Path(__file__).parents[2] / "helpers",
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(number, signal.SIG_DFL),  # tests under nohup would hand on that it is ignored
    )
    try:
        end = time.monotonic() + 120
        while len(workers := find_guests(run.pid)) < 2:
            assert time.monotonic() < end and run.poll() is None
            time.sleep(0.05)
        run.send_signal(number)
        told = run.communicate(timeout=60)[1]
    finally:
        run.kill()
        run.wait()
    assert run.returncode == 130 and "Go on with: maexp suite run resume=" in told
    end = time.monotonic() + 30
    while left := [
        worker for worker in workers if Path(f"/proc/{worker}").exists()
    ]:  # killed, and perhaps not yet gone
        assert time.monotonic() < end, left
        time.sleep(0.05)


def find_guests(parent: int) -> list[int]:
    """Processes of policies that `parent` has started."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            mine = int((path / "stat").read_text().rpartition(")")[2].split()[1]) == parent
            if mine and b"maexp.agents.policies.remote.worker" in (path / "cmdline").read_bytes():
                found.append(int(path.name))
    return found
