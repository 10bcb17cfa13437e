"""Where teams start in volumes: the voxels that a kind of robot can start in, and starts that are given or fixed."""

from __future__ import annotations

import math
import zlib
from typing import TYPE_CHECKING

import numpy as np
import torch

from maexp.envs.maps.point_cloud import MapError
from maexp.envs.spawn import NO_ROOM
from maexp.envs.volume.map import VoxelMap
from maexp.kernels.types import BESIDE, START_CLEARANCE

if TYPE_CHECKING:
    from maexp.envs.environment import ExplorationEnv

POSE = "x, y, z [m] and heading [rad]"


def check_room(m: VoxelMap, places: list[np.ndarray], thresholds: list[float]) -> None:
    """MapError unless every robot finds a place of its own, apart from the others.

    Args:
        places: where each robot may start [m], float [K, 3].
        thresholds: how near a robot may come to another [m].
    """
    taken: list[np.ndarray] = []
    for i, points in enumerate(places):
        free = np.ones(len(points), dtype=bool)
        for other, at in enumerate(taken):
            gap = START_CLEARANCE * max(thresholds[i], thresholds[other])
            free &= np.linalg.norm(points - at, axis=-1) >= gap
        if not free.any():
            raise MapError(f"map {m.name} has room for {i} of num_robots={len(places)} robots: {NO_ROOM}")
        taken.append(points[free.argmax()])


def check_gathering(m: VoxelMap, places: list[np.ndarray], thresholds: list[float]) -> None:
    """MapError unless the team fits in one place, each beside another one, as the kernels gather it."""
    starts = places[0][np.random.default_rng(0).permutation(len(places[0]))[:200]]
    most = max(_gather(start, places, thresholds) for start in starts)
    if most < len(places):
        raise MapError(
            f"map {m.name} has room for {most} of num_robots={len(places)} robots that start together: use "
            f"scenario.starts=drawn, {NO_ROOM}"
        )


def _gather(start: np.ndarray, places: list[np.ndarray], thresholds: list[float]) -> int:
    """How many robots find room from a place on."""
    taken = [start]
    for i in range(1, len(places)):
        gaps = np.linalg.norm(places[i][:, None] - np.array(taken), axis=-1)
        room = START_CLEARANCE * np.maximum(thresholds[i], thresholds[:i])
        fits = (gaps >= room).all(-1) & (gaps <= BESIDE * room).any(-1)
        if not fits.any():
            return i
        taken.append(places[i][np.where(fits, gaps[:, 0], np.inf).argmin()])
    return len(places)


def fixed_starts(env: ExplorationEnv, seed: int) -> np.ndarray:
    """A start of every robot on every map, from (seed, map) alone: x, y, z [m] and heading [rad], float32 [M, N, 4].

    Robot i has the same start in larger teams.
    """
    thresholds = [robot.collision_threshold for robot in env.robot_configs]
    return np.stack([_fix_map(env, number, thresholds, seed) for number in range(len(env.maps))])


def _fix_map(env: ExplorationEnv, number: int, thresholds: list[float], seed: int) -> np.ndarray:
    m = env.maps[number]
    key = zlib.crc32(np.packbits(m.free).tobytes(), zlib.crc32(np.packbits(m.occupied).tobytes()))
    rng, turn = (np.random.default_rng([seed, key, k]) for k in range(2))
    starts: list[np.ndarray] = []
    for i, points in enumerate(env.bank.places(number)):
        points = points[rng.permutation(len(points))]
        fits = np.ones(len(points), dtype=bool)
        for other, at in enumerate(starts):
            gap = START_CLEARANCE * max(thresholds[i], thresholds[other])
            fits &= np.linalg.norm(points - at, axis=-1) >= gap
        if not fits.any():
            raise MapError(
                f"map {m.name} has room for {i} of num_robots={len(thresholds)} robots at fixed starts: {NO_ROOM}"
            )
        starts.append(points[fits.argmax()])
    heading = turn.uniform(-math.pi, math.pi, (len(starts), 1))
    return np.concatenate([np.array(starts), heading], axis=1).astype(np.float32)


def check_starts(env: ExplorationEnv, poses) -> np.ndarray:
    """Poses [N, 4] or [E, N, 4] as float32 [E, N, 4], headings in [-pi, pi); ValueError where a robot cannot stand."""
    envs, robots = env.num_envs, env.num_robots
    try:
        poses = torch.as_tensor(poses).detach().cpu().double().numpy()
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"starts={poses!r} must be numbers, [num_robots, 4] or [num_envs, num_robots, 4]") from error
    if poses.shape not in ((robots, 4), (envs, robots, 4)):
        raise ValueError(
            f"starts has shape {tuple(poses.shape)}: give {POSE} as [{robots}, 4] for all envs or [{envs}, {robots}, 4]"
        )
    poses = np.broadcast_to(poses, (envs, robots, 4)).copy()
    poses[..., 3] = (poses[..., 3] + math.pi) % (2.0 * math.pi) - math.pi
    shown = poses[:1] if np.array_equal(poses, np.broadcast_to(poses[:1], poses.shape)) else poses
    _blame(shown, ~np.isfinite(shown).all(-1), "is not finite: give numbers")
    for number, m in enumerate(env.maps):
        stands = np.stack([env.bank.stands(number, i, shown[:, i, :3]) for i in range(robots)], axis=1)
        _blame(
            shown,
            ~stands,
            f"is no place for it on map {m.name}: give the middle of free space that the robot fits in, and one that "
            "drives a place on the ground",
        )
    threshold = np.array([robot.collision_threshold for robot in env.robot_configs])
    gap = np.linalg.norm(shown[:, :, None, :3] - shown[:, None, :, :3], axis=-1)
    near = (gap < np.maximum(threshold[:, None], threshold)) & ~np.eye(robots, dtype=bool)
    _blame(shown, near.any(-1), "collides with another robot: move them apart")
    return poses.astype(np.float32)


def _blame(poses: np.ndarray, wrong: np.ndarray, why: str) -> None:
    """ValueError for the first wrong pose, if there is one."""
    if wrong.any():
        e, i = np.unravel_index(wrong.argmax(), wrong.shape)
        x, y, z, heading = poses[e, i]
        told = f"x={x:g} m, y={y:g} m, z={z:g} m, heading={heading:g} rad"
        raise ValueError(f"the start of env {e}, robot {i} ({told}) {why}")
