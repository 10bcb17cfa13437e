"""The leaderboard: entries from runs of suites, as Markdown tables and as one page for a browser."""

import base64
import html
import json
import re
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from maexp.agents.benchmarks.report import improvement
from maexp.agents.benchmarks.suites import run_files
from maexp.agents.benchmarks.suites.play import Replay, build_maps, build_replay
from maexp.agents.benchmarks.suites.score import describe_score, profile, score_cells
from maexp.agents.benchmarks.suites.suite import Suite, load_suite
from maexp.agents.benchmarks.suites.verify import verify
from maexp.agents.errors import UserError
from maexp.agents.evaluation.plots import COLOURS
from maexp.agents.evaluation.video import play_teams
from maexp.agents.files import short, without_nan, write_text
from maexp.agents.tables import markdown_table
from maexp.envs.metrics import label_copies
from maexp.envs.render.episode import Episode
from maexp.kernels.constants import DT

FORMAT = "maexp-leaderboard-row-1"
KEPT = ("suite", "policy", "score", "random", "reference", "decisions", "run")
SHOWN = ("coverage_step_95", "collisions")  # metrics of a part beside the score
FRAMES, CELLS = 60, 96  # of a film, and cells of its picture on the longer side
EACH = "*"  # in SHAPE: every entry
NUMBER = int | float
MEAN = {"mean": NUMBER | None, "ci95": [NUMBER | None], "n": int}
SHAPE = {
    "format": str,
    "verified": bool,
    "metric": str,
    "policy": str,
    "decisions": dict,
    "run": {"commit": str | None, "versions": dict},
    "suite": {"name": str, "version": int, "checksum": str},
    "score": MEAN | {"mean": NUMBER, "normalised": NUMBER | None},
    "random": {"score": NUMBER},
    "reference": {"policy": str, "score": NUMBER, "parts": {EACH: NUMBER}, "difference": MEAN, "improvement": MEAN},
    "parts": {EACH: {"normalised": NUMBER | None, "episodes": [NUMBER], "copies": [int], "lost": int}},
    "films": {
        EACH: {"map": str, "cells": [int], "seconds": [NUMBER], "coverage": [int], "tracks": [[int]], "picture": str}
    },
}
"""Of a row: what the page and the tables read."""
UNSEEN, WALL, NOTHING = 253, 254, 255  # in the picture; below: the frame in which a cell was first seen


def make_row(
    where: Path, file: str | None, check: bool, advance: Callable[[int], None] = lambda count: None
) -> dict[str, Any]:
    """The row of the folder of a run.

    Args:
        file: of its suite, where that does not come with the package
        check: play its actions again, and refuse it where the results do not follow from them
        advance: called with the number of episodes that were played again

    Raises:
        UserError: it is damaged, not of the suite's own maps, or not what it says.
    """
    results = run_files.read_json(where / run_files.RESULTS)
    if check:
        _check_verified(where, verify(where, file, advance))
    suite = load_suite(file or str(results["suite"]["name"]))
    if results["suite"]["checksum"] != suite.checksum:
        raise UserError(f"{short(where)} was played with another version of {suite.name} than is here.")
    if not results["suite"]["frozen_maps"]:
        raise UserError(
            f"{short(where)} was played on other maps or starts (seed={results['suite']['seed']}): it has no score."
        )
    row: dict[str, Any] = {"format": FORMAT, "verified": check, "metric": suite.score}
    row |= {name: results[name] for name in KEPT}
    row["reference"] = {name: value for name, value in results["reference"].items() if name != "differences"}
    row["reference"]["difference"] = results["reference"]["difference"][suite.score]
    row["parts"] = {part: _describe_part(suite, part, figures, results) for part, figures in results["parts"].items()}
    row["films"] = {part: make_film(suite, part, where) for part in suite.parts}
    return json.loads(json.dumps(_rounded(row)))


def _check_verified(where: Path, report: dict[str, Any]) -> None:
    if not report["verified"]:
        first = report["differences"][0]
        why = f"{first['file']}: {first['where']}"
        raise UserError(f"{short(where)} is not what it says ({why}): no row is made of it.")


def _describe_part(suite: Suite, part: str, summary: dict, results: dict) -> dict[str, Any]:
    score = suite.scores[part]
    told = {name: summary[name] for name in (suite.score, *SHOWN) if name in summary}
    told |= {"metric": score} if score != suite.score else {}
    episodes = results["episodes"][part]
    values = {name: np.array(episodes[name], dtype=np.float64) for name in suite.metrics}
    return told | {
        "normalised": summary["normalised"],
        "episodes": episodes[score],
        "copies": label_copies(np.array(episodes["map"]), values).tolist(),
        "lost": len(episodes["lost"]),
        "seconds": DT * suite.parts[part].limit,
    }


def make_film(suite: Suite, part: str, where: Path) -> dict[str, Any]:
    """The first episode of a part as a page can show it."""
    noted = run_files.read_batch(where, suite, part, 0)
    known = suite.parts[part]
    env = build_replay(known, build_maps(known), 1, suite.seed)
    every = max(1, known.limit // FRAMES)
    return describe_film(play_teams(env, Replay(noted, 1, env.device), "", first=0, every=every)[0])


def describe_film(episode: Episode) -> dict[str, Any]:
    """{map, cells, seconds, coverage, tracks, picture}.

    `cells` of the picture, x before y; `seconds` and `coverage` [per mille] of each frame; `tracks` x, y of each robot
    in each frame, from the middle of the lowest to that of the highest cell of the longer side [per mille]; `picture`
    deflated bytes, in base64, row by row from below: the frame in which a cell was first seen, or UNSEEN, WALL or
    NOTHING.
    """
    place = episode.map
    points = np.concatenate([place.free[:, :2], place.boundary[:, :2]]).astype(np.float64)
    low, size = points.min(0), np.ptp(points, axis=0)
    cell = max(float(size.max()) / (CELLS - 1), place.resolution)
    width, height = (np.rint(size / cell).astype(int) + 1).tolist()
    picture = np.full((height, width), NOTHING, np.uint8)
    columns, rows = np.rint((points - low) / cell).astype(int).T
    free = len(place.free)
    picture[rows[free:], columns[free:]] = WALL
    first = np.where(episode.free_seen_at < 0, UNSEEN, episode.free_seen_at).min(0)
    picture[rows[:free], columns[:free]] = NOTHING  # a cell with free ground shows that
    np.minimum.at(picture, (rows[:free], columns[:free]), first.astype(np.uint8))
    centres = (episode.center.astype(np.float64) - low) / size.max()
    return {
        "map": place.name,
        "cells": [width, height],
        "seconds": episode.seconds.tolist(),
        "coverage": np.rint(1000 * episode.coverage).astype(int).tolist(),
        "tracks": np.rint(1000 * centres).astype(int).reshape(len(episode), -1).tolist(),
        "picture": base64.b64encode(zlib.compress(picture.tobytes(), 9)).decode(),
    }


def file_of(row: dict[str, Any]) -> str:
    """Where a leaderboard keeps a row: SUITE/POLICY.json, with the version where that is not the first."""
    suite = row["suite"]
    name = suite["name"] if suite["version"] == 1 else f"{suite['name']}-v{suite['version']}"
    return f"{_plain(name)}/{_plain(row['policy'])}.json"


def _plain(name: str) -> str:
    return re.sub(r"[^\w.+-]", "_", name)[:80].lstrip(".") or "_"


def write_row(where: Path, row: dict[str, Any]) -> Path:
    """Write a row into a leaderboard; one of the same name is replaced."""
    path = where / file_of(row)
    write_text(path, run_files.dump(row) + "\n")
    return path


def read_row(path: Path) -> dict[str, Any]:
    """A row from its file.

    Raises:
        UserError: it is damaged, or its score does not follow from its episodes.
    """
    try:
        row = json.loads(path.read_text())
        _check_shape(row, SHAPE, "row")
        _check_numbers(row)
    except (OSError, ValueError, TypeError, RecursionError) as error:
        told = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        raise UserError(f"{short(path)} is damaged or no row of a leaderboard ({told}).") from error
    return row


def _check_shape(value: Any, shape: Any, where: str) -> None:
    """Raise ValueError where an entry is missing or of another kind."""
    if isinstance(shape, dict):
        if not isinstance(value, dict) or not value:
            raise ValueError(f"{where} has no entries")
        for name, item in shape.items():
            for key in value if name == EACH else (name,):
                if key not in value:
                    raise ValueError(f"{where}.{key} is missing")
                _check_shape(value[key], item, f"{where}.{key}")
    elif isinstance(shape, list):
        if not isinstance(value, list) or not value:
            raise ValueError(f"{where} is no list")
        for item in value:
            _check_shape(item, shape[0], where)
    elif not isinstance(value, shape) or (isinstance(value, bool) and shape is not bool):
        raise ValueError(f"{where} is of another kind")


def _check_numbers(row: dict[str, Any]) -> None:
    """Raise ValueError where parts do not fit, or the score does not follow from the episodes."""
    if row["format"] != FORMAT:
        raise ValueError(f"format {row['format']}")
    if not isinstance(row.get("note", ""), str):
        raise ValueError("note is of another kind")
    parts = row["parts"]
    if not all(isinstance(part.get("metric", ""), str) for part in parts.values()):
        raise ValueError("metric of a part is of another kind")
    if not set(parts) == set(row["films"]) == set(row["reference"]["parts"]):
        raise ValueError("parts, films and reference are not of the same parts")
    if not all(row["metric"] in part and len(part["copies"]) == len(part["episodes"]) for part in parts.values()):
        raise ValueError("a part has too few entries")
    score = np.mean([np.mean(part["episodes"]) for part in parts.values()])
    if not abs(score - row["score"]["mean"]) < 1e-5:
        raise ValueError("its score does not follow from its episodes")


def find_rows(where: Path) -> list[Path]:
    """The files of the rows of a leaderboard."""
    return sorted(where.glob("*/*.json"))


def _rounded(value: Any) -> Any:
    """Six decimals are enough for a page."""
    if isinstance(value, dict):
        return {name: _rounded(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(item) for item in value]
    return round(value, 6) if isinstance(value, float) and value == value else value


TEMPLATE = Path(__file__).with_name("leaderboard.html")
PAGE, TABLES = "index.html", "README.md"
MARK = "/*DATA*/"


def write_site(where: Path, rows: list[dict[str, Any]]) -> list[Path]:
    """Write the page and the tables of rows; returns the files."""
    tables = ["# Leaderboard", "", *(line for suite_rows in group(rows) for line in table(suite_rows))]
    write_text(where / TABLES, "\n".join(tables))
    return [write_page(where, rows), where / TABLES]


def write_page(where: Path, rows: list[dict[str, Any]]) -> Path:
    """Write the page of rows; returns it."""
    data = json.dumps(without_nan([describe_suite(suite_rows) for suite_rows in group(rows)]), separators=(",", ":"))
    data = data.replace("<", "\\u003c")  # no name in it can end the script
    page = TEMPLATE.read_text().replace(MARK, f"const SUITES = {data}; const COLOURS = {json.dumps(COLOURS)};")
    write_text(where / PAGE, page)
    return where / PAGE


def group(rows: list[dict[str, Any]]) -> list[list[dict[str, Any]]]:
    """Rows by suite and checksum, the best first; the quick suite comes first."""
    found: dict[tuple, list] = {}
    for row in rows:
        found.setdefault((row["suite"]["name"], row["suite"]["version"], row["suite"]["checksum"]), []).append(row)
    order = sorted(found, key=lambda key: (key[0] != "minival", key))
    return [sorted(found[key], key=lambda row: -row["score"]["mean"]) for key in order]


def describe_suite(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """What the page knows of a suite: its rows, each with its profile, and who beats whom how often."""
    values, copies = (
        [{part: np.array(figures[name]) for part, figures in row["parts"].items()} for row in rows]
        for name in ("episodes", "copies")
    )
    numbers, first = range(len(rows)), rows[0]
    return {
        **{name: first["suite"][name] for name in ("name", "version", "checksum")},
        **{name: first[name] for name in ("metric", "random")},
        "scored": describe_score(scores_of(first)),
        "reference": {name: first["reference"][name] for name in ("policy", "score", "parts")},
        "rows": [row | {"profile": profile(own)} for row, own in zip(rows, values, strict=True)],
        "better": [
            [None if x == y else improvement(values[x], values[y], (copies[x], copies[y])) for y in numbers]
            for x in numbers
        ],
    }


def scores_of(row: dict[str, Any]) -> dict[str, str]:
    """Part -> the metric that counts there."""
    return {part: figures.get("metric", row["metric"]) for part, figures in row["parts"].items()}


def table(rows: list[dict[str, Any]]) -> list[str]:
    """A suite's rows as a table in Markdown."""
    suite, reference = rows[0]["suite"], rows[0]["reference"]["policy"]
    heads = [
        "",
        "policy",
        "score",
        "95 % interval",
        f"between `random` and `{reference}`",
        f"less `{reference}`, points",
    ]
    cells = []
    for number, row in enumerate(rows, 1):
        name = _escaped(row["policy"])
        score = score_cells(row["score"], row["score"]["normalised"], row["reference"]["difference"])
        cells.append([str(number), f"`{name}`", *score, "yes" if row["verified"] else "no"])
    title = f"## {suite['name']}, version {suite['version']}"
    noted: dict[str, list[str]] = {}
    for row in rows:
        noted.setdefault(row.get("note", ""), []).append(f"`{_escaped(row['policy'])}`")
    notes = [f"- {', '.join(names)}: {_escaped(note)}" for note, names in noted.items() if note]
    told = describe_score(scores_of(rows[0]))
    scored = [f"Score: {told}.", ""] * (rows[0]["metric"] != "coverage_auc")
    return [title, "", *scored, *markdown_table([*heads, "verified"], cells), "", *notes, *[""] * bool(notes)]


def _escaped(text: str) -> str:
    """For Markdown: on one line, no HTML, no end of a cell or of code."""
    return " ".join(html.escape(text).replace("|", "\\|").replace("`", "'").split())
