"""What a planner needs to know of a running env: known grids, distances, targets and ways, as torch tensors.

A `Navigation` reads an `ExplorationEnv` and never writes to it. `update` brings everything up to date for all
envs at once, on the env's device, without a loop over envs or robots.
"""

from __future__ import annotations

import copy
import math
from typing import TYPE_CHECKING

import numpy as np
import torch
import warp as wp

from maexp.envs.maps.nav_grid import bank_block_sides, bank_nav_grids
from maexp.envs.simulation import navigation_bytes, refuse_too_many
from maexp.kernels import goals, information_gain, targets
from maexp.kernels.constants import COMFORT, MARGIN_CELLS, RAYS, STRAIGHT
from maexp.kernels.drifting_grid import DrawnGrids
from maexp.kernels.frontier_clusters import FrontierBlocks
from maexp.kernels.launches import Launch, finish_filling, launch_named, launch_on, record, replay, view
from maexp.kernels.occupancy_grid import KnownGrids
from maexp.kernels.rrt import _grow_tree
from maexp.kernels.traversability import PassableGrids
from maexp.kernels.wavefront import PathSearch, distinct_masks

if TYPE_CHECKING:
    from maexp.envs.environment import ExplorationEnv

OPEN_GROUND = 1.2  # places with so many clearances of room around are open: DWA pays nothing for being there
OPEN_SAMPLES = 7  # places on a way that are looked at


class RowView:
    """Tensors [E, ...] by name, of which only some rows are given out."""

    def __init__(self, tensors: dict[str, torch.Tensor], rows: torch.Tensor):
        self.tensors, self.rows = tensors, rows

    def __getitem__(self, name: str) -> torch.Tensor:
        return self.tensors[name][self.rows]


class Navigation:
    """Known grids, distances and targets of all envs of an `ExplorationEnv`.

    That of `some` is about some envs: E below then counts those. `grow_trees`, `waypoints` and
    `leads_through_open_ground` need all envs and are errors there.

    R rows per env hold what is known: 1 where all communicate, else N (a robot knows what it has heard). K is
    the number of blocks of the largest map, T the most blocks with a target that an env has now. Attributes below are
    valid after `update`.

    Attributes:
        known: uint8 [E, R, C], `UNKNOWN`, `FREE` or `OBSTACLE` by cell (iy * width + ix).
        known_count: int32 [E, R], cells that are not `UNKNOWN`.
        frontier: uint8 [E, R, C], known free cells with an unknown neighbour.
        distance: int32 [E, N, C], way from each robot over known free cells, 10 a cell; `UNREACHED` elsewhere.
        target: int64 [E, R, K], the cell to go to for each block with frontier cells; -1 = none.
        size: int32 [E, R, K], frontier cells in the block.
        block: int64 [E, 1, T], the blocks with a target in some row, in order; -1 fills up.
        cell: int64 [E, R, T], the cells to go to for these; -1 = none.
        point: float32 [E, N, T, 2], where those are [m].
        way: float32 [E, N, T], how far each robot has to drive there [m], infinite where there is no way.
        around: float32 [E, N, T], frontier cells in those blocks.
    """

    def __init__(self, env: ExplorationEnv):
        sim = env.simulation
        refuse_too_many(env.settings, navigation_bytes(env.settings, env.bank))
        self.envs: torch.Tensor | None = None
        self._state, self.device = sim.believed, env.device
        self.num_envs, self.num_robots = env.num_envs, env.num_robots
        self.launch = launch_on(env.device)
        limited = env.settings.limited
        names = ("map_id", "active", "collided", "macro_step", "seed", "env_id", "episode")
        self.arrays = {name: wp.from_torch(self._state[name]) for name in names}
        self.arrays["center"] = wp.from_torch(self._state["center"], dtype=wp.vec3)
        self.arrays |= {name: wp.from_torch(sim.map_tensors[name], dtype=wp.vec2) for name in ("lower", "upper")}
        self.known_grids = known_grids(env)
        self.grids, self.rows = self.known_grids.grids, self.known_grids.rows_per_env
        cells = self.known_grids.known.shape[1]
        threshold, clearance = (sim.robot_tensors[name].cpu().numpy() for name in ("collision_threshold", "clearance"))
        radius, comfort, mask_of_robot = distinct_masks(threshold, COMFORT * clearance, limited)
        self.passable = PassableGrids(self.known_grids, radius, comfort, MARGIN_CELLS, through_unknown=False)
        self.paths = PathSearch(self.passable, mask_of_robot, shared=True)
        room = np.ascontiguousarray((comfort * (OPEN_GROUND / COMFORT))[:, mask_of_robot])
        self.room = wp.array(room, dtype=wp.float32, device=str(env.device))
        least = min(r.range for r in env.radar_configs)
        self.blocks = FrontierBlocks(self.paths, bank_block_sides(env.bank, least), float(threshold.max()))
        self.num_blocks = self.blocks.num_blocks
        self._make_views(cells)
        self._listed = torch.arange(self.num_envs, dtype=torch.int32, device=env.device)
        self._updates = record(self._update, self.known_grids.known.device)
        self._rays: dict[float, list[wp.array]] = {}
        finish_filling(env.device)
        self.radar_range = max(r.range for r in env.radar_configs)
        self.clearance = float(sim.robot_tensors["clearance"].max())

    def _make_views(self, cells: int) -> None:
        """Outputs as torch tensors that share memory with the kernels' arrays."""
        e, n, r, blocks = self.num_envs, self.num_robots, self.rows, self.blocks
        self.cell_size, self.width, self.height = (
            wp.to_torch(getattr(self.grids, v)) for v in ("cell", "width", "height")
        )
        self.origin = wp.to_torch(self.grids.origin)
        self._known_count = wp.to_torch(self.known_grids.known_count).view(e, r)
        self._known, self._frontier = (
            wp.to_torch(array).view(e, r, cells) for array in (self.known_grids.known, blocks.frontier)
        )
        self._distance = wp.to_torch(self.paths.search.distance).view(e, n, cells)
        self._stop = wp.to_torch(self.paths.search.stop).view(e, n)
        self._target, self._size = (wp.to_torch(array).view(e, r, -1) for array in (blocks.target_cell, blocks.size))
        self._looked, self._count = wp.to_torch(self.known_grids.looked), wp.to_torch(blocks.count)

    def some(self, envs: torch.Tensor) -> Navigation:
        """The same of some envs, int64 [S], by itself: what is there of the others stays as it is."""
        found = copy.copy(self)
        found.envs, found._listed = envs, envs.to(torch.int32)
        return found

    def values(self) -> dict:
        """Arrays by the names of the kernels' parameters; `env` is int32 [S], the envs looked at."""
        return self.blocks.values() | self.arrays | {"env": view(self._listed)}

    def pick(self, values: torch.Tensor) -> torch.Tensor:
        """What concerns the envs looked at: [E, ...] -> [S, ...]."""
        return values if self.envs is None else values[self.envs]

    def put(self, values: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        """`values` [E, ...] with `rows` [S, ...] for the envs looked at."""
        return rows if self.envs is None else values.index_copy_(0, self.envs, rows)

    def _need_all(self, name: str) -> None:
        """Raise RuntimeError for that of `some`: what is asked for looks at all envs."""
        if self.envs is not None:
            raise RuntimeError(f"{name} is about all envs, and here are some")

    def _spread(self, rows: torch.Tensor) -> torch.Tensor:
        """[S, ...] -> int32 [E, ...], -1 for envs not looked at."""
        rows = rows.to(torch.int32).contiguous()
        return rows if self.envs is None else self.put(rows.new_full((self.num_envs, *rows.shape[1:]), -1), rows)

    def update(self) -> None:
        """Bring everything up to date with the env."""
        if self.envs is not None:
            self._looked.zero_().index_fill_(0, self.envs, 1)
        replay(self._updates)
        if self.envs is not None:
            self._looked.fill_(1)
        looks, most = len(self._listed), max(int(self.pick(self._count).max()), 1)
        shape, device = (looks, self.num_robots, most), self.device
        self.block = torch.empty((looks, 1, most), dtype=torch.int64, device=device)
        self.cell = torch.empty((looks, self.rows, most), dtype=torch.int64, device=device)
        self.point = torch.empty((*shape, 2), dtype=torch.float32, device=device)
        self.way = torch.empty(shape, dtype=torch.float32, device=device)
        self.around = torch.empty(shape, dtype=torch.float32, device=device)
        values = (
            self.values()
            | {"point": view(self.point, wp.vec2)}
            | {name: view(getattr(self, name)) for name in ("block", "cell", "way", "around")}
        )
        launch_named(self.launch, targets._list_targets, (looks, most), values)

    def _update(self, launch: Launch) -> None:
        """The launches of `update` that are always the same."""
        self.known_grids.paint(launch)
        self.known_grids.count(launch)
        self.passable.paint(launch)
        self.blocks.mark(launch)
        launch_named(launch, targets._locate_robots, self.paths.shape, self.values())
        self.paths.flood(launch)
        self.blocks.place(launch)

    @property
    def state(self) -> dict[str, torch.Tensor] | RowView:
        """The simulation's tensors, with the poses that robots believe to have."""
        return self._state if self.envs is None else RowView(self._state, self.envs)

    @property
    def known(self) -> torch.Tensor:
        return self.pick(self._known)

    @property
    def known_count(self) -> torch.Tensor:
        return self.pick(self._known_count)

    @property
    def frontier(self) -> torch.Tensor:
        return self.pick(self._frontier)

    @property
    def distance(self) -> torch.Tensor:
        return self.pick(self._distance)

    @property
    def target(self) -> torch.Tensor:
        return self.pick(self._target).long()

    @property
    def size(self) -> torch.Tensor:
        return self.pick(self._size)

    def look_around(
        self, radius: float, cells: torch.Tensor | None = None, known: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """What could be seen for the first time from every target, within ``radius`` [m] and in front of known walls.

        Args:
            radius: how far [m].
            cells: int64 [E, R, M], from where; -1 = nowhere. None: from the targets of all blocks.
            known: uint8 [E, R, C], what is taken for known. None: what is.

        Returns:
            float32 [E, R, K or M], unknown cells; float32 [E, R, K or M, 2], their middle, from the target [m].
        """
        start = self._spread(self.target if cells is None else cells).flatten(0, 1)
        grid = self.known_grids.known if known is None else wp.from_torch(known.flatten(0, 1).contiguous())
        area = torch.empty(start.shape, dtype=torch.float32, device=self.device)
        middle = torch.empty((*start.shape, 2), dtype=torch.float32, device=self.device)
        self.launch(
            information_gain._look_around,
            tuple(area.shape),
            [
                self.grids,
                self.known_grids.grid_of_row,
                grid,
                wp.from_torch(start),
                *self._spread_rays(radius),
                float(radius),
                wp.from_torch(area),
                wp.from_torch(middle, dtype=wp.vec2),
            ],
        )
        shape = (self.num_envs, self.rows, -1)
        return self.pick(area.view(shape)), self.pick(middle.view(*shape, 2))

    def look_from_targets(self) -> tuple[torch.Tensor, torch.Tensor]:
        """`look_around` as far as the radar reaches from the targets of `cell`: float32 [E, R, T] and [E, R, T, 2].

        What still holds since the last time is not computed again.
        """
        area = torch.empty(self.cell.shape, dtype=torch.float32, device=self.device)
        middle = torch.empty((*self.cell.shape, 2), dtype=torch.float32, device=self.device)
        radius = float(self.radar_range)
        ray_cell, ray_part = self._spread_rays(radius)
        values = self.values() | {
            "radius": radius,
            "block": view(self.block),
            "cell": view(self.cell),
            "ray_cell": ray_cell,
            "ray_part": ray_part,
            "area": view(area),
            "middle": view(middle, wp.vec2),
        }
        launch_named(self.launch, information_gain._look_from_targets, tuple(self.cell.shape), values)
        return area, middle

    def _spread_rays(self, radius: float) -> list[wp.array]:
        """The rays of a radius [m], computed once: their cells and what those count."""
        if radius not in self._rays:
            across = math.hypot(int(self.width.max()), int(self.height.max()))  # no ray stays in a grid for longer
            shape = (RAYS, int(min(radius / float(self.cell_size.min()), across)) + 2)
            rays = [wp.zeros(shape, dtype=kind, device=str(self.device)) for kind in (wp.vec2i, wp.vec3)]
            finish_filling(self.device)
            self.launch(information_gain._spread_rays, shape, rays)
            self._rays[radius] = rays
        return self._rays[radius]

    def grow_trees(self, samples: int, branch: float) -> torch.Tensor:
        """Targets that random trees of the robots came upon: bool [E, R, K].

        Args:
            samples: random points a tree grows toward.
            branch: length of the longest branch [m].
        """
        self._need_all("grow_trees")
        found = torch.zeros_like(self._target).flatten(0, 1)
        items = self.num_envs * self.num_robots
        node = torch.empty((items, samples, 2), dtype=torch.float32, device=self.device)
        state = [self.arrays[name] for name in ("seed", "env_id", "episode", "macro_step")]
        cells = branch / float(self.cell_size.max())
        self.launch(
            _grow_tree,
            items,
            [
                self.grids,
                self.arrays["map_id"],
                self.blocks.block,
                *state,
                self.known_grids.known,
                self.paths.search.sources,
                self.rows,
                self.num_robots,
                samples,
                cells,
                wp.from_torch(node, dtype=wp.vec2),
                wp.from_torch(found),
            ],
        )
        return found.view(self.num_envs, self.rows, -1) != 0

    def alive(self) -> torch.Tensor:
        """Robots that can still move: bool [E, N]."""
        stands = (self.state["collided"] != 0) | (self.state["failed"] != 0)
        return ~stands & (self.state["active"] != 0).unsqueeze(1)

    def centers(self) -> torch.Tensor:
        """Centres of the bodies [m]: float32 [E, N, 2]."""
        return self.state["center"][..., :2]

    def cell_of_env(self) -> torch.Tensor:
        """Edge of a cell of each env's grid [m]: float32 [E]."""
        return self.cell_size[self.state["map_id"].long()]

    def known_area(self) -> torch.Tensor:
        """What is known [m^2]: float32 [E, R]."""
        return (self.known != 0).sum(-1).float() * self.cell_of_env().unsqueeze(-1) ** 2

    def points(self, cells: torch.Tensor) -> torch.Tensor:
        """Centres of cells [m]: int64 [E, ...] -> float32 [E, ..., 2]."""
        m = self.state["map_id"].long()
        shape = (-1,) + (1,) * (cells.dim() - 1)
        width = self.width[m].long().view(shape)
        index = torch.stack([cells % width, cells // width], dim=-1).float() + 0.5
        return self.origin[m].view(*shape, 2) + index * self.cell_size[m].view(*shape, 1)

    def points_on_way(self, cells: torch.Tensor, ahead: float) -> torch.Tensor:
        """Points ``ahead`` [cells] in front of robots on their ways to ``cells``, int64 [E, N, M], -1 = none.

        Returns:
            float32 [E, N, M, 2] [m]; the first cell of the map where there is no way.
        """
        wanted = self._spread(cells)
        cell = torch.empty_like(wanted)
        self.launch(
            targets._first_cells,
            tuple(wanted.shape),
            [
                self.grids,
                self.arrays["map_id"],
                self.passable.passable,
                self.paths.row_of_item,
                self.paths.search.distance,
                wp.from_torch(wanted),
                int(STRAIGHT * ahead),
                wp.from_torch(cell),
            ],
        )
        return self.points(self.pick(cell).clamp_min(0).long())

    def waypoints(self, cells: torch.Tensor, points: torch.Tensor, reach: torch.Tensor) -> torch.Tensor:
        """The farthest point in sight on every robot's way.

        Args:
            cells: int64 [E, N], where to; -1 = to the cell nearest to `points` that the robot can get to.
            points: float32 [E, N, 2], where to [m], for robots without a cell.
            reach: float32 [E, N], how far away a waypoint may be [m].

        Returns:
            float32 [E, N, 2]: waypoints [m].
        """
        self._need_all("waypoints")
        a = self.arrays
        goal = torch.where((cells >= 0).unsqueeze(-1), self.points(cells.clamp_min(0)), points).contiguous()
        self._stop.copy_(cells)
        result = goal.clone()
        goal = wp.from_torch(goal, dtype=wp.vec2)
        self.paths.trace(self.launch, goal)
        self.paths.pick(
            self.launch,
            a["active"],
            a["collided"],
            a["center"],
            goal,
            wp.from_torch(reach.contiguous()),
            wp.from_torch(result, dtype=wp.vec2),
        )
        return result

    def leads_through_open_ground(self, points: torch.Tensor) -> torch.Tensor:
        """Whether a robot has `OPEN_GROUND` clearances of room somewhere on its straight way to a point.

        Args:
            points: float32 [E, N, 2], one for each robot [m].

        Returns:
            bool [E, N].
        """
        self._need_all("leads_through_open_ground")
        share = torch.linspace(0.0, 1.0, OPEN_SAMPLES, dtype=torch.float32, device=self.device).view(1, 1, -1, 1)
        at = self.centers().unsqueeze(2)
        m = self.state["map_id"].long().view(-1, 1, 1)
        cell = (at + share * (points.unsqueeze(2) - at) - self.origin[m]) / self.cell_size[m].unsqueeze(-1)
        x, y = cell.floor().long().clamp_min(0).unbind(-1)
        index = torch.minimum(y, self.height[m] - 1) * self.width[m] + torch.minimum(x, self.width[m] - 1)
        found = torch.empty(index.shape[:2], dtype=torch.bool, device=self.device)
        self.launch(
            targets._find_open_ground,
            tuple(found.shape),
            [
                self.grids,
                self.arrays["map_id"],
                self.known_grids.known,
                self.known_grids.walls,
                self.rows,
                wp.from_torch(index.to(torch.int32).contiguous()),
                self.room,
                wp.from_torch(found),
            ],
        )
        return found

    def aim(self, chosen: torch.Tensor, cell: torch.Tensor, toward: torch.Tensor) -> torch.Tensor:
        """Where robots go that have chosen targets, or anywhere, float32 [E, N, 2] [m].

        Args:
            chosen: int64 [E, N]; -1 = none.
            cell: int64 [E, N], where that is; -1 afterwards where there is none.
            toward: float32 [E, N, 2]; 0 afterwards where there is none.
        """
        target = torch.empty_like(toward)
        values = self.values() | {
            "chosen": view(chosen),
            "cell": view(cell),
            "toward": view(toward, wp.vec2),
            "target": view(target, wp.vec2),
        }
        launch_named(self.launch, goals._aim, tuple(chosen.shape), values)
        return target


def known_grids(env: ExplorationEnv) -> KnownGrids:
    """Grids of what the teams of an env know, a row for each env, or for each robot where communication is limited.

    Not those of the local planner `wavefront`, though at a decision they show the same (see `kernels.known_grid`).
    """
    sim, limited = env.simulation, env.settings.limited
    state, prefix = sim.tensors, "known" if limited else "viewers"
    grids, cells = (sim.nav_grids, sim.nav_cells) if sim.nav_cells else bank_nav_grids(env.bank, env.device)
    map_id, *flags = (wp.from_torch(state[name]) for name in ("map_id", f"{prefix}_free", f"{prefix}_boundary"))
    false = wp.from_torch(state["false_walls"]) if sim.settings.false_alarms else None
    known = (sim.maps, grids, map_id, *flags, env.num_robots if limited else 1, cells, false)
    if sim.settings.map_errors:
        return DrawnGrids(*known, **{name: wp.from_torch(state[name]) for name in ("drawn", "place_free")})
    return KnownGrids(*known)
