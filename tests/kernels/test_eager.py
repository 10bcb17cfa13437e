"""MAEXP_EAGER=1: stages run from their first line at every step, to the same bits."""

import json
import os
import subprocess
import sys

SCRIPT = """
import hashlib, json, torch
from maexp.kernels import step
calls = []
reward = step.reward_robots
step.reward_robots = lambda launch, shard: (calls.append(shard.first), reward(launch, shard))
from maexp.envs import ExplorationEnv, make_map
env = ExplorationEnv([make_map("maze_small", 0)], num_envs=2, num_robots=3, local_steps=5, num_threads=2)
recorded = len(calls)
torch.manual_seed(0)
td = env.rollout(3)
bits = hashlib.sha256(b"".join(v.numpy().tobytes() for k, v in sorted(env.simulation.tensors.items()))).hexdigest()
print(json.dumps([len(calls) - recorded, bits, float(td["next", "info", "coverage"][:, -1].sum())]))
"""


def play(eager: str) -> list:
    env = os.environ | {"MAEXP_EAGER": eager, "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, env=env)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


def test_every_local_step_enters_its_stages_and_the_bits_stay():
    recorded, eager = play("0"), play("1")
    assert recorded[0] == 0 and eager[0] == 3 * 5
    assert recorded[1:] == eager[1:]
