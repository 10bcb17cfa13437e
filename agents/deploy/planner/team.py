"""The robots of one call: names, poses, speeds and sizes, checked; what is missing stays out and is said."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass

import numpy as np

FASTEST = 1e3  # speeds above are none [m/s]


@dataclass(frozen=True)
class Team:
    """N robots.

    Attributes:
        names: keys of the poses, or 0 to N - 1.
        at: float64 [N, 2], centres in the map's frame [m]; NaN where a pose is not known.
        yaw: float64 [N], headings [rad]; 0 where not given.
        speed: float64 [N], [m/s].
        radius: float64 [N], distance that a centre keeps from obstacles [m].
    """

    names: tuple[Hashable, ...]
    at: np.ndarray
    yaw: np.ndarray
    speed: np.ndarray
    radius: np.ndarray

    def title(self, robot: int) -> str:
        """What a robot is called in messages."""
        name = self.names[robot]
        return f"robot {name}" if isinstance(name, int) else str(name)


def read_team(poses, velocities, radius, notes: list[str]) -> Team:
    """The team of one call.

    Args:
        poses: {name: (x, y) or (x, y, yaw) or None}, or numbers [N, 2] or [N, 3] [m, rad]; the map's frame.
        velocities: speeds [m/s], or (vx, vy) each, as a mapping or in the same order; None: standing.
        radius: of the robots [m], one for all or a mapping or list.
        notes: what is left out is added in a sentence.

    Raises:
        ValueError: what was given cannot be read as that.
    """
    names, rows = _split(poses, "poses", "{name: (x, y, yaw)} or numbers [N, 2] or [N, 3]")
    pose = np.full((len(names), 3), np.nan)
    for row, (name, given) in enumerate(zip(names, rows, strict=True)):
        pose[row] = check_pose(name, given)
    team = Team(
        names,
        pose[:, :2],
        np.nan_to_num(pose[:, 2]),
        _read_speeds(velocities, names, notes),
        _read_radius(radius, names),
    )
    for row in np.flatnonzero(np.isnan(pose[:, :2]).any(-1)).tolist():
        notes.append(f"{team.title(row)} has no pose and was left out")
    return team


def _split(value, what: str, wanted: str) -> tuple[tuple, list]:
    """Names and rows of a mapping or of a sequence."""
    if isinstance(value, Mapping):
        return tuple(value), list(value.values())
    try:
        rows = list(value)
    except TypeError:
        raise ValueError(f"{what}={value!r} must be {wanted}") from None
    return tuple(range(len(rows))), rows


def check_pose(name, value) -> np.ndarray:
    """x, y [m] and yaw [rad] of a robot; NaN where there is no pose.

    Raises:
        ValueError: what was given cannot be read as that.
    """
    if value is None:
        return np.full(3, np.nan)
    numbers = _numbers(value)
    if numbers is None or numbers.shape not in ((2,), (3,)):
        told = " ".join(repr(value).split())
        raise ValueError(f"poses: {name!r} has {told}, and it must be x, y [m] and, if known, yaw [rad]")
    numbers = np.append(numbers, 0.0)[:3]
    known = np.isfinite(numbers[:2]).all() and np.abs(numbers[:2]).max() < 1e9
    return np.where(np.isfinite(numbers), numbers, 0.0) if known else np.full(3, np.nan)


def _numbers(value) -> np.ndarray | None:
    """float64, NaN where a masked array is masked; None: they are no numbers."""
    try:
        if isinstance(value, np.ma.MaskedArray):
            value = np.ma.filled(value.astype(np.float64), np.nan)
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return None


def _read_speeds(velocities, names: tuple, notes: list[str]) -> np.ndarray:
    speed = np.zeros(len(names))
    if velocities is None:
        return speed
    for row, value in enumerate(_match(velocities, names, "velocities")):
        numbers = None if value is None else _numbers(value)
        if numbers is None or numbers.size == 0 or not (np.abs(numbers) < FASTEST).all():
            notes.append(f"velocities: {names[row]!r} has {value!r}, taken as 0 m/s")
        else:
            speed[row] = numbers if numbers.ndim == 0 else np.hypot(*np.append(numbers, 0.0)[:2])
    return speed


def _read_radius(radius, names: tuple) -> np.ndarray:
    if np.ndim(radius) == 0 and not isinstance(radius, Mapping):
        radius = [radius] * len(names)
    given = _match(radius, names, "robot_radius")
    values = [_numbers(radius_given) for radius_given in given]
    for name, wrong, value in zip(names, given, values, strict=True):
        if value is None or value.ndim or not 0.0 < value < 1e3:
            raise ValueError(f"robot_radius of robot {name!r} is {wrong!r}: give metres above 0")
    return np.array(values, np.float64).reshape(len(names))


def _match(value, names: tuple, what: str) -> list:
    """One value for each robot, None where a mapping has none."""
    if isinstance(value, Mapping):
        return [value.get(name) for name in names]
    _, rows = _split(value, what, "a mapping or one value a robot")
    if len(rows) != len(names):
        raise ValueError(f"{what} holds {len(rows)} values, and poses {len(names)} robots: give one each")
    return rows
