"""Teams that start together in ir-sim, with distinct targets and without: a table, one row for each trial.

`python tests/tools/distinct_irsim.py FLOOR.yaml cost_utility 3 240` plays three starts of three robots, at most 240 s
each. Before is without distinct targets. Needless duplicates are counted as in
`python -m maexp.agents.deploy.planner simulate`.
"""

import sys

import numpy as np

from maexp.agents.deploy.irsim.config import TrialConfig
from maexp.agents.deploy.irsim.trial import Trial, run_trial
from maexp.agents.deploy.planner.simulate import MARKS, count_close
from maexp.agents.runtime import TeamPlanner
from maexp.envs import ExplorationEnv, RobotConfig
from maexp.envs.io import import_map

ROBOTS, RADIUS, REACH, SPEED, DT = 3, 0.2, 4.0, 0.6, 0.1


class Counting(TeamPlanner):
    """Counts what it gives away twice."""

    needless = 0

    def plan(self, *words, **settings):
        plan = super().plan(*words, **settings)
        self.needless += count_close(plan, RADIUS)[1]
        return plan


def play(world, policy: str, seed: int, seconds: float, distinct: bool) -> tuple[Trial, int]:
    """A trial from a place of its own, and its needless duplicates."""
    robot = RobotConfig("differential", radius=RADIUS)
    env = ExplorationEnv(world, 1, ROBOTS, robot=robot, seed=seed, starts="together", num_threads=1)
    env.reset()
    now = env.snapshot()
    starts = np.concatenate([now["center"], now["pose"][:, 3:4]], axis=1).astype(float)
    config = TrialConfig(seconds, REACH, SPEED, 1.0, RADIUS - 0.05, RADIUS, decide=1.0, seed=seed)
    planner = Counting(policy, radar_range=REACH, robot_radius=RADIUS, max_speed=SPEED, seconds=1.0, distinct=distinct)
    return run_trial(world, planner, starts, config), planner.needless


def row(policy: str, seed: int, distinct: bool, trial: Trial, needless: int) -> str:
    """A trial as a row of the table."""
    seen = np.array(trial.coverage)
    when = [f"{DT * (seen >= mark).argmax():.0f}" if (seen >= mark).any() else "" for mark in MARKS]
    done = "" if trial.done_at is None else f"{trial.done_at:.0f}"
    end = [f"{100 * seen[-1]:.1f}", f"{trial.path.sum():.0f}", needless, trial.collided.sum()]
    return " | ".join(map(str, [f"| {policy}", seed, "after" if distinct else "before", *when, done, *end])) + " |"


def main(file: str, policy: str, runs: int, seconds: float) -> None:
    """Print the table."""
    world = import_map(file, num_robots=ROBOTS, robot_radius=RADIUS)
    names = ["| policy", "seed", "targets", *(f"{100 * mark:g} % [s]" for mark in MARKS), "done [s]", "seen [%]"]
    print(" | ".join([*names, "driven [m]", "needless duplicates", "robots lost |"]))
    print("|" + 11 * " --- |")
    for seed in range(runs):
        for distinct in (False, True):
            print(row(policy, seed, distinct, *play(world, policy, seed, seconds, distinct)), flush=True)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]), float(sys.argv[4]))
