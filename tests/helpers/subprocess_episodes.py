"""Episodes of policies in processes of their own, and what to ask of processes, for tests."""

import time
from pathlib import Path

import torch
from mazes import make_env

from maexp.agents.evaluation.evaluate import play
from maexp.agents.policies.remote.subprocess_policy import HostedPolicy, guest_of

TESTS = Path(__file__).resolve().parent
EXAMPLES = TESTS.parents[1] / "docs" / "examples" / "policies"
ENVS, STEPS = 4, 5


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


def alive(process: int) -> bool:
    """Whether a process runs; one that has ended and was not asked about does not."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_for(what, seconds: float = 30.0) -> None:
    """Until it is so."""
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end
        time.sleep(0.05)
