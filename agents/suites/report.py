"""A suite and its results as text: what is in it, a table, sentences; and a picture of the profiles."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from maexp.agents.evaluation.evidence import Evidence, describe_evidence, verdict
from maexp.agents.evaluation.plots import COLOURS, LOOK, save
from maexp.agents.suites.score import RANDOM, describe_score, score_cells
from maexp.agents.suites.suite import Part, Suite
from maexp.agents.tables import NONE, brackets, fixed, markdown_table, print_table
from maexp.envs.config import CommConfig
from maexp.envs.metrics import label_copies
from maexp.kernels.constants import DT

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
