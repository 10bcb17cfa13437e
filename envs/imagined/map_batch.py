"""Room for imagined worlds (`maexp.envs.imagined.maps`): their grids, and a bank of maps that every team writes
anew."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
import warp as wp

from maexp.envs.maps.map_batch import CELLS_PER_RANGE, MapBank
from maexp.kernels.constants import block_sides
from maexp.kernels.launches import finish_filling
from maexp.kernels.occupancy_grid import NavGrids

if TYPE_CHECKING:
    from maexp.envs.environment import ExplorationEnv

ENDLESS = 1 << 30  # total weight of an imagined map: nobody knows how much there is to see


@dataclass(frozen=True)
class WorldSizes:
    """Grids of imagined worlds, a row for every true map; lengths in cells, but for `edge` and `origin` [m]."""

    edge: np.ndarray  # float32 [M], of a cell
    origin: np.ndarray  # float32 [M, 2], lower corner of cell (0, 0)
    width: np.ndarray  # int32 [M], with the margin
    height: np.ndarray
    margin: np.ndarray
    tile: np.ndarray  # the radar's cells
    block: np.ndarray  # blocks of frontier cells

    @classmethod
    def around(cls, grids: NavGrids, most: float, least: float) -> WorldSizes:
        """Grids around the true ones, for radars that reach `most` and at least `least` metres."""
        edge, width, height = (getattr(grids, name).numpy() for name in ("cell", "width", "height"))
        block = block_sides(edge, least, width, height)  # as in the true grids
        margin = (np.ceil((np.ceil(most / edge) + 1) / block) * block).astype(np.int32)
        return cls(
            edge=edge,
            origin=(grids.origin.numpy() - edge[:, None] * margin[:, None]).astype(np.float32),
            width=width + 2 * margin,
            height=height + 2 * margin,
            margin=margin,
            tile=np.maximum(1, np.round(most / CELLS_PER_RANGE / edge)).astype(np.int32),
            block=block,
        )

    @property
    def tiles_x(self) -> np.ndarray:
        """Tiles along x, int32 [M]."""
        return -(-self.width // self.tile)

    @property
    def tiles_y(self) -> np.ndarray:
        """Tiles along y, int32 [M]."""
        return -(-self.height // self.tile)


@dataclass(frozen=True)
class ImaginedMap:
    """Stands for a map in the bank of imagined worlds."""

    name: str
    resolution: float
    extent: tuple[tuple[float, float], tuple[float, float]]


@dataclass
class ImaginedBank(MapBank):
    """Room for imagined maps."""

    def tensors(self, device: torch.device) -> dict[str, torch.Tensor]:
        """The arrays on ``device``; walls are what masks the radar."""
        tensors = super().tensors(device)
        return tensors | {
            name: tensors[name.replace("occluder", "boundary")]
            for name in ("occluder", "occluder_begin", "occluder_cell")
        }


def imagined_bank(env: ExplorationEnv, sizes: WorldSizes, worlds: int) -> ImaginedBank:
    """Room for `worlds` maps as large as the largest."""
    cells, tiles = int((sizes.width * sizes.height).max()), int((sizes.tiles_x * sizes.tiles_y).max())
    points, pairs = cells + 1, 4 * cells  # of four pairs of neighbours a cell, no pattern parts more than three
    begin = np.arange(worlds + 1, dtype=np.int32)
    scalars = {
        "total_weight": np.full(worlds, ENDLESS, np.int32),
        "outline_radius_max": np.repeat(env.bank.arrays["outline_radius_max"].max(), worlds),
    } | {name: np.repeat(env.bank.arrays[name][:1], worlds, 0) for name in SCALARS}
    arrays = {
        "free": np.zeros((worlds * points, 3), np.float32),
        "free_weight": np.ones(worlds * points, np.int32),
        "free_clearance": np.zeros(worlds * points, np.float32),
        "free_begin": begin * points,
        "free_cell": np.zeros(worlds * (tiles + 1), np.int32),
        "boundary": np.zeros((worlds * points, 3), np.float32),
        "boundary_begin": begin * points,
        "boundary_cell": np.zeros(worlds * (tiles + 1), np.int32),
        "neighbour_begin": np.zeros(worlds * points + 1, np.int32),
        "neighbour": np.zeros(worlds * pairs, np.int32),
        "occluder": np.zeros((0, 3), np.float32),
        "occluder_begin": begin,
        "occluder_cell": begin,
        "occluder_radius": np.zeros(worlds * points, np.float32),
        "cell_begin": begin[:-1] * (tiles + 1),
        "shown_begin": begin[:-1] * 0,
        "point_pixel_begin": np.zeros(1, np.int32),
        "point_pixel": np.zeros(1, np.int32),
        "pixel_point_begin": np.zeros(1, np.int32),
        "pixel_point": np.zeros(1, np.int32),
    }
    finest, coarsest = float(sizes.edge.min()), float(sizes.edge.max())
    width, height = int(sizes.width.max()), int(sizes.height.max())
    in_range = (2 * math.ceil(max(radar.range for radar in env.radar_configs) / finest) + 3) ** 2
    grids = NavGrids()
    values = {
        "origin": (np.zeros((worlds, 2), np.float32), wp.vec2),
        "cell": (np.full(worlds, coarsest, np.float32), wp.float32),
        "width": (np.full(worlds, width, np.int32), wp.int32),
        "height": (np.full(worlds, height, np.int32), wp.int32),
        "free_cell": (np.zeros(worlds * points, np.int32), wp.int32),
        "boundary_cell": (np.zeros(worlds * points, np.int32), wp.int32),
        "cell_begin": (np.zeros(worlds + 1, np.int32), wp.int32),
        "stand_in": (np.arange(width * height, dtype=np.int32), wp.int32),
        "void_begin": (np.zeros(width * height + 1, np.int32), wp.int32),
        "voids": (np.zeros(1, np.int32), wp.int32),
    }
    for name, (array, kind) in values.items():
        setattr(grids, name, wp.array(array, dtype=kind, device=str(env.device)))
    finish_filling(env.device)
    side = ((0.0, 0.0), (finest * (width - 1), finest * (height - 1)))
    return ImaginedBank(
        maps=[ImaginedMap(f"imagined_{k}", finest, side) for k in range(worlds)],
        arrays=arrays | scalars,
        order_free=[],
        order_boundary=[],
        max_free=points,
        max_boundary=points,
        free_in_range=in_range,
        boundary_in_range=in_range,
        occluders_in_range=in_range,
        grids=(grids, width * height),
        block_sides=np.full(worlds, sizes.block.min()),
    )


SCALARS = (
    "resolution",
    "occluder_radius_max",
    "cell_origin",
    "cell_size",
    "cells_x",
    "cells_y",
    "lower",
    "upper",
    "frame_origin",
    "pixel_size",
)
"""What an imagined map has one of, set anew for every team."""
