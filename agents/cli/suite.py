"""`maexp suite`: frozen worlds, one score, and results that others can check."""

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from maexp.agents.benchmarks.suites.suite import Suite, load_suite, suite_names
from maexp.agents.cli import Command
from maexp.agents.config.overrides import find_override
from maexp.agents.config.runs import Recipe
from maexp.agents.config.verbs import SuiteSettings
from maexp.agents.errors import STOPPED, UserError, blame_input, ended_by_signals
from maexp.agents.files import command, lock, short, write_text
from maexp.agents.progress import Progress

# What needs torch is imported where it is used: `list` and `show` answer at once.

KEPT = ("place", "policy", "name", "seed", "num_envs", "decision_limit")
"""Settings of a run that `resume` keeps."""
DIFFERENT = 1


def prepare(overrides: list[str]) -> Recipe:
    """For resume=FOLDER: what that run played, then the new words."""
    return prepare_again(overrides, KEPT)


def prepare_again(overrides: list[str], kept: tuple[str, ...]) -> Recipe:
    """The words, after the settings `kept` of the run that is gone on with, if one is."""
    place = find_override(overrides, "resume")
    if place is None:
        return Recipe(overrides)
    from maexp.agents.benchmarks.suites import run_files

    if changed := [name for name in (*kept, "hydra.run.dir") if find_override(overrides, name) is not None]:
        raise UserError(f"resume={place} keeps what was played and where: leave {changed[0]} out.")
    saved = run_files.read_json(Path(place).expanduser() / run_files.RUN)["settings"]
    if missing := [name for name in kept if name not in saved]:
        raise UserError(f"{place} is no run of this command (it has no {missing[0]}): resume it as it was begun.")
    return Recipe(overrides, values={name: saved[name] for name in kept}, source=place)


def folder(overrides: list[str], claim: Callable[[], Path]) -> Path | None:
    return claim_for(overrides, claim, "run")


def claim_for(overrides: list[str], claim: Callable[[], Path], task: str) -> Path | None:
    """`task` has a new folder, or that of the run that it goes on with; the other tasks write none."""
    place = find_override(overrides, "resume")
    if place is not None:
        return Path(place).expanduser().absolute()
    return claim() if find_override(overrides, "task") == task else None


def check(cfg: SuiteSettings) -> None:
    """Raise UserError for words that are missing."""
    if cfg.task == "list":
        if cfg.place:
            raise UserError(f"maexp suite list lists all and takes no name: leave {cfg.place} out.")
        return
    if not cfg.place:
        what = "the folder of a run" if cfg.task == "verify" else f"a name: {', '.join(suite_names())}"
        raise UserError(f"maexp suite {cfg.task} needs {what} after it.")
    if cfg.task != "verify":
        suite = load_suite(cfg.place)
    if cfg.task in ("run", "freeze"):
        for part in suite.parts.values():
            if part.fetched:
                part.check_fetched()
    if cfg.task == "run":
        if not cfg.policy:
            raise UserError("Nothing to run: give policy=NAME, as policy=universal.")


def run(cfg: SuiteSettings, where: Path | None, overrides: list[str]) -> int:
    """Do the task."""
    return {"list": _list, "show": _show, "run": _run, "verify": _verify, "freeze": _freeze}[cfg.task](cfg, where)


def _list(cfg: SuiteSettings, where: None) -> int:
    for name in suite_names():
        suite = load_suite(name)
        first = suite.path.read_text().splitlines()[0].removeprefix("#").strip()
        print(f"{name:<12}{first}; {len(suite.parts) * suite.episodes} episodes, checksum {suite.checksum[:16]}")
    return 0


def _show(cfg: SuiteSettings, where: None) -> int:
    from maexp.agents.benchmarks.suites import score

    print("\n".join(score.describe_suite(load_suite(cfg.place))))
    return 0


def _run(cfg: SuiteSettings, where: Path) -> int:
    from maexp.agents.benchmarks.suites.play import SuitePolicy

    suite = load_suite(cfg.place)
    suite.check()
    limit = suite.decision_limit if cfg.decision_limit is None else cfg.decision_limit
    player = SuitePolicy(cfg.policy, limit, cfg.patience, cfg.name)
    settings = {name: getattr(cfg, name) for name in KEPT} | {"decision_limit": limit}
    if player.hosted and not cfg.resume:
        settings["num_envs"] = min(cfg.num_envs, cfg.workers or player.most_teams)
    return play(suite, player, where, settings, cfg.device, "suite run")


def play(suite: Suite, player: Any, where: Path, settings: dict[str, Any], device: str, words: str) -> int:
    """Play a suite, or what is left of it, and say what came of it.

    Args:
        player: as `maexp.agents.benchmarks.suites.play.SuitePolicy`.
        settings: what a resumed run keeps, with `seed` and `num_envs`.
        words: that go on with it, as "suite run".
    """
    from maexp.agents.benchmarks.suites import run_files, score
    from maexp.agents.benchmarks.suites.run import SuiteRun
    from maexp.agents.build import pick_device

    seed = settings["seed"]
    with blame_input():
        device = pick_device(device)
    with lock(where, f"maexp {words.split()[0]}"):
        if (where / run_files.RUN).exists():
            _check_same_suite(where, suite)
        else:
            content = {"format": run_files.FORMAT, "suite": run_files.describe_suite(suite, seed), "settings": settings}
            write_text(where / run_files.RUN, run_files.dump(content) + "\n")
        try:
            total = len(suite.parts) * suite.episodes
            with ended_by_signals(), Progress(f"{player.name} on {suite.name}", total) as progress:
                playing = SuiteRun(
                    suite, player, where, seed, settings["num_envs"], device, progress.advance, progress.tell
                )
                results = playing.play()
        except KeyboardInterrupt:
            again = command(*words.split(), f"resume={short(where)}")
            print(f"maexp: stopped. Go on with: {again}", file=sys.stderr)
            return STOPPED
        score.print_results(suite, results)
        for sentence in score.describe_results(suite, results):
            print(sentence)
        score.draw_profiles(suite, results, where / "profile.png")
    print(f"Written to {short(where)}: {run_files.RESULTS}, {run_files.ACTIONS}/, profile.png, {run_files.RUN}")
    print(f"Next: {command('suite', 'verify', short(where))}")
    return 0


def _check_same_suite(where: Path, suite: Suite) -> None:
    from maexp.agents.benchmarks.suites import run_files

    before = run_files.read_json(where / run_files.RUN)["suite"]
    if before["checksum"] != suite.checksum:
        raise UserError(
            f"{short(where)} was begun with version {before['version']} of {suite.name} (checksum "
            f"{before['checksum'][:16]}, now {suite.checksum[:16]}): begin a new run."
        )


def _verify(cfg: SuiteSettings, where: None) -> int:
    """Print the report as JSON, and what it says in a sentence on stderr; 0: all follows, 1: not."""
    from maexp.agents.benchmarks.suites.verify import verify

    place = Path(cfg.place).expanduser()
    found = verify(place, cfg.suite)
    print(json.dumps(found, indent=2))
    if found["verified"]:
        print(f"maexp: every number of {cfg.place} follows from its actions.", file=sys.stderr)
        return 0
    first = found["differences"][0]
    print(
        f"maexp: {cfg.place} is not what it says: {first['file']}, {first['where']}; "
        f"{found['number_of_differences']} differences.",
        file=sys.stderr,
    )
    return DIFFERENT


def _freeze(cfg: SuiteSettings, where: None) -> int:
    from maexp.agents.benchmarks.suites import run_files, score
    from maexp.agents.benchmarks.suites.frozen import freeze

    suite = load_suite(cfg.place)
    made = run_files.describe_code() | {"machine": run_files.describe_machine(), "date": time.strftime("%Y-%m-%d")}
    with Progress(f"random and {suite.reference} on {suite.name}", 2 * len(suite.parts) * suite.episodes) as progress:
        with blame_input():
            frozen = freeze(suite, made, progress.advance)
    print("\n".join(score.describe_suite(frozen)))
    return 0


COMMAND = Command(run, check, prepare=prepare, folder=folder)
