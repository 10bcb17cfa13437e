"""Where a team starts: room for it on a map, starts that are fixed or given, and the file they may come from."""

import math
import zlib
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

from maexp.envs.maps.point_cloud import MapError, PointCloudMap
from maexp.kernels.types import BESIDE, START_CLEARANCE

NO_ROOM = "use fewer robots, a smaller robot.radius or robot.collision_threshold, or a larger map"


def check_room(m: PointCloudMap, thresholds: list[float]) -> None:
    """MapError unless the team fits: every start ``3 * threshold`` from the boundary and from the others."""
    need = START_CLEARANCE * max(thresholds)
    far = cKDTree(m.boundary).query(m.free)[0] if len(m.boundary) else np.full(len(m.free), np.inf)
    candidates = m.free[far >= need]
    room = 0
    tree = cKDTree(candidates) if len(candidates) else None
    free = np.ones(len(candidates), dtype=bool)
    while room < len(thresholds) and free.any():
        start = int(np.argmax(free))
        free[tree.query_ball_point(candidates[start], need)] = False
        room += 1
    if room < len(thresholds):
        raise MapError(
            f"map {m.name} has room for {room} of num_robots={len(thresholds)} robots with {need:g} m of clearance: "
            + NO_ROOM
        )


def check_gathering(m: PointCloudMap, thresholds: list[float]) -> None:
    """MapError unless the team fits in one place, each beside another one, as `kernels.reset.gather_team` places it."""
    need = START_CLEARANCE * np.array(thresholds)
    far = cKDTree(m.boundary).query(m.free)[0] if len(m.boundary) else np.full(len(m.free), np.inf)
    points, far = m.free[far >= need.min(), :2].astype(np.float64), far[far >= need.min()]
    most = 0
    for start in np.random.default_rng(0).permutation(np.flatnonzero(far >= need[0])):
        most = max(most, _gather(points, far, need, start))
        if most == len(need):
            return
    raise MapError(
        f"map {m.name} has room for {most} of num_robots={len(need)} robots that start together, {need.max():g} m from "
        f"walls and each other: use scenario.starts=drawn, {NO_ROOM}"
    )


def _gather(points: np.ndarray, far: np.ndarray, need: np.ndarray, start: int) -> int:
    """How many robots find room from a point on; `far` is how far points are from walls [m]."""
    order = np.linalg.norm(points - points[start], axis=-1).argsort(kind="stable")
    order = order[: 200 * len(need)]  # the others stand near
    points, far, places = points[order], far[order], [points[start]]
    for i in range(1, len(need)):
        gaps = np.linalg.norm(points[:, None] - np.array(places), axis=-1)
        room = np.maximum(need[i], need[:i])
        fits = (far >= need[i]) & (gaps >= room).all(-1) & (gaps <= BESIDE * room).any(-1)
        if not fits.any():
            return i
        places.append(points[fits.argmax()])
    return len(need)


def fixed_starts(env, seed: int) -> np.ndarray:
    """A start of every robot on every map, from (seed, map) alone: x, y [m] and heading [rad], float32 [M, N, 3].

    Robot i has the same start in larger teams.
    """
    thresholds = np.array([r.collision_threshold for r in env.robot_configs])
    return np.stack([_fix_map(m, thresholds, seed) for m in env.maps])


def _fix_map(m: PointCloudMap, thresholds: np.ndarray, seed: int) -> np.ndarray:
    key = zlib.crc32(m.free.tobytes(), zlib.crc32(m.boundary.tobytes()))
    rng, turn = (np.random.default_rng([seed, key, k]) for k in range(2))
    need = START_CLEARANCE * thresholds
    points = m.free[rng.permutation(len(m.free)), :2].astype(np.float64)
    far = cKDTree(m.boundary[:, :2]).query(points)[0] if len(m.boundary) else np.full(len(points), np.inf)
    starts = np.empty((len(need), 2))
    nearest, taken = np.full(len(points), np.inf), np.zeros(len(points), dtype=bool)
    for i in range(len(need)):
        fits = (np.minimum(far, nearest) >= need[i]) & ~taken
        if not fits.any():
            raise MapError(f"map {m.name} has room for {i} of num_robots={len(need)} robots at fixed starts: {NO_ROOM}")
        starts[i] = points[fits.argmax()]
        gap = np.linalg.norm(points - starts[i], axis=1)
        nearest, taken = np.minimum(nearest, gap), taken | (gap < need[i])
    heading = turn.uniform(-math.pi, math.pi, (len(need), 1))
    return np.concatenate([starts, heading], axis=1).astype(np.float32)


def read_starts(path: str | Path, count: int) -> np.ndarray:
    """The first ``count`` rows of a .csv or .npy file: x, y [m] and heading [rad] of a robot each, float64 [count, 3].

    A .csv file may begin with a line of names, x,y,heading.

    Raises:
        ValueError: no such file, no numbers, or too few of them.
    """
    path, what = Path(path), "x, y [m] and heading [rad]"
    try:
        if path.suffix == ".npy":
            rows = np.load(path, allow_pickle=False)
        else:
            lines = [line.split(",") for line in path.read_text().splitlines() if line.strip()]
            rows = lines[1:] if lines and lines[0][0].strip() == "x" else lines  # names of the columns
        rows = np.asarray(rows, dtype=np.float64)
    except (OSError, ValueError, TypeError) as error:
        raise ValueError(f"scenario.starts={path} cannot be read: give a .csv or .npy file of rows {what}") from error
    if rows.ndim != 2 or rows.shape[1] != 3 or len(rows) < count:
        found = " x ".join(map(str, rows.shape))
        raise ValueError(f"scenario.starts={path} holds {found} numbers: {count} robots need {count} rows of {what}")
    return rows[:count]


def check_starts(env, poses) -> np.ndarray:
    """Poses [N, 3] or [E, N, 3] as float32 [E, N, 3], headings in [-pi, pi); ValueError where a robot cannot stand."""
    envs, robots = env.num_envs, env.num_robots
    try:
        poses = torch.as_tensor(poses).detach().cpu().double().numpy()
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"starts={poses!r} must be numbers, [num_robots, 3] or [num_envs, num_robots, 3]") from error
    if poses.shape not in ((robots, 3), (envs, robots, 3)):
        raise ValueError(
            f"starts has shape {tuple(poses.shape)}: give x, y, heading as [{robots}, 3] for all envs "
            f"or [{envs}, {robots}, 3]"
        )
    poses = np.broadcast_to(poses, (envs, robots, 3)).copy()
    poses[..., 2] = (poses[..., 2] + math.pi) % (2.0 * math.pi) - math.pi
    shown = poses[:1] if np.array_equal(poses, np.broadcast_to(poses[:1], poses.shape)) else poses
    _blame(shown, ~np.isfinite(shown).all(-1), lambda e, i: "is not finite: give numbers")
    for m in env.maps:
        wall = _in_wall(env, m, shown)
        _blame(
            shown,
            wall,
            lambda e, i, m=m: (
                f"lies in a wall of map {m.name} or outside it: give a place in free space "
                + (
                    "for the whole footprint"
                    if env.collision == "footprint"
                    else f"at least {env.robot_configs[i].collision_threshold:g} m from obstacle points"
                )
            ),
        )
    with_other = _on_top(env, shown)
    _blame(shown, with_other.any(-1), lambda e, i: f"collides with robot {with_other[e, i].argmax()}: move them apart")
    return poses.astype(np.float32)


def _blame(poses: np.ndarray, wrong: np.ndarray, why) -> None:
    """ValueError for the first wrong pose, if there is one."""
    if wrong.any():
        e, i = np.unravel_index(wrong.argmax(), wrong.shape)
        x, y, heading = poses[e, i]
        raise ValueError(f"the start of env {e}, robot {i} (x={x:g} m, y={y:g} m, heading={heading:g} rad) {why(e, i)}")


def _in_wall(env, m: PointCloudMap, poses: np.ndarray) -> np.ndarray:
    """Whether robots would stand off the free points of a map, or collide with its boundary; bool [E, N]."""
    at = poses[..., :2].reshape(-1, 2)
    gap, nearest = cKDTree(m.free[:, :2]).query(at)
    bad = gap > m.free_spacing[nearest]
    if len(m.obstacles):
        bad |= cKDTree(m.obstacles[:, :2]).query(at)[0] < gap
    bad = bad.reshape(poses.shape[:2])
    if not len(m.boundary):
        return bad
    tree = cKDTree(m.boundary[:, :2])
    for i, robot in enumerate(env.robot_configs):
        if env.collision == "centre":
            bad[:, i] |= tree.query(poses[:, i, :2])[0] < robot.collision_threshold
            continue
        near = tree.query_ball_point(poses[:, i, :2], 0.5 * math.hypot(robot.length, robot.width))
        for e in range(len(poses)):
            ahead, aside = _seen_from(poses[e, i], m.boundary[near[e], :2])
            bad[e, i] |= bool(((ahead <= 0.5 * robot.length) & (aside <= 0.5 * robot.width)).any())
    return bad


def _seen_from(pose: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far points [K, 2] lie ahead or behind, and aside, of a robot [m]."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x, y = (points - pose[:2]).T
    return np.abs(c * x + s * y), np.abs(c * y - s * x)


def _on_top(env, poses: np.ndarray) -> np.ndarray:
    """Which pairs of robots would collide; bool [E, N, N]."""
    count = poses.shape[1]
    hit = np.zeros((len(poses), count, count), dtype=bool)
    gap = np.linalg.norm(poses[:, :, None, :2] - poses[:, None, :, :2], axis=-1)
    if env.collision == "centre":
        threshold = np.array([r.collision_threshold for r in env.robot_configs])
        hit |= gap < np.maximum(threshold[:, None], threshold)
    else:
        size = np.array([(r.length, r.width) for r in env.robot_configs])
        reach = 0.5 * np.hypot(*size.T)
        for e, i, j in np.argwhere(gap <= reach[:, None] + reach):
            if i < j:
                hit[e, i, j] = hit[e, j, i] = not _parted(poses[e, [i, j]], size[[i, j]])
    hit[:, np.arange(count), np.arange(count)] = False
    return hit


def _parted(poses: np.ndarray, size: np.ndarray) -> bool:
    """Whether a line along a side of one of two rectangles lies between them."""
    axes = np.array([(math.cos(t + k), math.sin(t + k)) for t in poses[:, 2] for k in (0.0, 0.5 * math.pi)])
    half = [
        0.5 * (length * np.abs(axes @ (math.cos(t), math.sin(t))) + width * np.abs(axes @ (-math.sin(t), math.cos(t))))
        for t, (length, width) in zip(poses[:, 2], size, strict=True)
    ]
    return bool((np.abs(axes @ (poses[1, :2] - poses[0, :2])) > half[0] + half[1]).any())
