"""Imagined worlds of teams: what their robots know, and a guess for the rest, to play a team's future in.

Nothing true gets there but what robots know: no wall, free point, extent, robot or start that nobody has seen.
Unknown ground goes on beyond the known grid as far as the radar reaches.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import warp as wp
from scipy.ndimage import distance_transform_edt

from maexp.envs.config import CommConfig
from maexp.envs.imagined.branches import OF_POINTS, Branches, branch_env
from maexp.envs.imagined.map_batch import SCALARS, WorldSizes, imagined_bank
from maexp.envs.maps.nav_grid import bank_nav_grids
from maexp.envs.targets.navigation import Navigation
from maexp.envs.targets.tracker import TargetTracker
from maexp.kernels.constants import FREE, MARGIN_CELLS, OBSTACLE, UNKNOWN
from maexp.kernels.imagined_maps import NOBODY, recall, write_worlds
from maexp.kernels.launches import record, replay

if TYPE_CHECKING:
    from maexp.envs.environment import ExplorationEnv

Guess = Callable[[torch.Tensor], torch.Tensor]
FULL = 100  # weight of a cell that is free for certain
AWAY = 1.0e6  # where robots are put that a robot does not hear [m]
IN_GRIDS = {"origin": "cell_origin", "cell": "resolution"}
"""What navigation grids call two of `SCALARS`."""


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
        ranges = [radar.range for radar in env.radar_configs]
        self.true_grids = env.simulation.nav_grids or bank_nav_grids(env.bank, env.device)[0]
        self.sizes = WorldSizes.around(self.true_grids, max(ranges), min(ranges))
        self.rows, self.worlds = nav.rows, teams * nav.rows
        super().__init__(env, teams, copies, local_steps)
        self.one_world = self.rows == 1
        self.tracker: TargetTracker | None = None
        self._fill_tables()
        self._allocate()
        self._record()
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
        self.table = {
            name: torch.from_numpy(np.ascontiguousarray(column)).to(device) for name, column in columns.items()
        }

    def _allocate(self) -> None:
        sizes, device = self.sizes, self.origin.device
        self.cells, self.tiles = self.env.bank.grids[1], int((sizes.tiles_x * sizes.tiles_y).max())
        shape = (self.worlds, self.cells)
        self.state, self.certain, self.guess = (
            torch.full(shape, FREE, dtype=torch.uint8, device=device) for _ in range(3)
        )
        self.worth = torch.full(shape, FULL, dtype=torch.uint8, device=device)
        self.wall = torch.full((self.worlds, self.nav.known.shape[-1]), NOBODY, dtype=torch.int32, device=device)
        self.index = torch.zeros(shape, dtype=torch.int32, device=device)
        self.count = torch.zeros((self.worlds, self.tiles, 3), dtype=torch.int32, device=device)
        self.pair_begin = torch.zeros((self.worlds, self.tiles), dtype=torch.int32, device=device)
        self.total = torch.zeros((self.worlds, 2), dtype=torch.int32, device=device)
        self.place = torch.zeros(self.worlds, dtype=torch.int32, device=device)
        self.own = {name: torch.zeros(self.worlds, dtype=torch.int32, device=device) for name in ("margin", "tile")}
        self.known = torch.zeros((self.worlds, self.nav.known.shape[-1]), dtype=torch.uint8, device=device)
        flags = self.origin.simulation.tensors["viewers_boundary" if self.rows == 1 else "known_boundary"]
        self.flags = torch.zeros_like(flags[:1]).repeat(self.teams, 1, 1)
        self.map_id = torch.zeros(self.teams, dtype=torch.int32, device=device)

    def _kernel_values(self) -> dict[str, Any]:
        """What kernels of worlds take, by their parameters' names."""
        maps, grids = self.env.simulation.maps, self.env.bank.grids[0]
        own = ("wall", "guess", "state", "certain", "count", "index", "pair_begin", "total", "worth", "place")
        values = {name: wp.from_torch(value) for name, value in self.own.items()}
        values |= {name: wp.from_torch(getattr(self, name)) for name in own}
        return values | {
            "maps": self.origin.simulation.maps,
            "grids": self.true_grids,
            "rows_per_env": self.rows,
            "lanes": self.nav.known_grids.lanes,
            "robots": self.env.num_robots,
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
            "free_weight": maps.free_weight,
            "free": maps.free,
            "boundary": maps.boundary,
            "cell_of_free": grids.free_cell,
            "cell_of_boundary": grids.boundary_cell,
            "neighbour_begin": maps.neighbour_begin,
            "neighbour": maps.neighbour,
        }

    def _record(self) -> None:
        """The launches that write worlds, and those that let robots recall what they know in them."""
        env, grids, values = self.env, self.env.bank.grids[0], self._kernel_values()
        names = ("map_id", "seen_free", "viewers_free", "seen_boundary", "viewers_boundary")
        recalled = {name: wp.from_torch(env.simulation.tensors[name]) for name in names}
        read = {name: wp.from_torch(getattr(self, name)) for name in ("known", "flags", "map_id")}
        where = wp.device_from_torch(self.origin.device)
        self.writing = record(
            lambda launch: write_worlds(launch, self.worlds, self.cells, self.tiles, values | read), where
        )
        self.recalling = record(lambda launch: recall(launch, env.num_envs, values | recalled), where)
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
        for name, view in self.grid_views.items():
            view[:count] = self.table[IN_GRIDS.get(name, name)][place]
        for name, tensor in self.own.items():
            tensor[:count] = self.table[name][place]
        self._fit_blocks(place)
        self.wall[:count] = NOBODY
        self._take_up(teams)
        self.map_id[: len(teams)] = origin["map_id"][teams]
        if self.unknown is not None:
            self._guess(count)
        replay(self.writing)

    def _take_up(self, teams: torch.Tensor) -> None:
        """What the robots of some teams know: of each cell, and the walls that they have seen.

        Where maps have errors nobody knows where those are: all walls stand in the middle of their cells.
        """
        self.known[: len(teams) * self.rows] = self.nav._known[teams].flatten(0, 1)
        if self.origin.settings.odometry.map_errors:
            return
        prefix = "known" if self.rows > 1 else "viewers"
        self.flags[: len(teams)] = self.origin.simulation.tensors[f"{prefix}_boundary"][teams]

    def _guess(self, count: int) -> None:
        """Let unknown cells of the first `count` worlds hold what `unknown` makes of what is known."""
        place = self.place[:count].long()
        for m in place.unique().tolist():
            worlds = (place == m).nonzero().squeeze(-1)
            width, height, margin = (int(getattr(self.sizes, name)[m]) for name in ("width", "height", "margin"))
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
        reach = max(radar.range for radar in self.env.radar_configs)
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
        across, down = (-(-cells[place].unsqueeze(1) // side) for cells in inner.values())
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
        threshold = max(robot.collision_threshold for robot in self.origin.robot_configs)
        search = np.ceil(np.float32(threshold) / self.sizes.edge + MARGIN_CELLS).astype(np.int32) + 1
        self.table["search"] = torch.from_numpy(search).to(self.origin.device)
        self.block_views = {name: wp.to_torch(getattr(blocks, name)) for name in ("block", "search")}

    def _fit_blocks(self, place: torch.Tensor) -> None:
        """Blocks of frontier cells as large as in the true grids."""
        if self.tracker is not None:
            for name, view in self.block_views.items():
                view[: len(place)] = self.table[name][place]
            reach = self.tracker.nav.radar_range
            self.tracker.disc[: len(place)] = torch.pi * (reach / self.table["resolution"][place]) ** 2


def guess_nearest(known: torch.Tensor) -> torch.Tensor:
    """1 where the nearest known cell is free, or nothing is known, and 0 where it is an obstacle.

    Args:
        known: uint8 [B, H, W].

    Returns:
        float32 [B, H, W].
    """
    found = torch.ones(known.shape, dtype=torch.float32)
    for grid, chance in zip(known.cpu().numpy(), found, strict=True):
        if (grid != UNKNOWN).any():
            nearest = distance_transform_edt(grid == UNKNOWN, return_distances=False, return_indices=True)
            chance.copy_(torch.from_numpy(grid[tuple(nearest)] == FREE))
    return found.to(known.device)
