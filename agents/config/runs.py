"""What the settings of a verb are composed from: the values of a run, and the new words of the command line.

- A value of the run stays unless the new words set it.
- A group chosen anew (planner=wavefront where the run had dwa) is taken as a whole, as it is today.
- Values that the scenario had supplied follow a new scenario; those that the run's own words had set stay.
"""

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from maexp.agents.config.overrides import find_override, set_names, without
from maexp.agents.config.resolved import flatten
from maexp.agents.config.schema import default_values
from maexp.agents.config.verbs import SCHEMAS
from maexp.agents.errors import UserError
from maexp.conf import groups_of_choice, list_choices
from maexp.envs.config import BODY
from maexp.envs.config import GROUPS as ENV_GROUPS

ENV = ("scenario", *ENV_GROUPS)
GROUPS = (*ENV, "algorithm", "model")
PLAYED = (*ENV, "num_envs", "num_robots", "seed", "num_threads")
"""Settings that matter to who only plays."""
SHARED = ("num_robots", "seed")  # the other settings without a group mean something else to each verb
SUPPLIERS = {
    f"{group}.{setting.name}": f"scenario.{source}"
    for group, kind in ENV_GROUPS.items()
    for setting in fields(kind)
    if (source := setting.metadata.get("scenario"))
}
"""The settings of the scenario whose values others take; that of another name is called the same."""
WHEELBASE = ("robot.length", "robot.width", "robot.radius", "robot.team")  # what it follows
ROUND = tuple(f"robot.{name}" for name in BODY)  # follow a radius
HELD_OUT = ("scenario.held_out", "scenario.held_out_count")  # one of the two


@dataclass(frozen=True)
class Recipe:
    """What settings are composed from.

    Attributes:
        words: overrides in the order of the command line, those of a run first
        defaults: overrides in front of these, which are not the run's own words
        values: values of that run by their full names; they replace what the words come to
        source: the checkpoint they come from, for messages
    """

    words: list[str]
    defaults: list[str] = field(default_factory=list)
    values: dict[str, Any] = field(default_factory=dict)
    source: str = ""


def continue_run(path: Path, saved: dict, new: list[str], verb: str, *leave_out: str) -> Recipe:
    """The settings of a run of `maexp train` as far as `verb` has them, then the new words.

    Args:
        path, saved: the checkpoint and its content
        new: overrides of the command line
        leave_out: settings of the run that do not matter here
    """
    known = default_values(SCHEMAS[verb])
    values = {"algorithm.learn_share": 1.0} | flatten(saved["settings"])  # runs from before that was a setting
    for name in ("preset", "tuning"):
        if choice := find_override(new, name):
            raise UserError(
                f"{name}={choice} stands for many settings, and those of {path} are kept: name the ones to change."
            )
    foreign = [name for name in default_values(SCHEMAS["train"]) if name not in known]
    chosen = _chosen_anew(values, new)
    leave_out += ("preset", "tuning") * (verb != "train")
    if verb != "train" and "episodes=0" in saved["overrides"]:  # of a training alone: none
        leave_out += ("episodes",)
    left_out = [*foreign, *leave_out, *chosen, "hydra", "resume", "checkpoint"]
    left_out += ["scenario.local_steps"] * ("scenario.decision_seconds" in set_names(new))
    left_out += HELD_OUT if {*HELD_OUT} & {*set_names(new)} else ()
    said_anew = [name for name in set_names(new) if name not in GROUPS]  # the command to begin anew says it once
    kept, defaults = without(saved["overrides"], *left_out, *said_anew), []
    followed = "planner.clearance_factor" in saved["followers"] and values["planner.name"] == "dwa"
    if followed and "planner" not in chosen:  # the paper's DWA: of a new scenario, too, that scenario's clearance
        defaults.append("planner.clearance_factor=null")
    gone = {*left_out, *_gone_with_the_scenario(saved, values, new, verb)}
    if verb != "train":
        gone |= {name for name in values if name.partition(".")[0] not in (*GROUPS, *SHARED)}
    held = {
        name: value
        for name, value in values.items()
        if not gone & {name, name.partition(".")[0]} and not _is_set(name, new)
    }
    if "scenario.decision_seconds" not in set_names(new) and "scenario" not in chosen:
        held["scenario.decision_seconds"] = None  # the run's pace is in its local_steps, or in those of the new words
    return Recipe([*kept, *new], defaults, held, str(path))


def _is_set(name: str, words: list[str]) -> bool:
    return any(name == prefix or name.startswith(f"{prefix}.") for prefix in set_names(words) if prefix not in GROUPS)


def _chosen_anew(values: dict[str, Any], new: list[str]) -> list[str]:
    """The groups that the new words choose, and what the protocol of a new scenario sets; a scenario or planner that
    the run had already is no new choice."""
    had = {name: values.get(f"{name}.name") for name in ("scenario", "planner")}
    chosen = [name for name in set_names(new) if name in GROUPS and (had.get(name) or "") != find_override(new, name)]
    scenario = find_override(new, "scenario") if "scenario" in chosen else None
    return chosen + (groups_of_choice("scenario", scenario) if scenario in list_choices("scenario") else [])


def _gone_with_the_scenario(saved: dict, values: dict[str, Any], new: list[str], verb: str) -> list[str]:
    """The run's values that followed what the new words change."""
    followers, names = saved["followers"], set_names(new)
    place = find_override(new, "scenario.name") or find_override(new, "scenario") or values["scenario.name"]
    if place != values["scenario.name"] or "scenario.path" in names:
        return followers
    gone = [
        follower for follower in followers if SUPPLIERS.get(follower, f"scenario.{follower.partition('.')[2]}") in names
    ]
    if "scenario.decision_seconds" in names:
        gone += ["scenario.local_steps", "scenario.macro_steps"]
    gone += [follower for follower in ROUND if follower in followers and "robot.radius" in names]
    gone += ["robot.wheelbase"] * ("robot.wheelbase" in followers and bool({*WHEELBASE} & {*names}))
    if verb != "train" and "scenario.path" in values:  # each map that is played has its own length of an episode
        gone += ["scenario.macro_steps"] * ("scenario.macro_steps" in followers)
    return gone
