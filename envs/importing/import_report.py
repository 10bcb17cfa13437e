"""What an import did, step by step, with counts, and what the file held before."""

from dataclasses import dataclass, field

import numpy as np

SHOWN_POINTS = 300_000  # of a cloud, for its picture


@dataclass(frozen=True)
class ScannedImage:
    """The image of a floor map as the file holds it: brightness 0..255 [height, width], pixel side and corner [m]."""

    values: np.ndarray
    pixel: float
    corner: tuple[float, float]


@dataclass(frozen=True)
class ScannedPoints:
    """The points of a cloud in the file's own axes [m], float32 [count, 3], at most SHOWN_POINTS of them."""

    points: np.ndarray

    @classmethod
    def some_of(cls, points: np.ndarray) -> "ScannedPoints":
        """A fair sample, moved so that float32 holds it where coordinates are large."""
        some = points[:: -(-len(points) // SHOWN_POINTS)]
        far = np.abs(some).max() > 1e5
        return cls((some - some.min(axis=0) if far else some).astype(np.float32))


@dataclass(frozen=True)
class ImportStep:
    """One step: what it did, and how much there was before and after (cells, points; None: does not apply)."""

    name: str
    detail: str
    before: int | None = None
    after: int | None = None


@dataclass
class ImportReport:
    """The steps of one import in order, and warnings a person should read."""

    path: str
    steps: list[ImportStep] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    seconds: float = 0.0
    before: ScannedImage | ScannedPoints | None = None  # None: the file holds a map's points already

    def add(self, name: str, detail: str, before: int | None = None, after: int | None = None) -> None:
        self.steps.append(ImportStep(name, detail, before, after))

    def warn(self, text: str) -> None:
        self.warnings.append(text)

    def table(self) -> str:
        """The report as text: one line a step."""
        head = ("step", "before", "after", "what was done")
        rows = [(step.name, _count(step.before), _count(step.after), step.detail) for step in self.steps]
        widths = [max(len(row[column]) for row in [head, *rows]) for column in range(3)]
        lines = [
            f"{row[0]:<{widths[0]}}  {row[1]:>{widths[1]}}  {row[2]:>{widths[2]}}  {row[3]}" for row in [head, *rows]
        ]
        lines.insert(0, f"import of {self.path} ({self.seconds:.1f} s)")
        lines += [f"warning: {text}" for text in self.warnings]
        return "\n".join(lines)


def _count(value: int | None) -> str:
    return "" if value is None else f"{value:,}"
