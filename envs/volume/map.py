"""A map of voxels: free, occupied and unknown space in three dimensions, and its file format."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np

from maexp.envs.maps.point_cloud import MapError, _as_text, _check_resolution, read_npz, write_npz

MAX_MAP_VOXELS = 64_000_000  # of the box of a map
WORD_BITS = 32  # layers of a column in one word
_FORMAT = "maexp-voxels-1"
_TEXTS = ("format", "name", "scenario")
_NUMBERS = {"resolution": (), "origin": (3,), "shape": (3,)}
_GRIDS = ("free", "occupied")


@dataclass(frozen=True, eq=False, init=False, repr=False)
class VoxelMap:
    """Free and occupied voxels of a box; what is neither is unknown and lies outside.

    Args:
        free: explorable voxels, bool [X, Y, Z].
        occupied: voxels that block motion and sight, bool [X, Y, Z]; none of them free.
        resolution: side of a voxel [m].
        origin: (x, y, z) [m], the lowest corner of voxel (0, 0, 0), which spans one resolution from there.
        name: what tables and file names call the map.
        scenario: whose parameters (robot, radar, steps) fit the map; "volume" for imports.

    Raises:
        MapError: no free voxel, wrong shapes or types, a voxel that is both, more than 64 million voxels,
            resolution <= 0, or coordinates too large for float32.
    """

    free: np.ndarray
    occupied: np.ndarray
    resolution: float
    origin: tuple[float, float, float]
    name: str
    scenario: str

    def __init__(
        self,
        free,
        occupied,
        resolution: float,
        origin=(0.0, 0.0, 0.0),
        *,
        name: str = "map",
        scenario: str = "volume",
    ):
        resolution = _check_resolution(resolution)
        free, occupied = _check_grid("free", free), _check_grid("occupied", occupied)
        if free.shape != occupied.shape:
            raise MapError(f"free has shape {free.shape} and occupied {occupied.shape}; give both one shape [X, Y, Z]")
        both = int(np.count_nonzero(free & occupied))
        if both:
            raise MapError(f"{both} voxels are free and occupied; give each voxel one state")
        if not free.any():
            raise MapError("free has 0 voxels; a map needs at least one free voxel to explore")
        values = {
            "free": free,
            "occupied": occupied,
            "resolution": resolution,
            "origin": _check_origin(origin, free.shape, resolution),
            "name": str(name),
            "scenario": str(scenario),
        }
        for field, value in values.items():
            object.__setattr__(self, field, value)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxels along x, y and z."""
        nx, ny, nz = self.free.shape
        return nx, ny, nz

    @property
    def extent(self) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """((xmin, ymin, zmin), (xmax, ymax, zmax)) [m]: the box of all voxels."""
        x, y, z = (low + count * self.resolution for low, count in zip(self.origin, self.shape, strict=True))
        return self.origin, (x, y, z)

    @property
    def free_volume(self) -> float:
        """Volume of the free voxels [m^3]."""
        return float(np.count_nonzero(self.free)) * self.resolution**3

    @property
    def num_words(self) -> int:
        """Words of one column, W in `words`."""
        return -(-self.free.shape[2] // WORD_BITS)

    def words(self) -> tuple[np.ndarray, np.ndarray]:
        """Free and occupied voxels as bits, int32 [X, Y, W] each: bit b of word w is layer z = 32 * w + b."""
        return pack_words(self.free), pack_words(self.occupied)

    def centres(self, mask: np.ndarray) -> np.ndarray:
        """Centres [m] of the true voxels of `mask`, bool [X, Y, Z]; float32 [count, 3], in the order of x, y, z."""
        return ((np.argwhere(mask) + 0.5) * self.resolution + self.origin).astype(np.float32)

    def indices(self, points) -> np.ndarray:
        """Voxels that hold `points` [m], shape [..., 3]; int64 [..., 3], outside the grid for points outside."""
        away = np.asarray(points, dtype=np.float64) - self.origin
        return np.floor(away / self.resolution).astype(np.int64)

    def __repr__(self) -> str:
        nx, ny, nz = self.shape
        return (
            f"VoxelMap({self.name!r}, {nx} x {ny} x {nz} voxels of {self.resolution:g} m, "
            f"{np.count_nonzero(self.free)} free, {np.count_nonzero(self.occupied)} occupied)"
        )

    def save(self, path: str | os.PathLike):
        """Writes the map as .npz (no pickle) and returns its path; the file appears whole or not at all.

        Raises MapError where it cannot be written: no such folder, a full disk.
        """
        return write_npz(path, self.to_arrays())

    def to_arrays(self) -> dict[str, np.ndarray]:
        """The arrays of a map file, to write them beside others; eight voxels a byte, z fastest."""
        arrays = {name: np.packbits(getattr(self, name)) for name in _GRIDS}
        texts = {"format": _FORMAT, "name": self.name, "scenario": self.scenario}
        arrays |= {name: np.array(text, dtype=np.str_) for name, text in texts.items()}
        arrays |= {"resolution": np.float64(self.resolution), "origin": np.array(self.origin, dtype=np.float64)}
        return arrays | {"shape": np.array(self.shape, dtype=np.int64)}

    @classmethod
    def load(cls, path: str | os.PathLike) -> VoxelMap:
        """Reads what `save` wrote; raises MapError on any other or damaged file."""
        return cls.from_arrays(read_npz(path), path)

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray], path: str | os.PathLike) -> VoxelMap:
        """The map among the arrays that `path` held; raises MapError as `load` does."""
        missing = {*_TEXTS, *_NUMBERS, *_GRIDS} - arrays.keys()
        if missing:
            raise MapError(
                f"{path} is a .npz file but not a map of voxels (no {', '.join(sorted(missing))}); "
                "save maps with VoxelMap.save"
            )
        texts = {name: _as_text(path, name, arrays[name]) for name in _TEXTS}
        if texts["format"] != _FORMAT:
            raise MapError(f"{path} has map format {texts['format']!r}; this version reads {_FORMAT!r}")
        for name, shape in _NUMBERS.items():
            if arrays[name].shape != shape or arrays[name].dtype.kind not in "fiu":
                raise MapError(f"{path}: {name} must be numbers of shape {shape}, found {arrays[name].shape}")
        try:
            shape = _check_shape(arrays["shape"].tolist())
            return cls(
                *(_unpack(name, arrays[name], shape) for name in _GRIDS),
                resolution=float(arrays["resolution"]),
                origin=arrays["origin"],
                name=texts["name"],
                scenario=texts["scenario"],
            )
        except MapError as error:
            raise MapError(f"{path}: {error}") from error


def is_voxel_file(arrays: dict[str, np.ndarray]) -> bool:
    """Whether the arrays of an .npz file are those of a map of voxels, of whatever version."""
    mark = arrays.get("format")
    return mark is not None and mark.dtype.kind == "U" and mark.shape == () and str(mark).startswith("maexp-voxels-")


def pack_words(mask: np.ndarray) -> np.ndarray:
    """Layers as bits: bool [X, Y, Z] to int32 [X, Y, W], bit b of word w is layer z = 32 * w + b."""
    nx, ny, nz = mask.shape
    count = -(-nz // WORD_BITS)
    layers = np.zeros((nx, ny, count * WORD_BITS), dtype=bool)
    layers[..., :nz] = mask
    octets = np.packbits(layers, axis=-1, bitorder="little")
    return octets.view("<i4").astype(np.int32, copy=False)


def unpack_words(words: np.ndarray, layers: int) -> np.ndarray:
    """The inverse: int32 [X, Y, W] to bool [X, Y, layers]."""
    octets = np.ascontiguousarray(words).astype("<i4", copy=False).view(np.uint8)
    return np.unpackbits(octets, axis=-1, count=layers, bitorder="little").astype(bool)


def _check_grid(name: str, grid) -> np.ndarray:
    try:
        grid = np.asarray(grid)
    except ValueError:
        raise MapError(f"{name} is ragged; give an array of shape [X, Y, Z]") from None
    if grid.dtype != bool or grid.ndim != 3:
        raise MapError(f"{name} has shape {grid.shape} and dtype {grid.dtype}; give bool [X, Y, Z]")
    _check_shape(grid.shape)
    return np.ascontiguousarray(grid)


def _check_shape(shape) -> tuple[int, int, int]:
    nx, ny, nz = (int(count) for count in shape)
    if min(nx, ny, nz) < 1 or nx * ny * nz > MAX_MAP_VOXELS:
        raise MapError(
            f"the map has {nx} x {ny} x {nz} voxels; between 1 and {MAX_MAP_VOXELS:,} are possible: crop it, or take a "
            "larger resolution"
        )
    return nx, ny, nz


def _check_origin(origin, shape, resolution: float) -> tuple[float, float, float]:
    try:
        low = np.asarray(origin, dtype=np.float64)
    except (TypeError, ValueError):
        raise MapError(f"origin={origin!r} must be three numbers of metres") from None
    if low.shape != (3,) or not np.isfinite(low).all():
        raise MapError(f"origin={origin!r} must be three finite numbers of metres")
    largest = float(max(np.abs(low).max(), np.abs(low + np.multiply(shape, resolution)).max()))
    if largest * 2.0**-23 > 0.1 * resolution:
        raise MapError(
            f"the map has coordinates up to {largest:g} m, too large for float32 at {resolution:g} m; "
            "subtract an offset from its origin"
        )
    x, y, z = low.tolist()
    return x, y, z


def _unpack(name: str, octets: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    nx, ny, nz = shape
    count = nx * ny * nz
    if octets.dtype != np.uint8 or octets.shape != (-(-count // 8),):
        raise MapError(f"{name} has {octets.shape} {octets.dtype}, not the bits of {nx} x {ny} x {nz} voxels")
    return np.unpackbits(octets, count=count).astype(bool).reshape(shape)
