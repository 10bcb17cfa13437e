"""Golden episodes: small rollouts of every scenario and planner with fixed actions, recorded.

`python -m tests.golden.record` in the root of the source writes them anew. Do so only for a change of behaviour that is
meant, and say in the commit what changed and why.
"""

from pathlib import Path

import numpy as np
import torch

from maexp.envs import ExplorationEnv, PlannerConfig, make_map
from maexp.envs.scenarios import SCENARIOS
from maexp.envs.specs import REWARD_TERMS

FOLDER = Path(__file__).parent
ROBOTS, STEPS, SEED = 3, 3, 11
CASES = {name: (name, "dwa") for name, one in SCENARIOS.items() if one.build is not None}
CASES |= {f"maze_small_{planner}": ("maze_small", planner) for planner in ("wavefront", "direct")}


def play(case: str) -> dict[str, np.ndarray]:
    """What two envs of a case come to after each macro step.

    Arrays [step, env, robot, ...]: pose [m, m, m/s, rad], reward terms, path_length [m]; [step, env]: coverage;
    and sums of the pictures, which notice what the rest does not.
    """
    scenario, planner = CASES[case]
    maps = [make_map(scenario, index) for index in (0, 1)]
    planning = PlannerConfig(name=planner)
    env = ExplorationEnv(maps, num_envs=2, num_robots=ROBOTS, seed=SEED, planner=planning, num_threads=1)
    rng = np.random.default_rng(SEED)
    td = env.reset()
    rows = []
    for _ in range(STEPS):
        if planner == "direct":
            td["agents", "action", "control"] = torch.from_numpy(rng.uniform(-0.3, 0.3, (2, ROBOTS, 2))).float()
        else:
            td["agents", "action", "region"] = torch.from_numpy(rng.integers(0, 64, (2, ROBOTS)))
            td["agents", "action", "offset"] = torch.from_numpy(rng.uniform(-1, 1, (2, ROBOTS, 2))).float()
        td = env.step(td)["next"]
        rows.append({
            "pose": env.simulation.tensors["pose"].numpy().copy(),
            "terms": np.stack([td["info", f"reward_{term}"].numpy() for term in REWARD_TERMS], axis=-1),
            "path_length": td["info", "path_length"].numpy(),
            "coverage": td["info", "coverage"].numpy()[:, 0],
            "pictures": td["agents", "observation", "map"].float().mean((-1, -2)).numpy(),
            "team": td["team", "map"].float().mean((-1, -2)).numpy(),
        })  # fmt: skip
    return {name: np.stack([row[name] for row in rows]).astype(np.float32) for name in rows[0]}


def main() -> None:
    for case in CASES:
        np.savez_compressed(FOLDER / f"{case}.npz", **play(case))
        print(f"recorded {case}")
    print("Say in the commit what changed and why.")


if __name__ == "__main__":
    main()
