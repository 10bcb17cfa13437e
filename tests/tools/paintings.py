"""What sharing the painted map between the local planner and a policy could save: `python tests/tools/paintings.py`.

32 teams of three robots decide by `cost_utility` and drive by `wavefront`. Before each of 40 decisions the map is
painted for either, and once more: what is left then is looking for what is new. Both hold the same cells, or it ends.
"""

import statistics
import time

import numpy as np

from maexp.agents.policies import POLICIES
from maexp.envs import ExplorationEnv, PlannerConfig, make_map

TEAMS, DECISIONS, WARM = 32, 40, 5


def seconds(work, *arguments) -> float:
    begin = time.process_time()
    work(*arguments)
    return time.process_time() - begin


def paint_all(grids, launch) -> None:
    for grid in grids:
        grid.paint(launch)


def measure(scenario: str) -> list[dict[str, float]]:
    """Seconds of each part, for each decision."""
    maps, planner = [make_map(scenario, k) for k in range(8)], PlannerConfig(name="wavefront")
    env = ExplorationEnv(maps, TEAMS, 3, planner=planner, num_threads=1, seed=1)
    policy, td, rows = POLICIES["cost_utility"](env), env.reset(), []
    nav = policy.module.tracker.nav
    drivers = [block.wavefront.known for block in env.simulation.blocks]
    for _ in range(DECISIONS):
        row = {"policy": seconds(paint_all, [nav.known_grids], nav.launch)}
        row["planner"] = seconds(paint_all, drivers, nav.launch)
        row["looking"] = seconds(paint_all, drivers, nav.launch)
        known = np.concatenate([driver.known.numpy() for driver in drivers])
        assert (known == nav.known_grids.known.numpy()).all(), "the planner and the policy know different maps"
        for grids in (nav.known_grids, *drivers):
            grids.news_count.fill_(-1)  # masks follow the list of the last painting, which was in vain
        begin = time.process_time()
        td = env.step_and_maybe_reset(policy(td))[1]
        rows.append(row | {"all": time.process_time() - begin})
    return rows[WARM:]


def show(scenario: str, rows: list[dict[str, float]]) -> None:
    parts = {
        "painting for the policy": [row["policy"] / row["all"] for row in rows],
        "for the planner at the same moment": [row["planner"] / row["all"] for row in rows],
        "of which what is new": [(row["planner"] - row["looking"]) / row["all"] for row in rows],
    }
    for name, shares in parts.items():
        half = 1.96 * statistics.stdev(shares) / len(shares) ** 0.5
        print(f"{scenario}: {name}: {100 * statistics.mean(shares):.2f} ± {100 * half:.2f} % of a macro step")


if __name__ == "__main__":
    for scenario in ("maze_small", "indoor_medium", "outdoor"):
        show(scenario, measure(scenario))
