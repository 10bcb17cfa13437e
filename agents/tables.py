"""How figures are written and tables laid out: on the terminal, in Markdown, in LaTeX."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from maexp.envs.metrics import has_interval

Write = Callable[[float], str]
NONE = "-"
"""Stands where there is no value."""


def fixed(digits: int, factor: float = 1.0, sign: str = "") -> Write:
    """What writes a value times `factor` with so many digits; `sign` "+": a plus in front, too."""
    return lambda value: f"{factor * value:{sign}.{digits}f}"


POINTS = fixed(1, 100.0, "+")
"""A difference of shares, in points."""


def brackets(found: dict, write: Write) -> str:
    """[low, high] of a mean {mean, ci95, n}, with a blank in front; nothing where there is no interval."""
    return f" [{', '.join(write(end) for end in found['ci95'])}]" if has_interval(found) else ""


def estimate(found: dict, write: Write) -> str:
    """A mean {mean, ci95, n} and its interval."""
    return write(found["mean"]) + brackets(found, write)


def reached(found: dict, total: int) -> str:
    """(n/total): of how many episodes a mean {mean, ci95, n} is."""
    return f"({found['n']}/{total})"


@dataclass(frozen=True)
class TableCell:
    """A value, bold or not, and small lines below it."""

    text: str
    bold: bool = False
    below: tuple[str, ...] = ()

    def markdown(self) -> str:
        return "<br>".join([f"**{self.text}**" if self.bold else self.text, *self.below])

    def terminal(self) -> Text:
        text = Text(self.text, style="bold" if self.bold else "")
        return text.append("".join(f"\n{line}" for line in self.below), style="not bold dim")

    def latex(self) -> str:
        """The value alone: a tabular has a row for each line below."""
        mean, sign, deviation = self.text.partition(" ± ")
        mean = rf"\mathbf{{{mean}}}" if self.bold else mean
        return rf"${mean} \pm {deviation}$" if sign else self.text


def markdown_row(cells: Iterable[str]) -> str:
    """A line of a table."""
    return f"| {' | '.join(cells)} |"


def markdown_table(heads: Sequence[str], rows: Iterable[Iterable[str]]) -> list[str]:
    """The lines of a table."""
    return [markdown_row(row) for row in (heads, ["---"] * len(heads), *rows)]


def latex_row(cells: Iterable[str | None]) -> str:
    """A line of a tabular; None leaves a cell empty."""
    return f"{' & '.join(cell or '' for cell in cells)} " + r"\\"


def latex_small(text: str) -> str:
    """The words of a cell, small."""
    return rf"{{\scriptsize {text}}}" if text else ""


def latex_text(text: str) -> str:
    """Words with signs that LaTeX takes for its own."""
    for sign, latex in {"_": r"\_", "%": r"\%", "↑": r"$\uparrow$", "↓": r"$\downarrow$"}.items():
        text = text.replace(sign, latex)
    return text


def terminal_table(title: str, heads: Sequence[str], rows: Iterable[Sequence[str | Text]]) -> Table:
    """A table for the terminal: the first column is text, the others are numbers; nothing in it is rich's markup."""
    table = Table(title=escape(title), title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    for number, head in enumerate(heads):
        table.add_column(escape(head), justify="right" if number else "left", no_wrap=True)
    for row in rows:
        table.add_row(*(escape(cell) if isinstance(cell, str) else cell for cell in row))
    return table


def print_table(title: str, heads: Sequence[str], rows: Iterable[Sequence[str | Text]]) -> None:
    """`terminal_table` as wide as it is: a narrower terminal wraps lines, but nothing is lost."""
    table = terminal_table(title, heads, rows)
    natural = Measurement.get(Console(width=1000), Console(width=1000).options, table).maximum
    Console(width=max(natural, Console().width)).print(table)
