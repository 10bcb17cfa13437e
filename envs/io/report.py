"""The report of an import: what was done step by step, with counts and a picture."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from maexp.envs.atomic_write import whole_file
from maexp.envs.maps.plot import draw_map, paint_map
from maexp.envs.maps.point_cloud import MapError, PointCloudMap

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
    def some_of(cls, points: np.ndarray) -> ScannedPoints:
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
    """The steps of one import in order, what was assumed on the way, and warnings a person should read.

    Where `strict`, an assumption is a MapError.
    """

    path: str
    steps: list[ImportStep] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    assumptions: list[str] = field(default_factory=list)
    strict: bool = False
    seconds: float = 0.0
    before: ScannedImage | ScannedPoints | None = None  # None: the file holds a map's points already

    def add(self, name: str, detail: str, before: int | None = None, after: int | None = None) -> None:
        self.steps.append(ImportStep(name, detail, before, after))

    def warn(self, text: str) -> None:
        self.warnings.append(text)

    def assume(self, text: str, cure: str, warn: bool = False) -> None:
        """Note what the file does not say and was guessed; `cure` says how to settle it, `warn` that it may be wrong.

        Raises:
            MapError: the import is strict.
        """
        if self.strict:
            raise MapError(f"{self.path}: {text}, which importing.strict=true refuses; {cure}")
        (self.warnings if warn else self.assumptions).append(f"{text}; {cure}")

    def as_dict(self) -> dict[str, object]:
        """The report as plain values: path, seconds, steps (name, detail, before, after), assumptions, warnings."""
        steps = [asdict(step) | {"detail": printable(step.detail)} for step in self.steps]
        told = {"path": printable(self.path), "seconds": round(self.seconds, 3), "steps": steps}
        return told | {"assumptions": self.assumptions, "warnings": self.warnings}

    def to_json(self) -> str:
        """`as_dict` as JSON."""
        return json.dumps(self.as_dict(), indent=2) + "\n"

    def table(self) -> str:
        """The report as text: one line a step."""
        head = ("step", "before", "after", "what was done")
        rows = [(step.name, _count(step.before), _count(step.after), step.detail) for step in self.steps]
        widths = [max(len(row[column]) for row in [head, *rows]) for column in range(3)]
        lines = [
            f"{row[0]:<{widths[0]}}  {row[1]:>{widths[1]}}  {row[2]:>{widths[2]}}  {row[3]}" for row in [head, *rows]
        ]
        lines = [printable(line) for line in lines]
        lines.insert(0, f"import of {printable(self.path)} ({self.seconds:.1f} s)")
        lines += [f"assumed: {text}" for text in self.assumptions]
        lines += [f"warning: {text}" for text in self.warnings]
        return "\n".join(lines)


def printable(name: str) -> str:
    """A file's name as text: bytes that are no UTF-8, which print and save as nothing, as \\xNN."""
    return name.encode(errors="surrogateescape").decode(errors="backslashreplace")


def _count(value: int | None) -> str:
    return "" if value is None else f"{value:,}"


PANEL = 640  # pixels a side
SHOWN = (0.1, 99.9)  # percentiles of the coordinates in the picture: a single stray point would shrink all others


def draw_import(world: PointCloudMap, report: ImportReport, path: str | os.PathLike) -> Path:
    """Writes before and after side by side (PNG); a file that held a map's points already has no before.

    Before is the image of a floor map, or a cloud in its own axes from two sides (x, y and x, z): tilt, another axis
    up, ceilings and stray points are still there.
    """
    if report.before is None:
        return draw_map(world, path)
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # late: slow to import
    from matplotlib.figure import Figure

    inch = PANEL / 100
    figure = Figure(figsize=(2 * inch + 1.5, inch + 1.0), dpi=100, layout="constrained")
    before, after = figure.subfigures(1, 2)
    if isinstance(report.before, ScannedImage):
        _paint_image(before.add_subplot(), report.before)
    else:
        paint_cloud(before, report.before)
    before.suptitle(f"before: {printable(Path(report.path).name)}", fontsize=11)
    paint_map(after.add_subplot(), world, PANEL)
    after.suptitle("after", fontsize=11)
    with whole_file(Path(path)) as part:
        FigureCanvasAgg(figure).print_png(part)
    return Path(path)


def _paint_image(axes, image: ScannedImage) -> None:
    """The image as it is, in metres from its corner's place; one that the yaml turns is shown unturned."""
    height, width = image.values.shape
    x, y = image.corner
    extent = (x, x + width * image.pixel, y, y + height * image.pixel)
    axes.imshow(image.values, cmap="gray", vmin=0, vmax=255, extent=extent)
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.set_title(f"{width} x {height} pixels of {image.pixel:g} m", fontsize=9)


def paint_cloud(figure, scan: ScannedPoints) -> None:
    """The cloud along its third axis and along its second, as an X-ray: walls, floor and ceiling are dark lines."""
    low, high = np.percentile(scan.points, SHOWN, axis=0)
    span = np.maximum(high - low, 1e-3 * (high - low).max() + 1e-9)
    panels = figure.subplots(2, 1, height_ratios=[max(span[1], 0.35 * span[2]), max(span[2], 0.35 * span[1])])
    for axes, (up, depth) in zip(panels, ((1, 2), (2, 1)), strict=True):
        count = _count_cells(scan.points[:, [0, up]], low[[0, up]], span[[0, up]])
        extent = (low[0], low[0] + span[0], low[up], low[up] + span[up])
        shade = np.log1p(count)
        top = max(1.0, float(np.percentile(shade[count > 0], 98))) if count.any() else 1.0
        axes.imshow(shade, cmap="gray_r", vmin=0, vmax=top, origin="lower", extent=extent)
        axes.set(xlabel="x of the file [m]", ylabel=f"{'xyz'[up]} of the file [m]", aspect="equal")
        axes.set_title(f"looking along {'xyz'[depth]}: the darker, the more points", fontsize=9)


def _count_cells(places: np.ndarray, low: np.ndarray, span: np.ndarray) -> np.ndarray:
    """Places [m] in each pixel, float [rows, columns], the longer side half a panel."""
    scale = 0.5 * PANEL / span.max()
    columns, rows = np.maximum(1, np.ceil(span * scale)).astype(int)
    limits = ((low[1], low[1] + span[1]), (low[0], low[0] + span[0]))
    return np.histogram2d(places[:, 1], places[:, 0], bins=(rows, columns), range=limits)[0]
