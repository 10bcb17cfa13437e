"""`python -m maexp.agents.runtime`: how long a plan takes on this computer, for every planner and shipped policy.

Policies need onnxruntime and are left out where it is not installed.
"""

import argparse
import importlib.util
import time

import numpy as np

from maexp.agents.runtime import CHOICES, TeamPlanner, shipped_names


def make_floor(cells: int, room: int = 80, door: int = 10) -> np.ndarray:
    """A square floor of rooms with doors, of which the right third is not known yet: [cells, cells] as ROS has it."""
    grid = np.zeros((cells, cells), np.int8)
    walls = np.append(np.arange(0, cells - 1, room), cells - 1)
    grid[walls], grid[:, walls] = 100, 100
    for middle in range(room // 2, cells, room):
        for wall in walls[1:-1]:
            grid[middle : middle + door, wall] = 0
            grid[wall, middle : middle + door] = 0
    grid[:, 2 * cells // 3 :] = -1
    return grid


def main() -> None:
    """Print milliseconds a plan, the middle and the longest of several, in processor time of one core."""
    parser = argparse.ArgumentParser(prog="python -m maexp.agents.runtime", description=__doc__)
    parser.add_argument("--metres", type=float, default=50.0, help="side of the floor [m]")
    parser.add_argument("--resolution", type=float, default=0.1, help="edge of a cell [m]")
    parser.add_argument("--robots", type=int, default=3)
    parser.add_argument("--calls", type=int, default=10, help="plans for each planner")
    given = parser.parse_args()
    grid = make_floor(round(given.metres / given.resolution))
    poses = [(1.5 + 1.2 * (k % 5), 1.5 + 1.2 * (k // 5), 0.0) for k in range(given.robots)]
    print(f"{given.robots} robots, {grid.shape[1]} x {grid.shape[0]} cells of {given.resolution:g} m")
    trained = shipped_names() if importlib.util.find_spec("onnxruntime") else []
    for name in (*CHOICES, *trained):
        planner, spent = TeamPlanner(name, radar_range=5.0, robot_radius=0.3), []
        for now in range(given.calls):
            begin = time.process_time()
            plan = planner.plan(grid, given.resolution, (0.0, 0.0), poses, now=0.1 * now)
            spent.append(1e3 * (time.process_time() - begin))
        print(f"{name:<18}{np.median(spent):7.0f} ms, at most {max(spent):.0f} ms, {len(plan.targets)} targets")


if __name__ == "__main__":
    main()
