"""Point clouds from .pcd files of PCL: ascii, binary and compressed, with fields of 1 to 8 bytes."""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from maexp.envs.io.cloud_files import Cloud, check_promise, check_rest, float32_step, read_header, read_rows
from maexp.envs.maps.point_cloud import MAX_FILE_BYTES, MapError

KINDS = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
LARGE = 4 * 2**20  # bytes; unpacking more than this is left to Open3D, which takes seconds to load


@dataclass(frozen=True)
class _Head:
    """What a PCD header says; the fields are named in small letters."""

    fields: list[str]
    sizes: list[int]
    types: list[str]
    counts: list[int]
    points: int
    kind: str
    start: int  # byte at which the data begin

    @property
    def stride(self) -> int:
        return sum(size * count for size, count in zip(self.sizes, self.counts, strict=True))

    def offset(self, name: str, width: list[int]) -> int:
        """Sum of `width` times count over the fields before one."""
        at = self.fields.index(name)
        return sum(w * count for w, count in zip(width[:at], self.counts[:at], strict=True))

    def dtype(self, name: str) -> str:
        at = self.fields.index(name)
        return f"<{self.types[at].lower()}{self.sizes[at]}"


def read_pcd(path: Path) -> Cloud:
    """All points of a .pcd file.

    Raises:
        MapError: the header promises what the file does not hold, or other data than numbers.
    """
    head = _read_head(path)
    rest = path.stat().st_size - head.start
    least = 2 * sum(head.counts) if head.kind == "ascii" else head.stride
    if head.kind == "binary_compressed":
        _check_compressed(path, head, rest)
    check_promise(path, head.points, least, rest, head.kind)
    if head.kind == "ascii":
        columns = [head.offset(axis, [1] * len(head.fields)) for axis in "xyz"]
        points = read_rows(path, head.start, head.points, columns, sum(head.counts))
    elif head.kind == "binary":
        check_rest(path, head.start + head.points * head.stride, head.stride)
        points = _read_binary(path, head)
    else:
        points = _read_compressed(path, head)
    return Cloud(points, step=float32_step(points))


def _read_head(path: Path) -> _Head:
    lines, start = read_header(path, "DATA")
    entries = {words[0].upper(): words[1:] for words in map(str.split, lines) if len(words) > 1}
    try:
        fields = [name.lower() for name in entries.get("FIELDS") or entries["COLUMNS"]]  # COLUMNS: PCD 0.5
        kind = entries["DATA"][0].lower()
        sizes = [int(value) for value in entries["SIZE"]]
        types = [value.upper() for value in entries.get("TYPE", ["F"] * len(fields))]
        counts = [int(value) for value in entries.get("COUNT", ["1"] * len(fields))]
        width, height = int(entries["WIDTH"][0]), int(entries.get("HEIGHT", ["1"])[0])
        promised = int(entries.get("POINTS", [str(width * height)])[0])
    except (KeyError, ValueError) as error:
        raise MapError(f"{path} has no usable PCD header ({error}); save it again") from error
    known = len(fields) == len(sizes) == len(counts) == len(types)
    if not known or not {"x", "y", "z"} <= set(fields):
        raise MapError(f"{path}: PCD fields {' '.join(fields)} do not name x, y and z with a size each; save it again")
    if min(sizes) < 1 or max(sizes) > 8 or min(counts) < 0 or width * height != promised:
        raise MapError(f"{path}: PCD header is inconsistent ({promised} points, sizes {sizes}); save it again")
    for axis in "xyz":
        at = fields.index(axis)
        if sizes[at] not in KINDS.get(types[at], ()) or counts[at] > 1:
            told = f"TYPE {types[at]} SIZE {sizes[at]} COUNT {counts[at]}"
            raise MapError(f"{path}: PCD field {axis} is {told}, no number; save it again")
    if kind not in ("ascii", "binary", "binary_compressed"):
        raise MapError(f"{path}: PCD data is {kind!r}; ascii, binary and binary_compressed are read")
    return _settle_counts(path, _Head(fields, sizes, types, counts, promised, kind, start))


def _settle_counts(path: Path, head: _Head) -> _Head:
    """COUNT 0, from old converters, stands for 1 (as in PCL); for nothing where the data only fit so."""
    if 0 not in head.counts:
        return head
    counts = zip(head.fields, head.counts, strict=True)
    ones = replace(head, counts=[count or 1 for count in head.counts])
    empty = replace(head, counts=[count or int(name in "xyz") for name, count in counts])
    with path.open("rb") as file:
        file.seek(head.start)
        if head.kind == "ascii":
            return ones if len(file.readline().split()) == sum(ones.counts) else empty
        if head.kind == "binary_compressed":
            unpacked = struct.unpack("<4xI", file.read(8).ljust(8, b"\0"))[0]
            return ones if unpacked == head.points * ones.stride else empty
    return ones if path.stat().st_size - head.start >= head.points * ones.stride else empty


def _read_binary(path: Path, head: _Head) -> np.ndarray:
    formats = {"names": list("xyz"), "formats": [head.dtype(axis) for axis in "xyz"]}
    layout = np.dtype(formats | {"offsets": [head.offset(axis, head.sizes) for axis in "xyz"], "itemsize": head.stride})
    with path.open("rb") as file:
        file.seek(head.start)
        table = np.frombuffer(file.read(head.points * head.stride), dtype=layout)
    return np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)


def _read_compressed(path: Path, head: _Head) -> np.ndarray:
    """Unpacked data hold one field after the other, each of all points."""
    usual = all(head.dtype(axis) == "<f4" for axis in "xyz") and max(head.sizes) <= 4
    if usual and head.points * head.stride > LARGE and (found := _read_with_open3d(path, head.points)) is not None:
        return found
    with path.open("rb") as file:
        file.seek(head.start)
        packed = struct.unpack("<II", file.read(8))[0]
        data = _unpack(path, file.read(packed), head.points * head.stride)
    starts = [head.points * head.offset(axis, head.sizes) for axis in "xyz"]
    columns = [np.frombuffer(data, head.dtype(axis), head.points, at) for axis, at in zip("xyz", starts, strict=True)]
    return np.stack([column.astype(np.float64) for column in columns], axis=1)


def _unpack(path: Path, data: bytes, size: int) -> bytearray:
    """LZF: runs of bytes as they are, and copies of what was written up to 8 kB before."""
    result, at, i, end = bytearray(), 0, 0, len(data)
    try:
        while i < end and at <= size:
            code = data[i]
            i += 1
            if code < 32:
                result += data[i : i + code + 1]
                i, at = i + code + 1, at + code + 1
                continue
            length = code >> 5
            if length == 7:
                length += data[i]
                i += 1
            length, start = length + 2, at - ((code & 31) << 8) - data[i] - 1
            i += 1
            if start < 0:
                raise IndexError
            piece = result[start : start + length]
            result += piece if len(piece) == length else (piece * (length // len(piece) + 1))[:length]
            at += length
    except IndexError:
        at = -1
    if at != size or len(result) != size:
        raise MapError(f"{path} is damaged: its compressed points cannot be unpacked; save it again")
    return result


def _check_compressed(path: Path, head: _Head, rest: int) -> None:
    """The two lengths in front of compressed data must fit the file and the header."""
    with path.open("rb") as file:
        file.seek(head.start)
        begin = file.read(8)
    packed, unpacked = struct.unpack("<II", begin) if len(begin) == 8 else (0, 0)
    wanted = head.points * head.stride
    if packed == 0 or packed > rest - 8 or unpacked != wanted or wanted > MAX_FILE_BYTES:
        raise MapError(f"{path} is truncated: its data should have {packed} bytes, the file holds {max(0, rest - 8)}")


def _read_with_open3d(path: Path, promised: int) -> np.ndarray | None:
    """The points as Open3D reads them; None where it is not there, or reads other headers only."""
    try:
        import open3d  # late: it takes seconds to load
    except ImportError:
        return None
    try:
        with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
            cloud = open3d.io.read_point_cloud(
                str(path), format="pcd", remove_nan_points=False, remove_infinite_points=False
            )
    except (RuntimeError, MemoryError) as error:
        raise MapError(f"{path} cannot be read ({error}); save it again") from error
    points = np.asarray(cloud.points, dtype=np.float64)
    return points.copy() if len(points) == promised else None
