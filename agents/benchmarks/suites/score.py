"""The score of a suite between `random` (0) and the reference planner (1), with intervals, as tables and plots."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from maexp.agents.benchmarks.report import improvement
from maexp.agents.benchmarks.suites.suite import SCORE, Part, Suite
from maexp.agents.evaluation.evaluate import EvaluationResult
from maexp.agents.evaluation.metric_format import Evidence, describe_evidence, verdict
from maexp.agents.evaluation.plots import COLOURS, LOOK, save
from maexp.agents.tables import NONE, POINTS, brackets, estimate, fixed, markdown_table, print_table
from maexp.envs.config import CommConfig
from maexp.envs.metrics import LEAST_DISTINCT, label_copies, resample_weights, resampled_means
from maexp.kernels.constants import DT

Results = dict[str, EvaluationResult]  # part -> its episodes
RANDOM = "random"
SCORED = {
    "coverage_auc": "the share of the place that the team has seen",
    "base_coverage_auc": "the share of the place that the base station knows",
    "worst_coverage_auc": "the share of the place that the robot knows that knows least",
}
"""What scores are in words."""
LEVELS = 101  # of a performance profile, from 0 to 1


def to_result(suite: Suite, policy: str, part: str, episodes: dict[str, np.ndarray], maps: Any) -> EvaluationResult:
    """The episodes of a part: each metric's values [episodes], and `SCORE` where parts have different scores."""
    own = {SCORE: episodes[suite.scores[part]]} if suite.score == SCORE else {}
    return EvaluationResult(policy, suite.parts[part].num_robots, episodes | own, 0.0, maps)


def describe_score(scores: dict[str, str]) -> str:
    """What is scored, of the metric of each part: "mean coverage_auc, the share of ... seen, on average over time"."""
    parts: dict[str, list[str]] = {}
    for part, metric in scores.items():
        parts.setdefault(metric, []).append(part)
    told = [f"{metric}, {SCORED[metric]}" if metric in SCORED else metric for metric in parts]
    if len(parts) > 1:
        told = [f"{metric} ({', '.join(names)})" for metric, names in zip(told, parts.values(), strict=True)]
    return f"mean {'; '.join(told)}{', on average over the time' * any(metric in SCORED for metric in parts)}"


def summarise_suite(suite: Suite, mine: Results, frozen: dict[str, Results]) -> dict[str, Any]:
    """All that follows from the episodes of a policy.

    Args:
        mine: its episodes
        frozen: those of `random` and of the reference planner, by name
    """
    name, theirs, worst = suite.score, frozen[suite.reference], frozen[RANDOM]
    own, zero, reference = (_values(name, results) for results in (mine, worst, theirs))
    ends = {part: (zero[part].mean(), reference[part].mean()) for part in own}
    overall = mean_over_parts(own, mine)
    copies = tuple({part: result.copies() for part, result in results.items()} for results in (mine, theirs))
    return {
        "score": overall | {"normalised": place_between(overall["mean"], mean_of(zero), mean_of(reference))},
        "parts": {
            part: result.summary() | {"normalised": place_between(own[part].mean(), *ends[part])}
            for part, result in mine.items()
        },
        RANDOM: {"score": mean_of(zero), "parts": {part: float(scores.mean()) for part, scores in zero.items()}},
        "reference": {
            "policy": suite.reference,
            "score": mean_of(reference),
            "parts": {part: float(values.mean()) for part, values in reference.items()},
            "difference": {metric: subtract(mine, theirs, metric) for metric in dict.fromkeys((*suite.metrics, name))},
            "differences": {part: result.minus(theirs[part])[name] for part, result in mine.items()},
            "improvement": improvement(own, reference, copies),
        },
        "profile": {
            name: np.linspace(0.0, 1.0, LEVELS).round(3).tolist(),
            "policy": profile(own),
            RANDOM: profile(zero),
            "reference": profile(reference),
        },
    }


def mean_of(values: dict[str, np.ndarray]) -> float:
    """Mean over parts of the means of their episodes."""
    return float(np.mean([value.mean() for value in values.values()]))


def mean_over_parts(values: dict[str, np.ndarray], *results: Results) -> dict[str, Any]:
    """{mean, ci95, n} of values [episodes] of each part; NaN where an episode has none.

    Args:
        values: part -> a value for each episode
        results: what they are of: one's episodes, or those of two that played the same
    """
    kept = {part: ~np.isnan(value) for part, value in values.items()}
    have = {part: value for part, value in values.items() if kept[part].any()}
    if not have:
        return {"mean": np.nan, "ci95": [np.nan, np.nan], "n": 0}
    means, distinct = [], 0
    for number, (part, value) in enumerate(have.items()):
        first, *others = (played[part] for played in results)
        copies = first.copies(*others)
        distinct += len(np.unique(copies[kept[part]]))
        weights = resample_weights(first.maps, copies=copies, seed=number)[:, kept[part]]
        drawn = resampled_means(value[kept[part]], weights)
        means.append(np.resize(drawn, len(weights)))  # a resample without any value is left out: others stand for it
    ends = np.percentile(np.mean(means, axis=0), [2.5, 97.5])
    ends = ends.tolist() if distinct >= LEAST_DISTINCT else [np.nan, np.nan]
    middle = mean_of({part: value[kept[part]] for part, value in have.items()})
    return {"mean": middle, "ci95": ends, "n": int(sum(value.sum() for value in kept.values()))}


def subtract(mine: Results, theirs: Results, metric: str) -> dict[str, Any]:
    """`mean_over_parts` of the paired differences."""
    pairs = {part: result.episodes[metric] - theirs[part].episodes[metric] for part, result in mine.items()}
    return mean_over_parts(pairs, mine, theirs)


def place_between(value: float, zero: float, reference: float) -> float | None:
    """Where a score lies between that of `random` (0) and that of the reference (1); None where these are the same."""
    return None if reference == zero else float((value - zero) / (reference - zero))


def profile(values: dict[str, np.ndarray]) -> list[float]:
    """Performance profile (Agarwal et al. 2021): the share of episodes above each level, every part counting alike."""
    levels = np.linspace(0.0, 1.0, LEVELS)
    shares = [(value[:, None] > levels).mean(0) for value in values.values()]
    return np.mean(shares, axis=0).round(6).tolist()


def _values(metric: str, results: Results) -> dict[str, np.ndarray]:
    return {part: result.episodes[metric] for part, result in results.items()}


def score_cells(
    score: dict[str, Any], normalised: float | None, less: dict[str, Any], ends: tuple[float, ...] = ()
) -> list[str]:
    """What tables show of a score {mean, ci95, n}: with `ends`, the scores of `random` and the reference, before where
    it lies between them, and `less`, in points how far it is from the reference."""
    share, between = fixed(3), NONE if normalised is None else fixed(2)(normalised)
    interval = brackets(score, share).strip() or NONE
    return [share(score["mean"]), interval, *map(share, ends), between, estimate(less, POINTS)]


COLUMNS = ("part", "score", "95 % interval", RANDOM, "reference", "between", "less reference", "95 % at", "lost")


def describe_suite(suite: Suite) -> list[str]:
    """What `maexp suite show` prints."""
    scores = suite.frozen.get("scores", {})
    told = ", ".join(f"{name} {values['score']:.4f}" for name, values in scores.items())
    lines = [
        f"{suite.name}, version {suite.version}, checksum {suite.checksum[:16]}",
        f"score: {describe_score(suite.scores)}",
        f"{suite.episodes} episodes of each of {len(suite.parts)} parts",
        f"frozen scores: {told or 'none yet'} (0 and 1 of the normalised score)",
    ]
    heads, rows = ["part", "maps", "robots", "radar [m]", "starts", "episode [s]"], []
    radios = {name: _describe_radios(part) for name, part in suite.parts.items()}
    heads += ["radios", "ends an episode"] * any(radios.values())
    for name, part in suite.parts.items():
        maps = f"{part.scenario} {part.first} to {part.first + part.count - 1}"
        if part.fetched:
            maps = f"{part.fetched}: {', '.join(part.map_names())}"
        robots = f"{part.num_robots} {part.robot['kind']}, {part.robot['max_speed']:g} m/s"
        seconds = f"{DT * part.limit:g}, a decision every {DT * part.local_steps:g}"
        rows.append([name, maps, robots, f"{part.radar['range']:g}", part.starts, seconds])
        rows[-1] += [radios[name] or "everyone", f"{part.success_coverage:.0%} of {part.done}"] * any(radios.values())
    return [*lines, "", *markdown_table(heads, rows), "", *_describe_sources(suite), f"File: {suite.path}"]


def _describe_radios(part: Part) -> str:
    """What limits them, as settings; "" where everyone hears everyone."""
    usual = CommConfig()
    return ", ".join(f"{name}={value}" for name, value in part.comm.items() if value != getattr(usual, name))


def _describe_sources(suite: Suite) -> list[str]:
    """Whose published maps it plays, with their licences."""
    sets = {part.map_set.name: part for part in suite.parts.values() if part.fetched}
    lines = []
    for part in sets.values():
        sources = ", ".join({f"{floor.source} ({floor.licence})": None for floor in part.floors})
        lines.append(f"Maps to fetch, {part.map_set.fetch}: {sources}")
    return lines


def print_results(suite: Suite, results: dict[str, Any]) -> None:
    """A row for each part and one for all."""
    title = f"{results['policy']} on {suite.name}, version {suite.version}, checksum {suite.checksum[:16]}"
    reference, zero, name = results["reference"], results[RANDOM], suite.score
    cells = []
    for part, figures in results["parts"].items():
        ends = (zero["parts"][part], reference["parts"][part])
        score = score_cells(figures[name], figures["normalised"], reference["differences"][part], ends)
        cells.append([part, *score, *_more(figures)])
    score, ends = results["score"], (zero["score"], reference["score"])
    cells.append(["all", *score_cells(score, score["normalised"], reference["difference"][name], ends), "", ""])
    print_table(title, COLUMNS, cells)


def _more(part: dict) -> list[str]:
    steps = part.get("coverage_step_95", {"n": 0})
    when = f"{DT * steps['mean']:.1f} s ({steps['n']})" if steps["n"] else NONE
    return [when, f"{part['collisions']['mean']:.2f}" if "collisions" in part else ""]


def describe_results(suite: Suite, results: dict[str, Any]) -> list[str]:
    """Sentences below the table."""
    found, better = results["reference"]["difference"][suite.score], results["reference"]["improvement"]
    points = fixed(2, 100.0, "+")
    lines = [
        f"{results['policy']} {verdict(found)} the reference, {suite.reference} as it was frozen: "
        f"{points(found['mean'])} points of {suite.score}{brackets(found, points)} in the same episodes. An "
        f"episode of its is better than one of the reference with probability {better['mean']:.2f}.",
    ]
    lines += describe_evidence([_evidence(suite, results)])
    if results["decisions"]["count"]:
        spent = results["decisions"]
        lines.append(
            f"Processor time of the policy: {1000 * spent['mean_seconds']:.1f} ms a decision of a team, "
            f"at most {1000 * spent['largest_seconds']:.0f} ms; no part of the score."
        )
    lost = {part: rows["lost"] for part, rows in results["episodes"].items() if rows["lost"]}
    for part, reasons in lost.items():
        number, reason = next(iter(reasons.items()))
        lines.append(f"{part}: {len(reasons)} of {suite.episodes} episodes ended early, {number} first: {reason}.")
    if not results["suite"]["frozen_maps"]:
        others = "starts" if all(part.fetched for part in suite.parts.values()) else "maps and starts"
        lines.append(f"Other {others}, of seed {results['suite']['seed']}: not the score of {suite.name}.")
    return lines


def _evidence(suite: Suite, results: dict[str, Any]) -> Evidence:
    """What the figures of all parts rest on."""
    parts = results["episodes"].values()
    metrics = [{name: np.array(rows[name], dtype=np.float64) for name in suite.metrics} for rows in parts]
    copies = [label_copies(np.array(rows["map"]), own) for rows, own in zip(parts, metrics, strict=True)]
    distinct, maps = sum(len(np.unique(copy)) for copy in copies), {place for rows in parts for place in rows["map"]}
    return Evidence(results["policy"], sum(map(len, copies)), distinct, len(maps))


def draw_profiles(suite: Suite, results: dict[str, Any], path: Path) -> Path:
    """How many episodes are above each level of the score: the policy, the reference and random."""
    names = {"policy": results["policy"], "reference": f"{suite.reference} (reference)", RANDOM: RANDOM}
    with rc_context(LOOK):
        figure = Figure(figsize=(6.4, 4.0), layout="constrained")
        ax = figure.subplots()
        for number, (key, name) in enumerate(names.items()):
            profile = results["profile"]
            ax.plot(profile[suite.score], profile[key], color=COLOURS[number], label=name)
        ax.set_xlabel(suite.score)
        ax.set_ylabel("share of episodes above")
        ax.set_title(f"{suite.name}, version {suite.version}", loc="left")
        ax.legend()
        return save(figure, path)
