"""Two robots that part, meet and merge their maps: `python -m tests.tools.meeting docs/pictures/meeting.png`, or
`meeting.gif` for a film of the whole episode."""

import sys
from pathlib import Path

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torchrl.envs.utils import step_mdp

from maexp.agents.evaluation.plots import COLOURS, panels
from maexp.agents.policies import POLICIES
from maexp.envs import CommConfig, ExplorationEnv, PointCloudMap, make_map
from maexp.envs.atomic_write import whole_file
from maexp.envs.render.video import write_gif
from maexp.kernels import unpack_flags

SCENARIO, MAPS, EPISODE = "indoor_medium", range(26, 38), 6
GREY, BOTH = "#D8D8D8", COLOURS[2]


def play(env: ExplorationEnv) -> list[dict]:
    """What two robots know, and where they are, after every decision."""
    policy, s, seen = POLICIES["cost_utility"](env), env.simulation.tensors, []
    td = env.reset()
    while True:
        known = unpack_flags(s["known_free"], 2)[0].numpy()
        seen.append(
            {
                "known": known,
                "at": s["center"][0, :, :2].numpy().copy(),
                "hears": bool(s["comm"][0, 0, 1]),
                "seconds": float(s["local_step"][0]) / 10,
            }
        )
        if bool(td["done"].any()):
            return seen
        td = step_mdp(env.step(policy(td)), exclude_done=False)


def choose(seen: list[dict]) -> list[tuple[str, dict]]:
    """The moments shown: parted, the last decision before they meet, and the one after."""
    parted = [k for k, inputs in enumerate(seen) if not inputs["hears"]]
    apart = [np.count_nonzero(inputs["known"][0] != inputs["known"][1]) for inputs in seen]
    meets = [k for k in parted if k + 1 < len(seen) and seen[k + 1]["hears"]]
    last = max(meets, key=lambda k: apart[k])
    begin = max((k for k in range(last) if seen[k]["hears"]), default=0)
    named = (("parted", (begin + last) // 2), ("before they meet", last), ("merged", last + 1))
    return [(f"{what}, {seen[k]['seconds']:.0f} s", seen[k]) for what, k in named]


def draw(path: Path) -> None:
    """Write the picture, or the film."""
    maps, comm = [make_map(SCENARIO, k) for k in MAPS], CommConfig(range=4.0, line_of_sight=True)
    env = ExplorationEnv(maps, 1, 2, comm=comm, num_threads=1, starts="together")
    env.set_episodes(torch.tensor([EPISODE]))
    seen = play(env)
    tensors, m = env.simulation.map_tensors, int(env.simulation.tensors["map_id"])
    free = tensors["free"][tensors["free_begin"][m] : tensors["free_begin"][m + 1], :2].numpy()  # in the kernels' order
    if path.suffix == ".gif":
        titles = [
            f"{inputs['seconds']:.0f} s: {'they hear each other' if inputs['hears'] else 'apart'}" for inputs in seen
        ]
        figures = [draw_moments([inputs], maps[m], free) for inputs in zip(titles, seen, strict=True)]
        write_gif([pixels(figure) for figure in figures], path, fps=2.0)
        return
    with whole_file(path) as file:
        draw_moments(choose(seen), maps[m], free).savefig(file, format="png", dpi=90)


def draw_moments(moments: list[tuple[str, dict]], world: PointCloudMap, free: np.ndarray) -> Figure:
    """Moments side by side: who knows which of the free points, [count, 2]."""
    figure, axes = panels(len(moments), height=3.2)
    for ax, (title, inputs) in zip(axes, moments, strict=False):
        ax.set_title(title, loc="left")
        ax.plot(*world.boundary[:, :2].T, ".", color="black", markersize=1)
        known = inputs["known"][:, : len(free)]
        parts = (
            (~known[0] & ~known[1], GREY, None),
            (known[0] & ~known[1], COLOURS[0], "first alone"),
            (known[1] & ~known[0], COLOURS[1], "second alone"),
            (known[0] & known[1], BOTH, "both"),
        )
        for which, colour, label in parts:
            ax.plot(*free[which].T, "s", color=colour, markersize=2.2, label=label)
        for (x, y), colour in zip(inputs["at"], COLOURS[:2], strict=True):
            ax.plot(x, y, "o", color=colour, markeredgecolor="black", markersize=9)
        ax.set_aspect("equal")
        ax.set_axis_off()
    shown = axes[0].get_legend_handles_labels()
    columns = 3 if len(moments) > 1 else 2
    figure.legend(*shown, loc="outside lower center", ncols=columns, markerscale=4, title="known to")
    return figure


def pixels(figure: Figure) -> np.ndarray:
    """A figure as a frame of a film, uint8 [height, width, 3]."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
