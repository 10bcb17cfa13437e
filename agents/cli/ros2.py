"""`maexp ros2`: a suite for robots' software, or a team for our policies, over DDS."""

import importlib.util
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

from maexp.agents.benchmarks.suites.suite import load_suite, suite_names
from maexp.agents.cli import Command
from maexp.agents.cli.suite import claim_for, play, prepare_again
from maexp.agents.config.checks import as_list
from maexp.agents.config.runs import Recipe
from maexp.agents.config.verbs import Ros2Settings
from maexp.agents.deploy.planner.drivers import make_driver
from maexp.agents.deploy.planner.estimate import ESTIMATE
from maexp.agents.deploy.planner.team_driver import DriverSettings, check_name, read_settings
from maexp.agents.errors import UserError, blame_input

KEPT = ("place", "seed", "name")
"""Settings of a served suite that `resume` keeps."""
CHOICES = {
    "serve": {"tf": ("shared", "own"), "wait_for": ("all", "idle")},
    "team": {"goals": ("goal_pose", "navigate_to_pose")},
}


def prepare(overrides: list[str]) -> Recipe:
    """For resume=FOLDER: what that run served, then the new words."""
    return prepare_again(overrides, KEPT)


def folder(overrides: list[str], claim: Callable[[], Path]) -> Path | None:
    """A suite that is served has one, as `maexp suite run`."""
    return claim_for(overrides, claim, "serve")


def check(cfg: Ros2Settings) -> None:
    """Raise UserError for words that are missing or unknown, and where DDS is not installed."""
    if cfg.task == "serve":
        if not cfg.place:
            raise UserError(f"maexp ros2 serve needs a suite after it: {', '.join(suite_names())}.")
        load_suite(cfg.place)
        with blame_input():
            for robot in as_list(cfg.robots):
                check_name("robots", str(robot))
    elif cfg.place:
        raise UserError(f"maexp ros2 team takes no name: leave {cfg.place} out, and name the robots: robots=a,b,c.")
    elif not cfg.robots:
        raise UserError("No robots: name those of the team, as in maexp ros2 team robots=robot1,robot2,robot3.")
    for name, choices in CHOICES[cfg.task].items():
        if getattr(cfg, name) not in choices:
            raise UserError(f"{name}={getattr(cfg, name)} is unknown: choose {' or '.join(choices)}.")
    if importlib.util.find_spec("cyclonedds") is None:
        raise UserError('maexp ros2 speaks DDS by cyclonedds: pip install "maexp[ros2]".')
    from maexp.agents.deploy.ros2.dds import read_domain

    with blame_input():
        read_domain(cfg.domain)
        if cfg.task == "team":
            make_driver(driver_settings(cfg))


def driver_settings(cfg: Ros2Settings) -> DriverSettings:
    """Those of the team; what was not given is as `DriverSettings` has it."""
    values = {field.name: getattr(cfg, field.name) for field in fields(DriverSettings)}
    several = [field.name for field in fields(DriverSettings) if isinstance(field.default, tuple)]
    for name in several:
        values[name] = as_list(values[name])
        if name == "robot_radius" or (name == "offsets" and values[name] != list(ESTIMATE)):
            values[name] = [_number(name, value) for value in values[name]]
    return read_settings(values)


def _number(name: str, value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        raise UserError(f"{name}: {value!r} is no number.") from None


def run(cfg: Ros2Settings, where: Path | None, overrides: list[str]) -> int:
    """Do the task."""
    from maexp.agents.deploy.ros2.dds import Wire

    with blame_input():
        wire = Wire(cfg.domain)
    return _serve(cfg, where, wire) if cfg.task == "serve" else _team(cfg, wire)


def _serve(cfg: Ros2Settings, where: Path, wire: Any) -> int:
    from maexp.agents.deploy.ros2.serve import WORD, Ros2Player, Serving

    suite = load_suite(cfg.place)
    suite.check()
    names = tuple(str(robot) for robot in as_list(cfg.robots))
    serving = Serving(names, cfg.tf == "own", cfg.wait_for, cfg.stands, cfg.limit, cfg.answer, _tell)
    player = Ros2Player(cfg.name, wire, serving)
    settings = {name: getattr(cfg, name) for name in KEPT} | {"policy": WORD, "num_envs": 1, "decision_limit": None}
    try:
        return play(suite, player, where, settings, "cpu", "ros2 serve")
    finally:
        player.end()


def _team(cfg: Ros2Settings, wire: Any) -> int:
    from maexp.agents.deploy.ros2.robot import make_team

    course = make_team(make_driver(driver_settings(cfg)), wire, cfg.answer, _tell, cfg.goals).run()
    each = f", {1e3 * course.seconds / course.plans:.1f} ms of processor time each" if course.plans else ""
    print(f"{course.plans} decisions{each}; {course.episodes} episodes of an arena.")
    return 0


def _tell(sentence: str) -> None:
    print(sentence, flush=True)


COMMAND = Command(run, check, prepare=prepare, folder=folder)
