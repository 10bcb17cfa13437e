"""Imagined worlds of teams: what their robots know, and a guess for the rest, to play a team's future in.

Nothing true gets there but what robots know: no wall, free point, extent, robot or start that nobody has seen.
Unknown ground goes on beyond the known grid as far as the radar reaches.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
import warp as wp
from scipy.ndimage import distance_transform_edt

from maexp.envs.bank import CELLS_PER_RANGE, MapBank
from maexp.envs.branches import OF_POINTS, Branches, branch_env
from maexp.envs.config import CommConfig
from maexp.envs.nav_grid import bank_nav_grids
from maexp.envs.navigation import Navigation
from maexp.envs.targets import TargetTracker
from maexp.kernels.belief import NOBODY, recall, write_worlds
from maexp.kernels.block_size import block_sides
from maexp.kernels.constants import FREE, MARGIN_CELLS, OBSTACLE, UNKNOWN
from maexp.kernels.known_grid import NavGrids
from maexp.kernels.launches import finish_filling, record, replay

if TYPE_CHECKING:
    from maexp.envs.environment import ExplorationEnv

Guess = Callable[[torch.Tensor], torch.Tensor]
ENDLESS = 1 << 30  # total weight of an imagined map: nobody knows how much there is to see
FULL = 100  # weight of a cell that is free for certain
AWAY = 1.0e6  # where robots are put that a robot does not hear [m]


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
    in_range = (2 * math.ceil(max(one.range for one in env.radar_configs) / finest) + 3) ** 2
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


IN_GRIDS = {"origin": "cell_origin", "cell": "resolution"}
"""What navigation grids call two of these."""


class Beliefs(Branches):
    """Copies of teams in worlds of what their robots know.

    Where communication is limited, every robot decides in a world of its own: what it knows, and only those that it
    hears.

    Args:
        nav: of the env's teams, up to date: gives what they know.
        unknown: chance that a cell is free ground, float32 [B, H, W], from what is known, uint8 [B, H, W]; where it is
            less than half a wall stands, elsewhere it is what a newly covered cell counts. None: all is free.

    Attributes:
        guess: uint8 [W, C], `FREE` or `OBSTACLE`, for every cell of the worlds of the teams listed; counts where
            nothing is known.
    """

    _own = (*OF_POINTS, "hears", "contacts", "comm", "known_weight")

    def __init__(
        self,
        env: ExplorationEnv,
        teams: int,
        copies: int,
        nav: Navigation,
        unknown: Guess | None = None,
        local_steps: int | None = None,
    ):
        self.nav, self.unknown = nav, unknown
        ranges = [one.range for one in env.radar_configs]
        self.true_grids = env.simulation.nav_grids or bank_nav_grids(env.bank, env.device)[0]
        self.sizes = WorldSizes.around(self.true_grids, max(ranges), min(ranges))
        self.rows, self.worlds = nav.rows, teams * nav.rows
        super().__init__(env, teams, copies, local_steps)
        self.one_world = self.rows == 1
        self.tracker: TargetTracker | None = None
        self._fill_tables()
        self._allocate()
        self.env.simulation.tensors["comm"].fill_(True)
        self.env.simulation.tensors["hears"].fill_(-1)

    def _make_env(self, count: int) -> ExplorationEnv:
        bank = imagined_bank(self.origin, self.sizes, self.worlds)
        return branch_env(self.origin, count, bank, CommConfig(), self.local_steps)

    def _source(self) -> dict[str, torch.Tensor]:
        return self.origin.simulation.believed

    def _fill_tables(self) -> None:
        """For every true map what its imagined ones have one of, on the device."""
        sizes, true = self.sizes, self.origin.bank.arrays
        radius = self.origin.radar_configs[0].obstacle_radius
        width = sizes.edge / math.sqrt(2.0) if radius == "auto" else np.full_like(sizes.edge, radius)
        columns = {
            "resolution": sizes.edge,
            "occluder_radius_max": width,
            "cell_origin": sizes.origin,
            "cell_size": sizes.edge * sizes.tile,
            "cells_x": sizes.tiles_x,
            "cells_y": sizes.tiles_y,
            "lower": true["lower"],
            "upper": true["upper"],
            "frame_origin": true["frame_origin"],
            "pixel_size": true["pixel_size"],
            "width": sizes.width,
            "height": sizes.height,
            "margin": sizes.margin,
            "tile": sizes.tile,
            "block": sizes.block,
        }
        device = self.origin.device
        self.table = {name: torch.from_numpy(np.ascontiguousarray(one)).to(device) for name, one in columns.items()}

    def _allocate(self) -> None:
        env, maps, sizes, device = self.env, self.env.simulation.maps, self.sizes, self.origin.device
        grids, cells = env.bank.grids
        self.cells, self.tiles = cells, int((sizes.tiles_x * sizes.tiles_y).max())
        self.state, self.certain, self.guess = (
            torch.full((self.worlds, cells), FREE, dtype=torch.uint8, device=device) for _ in range(3)
        )
        self.worth = torch.full((self.worlds, cells), FULL, dtype=torch.uint8, device=device)
        self.wall = torch.full((self.worlds, self.nav.known.shape[-1]), NOBODY, dtype=torch.int32, device=device)
        index = torch.zeros((self.worlds, cells), dtype=torch.int32, device=device)
        count = torch.zeros((self.worlds, self.tiles, 3), dtype=torch.int32, device=device)
        pair_begin = torch.zeros((self.worlds, self.tiles), dtype=torch.int32, device=device)
        self.total = torch.zeros((self.worlds, 2), dtype=torch.int32, device=device)
        self.place = torch.zeros(self.worlds, dtype=torch.int32, device=device)
        self.own = {name: torch.zeros(self.worlds, dtype=torch.int32, device=device) for name in ("margin", "tile")}
        own = {name: wp.from_torch(one) for name, one in self.own.items()}
        self.values = own | {
            "maps": self.origin.simulation.maps,
            "grids": self.true_grids,
            "place": wp.from_torch(self.place),
            "rows_per_env": self.rows,
            "lanes": self.nav.known_grids.lanes,
            "robots": env.num_robots,
            "wall": wp.from_torch(self.wall),
            "guess": wp.from_torch(self.guess),
            "state": wp.from_torch(self.state),
            "certain": wp.from_torch(self.certain),
            "count": wp.from_torch(count),
            "index": wp.from_torch(index),
            "pair_begin": wp.from_torch(pair_begin),
            "total": wp.from_torch(self.total),
            "most_pairs": maps.neighbour.shape[0] // self.worlds,
            "tiles_x": maps.cells_x,
            "origin": grids.origin,
            "edge": grids.cell,
            "width": grids.width,
            "height": grids.height,
            "begin": maps.cell_begin,
            "free_begin": maps.free_begin,
            "boundary_begin": maps.boundary_begin,
            "free_cell": maps.free_cell,
            "boundary_cell": maps.boundary_cell,
            "worth": wp.from_torch(self.worth),
            "free_weight": maps.free_weight,
            "free": maps.free,
            "boundary": maps.boundary,
            "cell_of_free": grids.free_cell,
            "cell_of_boundary": grids.boundary_cell,
            "neighbour_begin": maps.neighbour_begin,
            "neighbour": maps.neighbour,
        }
        state = env.simulation.tensors
        names = ("map_id", "seen_free", "viewers_free", "seen_boundary", "viewers_boundary")
        recalled = {name: wp.from_torch(state[name]) for name in names}
        origin = self.origin.simulation.tensors
        self.known = torch.zeros((self.worlds, self.nav.known.shape[-1]), dtype=torch.uint8, device=device)
        self.flags = torch.zeros_like(origin["viewers_boundary" if self.rows == 1 else "known_boundary"][:1])
        self.flags = self.flags.repeat(self.teams, 1, 1)
        self.map_id = torch.zeros(self.teams, dtype=torch.int32, device=device)
        read = {name: wp.from_torch(getattr(self, name)) for name in ("known", "flags", "map_id")}
        where = wp.device_from_torch(device)
        self.writing = record(
            lambda launch: write_worlds(launch, self.worlds, self.cells, self.tiles, self.values | read), where
        )
        self.recalling = record(lambda launch: recall(launch, env.num_envs, self.values | recalled), where)
        self.grid_views = {name: wp.to_torch(getattr(grids, name)) for name in ("origin", "cell", "width", "height")}

    def look(self, teams: torch.Tensor) -> None:
        """Write the worlds of some teams, int64 [T']: what their robots know now."""
        super().look(teams)
        count = len(teams) * self.rows
        origin, maps = self.origin.simulation.tensors, self.env.simulation.map_tensors
        place = origin["map_id"][teams].repeat_interleave(self.rows)
        self.place[:count] = place
        place = place.long()
        for name in SCALARS:
            maps[name][:count] = self.table[name][place]
        maps["occluder_radius"].view(self.worlds, -1)[:count] = self.table["occluder_radius_max"][place].unsqueeze(1)
        for name, one in self.grid_views.items():
            one[:count] = self.table[IN_GRIDS.get(name, name)][place]
        for name, one in self.own.items():
            one[:count] = self.table[name][place]
        self._fit_blocks(place)
        self.wall[:count] = NOBODY
        self._take_up(teams)
        self.map_id[: len(teams)] = origin["map_id"][teams]
        if self.unknown is not None:
            self._guess(count)
        replay(self.writing)

    def _take_up(self, teams: torch.Tensor) -> None:
        """What the robots of some teams know: of each cell, and the walls that they have seen."""
        prefix = "known" if self.rows > 1 else "viewers"
        self.known[: len(teams) * self.rows] = self.nav._known[teams].flatten(0, 1)
        self.flags[: len(teams)] = self.origin.simulation.tensors[f"{prefix}_boundary"][teams]

    def _guess(self, count: int) -> None:
        """Let unknown cells of the first `count` worlds hold what `unknown` makes of what is known."""
        place = self.place[:count].long()
        for m in place.unique().tolist():
            worlds = (place == m).nonzero().squeeze(-1)
            width, height, margin = (int(getattr(self.sizes, one)[m]) for one in ("width", "height", "margin"))
            inner = (height - 2 * margin, width - 2 * margin)
            known = self.known[worlds, : math.prod(inner)].view(-1, *inner)
            known = torch.nn.functional.pad(known, (margin,) * 4, value=UNKNOWN)
            chance = self.unknown(known).flatten(1)
            self.guess[worlds, : width * height] = torch.where(chance >= 0.5, FREE, OBSTACLE).to(torch.uint8)
            self.worth[worlds, : width * height] = (FULL * chance).round().to(torch.uint8)

    def _place(self, rows: torch.Tensor, robot: int) -> None:
        """Worlds of the branches, and what their robots know and hear in them."""
        state, origin = self.env.simulation.tensors, self.origin.simulation.tensors
        count = len(rows)
        world = torch.arange(len(self.listed), device=rows.device, dtype=torch.int32) * self.rows
        state["map_id"][:count] = (world + (robot if self.rows > 1 else 0)).repeat_interleave(self.copies)
        replay(self.recalling)
        state["covered"][:count] = 0
        state["covered_before"][:count] = 0
        state["covered_sum"][:count] = 0
        if self.rows > 1:
            self._part(rows, robot, state, origin)

    def _part(self, rows: torch.Tensor, robot: int, state: dict, origin: dict) -> None:
        """Take away whom the robot does not hear: it neither moves, sees nor stands in the way."""
        count = len(rows)
        lost = ~origin["comm"][rows, robot]
        state["collided"][:count] |= lost.int()
        state["center"][:count] = torch.where(lost.unsqueeze(-1), AWAY, state["center"][:count])
        state["pose"][:count, :, :2] = torch.where(lost.unsqueeze(-1), AWAY, state["pose"][:count, :, :2])

    def disc(self) -> torch.Tensor:
        """Cells of a radar's disc, float32 [T * copies]."""
        reach = max(one.range for one in self.env.radar_configs)
        edge = self.grid_views["cell"][self.env.simulation.tensors["map_id"].long()]
        return FULL * torch.pi * (reach / edge) ** 2

    def blocks(self, block: torch.Tensor) -> torch.Tensor:
        """Numbers of blocks in the worlds: those of the true grid lie `margin` farther in."""
        place = self.origin.simulation.tensors["map_id"][self.listed].long()
        shape = (-1,) + (1,) * (block.dim() - 1)
        side = self.table["block"][place].view(shape)
        across = -(-(self.table["width"] - 2 * self.table["margin"])[place].view(shape) // side)
        wider = -(-self.table["width"][place].view(shape) // side)
        inward = self.table["margin"][place].view(shape) // side
        return (block // across + inward) * wider + block % across + inward

    def spread_blocks(self, values: torch.Tensor) -> torch.Tensor:
        """What the env keeps for every block, [E, N, blocks], for the branches: [T * copies, N, their blocks]."""
        kept = values[self.listed]
        place = self.origin.simulation.tensors["map_id"][self.listed].long()
        number = torch.arange(kept.shape[-1], device=kept.device).expand(len(kept), -1)
        side = self.table["block"][place].unsqueeze(1)
        inner = {name: self.table[name] - 2 * self.table["margin"] for name in ("width", "height")}
        across, down = (-(-one[place].unsqueeze(1) // side) for one in inner.values())
        there = (number < across * down).unsqueeze(1)
        index = torch.where(there, self.blocks(number).unsqueeze(1), 0).expand(kept.shape)
        spread = kept.new_zeros((*kept.shape[:2], self.num_blocks))
        spread.scatter_add_(2, index.long(), torch.where(there, kept, 0))
        return spread.repeat_interleave(self.copies, 0)

    def attach(self, tracker: TargetTracker) -> None:
        """Keep the targets of the branches, whose grids change with their worlds, up to date."""
        self.tracker, self.num_blocks = tracker, tracker.nav.num_blocks
        blocks = tracker.nav.blocks
        self.grid_views["cell"].fill_(float(self.sizes.edge.min()))
        tracker.nav._spread_rays(float(tracker.nav.radar_range))  # as long as the finest cells ask for
        threshold = max(one.collision_threshold for one in self.origin.robot_configs)
        search = np.ceil(np.float32(threshold) / self.sizes.edge + MARGIN_CELLS).astype(np.int32) + 1
        self.table["search"] = torch.from_numpy(search).to(self.origin.device)
        self.block_views = {name: wp.to_torch(getattr(blocks, name)) for name in ("block", "search")}

    def _fit_blocks(self, place: torch.Tensor) -> None:
        """Blocks of frontier cells as large as in the true grids."""
        if self.tracker is not None:
            for name, one in self.block_views.items():
                one[: len(place)] = self.table[name][place]
            reach = self.tracker.nav.radar_range
            self.tracker.disc[: len(place)] = torch.pi * (reach / self.table["resolution"][place]) ** 2


def guess_nearest(known: torch.Tensor) -> torch.Tensor:
    """1 where the nearest known cell is free, or nothing is known, and 0 where it is an obstacle.

    Args:
        known: uint8 [B, H, W].

    Returns:
        float32 [B, H, W].
    """
    found = torch.ones(known.shape)
    for grid, chance in zip(known.cpu().numpy(), found, strict=True):
        if (grid != UNKNOWN).any():
            nearest = distance_transform_edt(grid == UNKNOWN, return_distances=False, return_indices=True)
            chance.copy_(torch.from_numpy(grid[tuple(nearest)] == FREE))
    return found.to(known.device)
