"""Arrays by tables: a row says type, axes and meaning; from it come the memory and how many bytes that is."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
import warp as wp


@dataclass(frozen=True)
class Field:
    """An array.

    Attributes:
        kind: Warp type of an entry.
        axes: names of its axes; a vector's own length is none of them.
        unit: of an entry, "" for numbers, flags and counts.
        meaning: what an entry is.
        fill: what stands in it at first.
    """

    kind: type
    axes: str
    unit: str
    meaning: str
    fill: int = 0

    @property
    def dtype(self) -> torch.dtype:
        """Type of the torch tensor that owns the memory."""
        return wp.dtype_to_torch(getattr(self.kind, "_wp_scalar_type_", self.kind))

    def shape(self, sizes: Mapping[str, int]) -> tuple[int, ...]:
        """Shape of that tensor; a vector's entries are its last axis."""
        return (*self.lengths(sizes), *getattr(self.kind, "_shape_", ()))

    def lengths(self, sizes: Mapping[str, int]) -> tuple[int, ...]:
        """Lengths of its axes."""
        return tuple(sizes[axis] for axis in self.axes.split())


def make_arrays(fields: Mapping[str, Field], sizes: Mapping[str, int], device: wp.Device | str) -> dict[str, wp.array]:
    """Warp arrays for the rows of a table."""

    def make(field: Field) -> wp.array:
        given = {"shape": field.lengths(sizes), "dtype": field.kind, "device": device}
        return wp.full(value=field.fill, **given) if field.fill else wp.zeros(**given)

    return {name: make(field) for name, field in fields.items()}


def count_bytes(fields: Mapping[str, Field], sizes: Mapping[str, int]) -> dict[str, int]:
    """Bytes of each."""
    return {name: math.prod(field.shape(sizes)) * field.dtype.itemsize for name, field in fields.items()}
