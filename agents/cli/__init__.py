"""The command `maexp`: a verb, then Hydra overrides."""

import importlib
import os
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from maexp.agents.errors import STOPPED, UserError, describe_disk_error
from maexp.agents.memory import keep_freed_memory

BAD_INPUT, PIPE_CLOSED = 2, 141


@dataclass(frozen=True)
class Verb:
    """A verb: what it does, examples, bare arguments. The module of its name holds its `COMMAND`."""

    summary: str
    examples: tuple[str, ...]
    positional: tuple[str, ...] = ()
    actions: tuple[str, ...] = ()


@dataclass(frozen=True)
class Command:
    """What a verb does with its words.

    Attributes:
        run: (settings, folder, overrides) -> exit status
        check: raises UserError for settings that do not go together, before anything is written
        prepare: overrides -> `Recipe` of the settings; None: of these overrides
        folder: (overrides, claim) -> where it writes; None: `claim()`, a new folder of its own
    """

    run: Callable[[Any, Any, list[str]], int]
    check: Callable[[Any], None]
    prepare: Callable[[list[str]], Any] | None = None
    folder: Callable[[list[str], Callable[[], Path]], Path | None] | None = None


VERBS = {
    "train": Verb(
        "trains a team, then evaluates it beside the untrained one and planners",
        (
            "maexp train algorithm=mappo scenario=maze",
            "maexp train resume=outputs/DATE/RUN",
            "maexp train -m algorithm=ippo,mappo seed=0,1,2",
        ),
    ),
    "evaluate": Verb(
        "plays held-out episodes with a trained team or a classical policy",
        (
            "maexp evaluate checkpoint=RUN num_robots=1,2,6,8",
            "maexp evaluate checkpoint=RUN render=true render_envs=4",
            "maexp evaluate policy=universal,nearest_frontier scenario=maze",
            "maexp evaluate policy=cost_utility scenario.success_coverage=0.99 scenario.macro_steps=45",
        ),
    ),
    "benchmark": Verb(
        "compares algorithms and classical policies over scenarios and seeds, in one table; resumable",
        (
            "maexp benchmark preset=smoke",
            "maexp benchmark scenarios=maze,indoor_small algorithms=mappo policies=random",
            "maexp benchmark resume=outputs/DATE/RUN",
        ),
    ),
    "suite": Verb(
        "plays frozen worlds with any policy, one score beside random and a reference, and checks results of others",
        (
            "maexp suite list",
            "maexp suite show minival",
            "maexp suite run minival policy=universal",
            "maexp suite run minival policy=my_module:MyPlanner",
            "maexp suite verify FOLDER",
        ),
        ("task", "place"),
        ("list", "show", "run", "verify", "freeze"),
    ),
    "ros2": Verb(
        "serves a suite to robots' software over DDS, or drives a team of ROS 2, without ROS",
        ("maexp ros2 serve minival", "maexp ros2 team policy=universal robots=robot1,robot2,robot3"),
        ("task", "place"),
        ("serve", "team"),
    ),
    "leaderboard": Verb(
        "makes rows of runs of suites and draws a page of them that needs nothing but a browser",
        ("maexp leaderboard outputs/mine docs/leaderboard out=site",),
        ("places...",),
    ),
    "view": Verb(
        "shows a run, a recorded episode or a map in 3D: window, picture or browser",
        (
            "maexp view RUN",
            "maexp view RUN browser=true",
            "maexp view floor.yaml policy=nearest_frontier",
            "maexp view maze index=7",
        ),
        ("place",),
    ),
    "export": Verb(
        "writes the policy of a run as a folder for robots (maexp.agents.runtime)",
        ("maexp export RUN out=FOLDER", "maexp export RUN out=FOLDER results=EVALUATION,EVALUATION"),
        ("checkpoint",),
    ),
    "policies": Verb(
        "lists the trained policies that come with the package, and shows one",
        ("maexp policies list", "maexp policies show universal"),
        ("task", "name"),
        ("list", "show"),
    ),
    "maps": Verb(
        "lists, makes, imports, fetches, checks and draws maps",
        (
            "maexp maps list",
            "maexp maps make maze index=7",
            "maexp maps import floor.yaml",
            "maexp maps import FOLDER",
            "maexp maps fetch floors",
            "maexp maps check floor.yaml",
            "maexp maps show map.npz",
        ),
        ("task", "file"),
        ("list", "make", "import", "fetch", "check", "show"),
    ),
    "irsim": Verb(
        "plays a team in another simulator, ir-sim, with lidars and a map of its own, beside the same team in ours",
        (
            "maexp irsim floor.yaml policy=cost_utility",
            "maexp irsim floor.yaml range_noise=0.05 pose_noise=0.02 pose_drift=0.02 people=4",
        ),
        ("floor",),
    ),
    "bench": Verb(
        "measures throughput, as a table and JSON",
        (
            "maexp bench env scenario=maze num_robots=2,4",
            "maexp bench kernels radar.range=5,10 baseline=FILE",
            "maexp bench train model=small,paper",
            "maexp bench scale axes=envs,robots",
        ),
        ("task",),
        ("env", "kernels", "train", "scale"),
    ),
}


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit status: 0, 2 for bad input, 130 when interrupted."""
    words = list(sys.argv[1:] if argv is None else argv)
    warnings.showwarning = _show_warning
    keep_freed_memory()
    try:
        return _run(words)
    except UserError as error:
        if os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        print(f"maexp: {error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("maexp: interrupted.", file=sys.stderr)
        return STOPPED
    except BrokenPipeError:  # `maexp train --help | head`: the reader has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return PIPE_CLOSED
    except OSError as error:
        told = describe_disk_error(error)
        if told is None:
            raise
        print(f"maexp: {told}", file=sys.stderr)
        return BAD_INPUT


def _run(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help", "help"):
        print(overview())
        return 0
    if words[0] == "--version":
        from importlib import metadata

        print(f"maexp {metadata.version('maexp')}")
        return 0
    if words[0] not in VERBS:
        raise UserError(f"{words[0]!r} is not a verb: choose one of {', '.join(VERBS)}.")
    return run_verb(words[0], words[1:])


def overview() -> str:
    """What `maexp` alone prints."""
    lines = ["maexp: multi-robot exploration with reinforcement learning on point-cloud maps", ""]
    for name, verb in VERBS.items():
        lines += [f"  {name:<12}{verb.summary}", *(f"  {'':<12}  {example}" for example in verb.examples), ""]
    return "\n".join([*lines, "maexp VERB --help lists the settings and choices of a verb."])


def run_verb(name: str, words: list[str]) -> int:
    """Compose the settings of a verb, claim a folder and run it."""
    from maexp.agents.cli.run_folder import claim_folder, remove_if_empty
    from maexp.agents.cli.validate import check_sweep, check_words
    from maexp.agents.config.compose import compose
    from maexp.agents.config.overrides import find_override, make_overrides, split_flags, without
    from maexp.agents.config.resolved import describe_radius
    from maexp.agents.config.runs import Recipe

    verb = VERBS[name]
    flags, rest = split_flags(words)
    _check_flags(name, flags)
    if {"-h", "--help"} & set(flags):
        from maexp.agents.cli.help import verb_help

        print(verb_help(name, verb.summary, verb.examples))
        return 0
    multirun = bool({"-m", "--multirun"} & set(flags))
    _check_action(name, verb, rest)
    _check_working_folder()
    overrides = make_overrides(name, rest, verb.positional, multirun)
    if multirun:
        check_sweep(name, overrides)
        from maexp.agents.cli.sweep import run_sweep

        return run_sweep(name, overrides)
    composed = check_words(name, overrides)
    command: Command = importlib.import_module(f"maexp.agents.cli.{name}").COMMAND
    recipe = command.prepare(overrides) if command.prepare else Recipe(overrides)
    if composed is None or recipe != Recipe(overrides):  # the words belong to a run, or stand for others
        composed = compose(name, recipe)
    cfg = composed.settings
    if {"-c", "--cfg"} & set(flags):
        print_settings(cfg, name)
        return 0
    command.check(cfg)
    if told := describe_radius(cfg):
        print(told, flush=True)
    chosen = find_override(overrides, "hydra.run.dir") is not None
    claim = partial(claim_folder, composed.run_dir, chosen)
    folder = command.folder(overrides, claim) if command.folder else claim()
    try:
        return command.run(cfg, folder, without(recipe.words, "hydra", "resume", "checkpoint"))
    except UserError:
        remove_if_empty(folder)
        raise


def _check_working_folder() -> None:
    """Raise UserError where the folder that the command was started in is no more: runs and paths go by it."""
    try:
        os.getcwd()
    except OSError as error:
        raise UserError("the working folder was removed or cannot be entered: change to one that is there.") from error


def print_settings(cfg: Any, verb: str) -> None:
    """All settings of a verb with the values that they come to, as --cfg job asks for."""
    from maexp.agents.config.resolved import resolve, to_yaml
    from maexp.agents.errors import blame_input

    with blame_input():
        print(to_yaml(resolve(cfg), verb), end="")


def _check_flags(name: str, flags: list[str]) -> None:
    from maexp.agents.config.compose import SWEEPING

    allowed = {"-h", "--help", "-c", "--cfg", "job"}
    allowed |= {"-m", "--multirun"} if name in SWEEPING else set()
    for flag in flags:
        if flag not in allowed:
            known = ", ".join(sorted(word for word in allowed if word.startswith("--")))
            raise UserError(f"maexp {name} has no option {flag}: choose one of {known}.")


def _check_action(name: str, verb: Verb, rest: list[str]) -> None:
    if verb.actions and (not rest or rest[0] not in verb.actions):
        found = f"not {rest[0]!r}" if rest else "as in " + verb.examples[0]
        raise UserError(f"maexp {name} needs one of {', '.join(verb.actions)}, {found}.")


def _show_warning(message, category, filename, lineno, file=None, line=None) -> None:
    """Our own warnings as a sentence; those of libraries are for their authors."""
    if f"{os.sep}agents{os.sep}" in filename or f"{os.sep}envs{os.sep}" in filename:
        print(f"maexp: warning: {message}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
