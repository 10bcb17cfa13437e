"""Golden episodes: small rollouts of every scenario and planner with fixed actions, recorded.

`python -m tests.golden.record` in the root of the source writes them anew. Do so only for a change of behaviour that is
meant, and say in the commit what changed and why. The settings are written out: a new default changes no record.
"""

from pathlib import Path

import numpy as np
import torch

from maexp.envs import ExplorationEnv, PlannerConfig, RewardConfig, RobotConfig, make_map
from maexp.envs.scenarios import GENERATED, SCENARIOS
from maexp.envs.specs import REWARD_TERMS

FOLDER = Path(__file__).parent
ROBOTS, STEPS, SEED = 3, 3, 11
CASES = {name: (name, "dwa") for name in GENERATED}
CASES |= {f"maze_small_{planner}": ("maze_small", planner) for planner in ("wavefront", "direct")}
CLEARANCE = {"random": 3.0, "maze": 4.0, "indoor": 4.2, "outdoor": 4.2}  # factor by the first word of a scenario
REWARD = RewardConfig(
    explore=0.3,
    overlap=0.01,
    time=1.0,
    success=100.0,
    collision=200.0,
    points=60.0,
    events=60.0 / 7000.0,
    time_on="uncovered",
    charge_rest=False,
)


def settings(case: str) -> dict:
    """What the env of a case is told besides maps, sizes and seed."""
    scenario, planner = CASES[case]
    clearance = CLEARANCE.get(scenario.split("_")[0], SCENARIOS[scenario].clearance_factor)
    clearance = 2.0 if planner == "wavefront" else clearance
    planning = PlannerConfig(name=planner, horizon=3, clearance_factor=clearance, clearance_weight=100.0)
    robot = RobotConfig(kind="ackermann", wheelbase="length")
    return {"planner": planning, "robot": robot, "reward": REWARD, "decision_seconds": "protocol"}


def play(case: str) -> dict[str, np.ndarray]:
    """What two envs of a case come to after each macro step.

    Arrays [step, env, robot, ...]: pose [m, m, m/s, rad], reward terms, path_length [m]; [step, env]: coverage;
    and sums of the pictures, which notice what the rest does not.
    """
    scenario, planner = CASES[case]
    maps = [make_map(scenario, index) for index in (0, 1)]
    env = ExplorationEnv(maps, num_envs=2, num_robots=ROBOTS, seed=SEED, num_threads=1, **settings(case))
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
        rows.append(
            {
                "pose": env.simulation.tensors["pose"].numpy().copy(),
                "terms": np.stack([td["info", f"reward_{term}"].numpy() for term in REWARD_TERMS], axis=-1),
                "path_length": td["info", "path_length"].numpy(),
                "coverage": td["info", "coverage"].numpy()[:, 0],
                "pictures": td["agents", "observation", "map"].float().mean((-1, -2)).numpy(),
                "team": td["team", "map"].float().mean((-1, -2)).numpy(),
            }
        )
    return {name: np.stack([row[name] for row in rows]).astype(np.float32) for name in rows[0]}


def main() -> None:
    for case in CASES:
        np.savez_compressed(FOLDER / f"{case}.npz", **play(case))
        print(f"recorded {case}")
    print("Say in the commit what changed and why.")


if __name__ == "__main__":
    main()
