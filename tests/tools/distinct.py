"""Teams that start together, with `targets.distinct` and without, on the same held-out episodes to 99.5 %.

`python tests/tools/distinct.py cost_utility 48 maze_small ...` prints a table of means for each scenario: before (off),
after, and the paired difference with its 95 % interval over maps and episodes. Steps are local steps; an episode that
never gets to a share counts with its whole length. Needless duplicates: pairs of robots that hear each other and are
sent to one target, or to two nearer than their bodies, in one decision, while a target that nobody has was left.
"""

import sys

import numpy as np
import torch

from maexp.agents import make_env, make_policy
from maexp.agents.evaluation.evaluate import EvaluationResult, evaluate_recorded
from maexp.kernels.constants import DT

GOAL = 0.995
WORDS = ("scenario.starts=together", f"scenario.success_coverage={GOAL}", "scenario.macro_steps=60", "num_threads=1")
ROWS = {
    "steps to 95 %": "coverage_step_95_censored",
    "steps to 99 %": "coverage_step_99_censored",
    "steps to 99.5 %": "last",
    "reached 99.5 % [%]": "there",
    "coverage over time [%]": "coverage_auc",
    "needless duplicates": "needless",
    "robots lost": "collisions",
    "way of a robot [m]": "path_length",
}
PERCENT = ("coverage_auc", "there")


def watch(tracker, needless: np.ndarray, over: torch.Tensor) -> None:
    """Count what a tracker shares out in teams whose episode is not over."""
    share = tracker.share

    def watched(preference, travel, points):
        chosen, waits = share(preference, travel, points)
        body, hears = tracker.body[0, 0], tracker.nav.state["comm"]
        for e in (~over).nonzero().squeeze(-1).tolist():
            placed = [i for i in range(chosen.shape[1]) if chosen[e, i] >= 0]
            at = {i: points[e, i, chosen[e, i]] for i in placed}
            for i in placed:
                free = points[e, i][preference[e, i] > -torch.inf]
                spare = (torch.stack([(free - place).norm(dim=-1) for place in at.values()]).amin(0) >= 2 * body).any()
                close = [hears[e, i, j] and (at[i] - at[j]).norm() < 2 * body for j in placed if j < i]
                needless[e] += spare * sum(map(bool, close))
        return chosen, waits

    tracker.share = watched


def play(policy: str, scenario: str, episodes: int, distinct: bool) -> EvaluationResult:
    """The episodes of a planner, with what `ROWS` wants."""
    words = (f"policy={policy}", f"scenario={scenario}", f"num_envs={episodes}", f"targets.distinct={distinct}", *WORDS)
    env = make_env(*words, verb="evaluate")
    chooser = make_policy(policy, env)
    needless, over = np.zeros(episodes), torch.zeros(episodes, dtype=torch.bool)
    watch(chooser.module.tracker if hasattr(chooser.module, "tracker") else env.target_view.tracker, needless, over)

    def choose(state):
        over.logical_or_(state["done"].squeeze(-1).cpu())
        return chooser(state)

    result = evaluate_recorded(choose, env, episodes, name=policy)
    last = steps_to(result, GOAL, env.local_steps * env.macro_steps)
    result.episodes.update(last=last, there=1.0 * (result.coverage.max(1) >= GOAL), needless=needless)
    return result


def steps_to(result: EvaluationResult, share: float, limit: int) -> np.ndarray:
    """The local step of the first record at which each episode had covered a share, or the limit; [episodes]."""
    there = result.coverage >= share
    return np.where(there.any(1), result.times[there.argmax(1)] / DT, limit)


def main(policy: str, episodes: int, scenarios: list[str]) -> None:
    """Print the tables."""
    for scenario in scenarios:
        before, after = (play(policy, scenario, episodes, distinct) for distinct in (False, True))
        apart, old, new = after.minus(before), before.summary(), after.summary()
        print(f"\n{scenario}, {policy}, {episodes} episodes\n")
        print("| | before | after | after less before |\n| --- | --- | --- | --- |")
        for name, metric in ROWS.items():
            factor = 100.0 if metric in PERCENT else 1.0
            low, high = (np.nan if end is None else factor * end for end in apart[metric]["ci95"])
            told = f"{factor * apart[metric]['mean']:+.2f} [{low:+.2f}, {high:+.2f}]"
            values = " | ".join(f"{factor * summary[metric]['mean']:.2f}" for summary in (old, new))
            print(f"| {name} | {values} | {told} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), sys.argv[3:])
