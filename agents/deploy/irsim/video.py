"""A film of the team's grid, and coverage over time in both simulators."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from maexp.agents.deploy.irsim.simulator import PERSON_RADIUS
from maexp.agents.deploy.irsim.trial import FilmFrame
from maexp.envs.atomic_write import whole_file
from maexp.envs.render.frames import ROBOT_COLOURS
from maexp.kernels.constants import DT

UNKNOWN, CLEAR, WALL, PERSON = (205, 205, 210), (255, 255, 255), (40, 40, 46), (235, 160, 0)
HEAD = 26  # pixels above the picture, for what is going on


def draw_moment(inputs: FilmFrame, radius: float, width: int = 640) -> np.ndarray:
    """The team's grid with robots where they believe to be (discs) and are (rings); uint8 [height, width, 3]."""
    values = inputs.grid.values()
    colours = np.array([UNKNOWN, CLEAR, WALL], np.uint8)[np.where(values < 0, 0, np.where(values < 50, 1, 2))]
    rows, columns = values.shape
    scale = width / max(rows, columns)
    size = (max(1, round(columns * scale)), max(1, round(rows * scale)))
    picture = Image.new("RGB", (max(size[0], 320), size[1] + HEAD), (245, 245, 245))
    picture.paste(Image.fromarray(colours[::-1]).resize(size, Image.Resampling.BOX), (0, HEAD))
    draw = ImageDraw.Draw(picture)

    def disc(place, reach, **look):
        x, y = (np.asarray(place) - inputs.grid.low) / inputs.grid.cell * scale
        r = max(reach / inputs.grid.cell * scale, 3.0)
        draw.ellipse((x - r, HEAD + size[1] - y - r, x + r, HEAD + size[1] - y + r), **look)

    for person in inputs.people:
        disc(person, PERSON_RADIUS, fill=PERSON)
    for i, (believed, pose, goal) in enumerate(zip(inputs.believed, inputs.poses, inputs.goals, strict=True)):
        colour = ROBOT_COLOURS[i % len(ROBOT_COLOURS)]
        disc(believed[:2], radius, fill=colour)
        disc(pose[:2], 2 * radius, outline=colour, width=2)
        if np.isfinite(goal).all():
            disc(goal, 0.05, outline=colour, width=2)
    people = f", {len(inputs.people)} people" if len(inputs.people) else ""
    draw.text((6, 6), f"ir-sim {inputs.time:5.1f} s   seen {inputs.coverage:.1%}{people}", fill=(20, 20, 20))
    return np.asarray(picture)


def draw_curves(curves: dict[str, list[float]], title: str, path: str | os.PathLike) -> Path:
    """Coverage over time by name, PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # late: slow to import
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), dpi=100, layout="constrained")
    axes = figure.add_subplot()
    for name, curve in curves.items():
        axes.plot(np.arange(len(curve)) * DT, 100 * np.array(curve), label=name)
    axes.set(xlabel="time [s]", ylabel="free points seen [%]", ylim=(0, 101), title=title)
    axes.grid(alpha=0.3)
    axes.legend()
    with whole_file(Path(path)) as part:
        FigureCanvasAgg(figure).print_png(part)
    return Path(path)
