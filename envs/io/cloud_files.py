"""Point clouds: what a file holds, .xyz files, and the headers and tables of numbers that .pcd and .ply share."""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from maexp.envs.maps.point_cloud import MAX_POINTS, MapError

MAX_HEADER = 64 * 1024


@dataclass(frozen=True)
class Faces:
    """The triangles of a mesh, in the file's units and axes: centres and unit normals [count, 3], areas [count]."""

    centres: np.ndarray
    normals: np.ndarray
    areas: np.ndarray


@dataclass(frozen=True)
class Cloud:
    """What a file holds.

    Attributes:
        points: surfaces, in the file's units and axes, float64 [count, 3].
        open_space: places known to be empty (octrees), float64 [open_count, 3], or None.
        metres_per_unit: as the file says; None: it does not.
        metres_per_height: of the heights, where they have a unit of their own; None: that of x and y.
        up: axis that points up by the format's rules.
        outdoor: the format is that of airborne scans.
        spacing: side of the voxels the points stand for [file units]; None: plain points.
        faces: of a mesh, or None.
        step: between neighbouring coordinates that float32 can hold, where the points were rounded so [file units].
        assumed: what the reader guessed: pairs of what, and how to settle it.
    """

    points: np.ndarray
    open_space: np.ndarray | None = None
    metres_per_unit: float | None = None
    metres_per_height: float | None = None
    up: str = "auto"
    outdoor: bool = False
    spacing: float | None = None
    faces: Faces | None = None
    step: float = 0.0
    assumed: tuple[tuple[str, str], ...] = ()


def read_xyz(path: Path) -> Cloud:
    """x, y and z of every line, by the names of a header where there is one, else the first three numbers.

    Separated by blanks, semicolons or commas; where others separate, a comma within every number is a decimal comma.
    # and // begin comments.
    """
    lines = _read_text(path).splitlines()
    columns, lines = _skip_heads(path, lines)
    lines, assumed = _plain_numbers(path, lines)
    points = parse_numbers(path, lines, columns)
    if len(points) == 0:
        raise MapError(f"{path} holds 0 points; give a cloud with at least a few hundred")
    return Cloud(points, step=float32_step(points), assumed=assumed)


def _read_text(path: Path) -> str:
    """The text of a file that may begin with a byte order mark."""
    data = path.read_bytes()
    marks = {b"\xef\xbb\xbf": "utf-8-sig", b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}
    encoding = next((name for mark, name in marks.items() if data.startswith(mark)), "utf-8")
    try:
        return data.decode(encoding)
    except UnicodeDecodeError as error:
        if encoding == "utf-8" and b"\0" not in data:
            return data.decode("latin-1")  # a comment of an older program; that the rest are numbers is checked
        raise MapError(f"{path} is not text; save it as lines of x y z") from error


def _skip_heads(path: Path, lines: list[str]) -> tuple[list[int], list[str]]:
    """The columns of x, y and z, and the lines of numbers: without comments, names of columns, a number of points."""
    columns, rows = [0, 1, 2], []
    for line in lines:
        text = re.split("#|//", line, maxsplit=1)[0] if "#" in line or "//" in line else line
        if text.strip():
            rows.append(text)
        if not rows or (len(rows) == 1 and rows[0] is text):
            names = [name.lower() for name in re.split(r"[\s,;]+", line.strip('#/%! \t\r"')) if name]
            names = [name.strip('"') for name in names]
            if {"x", "y", "z"} <= set(names):
                columns = [names.index(axis) for axis in "xyz"]
                rows = []
    first = rows[0].split() if rows else []
    if len(first) == 1 and first[0].isdigit() and len(rows) > 1:  # CloudCompare writes the number of points
        if int(first[0]) != len(rows) - 1:
            raise MapError(f"{path} promises {first[0]} points and holds {len(rows) - 1}; save it again")
        rows = rows[1:]
    return columns, rows


def _plain_numbers(path: Path, lines: list[str]) -> tuple[list[str], tuple]:
    """The lines with decimal points and blanks between the numbers, and what was assumed about commas."""
    commas = [line for line in lines if "," in line]
    if not commas:
        return ([line.replace(";", " ") for line in lines] if any(";" in line for line in lines) else lines), ()
    alike = len({line.count(",") for line in commas}) == 1
    kinds = {_comma_kind(line) for line in (commas[:: 1 + len(commas) // 1000] if alike else commas)}
    if "unclear" in kinds or len(kinds) > 1:
        which = next((line for line in commas if _comma_kind(line) == "unclear"), commas[0]).strip()[:60]
        raise MapError(
            f"{path}: the commas of {which!r} may be decimal commas or separators; save it with decimal points and "
            "blanks between the numbers"
        )
    if kinds == {"decimal"}:
        told = "its commas were read as decimal commas", "save it with decimal points"
        return [line.replace(",", ".").replace(";", " ") for line in lines], (told,)
    assumed: tuple = ()
    fields = len(commas[0].split(","))
    if fields >= 6 and fields % 2 == 0 and len(commas) == len(lines) and not any("." in line for line in lines):
        told = f"the {fields} whole numbers of a line were read as such, not as decimals with commas"
        assumed = ((told, "save it with decimal points and blanks between the numbers"),)
    return [line.replace(",", " ").replace(";", " ") for line in lines], assumed


def _comma_kind(line: str) -> str:
    """What the commas of a line are: "decimal", "separator", or "unclear"."""
    fields = [field for field in re.split(r"[;\s]+", line.strip()) if field]
    if len(fields) < 3 or not any("," in field[:-1] for field in fields):
        return "separator"  # too few fields without its commas, or commas before blanks
    if any(field.strip(",").count(",") > 1 for field in fields):
        return "separator" if ";" not in line or all(field.count(",") != 1 for field in fields) else "unclear"
    whole = all(re.fullmatch(r"[+-]?\d*(,\d*)?([eE][+-]?\d+)?", field) for field in fields)
    blanks = any(field.startswith(",") for field in fields) and ";" not in line and "\t" not in line
    return "decimal" if whole and not blanks else "unclear"


def float32_step(points: np.ndarray) -> float:
    """How far apart neighbouring float32 numbers lie at the largest coordinate, where the points were rounded to them.

    0 where they were not: numbers that float32 does not hold, or that lie on a coarser grid of their own. Points
    [count, 3], the step in their unit.
    """
    finite = points[np.isfinite(points).all(axis=1)]
    if not len(finite):
        return 0.0
    steps = []
    for values in finite.T:
        step = float(np.spacing(np.float32(min(np.abs(values).max(), 1e30))))
        some = values[:: max(1, len(values) // 20_000)]
        rounded = (some == some.astype(np.float32)).all()
        steps.append(step if rounded and (np.mod(some, 2 * step) != 0).mean() > 0.05 else 0.0)
    return max(steps)


def read_rows(path: Path, start: int, promised: int, columns: list[int], width: int) -> np.ndarray:
    """Three columns of the rows of text from byte `start` on, each of `width` numbers; float64 [promised, 3]."""
    with path.open("rb") as file:
        file.seek(start)
        lines = file.read().decode("ascii", errors="replace").splitlines()
    return parse_table(path, [line for line in lines if line.strip()], promised, width)[:, columns]


def parse_table(path: Path, lines: list[str], promised: int, width: int) -> np.ndarray:
    """All numbers of `promised` rows of `width` numbers; float64 [promised, width]."""
    table = parse_numbers(path, lines, None)
    if len(table) != promised:
        raise MapError(f"{path} promises {promised} points and holds {len(table)}; save it again")
    if table.shape[1] != width:
        raise MapError(f"{path} promises {width} numbers a point and holds {table.shape[1]}; save it again")
    return table


def check_rest(path: Path, end: int, stride: int) -> None:
    """After the points that the header promises there must be no further ones; zeros and a few bytes are padding."""
    with path.open("rb") as file:
        file.seek(end)
        rest = file.read()
    if len(rest) >= stride and any(rest):
        raise MapError(f"{path} holds {len(rest)} bytes more than the points it promises; save it again")


def parse_numbers(path: Path, lines: list[str], columns: list[int] | None) -> np.ndarray:
    """Some columns (None: all, of which every line must hold the same number) of a table, float64 [rows, columns]."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an empty table is the caller's to refuse
            return np.loadtxt(lines, usecols=columns, ndmin=2, dtype=np.float64, comments=None)
    except (ValueError, IndexError) as error:
        reason = " ".join(str(error).split())
        raise MapError(f"{path}: {reason}; every line must hold the numbers of one point") from error


def read_header(path: Path, last: str) -> tuple[list[str], int]:
    """Lines up to the one that has `last` for its first word, in capitals or not, and where the data begin."""
    lines, start = [], 0
    with path.open("rb") as file:
        while start < MAX_HEADER:
            line = file.readline(MAX_HEADER)
            start += len(line)
            if not line or len(lines) > 1000:
                break
            text = line.removeprefix(b"\xef\xbb\xbf").decode("ascii", errors="replace").strip()
            if text and not text.startswith("#"):
                lines.append(text)
            if text.upper().split()[:1] == [last]:
                return lines, start
    raise MapError(f"{path} has no {path.suffix[1:].upper()} header; it is another kind of file, or truncated")


def check_promise(path: Path, promised: int, least_bytes: int, rest: int, kind: str) -> None:
    if promised < 1:
        raise MapError(f"{path} holds 0 points; give a cloud with at least a few hundred")
    if promised > MAX_POINTS:
        raise MapError(f"{path} promises {promised} points; thin it to {MAX_POINTS}")
    spare = int(kind == "ascii")  # the last line need not end
    if kind != "binary_compressed" and promised * least_bytes > rest + spare:
        raise MapError(f"{path} is truncated: it promises {promised} points and holds {rest} bytes of them")
