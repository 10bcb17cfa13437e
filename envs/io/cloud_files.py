"""Point clouds from .pcd, .ply and .xyz files; a header that promises what the file does not hold is refused."""

from __future__ import annotations

import struct
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from maexp.envs.maps.point_cloud import MAX_FILE_BYTES, MAX_POINTS, MapError

MAX_HEADER = 64 * 1024
PLY_BYTES = {
    "char": 1,
    "uchar": 1,
    "int8": 1,
    "uint8": 1,
    "short": 2,
    "ushort": 2,
    "int16": 2,
    "uint16": 2,
    "int": 4,
    "uint": 4,
    "int32": 4,
    "uint32": 4,
    "float": 4,
    "float32": 4,
    "double": 8,
    "float64": 8,
}


@dataclass(frozen=True)
class Cloud:
    """What a file holds.

    Attributes:
        points: surfaces, in the file's units and axes, float64 [count, 3].
        open_space: places known to be empty (octrees), float64 [open_count, 3], or None.
        metres_per_unit: as the file says; None: it does not.
        up: axis that points up by the format's rules.
        outdoor: the format is that of airborne scans.
        spacing: side of the voxels the points stand for [file units]; None: plain points.
    """

    points: np.ndarray
    open_space: np.ndarray | None = None
    metres_per_unit: float | None = None
    up: str = "auto"
    outdoor: bool = False
    spacing: float | None = None


def read_pcd(path: Path) -> Cloud:
    """All points of a .pcd file: ascii, binary or binary_compressed."""
    lines, start = _read_header(path, b"DATA ")
    entries = {words[0].upper(): words[1:] for words in map(str.split, lines) if len(words) > 1}
    try:
        fields, kind = [name.lower() for name in entries["FIELDS"]], entries["DATA"][0].lower()
        sizes = [int(value) for value in entries["SIZE"]]
        counts = [int(value) for value in entries.get("COUNT", ["1"] * len(fields))]
        width, height = int(entries["WIDTH"][0]), int(entries.get("HEIGHT", ["1"])[0])
        promised = int(entries.get("POINTS", [str(width * height)])[0])
    except (KeyError, ValueError) as error:
        raise MapError(f"{path} has no usable PCD header ({error}); save it again") from error
    if not len(fields) == len(sizes) == len(counts) or not {"x", "y", "z"} <= set(fields):
        raise MapError(f"{path}: PCD fields {' '.join(fields)} do not name x, y and z with a size each; save it again")
    if min(sizes) < 1 or max(sizes) > 8 or min(counts) < 1 or width * height != promised:
        raise MapError(f"{path}: PCD header is inconsistent ({promised} points, sizes {sizes}); save it again")
    stride = sum(size * count for size, count in zip(sizes, counts, strict=True))
    rest = path.stat().st_size - start
    if kind == "binary_compressed":
        _check_compressed(path, start, rest, promised * stride)
    elif kind not in ("ascii", "binary"):
        raise MapError(f"{path}: PCD data is {kind!r}; ascii, binary and binary_compressed are read")
    _check_promise(path, promised, 2 * sum(counts) if kind == "ascii" else stride, rest, kind)
    if kind == "ascii":
        starts = np.cumsum([0, *counts])
        return Cloud(_read_rows(path, start, promised, [int(starts[fields.index(axis)]) for axis in "xyz"]))
    if kind == "binary":
        check_rest(path, start + promised * stride, stride)
    return Cloud(_read_with_open3d(path, promised))


def _check_compressed(path: Path, start: int, rest: int, wanted: int) -> None:
    """The two lengths in front of compressed data must fit the file and the header."""
    with path.open("rb") as file:
        file.seek(start)
        head = file.read(8)
    packed, unpacked = struct.unpack("<II", head) if len(head) == 8 else (0, 0)
    if packed == 0 or packed > rest - 8 or unpacked != wanted or wanted > MAX_FILE_BYTES:
        raise MapError(f"{path} is truncated: its data should have {packed} bytes, the file holds {max(0, rest - 8)}")


def read_ply(path: Path) -> Cloud | None:
    """The vertices of a .ply file; None where it is a mesh with faces."""
    lines, start = _read_header(path, b"end_header")
    words = [line.split() for line in lines]
    kind = next((word[1] for word in words if len(word) > 1 and word[0] == "format"), "")
    if words[0] != ["ply"] or kind not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise MapError(f"{path} has no PLY header with a known format; save it again")
    elements, current = {}, None
    try:
        for word in words:
            if word[:1] == ["element"]:
                current = elements[word[1]] = [int(word[2])]
            elif word[:1] == ["property"]:
                current.append((word[-1], None if word[1] == "list" else PLY_BYTES[word[1]]))
    except (KeyError, IndexError, ValueError, AttributeError) as error:
        raise MapError(f"{path} has a damaged PLY header ({error}); save it again") from error
    promised, *properties = elements.get("vertex", [0])
    if not {"x", "y", "z"} <= {name for name, _ in properties}:
        raise MapError(f"{path}: PLY has no vertices with x, y and z; save it again")
    least = sum(1 if kind == "ascii" else size or 1 for _, size in properties) * (2 if kind == "ascii" else 1)
    _check_promise(path, promised, least, path.stat().st_size - start, kind)
    if elements.get("face", [0])[0] > 0:
        _check_promise(path, elements["face"][0], 1, path.stat().st_size - start, kind)
        return None
    alone = promised if len(elements) == 1 and None not in (size for _, size in properties) else 0
    if alone and kind == "ascii":
        names = [name for name, _ in properties]
        return Cloud(_read_rows(path, start, promised, [names.index(axis) for axis in "xyz"]))
    if alone:
        stride = sum(size for _, size in properties)
        check_rest(path, start + promised * stride, stride)
    return Cloud(_read_with_open3d(path, promised))


def read_xyz(path: Path) -> Cloud:
    """The first three numbers of every line; separated by blanks, commas or semicolons, # begins a comment."""
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise MapError(f"{path} is not text; save it as lines of x y z") from error
    points = _parse_numbers(path, text.replace(",", " ").replace(";", " "), [0, 1, 2])
    if len(points) == 0:
        raise MapError(f"{path} holds 0 points; give a cloud with at least a few hundred")
    return Cloud(points)


def _read_rows(path: Path, start: int, promised: int, columns: list[int]) -> np.ndarray:
    """Three columns of the rows of text from byte `start` on; Open3D takes missing and unreadable numbers for zeros."""
    with path.open("rb") as file:
        file.seek(start)
        text = file.read().decode("ascii", errors="replace")
    points = _parse_numbers(path, text, columns)
    if len(points) != promised:
        raise MapError(f"{path} promises {promised} points and holds {len(points)}; save it again")
    return points


def check_rest(path: Path, end: int, stride: int) -> None:
    """After the points that the header promises there must be no further ones; zeros and a few bytes are padding."""
    with path.open("rb") as file:
        file.seek(end)
        rest = file.read()
    if len(rest) >= stride and any(rest):
        raise MapError(f"{path} holds {len(rest)} bytes more than the points it promises; save it again")


def _parse_numbers(path: Path, text: str, columns: list[int]) -> np.ndarray:
    """Three columns of a table of numbers, float64 [rows, 3]."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an empty table is the caller's to refuse
            return np.loadtxt(text.splitlines(), usecols=columns, ndmin=2, dtype=np.float64)
    except (ValueError, IndexError) as error:
        raise MapError(f"{path}: {error}; every line must hold the numbers of one point") from error


def _read_header(path: Path, last: bytes) -> tuple[list[str], int]:
    """Lines up to the one that begins with `last`, and where the data begin."""
    lines, start = [], 0
    with path.open("rb") as file:
        while start < MAX_HEADER:
            line = file.readline(MAX_HEADER)
            start += len(line)
            if not line or len(lines) > 1000:
                break
            text = line.decode("ascii", errors="replace").strip()
            if text and not text.startswith("#"):
                lines.append(text)
            if line.startswith(last):
                return lines, start
    raise MapError(f"{path} has no {path.suffix[1:].upper()} header; it is another kind of file, or truncated")


def _check_promise(path: Path, promised: int, least_bytes: int, rest: int, kind: str) -> None:
    if promised < 1:
        raise MapError(f"{path} holds 0 points; give a cloud with at least a few hundred")
    if promised > MAX_POINTS:
        raise MapError(f"{path} promises {promised} points; thin it to {MAX_POINTS}")
    spare = int(kind == "ascii")  # the last line need not end
    if kind != "binary_compressed" and promised * least_bytes > rest + spare:
        raise MapError(f"{path} is truncated: it promises {promised} points and holds {rest} bytes of them")


def _read_with_open3d(path: Path, promised: int) -> np.ndarray:
    import open3d  # late: it takes seconds to load

    try:
        with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
            cloud = open3d.io.read_point_cloud(
                str(path), format=path.suffix[1:].lower(), remove_nan_points=False, remove_infinite_points=False
            )
    except (RuntimeError, MemoryError) as error:
        raise MapError(f"{path} cannot be read ({error}); save it again") from error
    points = np.asarray(cloud.points, dtype=np.float64)
    if len(points) != promised:  # its readers return an empty cloud, or the part they could read
        raise MapError(f"{path} is damaged: it promises {promised} points, {len(points)} could be read; save it again")
    return points.copy()
