"""Progress with rate and time left: a bar on a terminal, a line every so often in a file."""

import sys
import time

from rich.console import Console
from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as RichProgress

LINE_EVERY = 10.0  # seconds between lines where there is no terminal


class Progress:
    """Context that shows how far a task is.

    Args:
        title: what is done
        total: units of work
        done: units that were done before
    """

    def __init__(self, title: str, total: int, done: int = 0):
        self.title, self.total, self.first, self.done = title, total, done, done
        self.console = Console(file=sys.stderr)
        self.begin = self.last_line = time.monotonic()
        self.bar = None
        if self.console.is_terminal:
            columns = (TextColumn("{task.description}"), BarColumn(bar_width=24), TextColumn("{task.fields[text]}"))
            self.bar = RichProgress(*columns, console=self.console, transient=True)
            self.task = self.bar.add_task(title, total=total, completed=done, text="")

    def __enter__(self) -> "Progress":
        if self.bar:
            self.bar.start()
        return self

    def __exit__(self, *error) -> None:
        if self.bar:
            self.bar.stop()

    def advance(self, count: int) -> None:
        """`count` more units are done."""
        self.show(self.done + count)

    def tell(self, sentence: str) -> None:
        """Print something beside the bar."""
        self.console.print(sentence, markup=False, highlight=False, soft_wrap=True)

    def show(self, done: int, note: str = "") -> None:
        """`done` units are done in all."""
        self.done = done
        text = self.describe(note)
        if self.bar:
            self.bar.update(self.task, completed=done, text=text)
        elif time.monotonic() - self.last_line >= LINE_EVERY or done >= self.total:
            self.last_line = time.monotonic()
            print(f"{self.title}: {text}", file=sys.stderr, flush=True)

    def describe(self, note: str = "") -> str:
        """Share done, rate, time left."""
        spent = time.monotonic() - self.begin
        rate = (self.done - self.first) / spent if spent > 0 else 0.0
        left = (self.total - self.done) / rate if rate > 0 else float("inf")
        speed = f"{rate:,.0f}/s" if rate >= 10 else f"{rate:.2g}/s"
        parts = [f"{self.done:,}/{self.total:,}", speed, f"{duration(left)} left", note]
        return "  ".join(part for part in parts if part)


def duration(seconds: float) -> str:
    """1:02:03 or 2:03; ? where unknown."""
    if seconds == float("inf"):
        return "?"
    minutes, second = divmod(round(seconds), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02d}:{second:02d}" if hours else f"{minute}:{second:02d}"
