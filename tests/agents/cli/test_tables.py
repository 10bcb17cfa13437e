"""How figures are written and laid out: once for the terminal, Markdown and LaTeX."""

import math
import re
from io import StringIO

from rich.console import Console

from maexp.agents.tables import (
    POINTS,
    TableCell,
    brackets,
    estimate,
    fixed,
    latex_row,
    latex_text,
    markdown_table,
    terminal_table,
)

FOUND = {"mean": 0.25, "ci95": [0.125, 0.5], "n": 8}
LONELY = FOUND | {"ci95": [math.nan, math.nan]}


def test_figures_have_their_interval_where_there_is_one():
    assert estimate(FOUND, fixed(2)) == "0.25 [0.12, 0.50]" and estimate(LONELY, POINTS) == "+25.0"
    assert brackets(FOUND | {"ci95": [None, None]}, fixed(2)) == "", "as JSON has it"


def test_a_cell_is_bold_and_has_lines_below_in_each_layout():
    cell = TableCell("93.5 ± 3.5", bold=True, below=("[90.0, 97.0]", "(3/6)"))
    assert cell.markdown() == "**93.5 ± 3.5**<br>[90.0, 97.0]<br>(3/6)"
    assert cell.latex() == r"$\mathbf{93.5} \pm 3.5$" and TableCell("-").latex() == "-"
    out = StringIO()
    table = terminal_table("maze [m]", ["policy [m]", "ER"], [["[red]", cell.terminal()]])
    Console(file=out, width=80, force_terminal=True, color_system="standard").print(table)
    text = out.getvalue()
    assert "maze [m]" in text and "policy [m]" in text and "[red]" in text, "rich takes nothing for its markup"
    assert re.search(r"\x1b\[1m *93.5 ± 3.5\x1b\[0m", text) and "\x1b[2m[90.0, 97.0]" in text


def test_lines_of_tables_are_as_long_as_their_heads():
    assert markdown_table(["", "a"], [["b", "1"]]) == ["|  | a |", "| --- | --- |", "| b | 1 |"]
    assert latex_row([latex_text("CS_85 % ↓"), None, "1"]) == r"CS\_85 \% $\downarrow$ &  & 1 \\"
