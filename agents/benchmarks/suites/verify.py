"""Whether the numbers of a run follow from its actions: everything that can be computed again is, and compared."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from maexp.agents.benchmarks.suites import run_files
from maexp.agents.benchmarks.suites.frozen import check_maps, play_rivals, read_frozen, sums
from maexp.agents.benchmarks.suites.play import Batch, build_maps, build_replay, replay_batch
from maexp.agents.benchmarks.suites.score import summarise_suite
from maexp.agents.benchmarks.suites.suite import Suite, load_suite
from maexp.agents.errors import UserError
from maexp.agents.map_sets import MapsError

CLOSE = 1e-9  # numbers computed from metrics may differ by so much where libraries add up in another order
FEW = 20  # differences that are listed


class Findings(list):
    """What differs: {file, where, stated, found}."""

    def add(self, file: str, where: str, stated: Any = None, found: Any = None) -> None:
        self.append({"file": file, "where": where, "stated": stated, "found": found})


def verify(where: Path, file: str | None = None, advance: Callable[[int], None] = lambda count: None) -> dict[str, Any]:
    """The report on a folder: {verified, suite, policy, same_platform, differences, ...}.

    Args:
        file: of its suite, where that does not come with the package
        advance: called with the number of episodes that were played again

    Raises:
        UserError: there is no folder; MapsError: maps that were fetched are missing or others.
    """
    if not where.is_dir():
        raise UserError(f"{where} is no folder: give one that maexp suite run wrote.")
    found = Findings()
    report: dict[str, Any] = {"folder": str(where)}
    try:
        stated = run_files.read_json(where / run_files.RESULTS)
        suite = load_suite(file or str(stated["suite"]["name"]))
        report |= {name: stated[name] for name in ("suite", "policy")}
        same = {name: stated["run"]["machine"][name] for name in ("platform", "processor")}
        now = run_files.describe_machine()
        report["same_platform"] = all(now[name] == value for name, value in same.items())
        report["same_versions"] = run_files.describe_code()["versions"] == stated["run"]["versions"]
        if _same_suite(suite, stated["suite"], found):
            _check_files(where, stated["files"], found)
            _check_numbers(where, suite, stated, found, advance)
    except MapsError:
        raise  # that says nothing about the folder
    except UserError as error:
        found.add(run_files.RESULTS, str(error))
    except (KeyError, TypeError, AttributeError, ValueError, OverflowError) as error:
        found.add(run_files.RESULTS, f"an entry is missing or of another kind ({type(error).__name__}: {error})")
    return report | {"verified": not found, "differences": list(found[:FEW]), "number_of_differences": len(found)}


def _same_suite(suite: Suite, stated: dict, found: Findings) -> bool:
    suite.check()
    now = run_files.describe_suite(suite, None)
    for name in ("version", "checksum"):
        if stated[name] != now[name]:
            why = f"suite.{name}: played with another version of {suite.name}"
            found.add(run_files.RESULTS, why, stated[name], now[name])
            return False
    if stated["frozen_maps"] and stated["seed"] != suite.seed:
        found.add(run_files.RESULTS, "suite.seed", stated["seed"], suite.seed)
    return True


def _check_files(where: Path, stated: dict[str, str], found: Findings) -> None:
    """Every file is there and as it was written, and no other."""
    there = run_files.list_files(where)
    for name in sorted({*stated, *there}):
        if stated.get(name) != there.get(name):
            told = "the file was changed" if name in stated and name in there else "the file is not in both"
            found.add(name, f"SHA-256: {told}", stated.get(name), there.get(name))


def _check_numbers(where: Path, suite: Suite, stated: dict, found: Findings, advance: Callable) -> None:
    """Plays every episode again and compares all that follows."""
    seed = None if stated["suite"]["frozen_maps"] else int(stated["suite"]["seed"])
    batches: dict[str, list[Batch]] = {}
    for name in suite.parts:
        batches[name] = _replay_part(where, suite, name, seed, stated, found, advance)
    if not all(sum(len(batch.decisions) for batch in several) == suite.episodes for several in batches.values()):
        return  # what is missing has been named, and no score follows from the rest
    played = {_name_of(where, part, batch) for part, several in batches.items() for batch in several}
    for name in stated["files"]:
        if name not in played:
            found.add(name, "no episode of the suite is in it")
    compare(found, run_files.RESULTS, "episodes", stated["episodes"], run_files.describe_episodes(suite, batches), 0.0)
    rivals = read_frozen(suite) if seed is None else play_rivals(suite, seed)["results"]
    summary = summarise_suite(suite, run_files.to_results(stated["policy"], suite, batches), rivals)
    summary["decisions"] = run_files.describe_decisions(batches)
    for key, value in summary.items():
        compare(found, run_files.RESULTS, key, stated[key], value, CLOSE)


def _replay_part(
    where: Path, suite: Suite, name: str, seed: int | None, stated: dict, found: Findings, advance: Callable
) -> list[Batch]:
    part = suite.parts[name]
    maps = build_maps(part, seed)
    if seed is None or part.fetched:
        check_maps(suite, part, maps)
    compare(found, run_files.RESULTS, f"maps.{name}", stated["maps"][name], sums(part, maps, seed), 0.0)
    played, first, env = [], 0, None
    while first < suite.episodes:
        try:
            noted = run_files.read_batch(where, suite, name, first)
        except UserError as error:
            found.add(str(run_files.batch_file(where, name, first).relative_to(where)), str(error))
            return played
        count = len(noted.decisions)
        if first + count > suite.episodes:
            found.add(_name_of(where, name, noted), f"it holds episodes after the last, {suite.episodes - 1}")
            return played
        if env is None or env.num_envs < count:
            env = build_replay(part, maps, count, suite.key(seed))
        again = replay_batch(suite, env, noted)
        again.reasons, again.seconds = noted.reasons, noted.seconds
        _compare_batches(where, noted, again, name, found)
        played.append(again)
        first += count
        advance(count)
    return played


def _name_of(where: Path, part: str, batch: Batch) -> str:
    """The file of a batch, as `results.json` names it."""
    return str(run_files.batch_file(where, part, batch.first).relative_to(where))


def _compare_batches(where: Path, noted: Batch, again: Batch, part: str, found: Findings) -> None:
    """Bit for bit: what the file of actions says came of them, and what did."""
    file = _name_of(where, part, noted)
    pairs = {"decisions": (noted.decisions, again.decisions), "map": (noted.maps, again.maps)}
    pairs |= {name: (values, again.metrics[name]) for name, values in noted.metrics.items()}
    for name, (stated, computed) in pairs.items():
        same = (stated == computed) | ((stated != stated) & (computed != computed))  # NaN: an episode has no value
        for k in np.flatnonzero(~same):
            found.add(file, f"episode {noted.first + int(k)}: {name}", stated[k].item(), computed[k].item())


def compare(found: Findings, file: str, where: str, stated: Any, computed: Any, close: float) -> None:
    """Adds every entry in which two contents of a JSON file differ."""
    if isinstance(computed, dict):
        names = [*computed, *(name for name in stated if name not in computed)] if isinstance(stated, dict) else []
        if not isinstance(stated, dict):
            found.add(file, where, stated, "several entries")
        for name in names:
            compare(found, file, f"{where}.{name}", stated.get(str(name)), computed.get(name), close)
    elif isinstance(computed, list | tuple):
        if not isinstance(stated, list) or len(stated) != len(computed):
            found.add(file, where, f"{len(stated) if isinstance(stated, list) else stated}", f"{len(computed)} values")
        else:
            for k, pair in enumerate(zip(stated, computed, strict=True)):
                compare(found, file, f"{where}[{k}]", *pair, close)
    elif not _alike(stated, computed, close):
        found.add(file, where, stated, computed)


def _alike(stated: Any, computed: Any, close: float) -> bool:
    if isinstance(computed, float) and not math.isfinite(computed):
        return stated is None
    if isinstance(computed, float) and type(stated) in (int, float):
        return stated == computed or abs(stated - computed) <= close
    return stated == computed
