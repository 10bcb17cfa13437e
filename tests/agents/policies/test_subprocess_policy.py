"""Policies in processes of their own: what they do wrong costs them their episode, and nothing else."""

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
import torch
from mazes import make_env
from subprocess_episodes import ENVS, STEPS, TESTS, alive, play_hosted, wait_for

from maexp.agents.benchmarks.suites.play import SuitePolicy
from maexp.agents.errors import UserError
from maexp.agents.evaluation.evaluate import play
from maexp.agents.policies.remote import subprocess_policy
from maexp.agents.policies.remote.process import Lost, Process, ask_all
from maexp.agents.policies.remote.subprocess_policy import HostedPolicy, greet, guest_of
from maexp.agents.runtime import TeamPlanner

pytestmark = pytest.mark.slow  # processes


@pytest.fixture(autouse=True)
def beside_the_hostile_ones(monkeypatch):
    monkeypatch.chdir(TESTS)


GOOD = ("Stays", "IntoWalls", "Chats")
FAULTS = {
    "Raises": "it gave up: KeyError in hostile.py, line",
    "Exits": "it ended with status 3",
    "Dies": "it ended with SIGABRT",
    "Sleeps": "it gave no answer in 3 s",
    "Spins": "it thought for more than 1 s",
    "WrongShape": "it returned numbers of shape [4, 2]: goals must be numbers [3, 2]",
    "Words": "it gave up: ValueError: act() returned a str, and no goals",
    "Nothing": "it gave up: ValueError: act() returned nothing",
    "Infinite": "it returned a goal that is infinite",
    "Huge": "it answered garbage (a message of 1,073,741,824 bytes)",
    "Noise": "it answered garbage (a message that is no",
    "Deaf": "it closed its input or output",
    "Forks": "it ended with status 0",
    "Daemons": "it ended with status 0",
    "Deep": "it answered garbage (a message that holds more than",
    "Novel": "it answered garbage (a message that holds more than",
    "Paints": "it gave up: ",
    "BadReset": "it gave up: RuntimeError in hostile.py, line",
}


def test_half_of_the_episodes_meet_a_fault():
    _, reasons, bad, _ = play_hosted("hostile:Stays")
    assert 0 < sum(bad) < ENVS and reasons == [""] * ENVS


@pytest.mark.parametrize("kind", GOOD[1:])
def test_bad_goals_and_talk_are_no_fault(kind):
    final, reasons, _, _ = play_hosted(f"hostile:{kind}")
    assert reasons == [""] * ENVS and (final["local_steps"] == 20 * STEPS).all()


@pytest.mark.parametrize("kind", FAULTS)
def test_a_fault_costs_its_episode_and_nothing_else(kind, tmp_path, monkeypatch):
    monkeypatch.setenv("HOSTILE_CHILDREN", str(tmp_path / "children"))
    begin = time.monotonic()
    waits = {"Sleeps": 3.0}.get(kind, 60.0)
    final, reasons, bad, _ = play_hosted(f"hostile:{kind}", 1.0 if kind == "Spins" else 60.0, waits)
    assert time.monotonic() - begin < 120
    assert [bool(reason) for reason in reasons] == bad
    assert all(reason.startswith(FAULTS[kind]) and "\n" not in reason for reason in reasons if reason), reasons
    lost_after = 0 if kind == "BadReset" else 1
    steps = [20 * (lost_after if lost else STEPS) for lost in bad]
    assert final["local_steps"][:, 0].tolist() == steps
    assert all(reason.isprintable() and len(reason) < 500 for reason in reasons)
    if kind in ("Forks", "Daemons"):
        children = [int(line) for line in (tmp_path / "children").read_text().split()]
        assert len(children) == 5 * sum(bad)
        end = time.monotonic() + 20
        while [child for child in children if alive(child)]:  # killed, and on a busy machine not yet gone
            assert time.monotonic() < end
            time.sleep(0.05)


def test_a_policy_that_speaks_unasked_is_lost():
    _, reasons, bad, _ = play_hosted("hostile:Twice")
    assert [bool(reason) for reason in reasons] == bad and {reason for reason in reasons if reason} == {
        "it spoke without being asked"
    }


def test_the_next_episode_has_a_new_process():
    env = make_env(1, macro_steps=3)
    with HostedPolicy(env, guest_of("hostile:Exits"), "exits", 20.0, 20.0) as policy:
        ends = []
        for number in range(6):
            play(policy, env, torch.tensor([number]))
            ends.append((policy.sight.episode(0)["seed"] // 2 % 2 == 1, policy.reasons[0] != ""))
        processes = [worker.process for worker in policy.workers if worker is not None]
    assert all(bad == lost for bad, lost in ends) and {bad for bad, _ in ends} == {True, False}
    assert all(process.returncode is not None for process in processes)


@pytest.mark.parametrize(
    ("spec", "told"),
    [
        ("hostile:Nobody", "AttributeError"),
        ("nowhere:Nobody", "ModuleNotFoundError"),
        ("exec:true", "it ended"),
        ("exec:/no/such/program", "cannot be started"),
        ("exec:", "names no command"),
        ("exec:'a", "No closing quotation"),
        ("exec:yes", "garbage|spoke without being asked"),
        ("exec:sleep 1000", "it gave no answer in 2 s"),
        ("process:hostile:factory", "is no class with act"),
        ("process:nobody", "policy=nobody is unknown"),
        ("hostile:BadStart", "it gave up: RuntimeError in hostile.py"),
        ("hostile:Inert", "it gave up: TypeError: Inert is a class without act"),
    ],
)
def test_what_does_not_start_is_told_before_anything_is_played(spec, told, monkeypatch):
    monkeypatch.setattr(subprocess_policy, "START", 2.0 if "sleep" in spec else 60.0)
    with pytest.raises(UserError, match=f"(?s){told}") as error:
        SuitePolicy(spec)
    assert "\n" not in str(error.value)


def test_an_echo_is_no_policy():
    assert greet(guest_of("exec:cat"), "cat")
    _, reasons, _, _ = play_hosted("exec:cat")
    assert set(reasons) == {"it answered 'reset' where 'ready' was asked for"}


def test_the_processor_time_is_that_of_the_process():
    """Not the time that it waits for, nor ours."""
    program = (
        "import sys, time; from maexp.agents.policies.remote import protocol as wire\n"
        "while (m := wire.read(sys.stdin.buffer)):\n"
        "    begin = time.process_time()\n"
        "    while time.process_time() - begin < m['spin']: pass\n"
        "    time.sleep(m['sleep']); wire.write(sys.stdout.buffer, {'type': 'ready'})\n"
    )
    worker = Process([sys.executable, "-c", program])
    try:
        ask_all([(worker, {"type": "x", "spin": 0.0, "sleep": 0.0})], 60.0, 60.0)
        ask_all([(worker, {"type": "x", "spin": 0.3, "sleep": 0.6})], 60.0, 60.0)
        assert 0.29 < worker.seconds < 0.5
        (answer,) = ask_all([(worker, {"type": "x", "spin": 30.0, "sleep": 0.0})], 0.2, 60.0)
        assert isinstance(answer, Lost) and "thought for more than 0.2 s" in str(answer)
    finally:
        worker.kill()


RUN = """
import sys, threading, time
from maexp.agents.policies.remote.process import Process, command_of
guests = []
thread = threading.Thread(target=lambda: guests.append(Process(command_of(sys.argv[1]))))
thread.start()
thread.join()
guests[0].begin({"type": "hello", "version": 1})
guests[0].send()
print("asked", flush=True)
time.sleep(1000)
"""


@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="NO LINUX: policies of a killed run may stay")
@pytest.mark.parametrize("spec", ["sleeper:Sleeper", "exec:sh -c 'setsid sleep 1000 & exec sleep 1000'"])
def test_a_run_that_is_killed_outright_leaves_no_policy_behind(spec, tmp_path):
    """Nor what that has started, though it left the session; the thread that started the policy is gone by then."""
    (tmp_path / "sleeper.py").write_text(
        "import os, time\n\n\nclass Sleeper:\n    def __init__(self):\n        os.fork()\n        time.sleep(1e9)\n\n"
        "    def act(self, observation):\n        pass\n"
    )
    name = f"KILLED_RUN={tmp_path.name}-{time.time_ns()}"
    run = subprocess.Popen(
        [sys.executable, "-c", RUN, spec],
        env=os.environ | dict([name.split("=")]),
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        start_new_session=True,
    )
    try:
        assert run.stdout.readline() == b"asked\n"
        wait_for(lambda: len(having(name, but=run.pid)) == 3)  # two of the policy, and who watches
        os.killpg(run.pid, signal.SIGKILL)
        run.wait()
        begin = time.monotonic()
        wait_for(lambda: not having(name, but=run.pid))
        print(f"gone after {time.monotonic() - begin:.1f} s")
    finally:
        for path in having(name, but=0):
            os.kill(path, signal.SIGKILL)
        run.wait()
        run.stdout.close()


def having(variable: str, but: int) -> list[int]:
    """Processes that run with a variable in their environment, but one."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if variable.encode() in (path / "environ").read_bytes().split(b"\0") and int(path.name) != but:
                found.append(int(path.name))
    return found


def test_where_memory_runs_out_the_policy_is_ended_and_not_the_run():
    worker = Process(["sleep", "60"])
    try:
        assert Path(f"/proc/{worker.process.pid}/oom_score_adj").read_text() == "1000\n"
        assert int(Path("/proc/self/oom_score_adj").read_text()) < 1000
    finally:
        worker.kill()


def test_the_guest_needs_no_torch():
    """A process of a policy that imports none starts in a fraction of a second, and needs 40 MB."""
    program = (
        "import sys; from maexp.agents.policies.remote.worker import find; find('hostile:Stays'); "
        "print([name for name in ('torch', 'warp', 'hydra', 'scipy') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout == "[]\n", done.stdout + done.stderr
    assert TeamPlanner("cost_utility").learned is None
