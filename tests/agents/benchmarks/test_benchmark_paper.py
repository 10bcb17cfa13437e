"""The paper's Table II in the benchmark, and its slips in docs/reports, against the paper's own source."""

import os
import re
from pathlib import Path

import pytest
from paths import ROOT

from maexp.agents.benchmarks.paper_table import COLUMNS, PAPER

pytestmark = pytest.mark.slow  # trainings


def paper_tex() -> str:
    default = Path(__file__).resolve().parents[4] / "shared" / "paper" / "maexp.tex"
    path = Path(os.environ.get("MAEXP_PAPER", default))
    if not path.is_file():
        pytest.skip(f"PAPER ABSENT: no {path}; set MAEXP_PAPER to the paper's LaTeX")
    return path.read_text()


SCENARIOS = ("random_obstacles", "maze", "indoor_small", "indoor_medium", "indoor_large", "outdoor")


def printed_table() -> tuple[dict, dict]:
    """(values, bold) of Table II as the .tex prints it: (scenario, algorithm, column) -> (mean, std) or None."""
    values, bold = {}, {}
    table = re.search(r"Performance results of six MARL.*?\\end\{tabular\}", paper_tex(), re.DOTALL)[0]
    seen: dict[str, int] = {}
    for row in re.split(r"\\\\", table):
        found = re.search(r"&\s*(ITRPO|IPPO|MATRPO|MAPPO|VDPPO|VDA2C)\s*&(.*)", row, re.DOTALL)
        if not found:
            continue
        name, block = found[1].lower(), seen.get(found[1], 0)
        seen[found[1]] = block + 1
        cells = found[2].split("&")
        assert len(cells) == 18
        for k, cell in enumerate(cells):
            key = SCENARIOS[k // 3], name, COLUMNS[3 * block + k % 3]
            numbers = [float(number) for number in re.findall(r"\d+(?:\.\d+)?", cell.replace("textbf", ""))]
            values[key] = tuple(numbers) if numbers else None
            bold[key] = "textbf" in cell
    return values, bold


def test_the_papers_numbers_are_the_papers():
    values, _ = printed_table()
    ours = {}
    for scenario, rows in PAPER.items():
        for name, row in rows.items():
            ours |= {(scenario, name, metric): value for metric, value in zip(COLUMNS, row, strict=True)}
    assert len(ours) == 6 * 6 * 6 and ours == values


def paper_best(scenario: str, metric: str) -> set[str]:
    k, better = COLUMNS.index(metric), 1 if metric == "exploration_ratio" else -1
    means = {name: better * row[k][0] for name, row in PAPER[scenario].items() if row[k] is not None}
    return {name for name, mean in means.items() if mean == max(means.values(), default=0)}


def paper_page() -> str:
    return (ROOT / "docs" / "reports" / "paper.md").read_text()


def test_the_slips_that_the_log_lists_are_the_papers_bold_against_its_numbers():
    _, bold = printed_table()
    wrong = set()
    for scenario in SCENARIOS:
        for metric in COLUMNS:
            marked = {name for name in PAPER[scenario] if bold[scenario, name, metric]}
            if marked != paper_best(scenario, metric):
                wrong.add((scenario, metric))
    page = paper_page()
    slips = page[page.index("## Slips") :]
    rows = re.findall(r"^\| ((?:maze|indoor|random)[^,|]*), ([^|]*) \|", slips, re.MULTILINE)
    short = dict(zip(("ER", "85 % CS", "95 % CS", "85 % MO", "95 % MO", "RV"), COLUMNS, strict=True))
    assert {(place.replace(" ", "_"), short[metric]) for place, metric in rows} == wrong
