"""What a decision of one planner costs inside, as a class in Python, in a process, at a socket and over DDS.

    python decision_times.py cost_utility

Plays the same episodes of `minival` with one team in every way, and prints a table: the processor time of a decision in
this process and in the planner's own, the time by the clock (medians), and whether the actions are those inside. The
first episode of each warms up. Linux only, for the clock of another process.
"""

import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np

from maexp.agents.benchmarks.suites.play import SuitePolicy, build_env, build_maps, play_batch
from maexp.agents.benchmarks.suites.suite import load_suite
from maexp.agents.deploy.planner.arena_policy import TeamAgent
from maexp.agents.policies.remote.numpy_policy import as_policy
from maexp.envs import ObservationConfig

SUITE, PART, EPISODES = "minival", "outdoor", 3
PLAIN = ObservationConfig(pictures=False)
CLOSE = 1e-3  # m: goals that are the same
HEAD = ("way", "here [ms]", "its own process [ms]", "by the clock [ms]", "actions as inside")


def clock_of(process):
    """Processor time of a process and its threads so far [s]; None: nan."""
    return np.nan if process is None else time.clock_gettime((~process.pid << 3) | 2)


class Timed:
    """A policy and what its calls took: rows of seconds (here, own process, clock)."""

    def __init__(self, policy, process):
        self.policy, self.process, self.rows, self.reasons = policy, process, [], [""]

    def __call__(self, state):
        before = self._clocks()
        state = self.policy(state)
        self.rows.append(np.subtract(self._clocks(), before))
        self.reasons = getattr(self.policy, "reasons", [""])
        return state

    def _clocks(self):
        return time.process_time(), clock_of(self.process()), time.monotonic()


@contextmanager
def inside(name, suite):
    """A planner as the suite plays it; gives what the env shows, what makes the policy, and its process."""
    player = SuitePolicy(name)
    yield player.observation(), player.open, lambda: None


@contextmanager
def in_python(name, suite):
    """The NumPy planner, a class with `act`, in this process."""

    @contextmanager
    def make(env):
        yield as_policy(env, lambda: TeamAgent(name), name)

    yield PLAIN, make, lambda: None


@contextmanager
def in_a_process(name, suite):
    """The same in a process of its own."""
    player, opened = SuitePolicy(f"process:{name}"), []

    @contextmanager
    def make(env):
        with player.open(env) as policy:
            opened.append(policy)
            yield policy

    def process():
        return opened[-1].workers[0] and opened[-1].workers[0].process

    yield player.observation(), make, process


@contextmanager
def at_a_socket(name, suite):
    """The same behind TCP; its process belongs to the one that listens."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        address = f"127.0.0.1:{listener.getsockname()[1]}"
    command = [sys.executable, "-m", "maexp.agents.policies.remote.server", address, f"process:{name}"]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        server.stdout.readline()  # it listens
        player = SuitePolicy(f"socket:{address}")
        yield player.observation(), player.open, lambda: None
    finally:
        server.send_signal(signal.SIGINT)
        server.communicate()


@contextmanager
def over_dds(name, suite):
    """The same as `maexp ros2 team`."""
    from maexp.agents.deploy.ros2.dds import Wire
    from maexp.agents.deploy.ros2.serve import Ros2Player, Serving

    names = [f"robot{k + 1}" for k in range(suite.parts[PART].num_robots)]
    words = ["ros2", "team", f"policy={name}", f"robots={','.join(names)}", "answer=300"]
    call = "import sys; from maexp.agents.cli import main; sys.exit(main(sys.argv[1:]))"
    team = subprocess.Popen([sys.executable, "-c", call, *words], stdout=subprocess.DEVNULL)
    player = Ros2Player("ros2", Wire(), Serving(stands=120.0, answer=300.0))
    try:
        yield PLAIN, player.open, lambda: team
    finally:
        player.end()
        team.wait(60)


WAYS = {"inside": inside, "Python": in_python, "process": in_a_process, "socket": at_a_socket, "DDS": over_dds}


def measure(way, name, suite, maps):
    """The batches of a way, and the rows of `Timed` after the first episode."""
    part = suite.parts[PART]
    with WAYS[way](name, suite) as (shown, make, process):
        env = build_env(part, maps, 1, suite.seed, shown, device="cpu")
        with make(env) as policy:
            timed = Timed(policy, process)
            batches = [play_batch(suite, env, timed, 0)]
            timed.rows.clear()
            batches += [play_batch(suite, env, timed, number) for number in range(1, EPISODES)]
    return batches, np.array(timed.rows)


def compare(batches, inside):
    """In words."""
    pairs = list(zip(batches, inside, strict=True))
    if not all(np.array_equal(a.decisions, b.decisions) for a, b in pairs):
        return "no"
    apart = max(float(np.abs(a.sent["goal"] - b.sent["goal"]).max()) for a, b in pairs)
    if apart > CLOSE:
        return "no"
    return f"yes, to {apart:.0e} m" if apart else "yes, to the bit"


def main(name="cost_utility", *ways):
    suite = load_suite(SUITE)
    maps, first = build_maps(suite.parts[PART]), None
    print(f"{name}, {PART} of {SUITE}, one team of {suite.parts[PART].num_robots}\n")
    print(f"| {' | '.join(HEAD)} |\n|{' --- |' * len(HEAD)}")
    for way in ways or WAYS:
        batches, rows = measure(way, name, suite, maps)
        first = batches if first is None else first
        cells = ["-" if np.isnan(seconds) else f"{1e3 * seconds:.1f}" for seconds in np.median(rows, axis=0)]
        told = "" if batches is first else compare(batches, first)
        print(f"| {way} | {' | '.join(cells)} | {told} |", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
