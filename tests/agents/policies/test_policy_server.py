"""Policies elsewhere: who listens at a socket chooses as inside; what it does wrong costs it its episode."""

import signal
import socket
import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from mazes import OFFSET, REGION, make_env
from subprocess_episodes import ENVS, EXAMPLES, STEPS, TESTS, alive, play_hosted, wait_for

from maexp.agents.benchmarks.suites.play import SuitePolicy
from maexp.agents.errors import UserError
from maexp.agents.evaluation.evaluate import play
from maexp.agents.policies.remote import protocol, subprocess_policy
from maexp.agents.policies.remote import server as connection
from maexp.agents.policies.remote.numpy_policy import as_policy
from maexp.agents.policies.remote.process import command_of
from maexp.agents.policies.remote.server import address_of
from maexp.agents.policies.remote.subprocess_policy import HostedPolicy, guest_of

pytestmark = pytest.mark.slow  # processes

SERVE = "import sys; from maexp.agents.policies.remote.server import serve; serve('127.0.0.1', 0, sys.argv[1:])"


@contextmanager
def listening(spec: str, folder: Path = TESTS):
    """A machine elsewhere that plays `spec`; gives socket:HOST:PORT and its process."""
    command = [sys.executable, "-c", SERVE, *command_of(spec)]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, cwd=folder, text=True)
    try:
        yield f"socket:127.0.0.1:{server.stdout.readline().split()[-1]}", server
    finally:
        server.send_signal(signal.SIGINT)
        server.wait(60)
        server.stdout.close()


@contextmanager
def answering(reply):
    """Somebody who takes one connection after another and does `reply` with each."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def take():
            while True:
                try:
                    link, _ = server.accept()
                except OSError:
                    return
                with link:
                    try:
                        reply(link)
                    except OSError:
                        pass

        threading.Thread(target=take, daemon=True).start()
        yield f"socket:127.0.0.1:{server.getsockname()[1]}"
        server.shutdown(socket.SHUT_RDWR)


def stays(link: socket.socket) -> None:
    """A whole policy of another language, as it were."""
    stream = link.makefile("rwb")
    while (message := protocol.read(stream)) is not None:
        kind = {"hello": "hello", "reset": "ready", "act": "goals"}[message["type"]]
        protocol.write(stream, {"type": kind, "version": 1, "goals": np.full((3, 2), np.nan)})


def test_it_chooses_as_its_class_does_inside(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    from nearest import Nearest

    envs = [make_env(3, macro_steps=6) for _ in range(2)]
    inside = as_policy(envs[0], Nearest)
    with (
        listening("nearest:Nearest", EXAMPLES) as (spec, _),
        HostedPolicy(envs[1], guest_of(spec), spec, 60.0, 60.0) as outside,
    ):
        states = [env.reset() for env in envs]
        for _ in range(6):
            states = [policy(state) for policy, state in zip((inside, outside), states, strict=True)]
            assert all(torch.equal(states[0][name], states[1][name]) for name in (REGION, OFFSET))
            assert not states[1]["lost"].any()
            assert (states[1]["decision_seconds"][:, 0].numpy() > 0)[outside.sight.active].all()
            states = [env.step(state)["next"] for env, state in zip(envs, states, strict=True)]
    assert float(states[0]["info", "coverage"].mean()) > 0.4


@pytest.mark.parametrize(
    ("kind", "reason"),
    {
        "Raises": "it gave up: KeyError in hostile.py, line",
        "Exits": "it closed the connection",
        "Dies": "it closed the connection",
        "Sleeps": "it gave no answer in 3 s",
        "Spins": "it gave no answer in 3 s",
        "WrongShape": "it returned numbers of shape [4, 2]: goals must be numbers [3, 2]",
        "Infinite": "it returned a goal that is infinite",
        "Huge": "it answered garbage (a message of 1,073,741,824 bytes)",
        "Noise": "it answered garbage (a message that is no",
        "Deaf": "it gave no answer in 3 s",
        "BadReset": "it gave up: RuntimeError in hostile.py, line",
    }.items(),
)
def test_a_fault_costs_its_episode_and_nothing_else(kind, reason):
    with listening(f"hostile:{kind}") as (spec, _):
        final, reasons, bad, _ = play_hosted(spec, 60.0, 3.0 if "no answer" in reason else 60.0)
    assert 0 < sum(bad) < ENVS and [bool(said) for said in reasons] == bad
    assert all(said.startswith(reason) for said in reasons if said), reasons
    steps = [20 * ((kind != "BadReset") if lost else STEPS) for lost in bad]
    assert final["local_steps"][:, 0].tolist() == steps


def test_an_answer_too_many_is_no_answer_to_the_next_question():
    with listening("hostile:Twice") as (spec, _):
        _, reasons, bad, _ = play_hosted(spec)
    assert [bool(reason) for reason in reasons] == bad and {reason for reason in reasons if reason} == {
        "it spoke without being asked"
    }


def test_who_is_gone_loses_its_episodes_and_the_run_goes_on():
    env = make_env(1, macro_steps=3)
    with listening("hostile:Stays") as (spec, server):
        with HostedPolicy(env, guest_of(spec), spec, 60.0, 60.0) as policy:
            play(policy, env, torch.tensor([0]))
            assert policy.reasons == [""]
            server.send_signal(signal.SIGINT)
            server.wait(60)
            for told in ("it closed the connection", *2 * ["nobody can be reached at 127.0.0.1, port"]):
                final = play(policy, env, torch.tensor([1]))
                assert policy.reasons[0].startswith(told) and "\n" not in policy.reasons[0]
                assert int(final["local_steps"]) == 0


def test_what_plays_elsewhere_ends_with_its_connection(tmp_path):
    """A planner that thinks for ever is not left to burn a processor."""
    script = tmp_path / "spin"
    script.write_text(f"#!/bin/sh\necho $$ > {tmp_path}/number\nwhile :; do :; done\n")
    script.chmod(0o755)
    with listening(f"exec:{script}") as (spec, _):
        worker = guest_of(spec)()
        wait_for(lambda: (tmp_path / "number").exists() and (tmp_path / "number").read_text().strip())
        number = int((tmp_path / "number").read_text())
        assert alive(number)
        worker.kill()
        wait_for(lambda: not alive(number))


def test_a_listener_that_is_told_to_end_leaves_nobody_behind(tmp_path):
    """As `docker stop` and service managers tell it."""
    script = tmp_path / "sleeps"
    script.write_text(f"#!/bin/sh\necho $$ > {tmp_path}/number\nexec sleep 1000\n")
    script.chmod(0o755)
    place = f"127.0.0.1:{free_port()}"
    command = [sys.executable, "-m", "maexp.agents.policies.remote.server", place, f"exec:{script}"]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        port = int(server.stdout.readline().split()[-1])
        with socket.create_connection(("127.0.0.1", port)):
            wait_for(lambda: (tmp_path / "number").exists() and (tmp_path / "number").read_text().strip())
            server.send_signal(signal.SIGTERM)
            assert server.wait(20) == 0
        assert not alive(int((tmp_path / "number").read_text()))
    finally:
        server.kill()
        server.wait()
        server.stdout.close()


def test_a_program_that_is_not_there_is_told_before_anybody_connects(capsys):
    assert connection.main([f"127.0.0.1:{free_port()}", "exec:/no/such/program"]) == 2
    assert "/no/such/program is no program" in capsys.readouterr().err


def free_port() -> int:
    """Of this machine."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


def test_a_listener_that_takes_one_after_another_is_enough():
    with answering(stays) as spec:
        player = SuitePolicy(spec)
        assert player.hosted and player.most_teams == 1 and player.name == spec
        env = make_env(1, macro_steps=2)
        with player.open(env) as policy:
            for number in range(3):
                assert int(play(policy, env, torch.tensor([number]))["local_steps"]) == 40
                assert policy.reasons == [""]


def silent(link):
    link.recv(2**20)
    threading.Event().wait(5.0)


def replies(message: bytes):
    """Once it is asked."""

    def reply(link):
        link.recv(2**20)
        link.sendall(message)

    return reply


@pytest.mark.parametrize(
    ("reply", "told"),
    [
        (silent, "it gave no answer in 1 s"),
        (lambda link: None, "it closed the connection"),
        (lambda link: link.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n"), "garbage|unasked|without being asked"),
        (replies(protocol.HEAD.pack(2**30) + b"x" * 2**20), "a message of 1,073,741,824 bytes"),
        (replies(protocol.pack({"type": "hello", "version": 2})), "it must speak version 1"),
    ],
)
def test_who_is_no_policy_is_told_before_anything_is_played(reply, told, monkeypatch):
    monkeypatch.setattr(subprocess_policy, "START", 1.0 if reply is silent else 30.0)
    with answering(reply) as spec, pytest.raises(UserError, match=told) as error:
        SuitePolicy(spec)
    assert str(error.value).startswith(f"policy={spec}") and "\n" not in str(error.value)


def test_nobody_there_is_told_before_anything_is_played():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(UserError, match=f"nobody can be reached at 127.0.0.1, port {port} .*refused"):
        SuitePolicy(f"socket:127.0.0.1:{port}")
    with pytest.raises(UserError, match="nobody can be reached at no.such.host.invalid, port 5000"):
        SuitePolicy("socket:no.such.host.invalid:5000")


@pytest.mark.parametrize(
    "spec", ["socket:", "socket:5000", "socket:a:", "socket:a:0", "socket:a:65536", "socket:a:x", "socket:a:²"]
)
def test_what_is_no_address_is_told(spec):
    with pytest.raises(UserError, match="is no HOST:PORT, as localhost:5000") as error:
        SuitePolicy(spec)
    assert str(error.value).startswith(f"policy={spec} ")


def test_addresses():
    assert address_of("socket:localhost:5000") == ("localhost", 5000)
    assert address_of("[::1]:80") == ("::1", 80)


def test_the_table_of_decision_times(monkeypatch, capsys):
    monkeypatch.syspath_prepend(EXAMPLES.parent)
    import decision_times

    monkeypatch.setattr(decision_times, "PART", "maze_small")
    monkeypatch.setattr(decision_times, "EPISODES", 2)
    decision_times.main("cost_utility", "inside", "process", "socket")
    rows = [line.split("|") for line in capsys.readouterr().out.splitlines()[-3:]]
    inside, process, there = ([cell.strip() for cell in row[1:-1]] for row in rows)
    assert inside[2] == there[2] == "-" and float(process[2]) > 0
    for row in (process, there):
        assert row[-1].startswith("yes, to") and float(row[3]) > 0
