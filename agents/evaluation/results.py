"""What a run found: summary.json and results.json, and the table on the terminal."""

from collections.abc import Callable
from importlib import metadata
from pathlib import Path

import numpy as np

from maexp.agents.config.verbs import EpisodeSettings
from maexp.agents.evaluation.evaluate import EvaluationResult
from maexp.agents.evaluation.metric_format import MEASURES, describe_evidence
from maexp.agents.files import write_json
from maexp.agents.tables import NONE, estimate, print_table, reached
from maexp.agents.versions import PACKAGES, find_commit
from maexp.envs.metrics import LEAST_DISTINCT, in_reach, resample_weights, resampled_means

BASE, CEILING = "cost_utility", "clairvoyant"
"""The planner that leads are measured from, and the reference whose lead is the headroom."""


def headroom_shares(results: list[EvaluationResult], names: list[str]) -> dict[str, dict]:
    """The lead over `BASE` in coverage over time as a share of the lead of `CEILING`, on the same episodes.

    Args:
        results: of all policies.
        names: what each is called.

    Returns:
        {name: {mean, ci95: [low, high], n}} of the others, where both were played in the same place with a team of the
        same size and `CEILING` is ahead in all resamples of maps and of at least `LEAST_DISTINCT` distinct episodes.
    """
    groups: dict[tuple, list[tuple[str, EvaluationResult]]] = {}
    for name, result in zip(names, results, strict=True):
        groups.setdefault((result.place, result.num_robots), []).append((name, result))
    found = {}
    for group in groups.values():
        known = {result.policy: result for _, result in group}
        if BASE in known and CEILING in known:
            others = {name: result for name, result in group if result.policy not in (BASE, CEILING)}
            found |= _shares(others, known[BASE], known[CEILING])
    return found


def describe_shares(results: list[EvaluationResult], names: list[str]) -> list[str]:
    """A sentence for each share."""
    sentences = []
    for name, figures in headroom_shares(results, names).items():
        mean, low, high = (f"{100 * share:.0f}" for share in (figures["mean"], *figures["ci95"]))
        lead = f"the lead of {CEILING} over {BASE} in coverage over time"
        sentences.append(f"{name} wins {mean} % [{low}, {high}] of the headroom, {lead}.")
    return sentences


def _shares(others: dict[str, EvaluationResult], base: EvaluationResult, ceiling: EvaluationResult) -> dict[str, dict]:
    headroom, found = _lead(ceiling, base), {}
    for name, result in others.items():
        copies = base.copies(ceiling, result)
        weights = resample_weights(base.maps, copies=copies)
        drawn = resampled_means(headroom, weights)
        if headroom.mean() <= 0.0 or drawn.min() <= 0.0 or len(np.unique(copies)) < LEAST_DISTINCT:
            continue
        lead = _lead(result, base)
        low, high = np.percentile(resampled_means(lead, weights) / drawn, [2.5, 97.5])
        found[name] = {"mean": float(lead.mean() / headroom.mean()), "ci95": [float(low), float(high)], "n": len(lead)}
    return found


def _lead(result: EvaluationResult, base: EvaluationResult) -> np.ndarray:
    return result.episodes["coverage_auc"] - base.episodes["coverage_auc"]


FORMAT = "maexp-results-1"
COLUMNS = (
    "exploration_ratio",
    "coverage_auc",
    "coverage_step_85",
    "coverage_step_95",
    "coverage_step_95_censored",
    "coverage_step_99",
    "coverage_step_99_censored",
    "mutual_overlap_85",
    "success_rate",
    "collisions",
    "path_length",
    "base_coverage_auc",
    "worst_coverage_auc",
)
"""Metrics of the table."""


def describe_run(cfg: EpisodeSettings, maps: list, seconds: float) -> dict:
    """What was run: scenario, maps, seed, episodes, the coverage that ends one, commit, versions, seconds."""
    return {
        "format": FORMAT,
        "scenario": cfg.scenario.name,
        "maps": [world.name for world in maps],
        "seed": cfg.seed,
        "episodes": cfg.episodes,
        "success_coverage": cfg.scenario.success_coverage,
        "commit": find_commit(),
        "versions": {name: metadata.version(name) for name in PACKAGES},
        "seconds": round(seconds, 2),
    }


def result_names(results: list[EvaluationResult]) -> list[str]:
    """A name per result: the policy, with the map and the team's size where several of them were played."""
    several = len({result.num_robots for result in results}) > 1
    places = [f" on {result.place}" if result.place else "" for result in results]
    sizes = [f" N={result.num_robots}" if several else "" for result in results]
    return [f"{result.policy}{place}{size}" for result, place, size in zip(results, places, sizes, strict=True)]


def paired_differences(results: list[EvaluationResult]) -> dict[str, dict]:
    """{a: {b: {metric: {mean, std, ci95, n}}}} of a - b on the same episodes, for every learned a and all others."""
    named = list(zip(result_names(results), results, strict=True))

    def others(result: EvaluationResult) -> list[tuple[str, EvaluationResult]]:
        alike = (result.place, result.num_robots)
        return [
            (name, other) for name, other in named if other is not result and (other.place, other.num_robots) == alike
        ]

    learned = {
        name: {rival: result.minus(other) for rival, other in others(result)}
        for name, result in named
        if result.learned
    }
    return {name: found for name, found in learned.items() if found}


def write_results(path: Path, results: list[EvaluationResult], run: dict) -> None:
    """{policy: {metric: {mean, std, ci95, n}}}; `difference`: the same of the learned ones less each other; `run`: what
    was run; `headroom_share`: leads by that of `clairvoyant` (`headroom`)."""
    names = result_names(results)
    named = {name: result.summary() for name, result in zip(names, results, strict=True)}
    shares = headroom_shares(results, names)
    named |= {"difference": found} if (found := paired_differences(results)) else {}
    named |= {"headroom_share": shares} if shares else {}
    named["run"] = run | {
        "num_robots": sorted({result.num_robots for result in results}),
        "distinct_episodes": {name: result.evidence.distinct for name, result in zip(names, results, strict=True)},
    }
    write_json(path, named)


def print_results(results: list[EvaluationResult], title: str) -> None:
    """`print_summaries` of results; below it what they rest on, where it is little."""
    rows = [(name, result.summary()) for name, result in zip(result_names(results), results, strict=True)]
    print_summaries(title, rows, results[0].success_coverage)
    whole = [result for result in results if not result.place]
    named = zip(result_names(whole), whole, strict=True)
    evidence = [result.evidence._replace(policy=name) for name, result in named]
    shares = describe_shares(whole, result_names(whole))
    for sentence in [*describe_evidence(evidence), *describe_starts(whole), *shares]:
        print(sentence)


def describe_starts(results: list[EvaluationResult]) -> list[str]:
    """A sentence for each team size of which some see enough of the map where they start: nothing was left to do."""
    sentences = []
    for result in {result.num_robots: result for result in results if result.coverage is not None}.values():
        over = int((result.coverage[:, 0] >= result.success_coverage).sum())
        if over:
            team = f"{result.num_robots} robots" if result.num_robots > 1 else "the robot"
            episodes, goal = len(result.coverage), f"{100 * result.success_coverage:g} %"
            sentences.append(
                f"In {over} of {episodes} episodes {team} saw {goal} of the map from the start: they say nothing of a "
                "policy. Take a larger map, fewer robots or a smaller radar.range."
            )
    return sentences


def print_summaries(
    title: str, rows: list[tuple[str, dict]], goal: float, more: dict[str, Callable[[dict], str]] | None = None
) -> None:
    """The table of the main metrics: mean, 95 % interval of coverage, how many episodes got there.

    Args:
        rows: a name, and {metric: {mean, std, ci95, n}}.
        goal: the coverage that ends an episode.
        more: further columns, and what of a row stands in each.
    """
    more = more or {}
    columns = find_columns(rows, goal)
    cells = []
    for name, summary in rows:
        total = summary["exploration_ratio"]["n"]
        metrics = (_cell(metric, summary[metric], total) for metric in columns)
        cells.append([name, *(tell(summary) for tell in more.values()), *metrics])
    print_table(title, ["policy", *more, *(MEASURES[metric].column for metric in columns)], cells)


def find_columns(rows: list[tuple[str, dict]], goal: float) -> list[str]:
    """Those of `COLUMNS` that rows have and that episodes which end at `goal` tell something about."""
    return [name for name in COLUMNS if in_reach(name, goal) and all(name in summary for _, summary in rows)]


def _cell(metric: str, value: dict, total: int) -> str:
    if not value["n"]:
        return f"{NONE} {reached(value, total)}"
    write = MEASURES[metric].plain
    if metric == "exploration_ratio":
        return estimate(value, write)
    text = write(value["mean"])
    return text if value["n"] == total else f"{text} {reached(value, total)}"
