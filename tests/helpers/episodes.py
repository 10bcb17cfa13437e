"""Episodes of fixed actions, for tests of the env: played, stepped and compared."""

import torch
from torchrl.envs.utils import step_mdp

SHORT = {"local_steps": 3, "macro_steps": 4, "num_threads": 1}
"""Settings of an env whose episodes are short."""


def actions(envs: int, robots: int, steps: int, seed: int = 1) -> list[dict]:
    """Actions of env e that do not depend on how many envs there are."""
    result = []
    for t in range(steps):
        region, offset = [], []
        for e in range(envs):
            g = torch.Generator().manual_seed(seed * 1000003 + t * 1009 + e)
            region.append(torch.randint(64, (robots,), generator=g))
            offset.append(torch.rand(robots, 2, generator=g) * 2 - 1)
        result.append({"region": torch.stack(region), "offset": torch.stack(offset)})
    return result


def play(env, plan, reset=True):
    """Step through a plan with resets of finished envs; returns the list of stepped tensordicts."""
    td = env.reset() if reset else reset
    out = []
    for action in plan:
        td = td.clone()
        for name, value in action.items():
            td["agents", "action", name] = value
        stepped, td = env.step_and_maybe_reset(td)
        out.append(stepped.clone())
    return out


def equal(a, b) -> bool:
    return all(torch.equal(x, b[k]) for k, x in a.items(include_nested=True, leaves_only=True))


def step(env, td, action):
    td = td.clone()
    for name, value in action.items():
        td["agents", "action", name] = value
    return step_mdp(env.step(td)).clone()
