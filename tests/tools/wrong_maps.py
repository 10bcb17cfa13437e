"""Maps that odometry has bent: `python -m tests.tools.wrong_maps docs/pictures/wrong_maps.png`."""

import sys
from pathlib import Path

import torch
from matplotlib.colors import ListedColormap
from torchrl.envs.utils import step_mdp

from maexp.agents.evaluation.plots import COLOURS, panels
from maexp.agents.policies import POLICIES
from maexp.envs import CommConfig, ExplorationEnv, OdometryConfig, make_map
from maexp.envs.atomic_write import whole_file
from maexp.envs.targets.navigation import Navigation

SCENARIO, INDEX, DECISIONS = "random_obstacles", 30, 25
SHADES = ListedColormap(["#C8C8C8", "white", "black"])  # unknown, free, wall


def play() -> ExplorationEnv:
    """Two robots that hear each other nearby, after a while."""
    env = ExplorationEnv(
        make_map(SCENARIO, INDEX),
        1,
        2,
        comm=CommConfig(range=80.0, line_of_sight=True),
        odometry=OdometryConfig(drift=0.02, turn=0.005, map_errors=True),
        num_threads=1,
        starts="together",
    )
    policy, td = POLICIES["multi_criteria"](env), env.reset()
    for _ in range(DECISIONS):
        td = step_mdp(env.step(policy(td)))
    return env


def draw(path: Path) -> None:
    """Write the picture: the true map, and those of both robots with the places where they are and believe to be."""
    env = play()
    nav = Navigation(env)
    nav.update()
    width, height = int(nav.width[0]), int(nav.height[0])
    (left, bottom), cell = nav.origin[0].tolist(), float(nav.cell_size[0])
    extent = (left, left + width * cell, bottom, bottom + height * cell)
    s, believed = env.simulation.tensors, env.simulation.believed
    figure, axes = panels(3, height=3.6)
    world = env.maps[0]
    for axis, title in zip(axes, ("the map", "robot 1's map", "robot 2's map"), strict=True):
        axis.set_title(title, loc="left")
        axis.set_aspect("equal")
        axis.set(xlim=extent[:2], ylim=extent[2:], xticks=[], yticks=[])
    axes[0].plot(*world.boundary[:, :2].T, "s", color="black", ms=0.8)
    for robot in (0, 1):
        known = nav.known[0, robot, : width * height].view(height, width).numpy()
        axis = axes[robot + 1]
        axis.imshow(known, origin="lower", extent=extent, cmap=SHADES, vmin=0, vmax=2, interpolation="nearest")
        for state, mark, name in ((s, "o", "is"), (believed, "x", "believes to be")):
            x, y = state["center"][0, robot, :2].tolist()
            axis.plot(x, y, mark, color=COLOURS[robot], ms=9, mew=2.5, label=f"where it {name}", mfc="none")
    handles = axes[1].get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=2)
    with whole_file(path) as part:
        figure.savefig(part, dpi=90, format="png")


if __name__ == "__main__":
    torch.set_num_threads(1)
    draw(Path(sys.argv[1]))
