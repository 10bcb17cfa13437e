"""Volumes as the kernels want them: words of bits, what can be seen and where robots can be, trees of rays."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
import warp as wp
from scipy import ndimage

from maexp.envs.config import RadarConfig, RobotConfig
from maexp.envs.maps.point_cloud import MapError
from maexp.envs.volume.map import VoxelMap, pack_words, unpack_words
from maexp.kernels.volume.coarse import Cells
from maexp.kernels.volume.gain import Views
from maexp.kernels.volume.grid import VoxelMaps
from maexp.kernels.volume.motion import Fliers
from maexp.kernels.volume.rays import RayTrees, grow_trees
from maexp.kernels.volume.reset import StartPlaces
from maexp.kernels.volume.scan import Sensors
from maexp.kernels.volume.seeable import mark_seeable

CELL = 0.5  # side of the cells that ways and gains are found on, at most [m]
MOST_SIDE = 6  # voxels along a cell: the kernels count those unknown in a byte
BLOCKS_PER_RANGE = 2.5  # blocks of frontiers in a radar's range
DISC_OF_VIEW = 0.27
"""Gains count in this share of a full view: so 0.3 of it, what is worth a way in the plane (`choices.LEAST_GAIN`), is
8 % of a view."""
START_BALL = 1.5  # what robots know around their start, whatever their sensor [m]
OF_GAIN = 0.15  # rays for each cell on the sphere of a sensor's range that gains are found with
MOST_STARTS = 4096  # places to start in on a map
SPACING = 3  # voxels between places from which it is tried what can be seen


@dataclass
class VoxelBank:
    """All maps of a batch, for a team.

    Attributes:
        maps: as given.
        seeable: bool [X, Y, Z] of each, the free voxels that coverage counts.
        surface: the occupied ones that can be seen.
        room: voxels that the centre of a robot may be in, of the largest part of the map that hangs together.
        starts: float32 [K, 3] of each, where robots may start [m].
        robots, radars: of the team.
    """

    maps: list[VoxelMap]
    seeable: list[np.ndarray]
    surface: list[np.ndarray]
    room: list[np.ndarray]
    starts: list[np.ndarray]
    robots: Sequence[RobotConfig]
    radars: Sequence[RadarConfig]

    @property
    def resolution(self) -> float:
        """Side of a voxel [m]."""
        return self.maps[0].resolution

    @property
    def max_free(self) -> int:
        """Free voxels of the largest map."""
        return max(int(m.free.sum()) for m in self.maps)

    @property
    def side(self) -> int:
        """Voxels along a cell."""
        return max(1, min(MOST_SIDE, round(CELL / self.resolution - 1e-6)))

    @property
    def block(self) -> int:
        """Voxels along a block."""
        least = min(radar.range for radar in self.radars)
        return max(2 * self.side, round(least / (BLOCKS_PER_RANGE * self.resolution)))

    @property
    def view(self) -> float:
        """Voxels that count as one view, of the sensor that sees most."""
        return max(_whole(radar, self) for radar in self.radars)

    def places(self, number: int) -> list[np.ndarray]:
        """Where each robot may start on a map [m], float32 [K, 3] each."""
        return [self.starts[number]] * len(self.robots)

    def stands(self, number: int, robot: int, points: np.ndarray) -> np.ndarray:
        """Whether a robot has room at points [m], [E, 3], of a map: bool [E]."""
        m, room = self.maps[number], self.room[number]
        finite = np.isfinite(points).all(-1)
        index = m.indices(np.where(finite[:, None], points, m.origin))
        inside = finite & ((index >= 0) & (index < m.shape)).all(-1)
        index = np.where(inside[:, None], index, 0)
        return inside & room[index[:, 0], index[:, 1], index[:, 2]]

    def columns(self, name: str) -> np.ndarray:
        """Words of voxels of all maps, int32 [all columns, words]."""
        words = max(m.num_words for m in self.maps)
        parts = []
        for number, m in enumerate(self.maps):
            voxels = getattr(m, name) if name in ("free", "occupied") else getattr(self, name)[number]
            packed = pack_words(voxels).reshape(-1, m.num_words)
            parts.append(np.pad(packed, ((0, 0), (0, words - m.num_words))))
        return np.concatenate(parts)


def body_voxels(robots: Sequence[RobotConfig], resolution: float) -> int:
    """Voxels around one that must be free for the centre of any robot of a team to be in it."""
    return max(1, math.ceil(max(robot.collision_threshold for robot in robots) / resolution - 1e-6))


def build_bank(maps: Sequence[VoxelMap], robots: Sequence[RobotConfig], radars: Sequence[RadarConfig]) -> VoxelBank:
    """Prepare ``maps`` for a team.

    Raises:
        MapError: a map has no room for its robots.
        ValueError: maps of different voxels.
    """
    sides = sorted({m.resolution for m in maps})
    if len(sides) > 1:
        raise ValueError(
            f"maps have voxels of {', '.join(f'{side:g}' for side in sides)} m: give those of each an env of its own"
        )
    seen = [_measure(m, tuple(robots), tuple(radars)) for m in maps]
    seeable, surface, room, starts = (list(parts) for parts in zip(*seen, strict=True))
    return VoxelBank(list(maps), seeable, surface, room, starts, robots, radars)


@lru_cache(maxsize=512)
def _measure(
    m: VoxelMap, robots: tuple[RobotConfig, ...], radars: tuple[RadarConfig, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """What can be seen of a map, free and occupied, where robots have room, and where they may start."""
    body = body_voxels(robots, m.resolution)
    ball = np.ones((3, 3, 3), dtype=bool)
    room = ndimage.binary_erosion(m.free, ball, iterations=body)
    parts, count = ndimage.label(room, ball)
    if not count:
        raise MapError(
            f"map {m.name} has no room: no place is {body * m.resolution:g} m from all that is not free, as "
            f"robot.collision_threshold={max(r.collision_threshold for r in robots):g} m needs with voxels of "
            f"{m.resolution:g} m; use a smaller robot or finer voxels"
        )
    room = parts == 1 + np.argmax(np.bincount(parts.ravel())[1:])
    apart = room & (np.indices(m.shape).sum(0) % SPACING == 0)
    places = np.argwhere(apart)[:: max(1, SPACING)] if apart.any() else np.argwhere(room)
    free, occupied = (words.reshape(-1, m.num_words) for words in m.words())
    seen = np.zeros_like(free), np.zeros_like(free)
    for trees in {sensor_trees(radar, m.resolution)[1] for radar in radars}:
        found = mark_seeable(m.shape, free, occupied, places, trees)
        seen = tuple(a | b for a, b in zip(seen, found, strict=True))
    shape = (*m.shape[:2], m.num_words)
    seeable, surface = (unpack_words(words.reshape(shape), m.shape[2]) for words in seen)
    wide = ndimage.binary_erosion(room, ball)
    starts = m.centres(wide if wide.any() else room)
    if len(starts) > MOST_STARTS:
        starts = starts[np.random.default_rng(0).choice(len(starts), MOST_STARTS, replace=False)]
    return seeable | room, surface, room, starts


def sensor_trees(radar: RadarConfig, resolution: float) -> tuple[RayTrees, RayTrees]:
    """Trees of a reset, all around nearby, and of every scan."""
    near = grow_trees(round(START_BALL / resolution, 6), math.pi)
    return near, grow_trees(round(radar.range / resolution, 6), radar.vertical_fov)


def _distinct(trees: list[list[RayTrees]]) -> list[RayTrees]:
    """The trees once each, in order."""
    return list({id(tree): tree for row in trees for tree in row}.values())


def _join(trees: list[list[RayTrees]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Offsets, skips (within their tree) and begins [A, B, 9] of trees [A][B], each stored once."""
    parts = _distinct(trees)
    first = dict(zip(map(id, parts), np.cumsum([0, *(len(part.skip) for part in parts)]).tolist(), strict=False))
    begin = np.array([[tree.begin + first[id(tree)] for tree in row] for row in trees], dtype=np.int32)
    return np.concatenate([p.offset for p in parts]), np.concatenate([p.skip for p in parts]), begin


def kernel_values(bank: VoxelBank, device: torch.device) -> dict[str, Any]:
    """What kernels' parameters are named after: maps, places to start, sensors, cells, views, limits of robots."""
    place = str(device)

    def array(values, kind):
        return wp.array(np.ascontiguousarray(values), dtype=kind, device=place)

    maps = VoxelMaps()
    named = {"free": "free", "occupied": "occupied", "counted": "seeable", "counted_surface": "surface"}
    for name, of in named.items():
        setattr(maps, name, array(bank.columns(of), wp.int32))
    counts = [m.shape[0] * m.shape[1] for m in bank.maps]
    maps.begin = array(np.cumsum([0, *counts[:-1]]).astype(np.int32), wp.int32)
    maps.size = array(np.array([m.shape for m in bank.maps], dtype=np.int32), wp.vec3i)
    maps.origin = array(np.array([m.origin for m in bank.maps], dtype=np.float32), wp.vec3)
    maps.resolution = array(np.array([m.resolution for m in bank.maps], dtype=np.float32), wp.float32)
    cells = Cells()
    cells.side, cells.block, cells.body = bank.side, bank.block, body_voxels(bank.robots, bank.resolution)
    return {
        "maps": maps,
        "places": _start_places(bank, array),
        "sensors": _sensors(bank, array),
        "cells": cells,
        "views": _views(bank, array),
        "fliers": _fliers(bank, array),
    }


def _start_places(bank: VoxelBank, array) -> StartPlaces:
    places = StartPlaces()
    places.point = array(np.concatenate(bank.starts).astype(np.float32), wp.vec3)
    places.begin = array(np.cumsum([0, *map(len, bank.starts)]).astype(np.int32)[None], wp.int32)
    places.kind = array(np.zeros(len(bank.robots), dtype=np.int32), wp.int32)
    places.threshold = array(np.array([r.collision_threshold for r in bank.robots], dtype=np.float32), wp.float32)
    return places


def _sensors(bank: VoxelBank, array) -> Sensors:
    sensors, count = Sensors(), len(bank.maps)
    trees = [[sensor_trees(radar, bank.resolution)[kind] for radar in bank.radars] for kind in range(2)]
    offset, skip, begin = _join(trees)
    sensors.offset, sensors.skip = array(offset, wp.vec3i), array(skip, wp.int32)
    sensors.begin = array(np.repeat(begin[:, None], count, axis=1), wp.int32)
    farthest = [max(radar.range, START_BALL) for radar in bank.radars]
    sensors.reach = array(np.array(farthest, dtype=np.float32), wp.float32)
    sensors.cos_fov = array(np.array([_cos_fov(radar) for radar in bank.radars], dtype=np.float32), wp.float32)
    sensors.every = array(np.array([radar.every for radar in bank.radars], dtype=np.int32), wp.int32)
    return sensors


def _cos_fov(radar: RadarConfig) -> float:
    return math.cos(0.5 * radar.fov) if looks_ahead(radar) else -2.0


def looks_ahead(radar: RadarConfig) -> bool:
    """Whether a sensor does not see all around."""
    return radar.fov < 2.0 * math.pi - 1e-6


def _views(bank: VoxelBank, array) -> Views:
    views, count = Views(), len(bank.maps)
    edge = bank.resolution * bank.side
    trees = [grow_trees(round(radar.range / edge, 6), radar.vertical_fov, OF_GAIN) for radar in bank.radars]
    offset, skip, begin = _join([trees])
    views.offset, views.skip = array(offset, wp.vec3i), array(skip, wp.int32)
    views.weight = array(np.concatenate([tree.weight for tree in _distinct([trees])]), wp.float32)
    views.begin = array(np.repeat(begin, count, axis=0), wp.int32)
    whole = [_whole(radar, bank) for radar in bank.radars]
    views.whole = array(np.tile(np.array(whole, dtype=np.float32), (count, 1)), wp.float32)
    views.fov = array(
        np.array([radar.fov if looks_ahead(radar) else 0.0 for radar in bank.radars], dtype=np.float32), wp.float32
    )
    return views


def _whole(radar: RadarConfig, bank: VoxelBank) -> float:
    """Voxels that count as one view of a sensor."""
    view = sensor_trees(radar, bank.resolution)[1].view
    return DISC_OF_VIEW * view * min(radar.fov / (2.0 * math.pi), 1.0)


def _fliers(bank: VoxelBank, array) -> Fliers:
    fliers = Fliers()
    for name in ("max_speed", "max_accel", "max_yaw_rate"):
        setattr(fliers, name, array(np.array([getattr(r, name) for r in bank.robots], dtype=np.float32), wp.float32))
    fliers.threshold = array(np.array([r.collision_threshold for r in bank.robots], dtype=np.float32), wp.float32)
    fliers.looks_ahead = array(np.array([looks_ahead(radar) for radar in bank.radars], dtype=np.int32), wp.int32)
    return fliers
