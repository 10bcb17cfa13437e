"""Policies in processes of their own: what they are told and what they choose is the same as inside; what they do wrong
costs them their episode, and nothing else."""

import os
import shutil
import signal
import struct
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mazes import OFFSET, REGION, make_env

from maexp.agents.errors import UserError
from maexp.agents.evaluation.evaluate import play
from maexp.agents.policies import POLICIES, hosted, wire
from maexp.agents.policies.foreign import TeamSight, as_policy
from maexp.agents.policies.hosted import HostedPolicy, greet, guest_of
from maexp.agents.policies.load import load_policy_folder
from maexp.agents.policies.process import Lost, Process, ask_all, command_of
from maexp.agents.runtime import TeamPlanner
from maexp.agents.runtime.agent import TeamAgent
from maexp.agents.suites.players import Player
from maexp.envs import ObservationConfig, make_map
from maexp.envs.regions import from_regions
from maexp.envs.targets import TargetTracker

pytestmark = pytest.mark.slow  # processes

TESTS = Path(__file__).resolve().parent
EXAMPLES = TESTS.parent / "docs" / "examples" / "policies"
ENVS, STEPS = 4, 5


@pytest.fixture(autouse=True)
def beside_the_hostile_ones(monkeypatch):
    monkeypatch.chdir(TESTS)


def play_hosted(word: str, limit: float = 20.0, patience: float = 20.0):
    """An episode of four teams: last info, reasons, which teams meet a fault, decisions and their processor time."""
    env = make_env(ENVS, macro_steps=STEPS)
    with HostedPolicy(env, guest_of(word), word, limit, patience) as policy:
        taken = []

        def watched(state):
            acted = policy(state)
            taken.append(acted["decision_seconds"][:, 0].clone())
            return acted

        final = play(watched, env, torch.arange(ENVS))
        bad = [policy.sight.episode(team)["seed"] // 2 % 2 == 1 for team in range(ENVS)]
        return final, policy.reasons, bad, torch.stack(taken)


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
    assert [bool(one) for one in reasons] == bad
    assert all(one.startswith(FAULTS[kind]) and "\n" not in one for one in reasons if one), reasons
    lost_after = 0 if kind == "BadReset" else 1
    steps = [20 * (lost_after if one else STEPS) for one in bad]
    assert final["local_steps"][:, 0].tolist() == steps
    assert all(one.isprintable() and len(one) < 500 for one in reasons)
    if kind in ("Forks", "Daemons"):
        children = [int(line) for line in (tmp_path / "children").read_text().split()]
        assert len(children) == 5 * sum(bad)
        end = time.monotonic() + 20
        while [one for one in children if alive(one)]:  # killed, and on a busy machine not yet gone
            assert time.monotonic() < end
            time.sleep(0.05)


def alive(process: int) -> bool:
    """Whether a process runs; one that has ended and was not asked about does not."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_a_policy_that_speaks_unasked_is_lost():
    _, reasons, bad, _ = play_hosted("hostile:Twice")
    assert [bool(one) for one in reasons] == bad and {one for one in reasons if one} == {"it spoke without being asked"}


def test_the_next_episode_has_a_new_process():
    env = make_env(1, macro_steps=3)
    with HostedPolicy(env, guest_of("hostile:Exits"), "exits", 20.0, 20.0) as policy:
        ends = []
        for number in range(6):
            play(policy, env, torch.tensor([number]))
            ends.append((policy.sight.episode(0)["seed"] // 2 % 2 == 1, policy.reasons[0] != ""))
        processes = [guest.process for guest in policy.guests if guest is not None]
    assert all(bad == lost for bad, lost in ends) and {bad for bad, _ in ends} == {True, False}
    assert all(one.returncode is not None for one in processes)


@pytest.mark.parametrize(
    ("word", "told"),
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
def test_what_does_not_start_is_told_before_anything_is_played(word, told, monkeypatch):
    monkeypatch.setattr(hosted, "START", 2.0 if "sleep" in word else 60.0)
    with pytest.raises(UserError, match=f"(?s){told}") as error:
        Player(word)
    assert "\n" not in str(error.value)


def test_an_echo_is_no_policy():
    assert greet(guest_of("exec:cat"), "cat")
    _, reasons, _, _ = play_hosted("exec:cat")
    assert set(reasons) == {"it answered 'reset' where 'ready' was asked for"}


# The same choices


def note_goals(monkeypatch) -> list[torch.Tensor]:
    """Where planners inside send robots from now on, float32 [E, N, 2] [m] each time."""
    points, goals = [], TargetTracker.goals

    def note(*arguments):
        points.append(goals(*arguments))
        return points[-1]

    monkeypatch.setattr(TargetTracker, "goals", note)
    return points


def test_a_process_chooses_as_its_class_does_inside(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    monkeypatch.chdir(EXAMPLES)
    from nearest import Nearest

    envs = [make_env(3, macro_steps=8) for _ in range(2)]
    inside = as_policy(envs[0], Nearest)
    with HostedPolicy(envs[1], guest_of("nearest:Nearest"), "nearest", 20.0, 20.0) as outside:
        states = [env.reset() for env in envs]
        for _ in range(8):
            states = [policy(state) for policy, state in zip((inside, outside), states, strict=True)]
            for name in (REGION, OFFSET):
                assert torch.equal(states[0][name], states[1][name])
            asked = outside.sight.active
            assert not states[1]["lost"].any() and (states[1]["decision_seconds"][:, 0].numpy() > 0)[asked].all()
            states = [env.step(state)["next"] for env, state in zip(envs, states, strict=True)]
    assert float(states[0]["info", "coverage"].mean()) > 0.4


@pytest.mark.parametrize("policy", ["cost_utility", "hungarian", "small_mazes"])
def test_goals_over_the_wire_are_those_of_planners_inside(policy, monkeypatch):
    """As float64 metres: to the bit where a planner names regions and offsets, to their rounding where it names
    targets."""
    points = note_goals(monkeypatch)
    shown = ObservationConfig(pictures=False, targets=24 if policy == "small_mazes" else 0)
    env = make_env(3, observation=shown)
    play_inside = POLICIES[policy](env) if policy in POLICIES else load_policy_folder(policy, env)
    sight, state = TeamSight(env), env.reset()
    for _ in range(6):
        sight.look()
        before = env.simulation.tensors["center"].clone()
        acted = env.step(play_inside(state))
        sent = env.simulation.tensors["wanted"].clone()
        wired = wire.unpack(wire.pack({"type": "goals", "goals": points[-1].numpy().astype(np.float64)})[4:])["goals"]
        goals = from_regions(env.simulation, *sight.to_action(wired))
        assert torch.equal(goals, sent) or (policy == "small_mazes" and torch.allclose(goals, sent, rtol=0, atol=1e-5))
        state = acted["next"]
    assert not torch.equal(before, env.simulation.tensors["center"])


@pytest.mark.parametrize("policy", ["nearest_frontier", "cost_utility", "multi_criteria", "voronoi", "potential_field"])
def test_our_planners_through_a_process_take_the_targets_that_they_take_inside(policy, monkeypatch):
    """At every moment of an episode: the runtime's planner, through observation, wire and process, sends each robot
    where the env's planner sends it. (`hungarian`: of assignments alike, any.)"""
    apart, sent = 0.0, note_goals(monkeypatch)
    env = make_env(1, maps=[make_map("maze_small", 1)])
    inside, sight, state = POLICIES[policy](env), TeamSight(env), env.reset()
    guest = Process(command_of(f"process:{policy}"))
    try:
        ask_all([(guest, {"type": "hello", "version": 1})], 60.0, 60.0)
        for _ in range(5):
            sight.look()
            ask_all([(guest, {"type": "reset", "episode": sight.episode(0)})], 60.0, 60.0)
            (answer,) = ask_all([(guest, {"type": "act", "observation": sight.observation(0)})], 60.0, 60.0)
            state = env.step(inside(state))["next"]
            apart = max(apart, np.abs(answer["goals"] - sent[-1][0].numpy()).max())
    finally:
        guest.kill()
    print(f"{policy}: goals differ by at most {apart:.1e} m")
    assert apart < 1e-4


def test_a_trained_policy_through_a_process_takes_the_targets_that_it_takes_inside(monkeypatch):
    """Over an episode, for it looks back at where robots went last."""
    pytest.importorskip("onnxruntime", reason="THE EXTRA maexp[runtime] IS NOT INSTALLED")
    shown, apart, sent = ObservationConfig(pictures=False, targets=24), [], note_goals(monkeypatch)
    env = make_env(1, observation=shown)
    inside, sight, state = load_policy_folder("universal", env), TeamSight(env), env.reset()
    guest = Process(command_of("process:universal"))
    try:
        ask_all([(guest, {"type": "hello", "version": 1})], 60.0, 60.0)
        for step in range(6):
            sight.look()
            if step == 0:
                ask_all([(guest, {"type": "reset", "episode": sight.episode(0)})], 60.0, 60.0)
            (answer,) = ask_all([(guest, {"type": "act", "observation": sight.observation(0)})], 60.0, 60.0)
            with torch.no_grad():
                state = inside(state)
            state = env.step(state)["next"]
            apart.append(np.abs(answer["goals"] - sent[-1][0].numpy()).max())
    finally:
        guest.kill()
    print(f"universal: goals differ by at most {max(apart):.1e} m")
    assert max(apart) < 1e-4


@pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is absent: the example in C++ is not compiled")
def test_the_example_in_another_language_chooses_as_its_twin_in_python(tmp_path):
    """Both go to the nearest free cell beside unknown ground."""
    done = subprocess.run(
        ["g++", "-O1", "-o", tmp_path / "nearest", EXAMPLES / "nearest.cpp"], capture_output=True, text=True
    )
    if "nlohmann/json.hpp: No such file" in done.stderr:
        pytest.skip("nlohmann/json IS ABSENT: the example in C++ is not compiled")
    assert done.returncode == 0, done.stderr
    env = make_env(2, macro_steps=4)
    with HostedPolicy(env, guest_of(f"exec:{tmp_path / 'nearest'}"), "nearest", 60.0, 60.0) as policy:
        state = env.reset()
        for _ in range(4):
            state = policy(state)
            assert not state["lost"].any(), policy.reasons
            for team in range(2):
                seen = policy.sight.observation(team)
                for robot in range(3):
                    grid, own = seen["grid"][robot], seen["poses"][robot, robot, :2]
                    unknown = np.pad(grid == -1, 1)
                    beside = unknown[2:, 1:-1] | unknown[:-2, 1:-1] | unknown[1:-1, 2:] | unknown[1:-1, :-2]
                    cells = np.argwhere((grid == 0) & beside)[:, ::-1]
                    points = seen["origin"] + (cells + 0.5) * seen["resolution"]
                    goal = points[np.hypot(*(points - own).T).argmin()]
                    wanted = policy.sight.to_action(np.broadcast_to(goal, (2, 3, 2)))
                    sent = [state[name][team, robot] for name in (REGION, OFFSET)]
                    assert all(torch.equal(one[team, robot], two) for one, two in zip(wanted, sent, strict=True))
            state = env.step(state)["next"]


def test_a_team_that_does_not_hear_each_other_plans_robot_by_robot():
    env = make_env(1, num_robots=3)
    sight, agent = TeamSight(env), TeamAgent("nearest_frontier")
    env.reset()
    sight.look()
    seen = sight.observation(0)
    agent.reset(sight.episode(0))
    together = agent.act(seen)
    blank = seen["grid"].copy()
    blank[1] = -1  # robot 1 knows nothing
    alone = agent.act(seen | {"grid": blank, "heard": np.eye(3, dtype=bool)})
    assert np.isnan(alone[1]).all() and np.isfinite(alone[[0, 2]]).all() and np.isfinite(together).all()
    dead = agent.act(seen | {"alive": np.array([True, False, True])})
    assert np.isnan(dead[1]).all() and np.isfinite(dead[[0, 2]]).all()


# The wire


def test_messages_go_over_the_wire_and_back():
    sent = {
        "type": "act",
        "n": 3,
        "name": "å",
        "none": None,
        "origin": (1.5, -2.0),
        "big": np.float32(2.5),
        "grid": np.arange(-6, 6, dtype=np.int8).reshape(2, 3, 2),
        "poses": np.array([[np.nan, np.inf]]),
        "heard": np.eye(2, dtype=bool),
        "turned": np.arange(6.0).reshape(2, 3).T,
    }
    body = wire.pack(sent)
    assert struct.unpack("<I", body[:4])[0] == len(body) - 4
    got = wire.unpack(body[4:])
    for name, value in sent.items():
        if isinstance(value, np.ndarray):
            same = np.array_equal(got[name], value, equal_nan=value.dtype.kind == "f")
            assert got[name].dtype == value.dtype and same
        else:
            assert got[name] == (list(value) if isinstance(value, tuple) else value)
    with pytest.raises(TypeError, match="complex128 cannot be sent"):
        wire.pack({"a": np.zeros(1, complex)})


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=80))
def test_garbage_is_told_as_such(body):
    try:
        assert isinstance(wire.unpack(body)["type"], str)
    except ValueError:
        pass


@pytest.mark.parametrize(
    "array",
    [
        {"dtype": "object", "shape": [1], "data": b"x" * 8},
        {"dtype": "float64", "shape": [2], "data": b"x" * 8},
        {"dtype": "float64", "shape": [-1], "data": b"x" * 8},
        {"dtype": "float64", "shape": [2**30, 2**30], "data": b""},
        {"dtype": "float64", "shape": "1", "data": b"x" * 8},
        {"dtype": 3, "shape": [1], "data": b"x" * 8},
    ],
)
def test_arrays_that_are_none_are_garbage(array):
    with pytest.raises(ValueError):
        wire.unpack(wire.pack({"type": "goals", "goals": array})[4:])


def test_the_processor_time_is_that_of_the_process():
    """Not the time that it waits for, nor ours."""
    program = (
        "import sys, time; from maexp.agents.policies import wire\n"
        "while (m := wire.read(sys.stdin.buffer)):\n"
        "    begin = time.process_time()\n"
        "    while time.process_time() - begin < m['spin']: pass\n"
        "    time.sleep(m['sleep']); wire.write(sys.stdout.buffer, {'type': 'ready'})\n"
    )
    guest = Process([sys.executable, "-c", program])
    try:
        ask_all([(guest, {"type": "x", "spin": 0.0, "sleep": 0.0})], 60.0, 60.0)
        ask_all([(guest, {"type": "x", "spin": 0.3, "sleep": 0.6})], 60.0, 60.0)
        assert 0.29 < guest.seconds < 0.5
        (answer,) = ask_all([(guest, {"type": "x", "spin": 30.0, "sleep": 0.0})], 0.2, 60.0)
        assert isinstance(answer, Lost) and "thought for more than 0.2 s" in str(answer)
    finally:
        guest.kill()


RUN = """
import sys, threading, time
from maexp.agents.policies.process import Process, command_of
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
@pytest.mark.parametrize("word", ["sleeper:Sleeper", "exec:sh -c 'setsid sleep 1000 & exec sleep 1000'"])
def test_a_run_that_is_killed_outright_leaves_no_policy_behind(word, tmp_path):
    """Nor what that has started, though it left the session; the thread that started the policy is gone by then."""
    (tmp_path / "sleeper.py").write_text(
        "import os, time\n\n\nclass Sleeper:\n    def __init__(self):\n        os.fork()\n        time.sleep(1e9)\n\n"
        "    def act(self, observation):\n        pass\n"
    )
    name = f"KILLED_RUN={tmp_path.name}-{time.time_ns()}"
    run = subprocess.Popen(
        [sys.executable, "-c", RUN, word],
        env=os.environ | dict([name.split("=")]),
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        start_new_session=True,
    )
    try:
        assert run.stdout.readline() == b"asked\n"
        wait_until(lambda: len(having(name, but=run.pid)) == 3)  # two of the policy, and who watches
        os.killpg(run.pid, signal.SIGKILL)
        run.wait()
        begin = time.monotonic()
        wait_until(lambda: not having(name, but=run.pid))
        print(f"gone after {time.monotonic() - begin:.1f} s")
    finally:
        for one in having(name, but=0):
            os.kill(one, signal.SIGKILL)
        run.wait()
        run.stdout.close()


def having(variable: str, but: int) -> list[int]:
    """Processes that run with a variable in their environment, but one."""
    found = []
    for one in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if variable.encode() in (one / "environ").read_bytes().split(b"\0") and int(one.name) != but:
                found.append(int(one.name))
    return found


def wait_until(what, seconds: float = 30.0) -> None:
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_where_memory_runs_out_the_policy_is_ended_and_not_the_run():
    guest = Process(["sleep", "60"])
    try:
        assert Path(f"/proc/{guest.process.pid}/oom_score_adj").read_text() == "1000\n"
        assert int(Path("/proc/self/oom_score_adj").read_text()) < 1000
    finally:
        guest.kill()


def test_the_guest_needs_no_torch():
    """A process of a policy that imports none starts in a fraction of a second, and needs 40 MB."""
    program = (
        "import sys; from maexp.agents.policies.guest import find; find('hostile:Stays'); "
        "print([name for name in ('torch', 'warp', 'hydra', 'scipy') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout == "[]\n", done.stdout + done.stderr
    assert TeamPlanner("cost_utility").learned is None
