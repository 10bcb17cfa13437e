"""What a run found: summary.json and results.json, and the table on the terminal."""

from collections.abc import Callable
from importlib import metadata
from pathlib import Path

from maexp.agents.evaluation.evaluate import EvaluationResult
from maexp.agents.evaluation.evidence import describe_evidence
from maexp.agents.evaluation.headroom import describe_shares, headroom_shares
from maexp.agents.files import write_json
from maexp.agents.measures import MEASURES
from maexp.agents.settings.verbs import EpisodeSettings
from maexp.agents.tables import NONE, estimate, print_table, reached
from maexp.agents.versions import PACKAGES, find_commit
from maexp.envs.metrics import in_reach

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
