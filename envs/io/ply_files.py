"""Points and triangles of .ply files, ascii and binary; whatever else the file holds must be whole, too."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from maexp.envs.io.cloud_files import check_promise, parse_table, read_header
from maexp.envs.maps.point_cloud import MapError

TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
CORNERS = ("vertex_indices", "vertex_index")


@dataclass
class _Element:
    """A kind of rows: its properties are numbers (name, type) or lists (name, type of length, type of entries)."""

    name: str
    count: int
    properties: list[tuple[str, ...]] = field(default_factory=list)

    @property
    def lists(self) -> bool:
        return any(len(entry) == 3 for entry in self.properties)

    def index(self, *names: str) -> int | None:
        return next((i for i, entry in enumerate(self.properties) if entry[0] in names), None)


def read_ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices float64 [count, 3] and triangles int64 [triangles, 3], none where it is a cloud.

    Raises:
        MapError: the file holds less or more than its header promises, or something other than numbers.
    """
    lines, start = read_header(path, "END_HEADER")
    words = [line.split() for line in lines]
    kind = next((word[1] for word in words if len(word) > 1 and word[0] == "format"), "")
    if words[0] != ["ply"] or kind not in ORDERS:
        raise MapError(f"{path} has no PLY header with a known format; save it again")
    elements = _read_elements(path, words)
    rest = path.stat().st_size - start
    for element in elements:
        if element.name == "vertex" or element.count > 0:
            one = 2 if kind == "ascii" else 1
            least = sum(one if len(entry) == 3 or one == 2 else int(entry[1][1]) for entry in element.properties)
            check_promise(path, element.count, least, rest, kind)
    with path.open("rb") as file:
        file.seek(start)
        data = file.read()
    if kind == "ascii":
        return _read_ascii(path, data, elements)
    return _read_binary(path, data, elements, ORDERS[kind])


def _read_elements(path: Path, words: list[list[str]]) -> list[_Element]:
    elements: list[_Element] = []
    try:
        for word in words:
            if word[0] == "element":
                elements.append(_Element(word[1], int(word[2])))
            elif word[0] == "property" and word[1] == "list":
                elements[-1].properties.append((word[4].lower(), TYPES[word[2]], TYPES[word[3]]))
            elif word[0] == "property":
                elements[-1].properties.append((word[2].lower(), TYPES[word[1]]))
    except (KeyError, IndexError, ValueError) as error:
        raise MapError(f"{path} has a damaged PLY header ({error}); save it again") from error
    vertex = [element for element in elements if element.name == "vertex"]
    if len(vertex) != 1 or any(vertex[0].index(axis) is None for axis in "xyz"):
        raise MapError(f"{path}: PLY has no vertices with x, y and z; save it again")
    if any(element.count < 0 or not element.properties for element in elements):
        raise MapError(f"{path} has a damaged PLY header (an element without properties or number); save it again")
    return elements


def _read_ascii(path: Path, data: bytes, elements: list[_Element]) -> tuple[np.ndarray, np.ndarray]:
    """A row a line."""
    lines = [line for line in data.decode("ascii", errors="replace").splitlines() if line.strip()]
    promised = sum(element.count for element in elements)
    if len(lines) != promised:
        raise MapError(f"{path} promises {promised} lines of points and others and holds {len(lines)}; save it again")
    points, triangles, at = np.empty((0, 3)), np.empty((0, 3), np.int64), 0
    for element in elements:
        rows, at = lines[at : at + element.count], at + element.count
        if not rows:
            continue
        if not element.lists:
            table = parse_table(path, rows, element.count, len(element.properties))
            if element.name == "vertex":
                points = table[:, [element.index(axis) for axis in "xyz"]]
            continue
        lists = _split_lists(path, element, rows)
        if element.name == "vertex":
            points = np.array([[row[element.index(axis)][0] for axis in "xyz"] for row in lists])
        elif element.name == "face" and (corners := element.index(*CORNERS)) is not None:
            triangles = fan([row[corners] for row in lists])
    return points, check_corners(path, points, triangles)


def _split_lists(path: Path, element: _Element, rows: list[str]) -> list[list[list[float]]]:
    """The numbers of each property of each row."""
    found = []
    for row in rows:
        try:
            numbers = [float(word) for word in row.split()]
            parts, at = [], 0
            for entry in element.properties:
                length, at = (int(numbers[at]), at + 1) if len(entry) == 3 else (1, at)
                parts.append(numbers[at : at + length])
                at += length
        except (ValueError, IndexError, OverflowError):
            numbers, at = [], -1
        if at != len(numbers):
            raise MapError(f"{path}: {row.strip()[:60]!r} is no {element.name} as its header has them; save it again")
        found.append(parts)
    return found


def _read_binary(path: Path, data: bytes, elements: list[_Element], order: str) -> tuple[np.ndarray, np.ndarray]:
    points, triangles, at = np.empty((0, 3)), np.empty((0, 3), np.int64), 0
    for element in elements:
        wanted = CORNERS if element.name == "face" else ("x", "y", "z")
        needed = element.name in ("vertex", "face")
        if element.lists:
            columns, at = _read_lists(path, data, element, order, at, wanted if needed else ())
        else:
            layout = np.dtype([(f"p{i}", order + entry[1]) for i, entry in enumerate(element.properties)])
            if len(data) - at < layout.itemsize * element.count:
                raise _truncated(path, element)
            table = np.frombuffer(data, layout, element.count, at)
            columns = {entry[0]: table[f"p{i}"] for i, entry in enumerate(element.properties)}
            at += layout.itemsize * element.count
        if element.name == "vertex":
            points = np.stack([np.asarray(columns[axis], dtype=np.float64).reshape(-1) for axis in "xyz"], axis=1)
        elif element.name == "face":
            triangles = next((columns[name] for name in CORNERS if name in columns), triangles)
            triangles = triangles if isinstance(triangles, np.ndarray) else fan(triangles)
    rest = data[at:]
    if len(rest) >= 12 and any(rest):
        raise MapError(f"{path} holds {len(rest)} bytes more than its header promises; save it again")
    return points, check_corners(path, points, triangles)


def _read_lists(path: Path, data: bytes, element: _Element, order: str, at: int, wanted) -> tuple[dict, int]:
    """The wanted columns of rows with lists, and where they end; all triangles at once where all are."""
    fixed = []
    for i, entry in enumerate(element.properties):
        fixed += (
            [(f"n{i}", order + entry[1]), (f"p{i}", order + entry[2], (3,))]
            if len(entry) == 3
            else [(f"p{i}", order + entry[1])]
        )
    layout = np.dtype(fixed)
    if len(data) - at >= layout.itemsize * element.count:
        table = np.frombuffer(data, layout, element.count, at)
        if all((table[name] == 3).all() for name in layout.names if name[0] == "n"):
            columns = {e[0]: table[f"p{i}"] for i, e in enumerate(element.properties) if e[0] in wanted}
            return columns, at + layout.itemsize * element.count
    columns = {entry[0]: [] for entry in element.properties if entry[0] in wanted}
    kinds = [tuple(np.dtype(order + kind) for kind in entry[1:]) for entry in element.properties]
    for _ in range(element.count):
        for (name, *_), kind in zip(element.properties, kinds, strict=True):
            length = 1
            if len(kind) == 2:
                if at + kind[0].itemsize > len(data):
                    raise _truncated(path, element)
                length = int(np.frombuffer(data, kind[0], 1, at)[0])
                at += kind[0].itemsize
            if length < 0 or at + length * kind[-1].itemsize > len(data):
                raise _truncated(path, element)
            if name in columns:
                columns[name].append(np.frombuffer(data, kind[-1], length, at))
            at += length * kind[-1].itemsize
    return columns, at


def _truncated(path: Path, element: _Element) -> MapError:
    told = f"it promises {element.count} rows of {element.name!r} and holds fewer"
    return MapError(f"{path} is truncated: {told}; save it again")


def fan(polygons: list) -> np.ndarray:
    """Triangles around the first corner of each polygon, int64 [triangles, 3]; those of two corners have none."""
    groups: dict[int, list] = {}
    for polygon in polygons:
        groups.setdefault(len(polygon), []).append(polygon)
    found = []
    for length, group in groups.items():
        corners = np.array(group).astype(np.int64)
        found += [corners[:, [0, i, i + 1]] for i in range(1, length - 1)]
    return np.concatenate(found) if found else np.empty((0, 3), np.int64)


def check_corners(path: Path, points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Triangles as int64 whose corners are all there."""
    triangles = np.asarray(triangles).astype(np.int64)
    if len(triangles) and not (0 <= triangles.min() and triangles.max() < len(points)):
        worst = triangles.max() if triangles.max() >= len(points) else triangles.min()
        raise MapError(f"{path} has a face with vertex {worst}, of {len(points)} there are; save it again")
    return triangles
