"""The `wavefront` planner: a waypoint in sight on the shortest way to the goal, for DWA to drive to.

Every few local steps a robot's map is brought up to date and, where the path held so far is blocked or used
up, the distance from the robot is searched over cells not known to be blocked until the goal is reached;
unknown cells count as passable, tight ones (near obstacles) as a detour. A goal inside an obstacle or out of
reach is replaced by the reached cell nearest to it. Every local step the waypoint becomes the farthest cell of
the path that is in the robot's radar range and in sight, drawn nearer where the robot could not brake in time.
`COMFORT`, `CREEP` and `HEADROOM` are tuned: docs/reports/planners.md.

A path holds its first `PATH_CELLS` cells only; the search is repeated long before a robot gets there. What is
held never outlives a macro step: a new goal always searches anew.

The distances are those of `geodesic`, which names the other searches; here is when to search, and what of it is driven.
"""

import numpy as np
import warp as wp

from maexp.kernels.arrays import Field, count_bytes, make_arrays
from maexp.kernels.constants import COMFORT, MARGIN_CELLS, UNREACHED
from maexp.kernels.drifting_grid import DrawnGrids
from maexp.kernels.dynamics import Robots
from maexp.kernels.geodesic import SEARCH, SKIP, DistanceSearch
from maexp.kernels.launches import Launch, launch_named
from maexp.kernels.occupancy_grid import KNOWN, KnownGrids, NavGrids, nav_cell, nav_center
from maexp.kernels.path_steps import (
    PATH_CELLS,
    in_sight,
    is_passable,
    nearest_cell,
    nearest_passable,
    path_slot,
    step_back,
)
from maexp.kernels.shards import Shard
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.traversability import PASSABLE, PassableGrids
from maexp.kernels.types import Maps, point_xy

wp.set_module_options(MODULE_OPTIONS)


@wp.kernel
def _start_search(
    # Map:
    grids: NavGrids,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    collided: wp.array2d(dtype=wp.int32),  # [env, robot]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    goal: wp.array2d(dtype=wp.vec2),  # [env, robot]
    waypoint: wp.array2d(dtype=wp.vec2),  # [env, robot]
    # In:
    passable: wp.array2d(dtype=wp.uint8),  # [mask row, cell]
    row_of_item: wp.array(dtype=wp.int32),  # [item]
    path: wp.array2d(dtype=wp.int32),  # [item, slot]
    path_total: wp.array(dtype=wp.int32),  # [item]
    path_used: wp.array(dtype=wp.int32),  # [item]
    distance: wp.array2d(dtype=wp.int32),  # [item, cell]
    # Out:
    sources: wp.array2d(dtype=wp.int32),  # [item, 1]
    stop: wp.array(dtype=wp.int32),  # [item]
):
    """Which robots need a new path, from where and to where; the others skip the search.

    A goal where no robot fits is replaced by the nearest cell where one does: should that be out of reach, the search
    will have reached all that can be.
    """
    e, i = wp.tid()
    item = e * center.shape[1] + i
    stop[item] = SKIP
    if active[e] == 0 or collided[e, i] != 0:
        return
    m = map_id[e]
    w = grids.width[m]
    h = grids.height[m]
    row = row_of_item[item]
    # A goal just set is the waypoint, too: then nothing is kept.
    moved = waypoint[e, i] - goal[e, i]
    just_set = moved[0] == 0.0 and moved[1] == 0.0
    total = path_total[item]
    used = path_used[item]
    kept = wp.min(total, PATH_CELLS)
    keep = not just_set and used >= 0 and (kept == total or 2 * used < kept)
    if keep:
        for j in range(used, kept):
            if not is_passable(passable, row, path[item, path_slot(j, total)]):
                keep = False
    if not keep:
        start = nearest_passable(passable, row, nav_cell(grids, m, point_xy(center[e, i])), w, h)
        end = nav_cell(grids, m, goal[e, i])
        if not is_passable(passable, row, end):
            end = nearest_cell(end, passable, row, distance, -1, w, h)
        sources[item, 0] = start
        stop[item] = end


@wp.kernel
def _trace_path(
    # Map:
    grids: NavGrids,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # State in:
    goal: wp.array2d(dtype=wp.vec2),  # [env, robot]
    # In:
    passable: wp.array2d(dtype=wp.uint8),  # [mask row, cell]
    row_of_item: wp.array(dtype=wp.int32),  # [item]
    distance: wp.array2d(dtype=wp.int32),  # [item, cell]
    stop: wp.array(dtype=wp.int32),  # [item]
    # Out:
    path: wp.array2d(dtype=wp.int32),  # [item, slot]
    path_total: wp.array(dtype=wp.int32),  # [item], cells of the whole path; 0 = none
    path_used: wp.array(dtype=wp.int32),  # [item], how far along it the waypoint is; -1 = out of sight
    path_ends: wp.array(dtype=wp.int32),  # [item], 1 = at the goal, 0 = at the nearest reached cell
):
    """Follow the distances back from the goal, or from the reached cell nearest to it."""
    e, i = wp.tid()
    item = e * goal.shape[1] + i
    if stop[item] == SKIP:
        return
    m = map_id[e]
    w = grids.width[m]
    h = grids.height[m]
    end = stop[item]
    wanted = nav_cell(grids, m, goal[e, i])
    if end >= 0:
        if distance[item, end] >= UNREACHED:
            end = -1
    if end < 0:
        end = nearest_cell(wanted, passable, row_of_item[item], distance, item, w, h)
    path_ends[item] = wp.where(end == wanted and end == stop[item], 1, 0)
    total = wp.int32(0)
    cell = end
    while cell >= 0:
        path[item, total % PATH_CELLS] = cell
        total += 1
        cell = step_back(passable, row_of_item[item], distance, item, cell, w, h)
    path_total[item] = total
    path_used[item] = 0


@wp.kernel
def _pick_waypoint(
    # Map:
    grids: NavGrids,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    collided: wp.array2d(dtype=wp.int32),  # [env, robot]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    goal: wp.array2d(dtype=wp.vec2),  # [env, robot]
    # In:
    reach: wp.array2d(dtype=wp.float32),  # [env, robot], how far a waypoint may be [m]
    passable: wp.array2d(dtype=wp.uint8),  # [mask row, cell]
    row_of_item: wp.array(dtype=wp.int32),  # [item]
    path: wp.array2d(dtype=wp.int32),  # [item, slot]
    path_total: wp.array(dtype=wp.int32),  # [item]
    path_ends: wp.array(dtype=wp.int32),  # [item]
    # State out:
    waypoint: wp.array2d(dtype=wp.vec2),  # [env, robot]
    # Out:
    path_used: wp.array(dtype=wp.int32),  # [item]
):
    """The farthest cell of the path in reach and in sight; the nearest one where none is; the goal itself
    once its cell is in sight, and where there is no path at all."""
    e, i = wp.tid()
    item = e * center.shape[1] + i
    if active[e] == 0 or collided[e, i] != 0:
        return
    m = map_id[e]
    w = grids.width[m]
    at = point_xy(center[e, i])
    here = nav_cell(grids, m, at)
    total = path_total[item]
    kept = wp.min(total, PATH_CELLS)
    chosen = wp.int32(-1)
    nearest = wp.int32(-1)
    nearest_gap = wp.float32(1.0e30)
    j = kept - 1
    while j >= 0 and chosen < 0:
        cell = path[item, path_slot(j, total)]
        gap = wp.length(nav_center(grids, m, cell) - at)
        if gap < nearest_gap:
            nearest = j
            nearest_gap = gap
        if gap <= reach[e, i]:
            if in_sight(passable, row_of_item[item], here, cell, w):
                chosen = j
        j -= 1
    path_used[item] = chosen
    if chosen < 0:
        chosen = nearest
    if chosen < 0 or (chosen == total - 1 and path_ends[item] == 1):
        waypoint[e, i] = goal[e, i]
    else:
        waypoint[e, i] = nav_center(grids, m, path[item, path_slot(chosen, total)])


PATHS = {
    "row_of_item": Field(wp.int32, "item", "", "mask that the robot uses"),
    "path": Field(wp.int32, "item step", "", "cells of its way"),
    "path_total": Field(wp.int32, "item", "", "cells of the whole way; 0 = none"),
    "path_used": Field(wp.int32, "item", "", "how far along it the waypoint is; -1 = out of sight"),
    "path_ends": Field(wp.int32, "item", "", "1 = at the goal, 0 = at the nearest reached cell"),
}
"""Arrays of `PathSearch`; an item is a robot."""


class PathSearch:
    """Paths of every robot of a run of envs over `PassableGrids`.

    Args:
        passable: where each robot fits.
        mask_of_robot: which of the masks of its env each robot uses, N numbers.
        shared: as in `DistanceSearch`.
    """

    def __init__(self, passable: PassableGrids, mask_of_robot: np.ndarray, shared: bool = False):
        device = passable.passable.device
        rows, cells = passable.passable.shape
        envs, robots = rows // passable.masks, len(mask_of_robot)
        items = envs * robots
        row_of_item = np.arange(envs)[:, None] * passable.masks + np.asarray(mask_of_robot)[None]
        self.passable, self.shape = passable, (envs, robots)
        self.search = DistanceSearch(items, cells, 1, device, shared)
        vars(self).update(make_arrays(PATHS, {"item": items, "step": PATH_CELLS}, device))
        self.row_of_item.assign(row_of_item.reshape(-1).astype(np.int32))

    def values(self) -> dict:
        """The arrays of maps, masks and paths, by the names of the kernels' parameters."""
        masks, known = self.passable, self.passable.known
        return (
            vars(self)
            | vars(self.search)
            | {
                "grids": known.grids,
                "map_id": known.map_id,
                "passable": masks.passable,
            }
        )

    def find(self, launch: Launch, active, collided, center, goal, waypoint) -> None:
        """New paths for the robots that need one."""
        given = {"active": active, "collided": collided, "center": center, "goal": goal, "waypoint": waypoint}
        launch_named(launch, _start_search, self.shape, self.values() | given)
        self.flood(launch)
        self.trace(launch, goal)

    def flood(self, launch: Launch) -> None:
        """Distances from `search.sources`, as far as `search.stop`."""
        masks, grids = self.passable, self.passable.known.grids
        self.search.search(launch, masks.passable, self.row_of_item, masks.grid_of_row, grids.width, grids.height)

    def trace(self, launch: Launch, goal) -> None:
        """Paths to the cells of `search.stop`; where that is -1, to the reached cell nearest to `goal`."""
        launch_named(launch, _trace_path, self.shape, self.values() | {"goal": goal})

    def pick(self, launch: Launch, active, collided, center, goal, reach, waypoint) -> None:
        """The waypoint of every robot on its path."""
        given = {"active": active, "collided": collided, "center": center, "goal": goal, "reach": reach}
        launch_named(launch, _pick_waypoint, self.shape, self.values() | given | {"waypoint": waypoint})


def distinct_masks(radius: np.ndarray, comfort: np.ndarray, each: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The distances of robots that differ (of `each` robot if asked), [E, K] twice, and the mask of each robot."""
    robots = radius.shape[1]
    if each:
        return radius, comfort, np.arange(robots)
    _, first, mask_of_robot = np.unique(
        np.concatenate([radius, comfort]), axis=1, return_index=True, return_inverse=True
    )
    return radius[:, first], comfort[:, first], mask_of_robot.reshape(-1)


class Wavefront:
    """What the planner keeps for a shard of a simulation.

    Attributes:
        known, passable, paths: what robots know, where they fit, their ways.
        narrowed: the robots with the clearance that DWA is to keep now.
        values: what kernels' parameters are named after.
    """

    def __init__(self, shard: Shard, maps: Maps, grids: NavGrids, cells: int, narrowed: Robots):
        limited, view = shard.settings.limited, shard.view
        threshold, clearance = shard.robots.collision_threshold.numpy(), shard.robots.clearance.numpy()
        rows = threshold.shape[1] if limited else 1
        radius, comfort, mask_of_robot = distinct_masks(threshold, COMFORT * clearance, limited)
        boundary = shard.known("boundary")
        free = shard.known("free")
        known = (maps, grids, view.map_id, free, boundary, rows, cells, shard.false_walls)
        if shard.settings.map_errors:
            self.known = DrawnGrids(*known, drawn=view.drawn, place_free=view.place_free)
        else:
            self.known = KnownGrids(*known)
        self.passable = PassableGrids(self.known, radius, comfort, MARGIN_CELLS, through_unknown=True)
        self.paths = PathSearch(self.passable, mask_of_robot)
        self.narrowed = narrowed
        self.narrowed.clearance = wp.clone(shard.robots.clearance)
        self.values = {
            "grids": grids,
            "walls": self.known.walls,
            "rows_per_env": self.known.rows_per_env,
            "path": self.paths.path,
            "path_total": self.paths.path_total,
            "path_used": self.paths.path_used,
            "clearance": self.narrowed.clearance,
        }


def grid_bytes(sizes: dict[str, int]) -> int:
    """Bytes of the grids and ways of the `wavefront` planner and of a `Navigation` for one env."""
    return sum(sum(count_bytes(table, sizes).values()) for table in (KNOWN, PASSABLE, SEARCH, PATHS))
