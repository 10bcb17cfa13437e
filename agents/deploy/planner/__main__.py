"""`python -m maexp.agents.runtime`: how long a plan takes on this computer, for every planner and shipped policy.

`python -m maexp.agents.deploy.planner simulate` lets a team explore a floor in closed loop, and counts what goes wrong.
Policies need onnxruntime, lookahead needs torch and Warp; they are left out where these are not installed.
"""

import argparse
import importlib.util
import itertools
import logging
import sys
import time
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import get_origin

import numpy as np

from maexp.agents.deploy.planner import CHOICES, TeamPlanner, shipped_names
from maexp.agents.deploy.planner.lookahead import LOOKAHEAD
from maexp.agents.deploy.planner.simulate import (
    MARKS,
    Course,
    SimulatedFloor,
    explore,
    make_floor,
    place_team,
    read_floor,
)
from maexp.envs.config import TargetsConfig
from maexp.envs.config_fields import check_value, explain, kinds, replaced, same, setting

ROOM = 8.0  # side of a room of our own floors [m]


@dataclass(frozen=True)
class MeasureSettings:
    """`python -m maexp.agents.runtime`."""

    metres: float = setting(50.0, "side of the floor", unit="m", above=0)
    resolution: float = setting(0.1, "edge of a cell, at least", unit="m", above=0)
    robots: int = setting(3, "of the team", low=1)
    calls: int = setting(10, "plans for each planner", low=1)


@dataclass(frozen=True)
class SimulateSettings:
    """`python -m maexp.agents.deploy.planner simulate`."""

    floor: list[str] = setting([], "map_server yamls; default: rooms of our own")
    metres: float = replaced(MeasureSettings, "metres", 24.0)
    resolution: float = same(MeasureSettings, "resolution")
    robots: int = same(MeasureSettings, "robots")
    policy: str = setting("cost_utility", "one or several: cost_utility,universal")
    start: tuple[float, float] | None = setting(None, "x y [m] that the team begins near; default: drawn")
    radius: float = setting(0.35, "of a robot", unit="m", above=0)
    range: float = setting(6.0, "of its lidar", unit="m", above=0)
    speed: float = setting(0.6, "of a robot", unit="m/s", above=0)
    seconds: float = setting(1800.0, "broken off after so many", unit="s", above=0)
    seed: int = setting(0, "of starts and of choices at random", low=0)
    runs: int = setting(1, "from so many places, one seed after the other", low=1)
    spare: str = same(TargetsConfig, "spare")
    together: bool = setting(False, "robots may share a target")
    compare: bool = setting(False, "each run both ways, and a table of the differences")
    notes: bool = setting(False, "print what the planner says")
    picture: str | None = setting(None, "file to draw the last run in (.png), with its axes in metres")


def measure(given: MeasureSettings) -> None:
    """Print milliseconds a plan, the middle and the longest of several, in processor time of one core."""
    grid = make_floor(round(given.metres / given.resolution))
    grid[:, 2 * len(grid) // 3 :] = -1  # not known yet
    poses = [(1.5 + 1.2 * (k % 5), 1.5 + 1.2 * (k // 5), 0.0) for k in range(given.robots)]
    print(f"{given.robots} robots, {grid.shape[1]} x {grid.shape[0]} cells of {given.resolution:g} m")
    trained = shipped_names() if importlib.util.find_spec("onnxruntime") else []
    search = [LOOKAHEAD] if all(importlib.util.find_spec(module) for module in ("torch", "warp")) else []
    for name in (*CHOICES, *trained, *search):
        planner, spent = TeamPlanner(name, radar_range=5.0, robot_radius=0.3), []
        for now in range(given.calls):
            begin = time.process_time()
            plan = planner.plan(grid, given.resolution, (0.0, 0.0), poses, now=0.1 * now)
            spent.append(1e3 * (time.process_time() - begin))
        print(f"{name:<18}{np.median(spent):7.0f} ms, at most {max(spent):.0f} ms, {len(plan.targets)} targets")


def simulate(given: SimulateSettings) -> None:
    """Print how a team explores floors: one line for each policy and run, with --compare a table of each policy."""
    logging.getLogger("maexp.runtime").setLevel(logging.INFO if given.notes else logging.ERROR)
    courses: dict[tuple[str, bool], list[Course]] = {}
    for name in given.floor or [None]:
        grid, cell = open_floor(given, name)
        size = f"{grid.shape[1] * cell:.0f} x {grid.shape[0] * cell:.0f} m, {(grid == 0).sum() * cell**2:.0f} m2 free"
        print(f"{name or 'rooms'}: {size}; {given.robots} robots of {given.radius:g} m start together")
        seeds = range(given.seed, given.seed + given.runs)
        for policy, seed in itertools.product(given.policy.split(","), seeds):
            for distinct in (True, False) if given.compare else (not given.together,):
                course = run(given, grid, cell, policy, seed, distinct)
                courses.setdefault((policy, distinct), []).append(course)
    if given.compare:
        for policy in given.policy.split(","):
            print(compare(policy, courses[policy, True], courses[policy, False], given.seconds))


def open_floor(given: SimulateSettings, name: str | None) -> tuple[np.ndarray, float]:
    """Its grid and the edge of a cell [m]; None: rooms of our own."""
    if name is not None:
        return read_floor(name, given.resolution)
    cell = given.resolution
    return make_floor(round(given.metres / cell), round(ROOM / cell), max(round(1.0 / cell), 1)), cell


def run(given: SimulateSettings, grid: np.ndarray, cell: float, policy: str, seed: int, distinct: bool) -> Course:
    """One exploration, told in a line."""
    first = np.random.default_rng(seed) if given.start is None else np.array(given.start)
    places = place_team(grid, cell, given.radius, given.robots, first)
    floor = SimulatedFloor(grid, cell, places, given.radius, given.range, given.speed)
    planner = TeamPlanner(
        policy,
        radar_range=given.range,
        robot_radius=given.radius,
        max_speed=given.speed,
        seconds=1.0,
        bounded=True,
        distinct=distinct,
        spare=given.spare,
        seed=seed,
    )
    course = explore(floor, planner, given.seconds)
    print(describe(policy if distinct else f"{policy}, shared", seed, course), flush=True)
    if given.notes:
        print("".join(f"    {note}\n" for note in course.notes), end="")
    if given.picture:
        draw(given.picture, floor, course, policy)
    return course


def describe(policy: str, seed: int, course: Course) -> str:
    """A course in a line."""
    marks = ", ".join(
        f"{100 * mark:g} % " + (f"{when:.0f} s" if np.isfinite(when) else "never")
        for mark, when in zip(MARKS, course.reached, strict=True)
    )
    end = f"done after {course.seconds:.0f} s" if course.done else f"broken off after {course.seconds:.0f} s"
    return (
        f"{policy:<20} seed {seed}: {marks}; {end}, {100 * course.share:.1f} % seen; {course.driven:.0f} m driven; "
        f"needless duplicates {course.needless}, close goals {course.close}, waits {course.waits}"
    )


def compare(policy: str, apart: list[Course], shared: list[Course], limit: float) -> str:
    """A table of means: robots that take distinct targets, robots that may share one, and the paired difference with
    its 95 % interval over runs. A share that was never seen counts with the time limit [s]."""
    rows = {f"{100 * mark:g} % [s]": lambda course, k=k: min(course.reached[k], limit) for k, mark in enumerate(MARKS)}
    rows |= {
        "done [s]": lambda course: course.seconds if course.done else limit,
        "driven [m]": lambda course: course.driven,
    }
    rows |= {"needless duplicates": lambda course: course.needless, "close goals": lambda course: course.close}
    rows |= {"waits": lambda course: course.waits, "runs that were done": lambda course: 100.0 * course.done}
    head = f"{'':<20}{'distinct':>10}{'shared':>10}   distinct - shared [95 %]"
    lines = [f"{policy}, {len(apart)} runs: means", head]
    for name, tell in rows.items():
        distinct, alike = (np.array([tell(course) for course in courses], float) for courses in (apart, shared))
        drawn = np.random.default_rng(0).integers(len(distinct), size=(2000, len(distinct)))
        low, high = np.percentile((distinct - alike)[drawn].mean(1), [2.5, 97.5])
        unit = " %" * (name == "runs that were done")
        difference = f"{(distinct - alike).mean():+.1f} [{low:+.1f}, {high:+.1f}]" if len(distinct) > 4 else ""
        lines.append(f"{name:<20}{f'{distinct.mean():.1f}{unit}':>10}{f'{alike.mean():.1f}{unit}':>10}   {difference}")
    return "\n".join(lines)


def draw(path: str, floor: SimulatedFloor, course: Course, policy: str) -> None:
    """The floor, what was seen (white), and the ways of a policy's robots, as a picture."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # late: robots need it not
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 9), dpi=100, layout="constrained")
    axes, (height, width) = figure.add_subplot(), floor.grid.shape
    shade = np.where(floor.grid != 0, 0.0, np.where(floor.seen, 1.0, 0.7))
    extent = (0.0, width * floor.cell, 0.0, height * floor.cell)
    axes.imshow(shade, cmap="gray", origin="lower", extent=extent, vmin=0.0, vmax=1.0)
    for robot in range(course.tracks.shape[1]):
        (line,) = axes.plot(*course.tracks[:, robot].T, linewidth=1.2, label=f"robot {robot}")
        axes.plot(*course.tracks[0, robot], "o", color=line.get_color())
        axes.plot(*course.tracks[-1, robot], "s", color=line.get_color())
    axes.legend(loc="upper right")
    axes.set_title(f"{policy}: {100 * course.share:.1f} % seen in {course.seconds:.0f} s; ways from dots to squares")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    FigureCanvasAgg(figure).print_png(path)


def read_words(words: list[str]) -> MeasureSettings | SimulateSettings:
    """The command line; ends with a sentence for what is out of its range, or a picture that cannot be written."""
    simulates = bool(words) and words[0] == "simulate"
    parser = argparse.ArgumentParser(
        prog="python -m maexp.agents.runtime" + " simulate" * simulates,
        description=simulate.__doc__ if simulates else __doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    kind = SimulateSettings if simulates else MeasureSettings
    add_settings(parser, kind)
    given = vars(parser.parse_args(words[simulates:]))
    try:
        for field in fields(kind):
            check_value(f"--{field.name}", given[field.name], kinds(kind)[field.name], field.metadata)
    except ValueError as error:
        parser.error(str(error))
    picture = Path(given.get("picture") or "x.png")
    if picture.suffix != ".png" or not picture.parent.is_dir():
        parser.error(f"--picture={picture} must be a .png file in a folder that is there")
    return kind(**given)


def add_settings(parser: argparse.ArgumentParser, kind: type) -> None:
    """An argument for each setting of a dataclass: a list stands by itself, the others are named."""
    for field in fields(kind):
        of, default = kinds(kind)[field.name][0], None if field.default is MISSING else field.default
        told = explain(field.metadata) + (f"; default: {default}" if default else "")
        if get_origin(of) is list:
            parser.add_argument(field.name, nargs="*", help=told)
        elif of is bool:
            parser.add_argument(f"--{field.name}", action="store_true", help=told)
        else:
            reads = {"type": float, "nargs": 2} if get_origin(of) is tuple else {"type": of}
            parser.add_argument(f"--{field.name}", default=default, help=told, **reads)


def main() -> None:
    """Do what the command line says; what cannot be done is one sentence."""
    given = read_words(sys.argv[1:])
    try:
        simulate(given) if isinstance(given, SimulateSettings) else measure(given)
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
