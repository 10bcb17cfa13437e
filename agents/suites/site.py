"""The leaderboard as a page that needs nothing but a browser, and as tables in Markdown."""

import html
import json
from pathlib import Path
from typing import Any

import numpy as np

from maexp.agents.benchmark.compare import improvement
from maexp.agents.evaluation.figures import COLOURS
from maexp.agents.files import without_nan, write_text
from maexp.agents.suites.score import describe_score, profile, score_cells
from maexp.agents.tables import markdown_table

TEMPLATE = Path(__file__).with_name("page.html")
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
