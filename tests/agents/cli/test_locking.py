"""One process at a time in a run's folder: the other is named, and a dead one holds nothing."""

import errno
import fcntl
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time

import pytest
from small_run import SMALL

from maexp.agents.cli import main
from maexp.agents.errors import UserError
from maexp.agents.files import LOCK, command, lock

HOLD = """
import os, sys, time
from pathlib import Path
from maexp.agents.files import lock
with lock(Path(sys.argv[1]), "maexp train"):
    if os.fork() == 0:  # a worker that outlives its parent, and has let go by the time it speaks
        print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def holder(tmp_path):
    """Another process that holds the folder, and a child of its."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, tmp_path], stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    assert process.stdout.readline() == "held\n"
    yield process
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def test_the_other_process_is_named_and_a_dead_one_holds_nothing(tmp_path, holder):
    with pytest.raises(UserError) as told, lock(tmp_path, "maexp train"):
        pass
    host = re.escape(socket.gethostname())
    wanted = rf"is in use by maexp train, process {holder.pid} on {host} since 20\d\d-.*stop it"
    assert re.search(wanted, str(told.value))
    os.kill(holder.pid, signal.SIGKILL)
    holder.wait()
    assert (tmp_path / LOCK).is_file()  # left behind
    with lock(tmp_path, "maexp train"):
        assert json.loads((tmp_path / LOCK).read_text())["pid"] == os.getpid()
    assert not list(tmp_path.iterdir())


def test_who_waits_comes_next(tmp_path):
    """Four that wait for one folder, which the one before leaves without its lock file."""
    inside, most = [], []

    def work():
        with lock(tmp_path, "maexp benchmark", wait=True):
            inside.append(1)
            most.append(len(inside))
            time.sleep(0.02)
            inside.pop()

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == [1, 1, 1, 1]


def test_a_file_system_without_locks_is_a_warning(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.warns(UserWarning, match="cannot be locked .No locks available.: run nothing else there"):
        with lock(tmp_path, "maexp train"):
            pass


def test_a_second_training_in_a_folder_changes_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    tiny = [*SMALL, "total_frames=4", "episodes=0", "device=cpu"]
    assert main(["train", *tiny, "hydra.run.dir=my run"]) == 0
    told = "Next: maexp evaluate 'checkpoint=my run' num_robots=1,2,6,8, or maexp view 'my run'"
    assert told in capsys.readouterr().out
    with lock(tmp_path / "my run", "maexp train"):
        before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
        assert main(["train", "resume=my run", "total_frames=8"]) == 2
        assert before == {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert re.match(r"maexp: my run is in use by maexp train, process \d+ on .*stop it.$", capsys.readouterr().err)
    assert main(["train", "resume=my run", "total_frames=8"]) == 0


def test_commands_are_as_a_shell_takes_them():
    assert command("train", "resume=a b/c") == "maexp train 'resume=a b/c'"
    assert command("view", "outputs/x", "browser=true") == "maexp view outputs/x browser=true"
