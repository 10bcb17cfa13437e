"""Places where only some packages can be imported, and a plan to make there."""

import importlib.util
from pathlib import Path

PLAN_WITH_A_POLICY = """
import importlib.util, numpy as np
import maexp.agents.runtime as runtime
for name in ("torch", "warp", "tensordict", "omegaconf"):
    assert importlib.util.find_spec(name) is None, name
grid = np.full((100, 150), -1)
grid[:, :60] = 0
grid[[0, -1], :60] = 100
grid[:, 0] = 100
for name in runtime.shipped_names():
    planner = runtime.TeamPlanner(name, radar_range=8.0, robot_radius=0.3)
    plan = planner.plan(grid, 0.1, (-2.0, -3.0), {"left": (0.0, 0.0, 0.0), "right": (0.0, 3.0, 1.57)}, time_left=0.9)
    assert plan.active.all() and not plan.notes, plan
    cells = np.floor((plan.goals - (-2.0, -3.0)) / 0.1).astype(int)
    assert (grid[cells[:, 1], cells[:, 0]] == 0).all(), plan.goals
assert len(runtime.shipped_names()) >= 2
print(runtime.__file__)
"""


def share_packages(site: Path, *names: str) -> None:
    """Make packages of this environment, and the libraries that lie beside them, importable from `site`."""
    site.mkdir(exist_ok=True)
    for name in names:
        home = Path(importlib.util.find_spec(name).origin).parent
        for part in (home, home.parent / f"{name}.libs"):
            if part.exists():
                (site / part.name).symlink_to(part)
