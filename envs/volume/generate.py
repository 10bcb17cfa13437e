"""Generated maps of voxels, drawn until they pass the checks that every map passes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from maexp.envs.scenarios.lattice import largest_component, make_generator
from maexp.envs.volume.cave import draw_cave
from maexp.envs.volume.map import VoxelMap
from maexp.envs.volume.office import draw_office
from maexp.envs.volume.reach import DRIVING, Body, label_reachable, passable
from maexp.envs.volume.town import draw_town

RESOLUTION = 0.25  # [m]
SHAPE = (120, 120, 24)
BODY = Body()
LEAST_SHARE = 0.12  # of the box is free
JOINED = 0.97  # of the places with clearance hang together
_DRAW: dict[str, Callable[[tuple[int, int, int], np.random.Generator], np.ndarray]] = {
    "cave": draw_cave,
    "office_3d": draw_office,
    "town_3d": draw_town,
}


def build_volume(scenario: str, index: int) -> VoxelMap:
    """Map `index` of a scenario of voxels."""
    rng = make_generator(scenario, index)
    free = None
    while free is None:  # some caves have no way between their halls
        free = _tidy(_DRAW[scenario](SHAPE, rng), with_ground=scenario == "office_3d")
    occupied = ~free
    return VoxelMap(free, occupied, RESOLUTION, name=f"{scenario}_{index}", scenario=scenario)


def _tidy(free: np.ndarray, with_ground: bool) -> np.ndarray | None:
    """The largest piece of free space, closed by the sides of the box; None where teams could not go about in it."""
    for axis in range(3):
        free[(slice(None),) * axis + ([0, -1],)] = False
    free = largest_component(free)
    if free.mean() < LEAST_SHARE or not _is_joined(free, BODY):
        return None
    if with_ground and not _has_joined_storeys(free):
        return None
    return free


def _is_joined(free: np.ndarray, body: Body) -> bool:
    """Whether nearly all places of a robot hang together."""
    _, sizes = label_reachable(passable(free, ~free, body, RESOLUTION), body, RESOLUTION)
    return bool(len(sizes)) and sizes.max() >= JOINED * sizes.sum()


def _has_joined_storeys(free: np.ndarray) -> bool:
    """Whether a driving robot gets from the lowest floor to the highest one."""
    body = Body(DRIVING)
    places = passable(free, ~free, body, RESOLUTION)
    labels, sizes = label_reachable(places, body, RESOLUTION)
    if not len(sizes):
        return False
    height = np.nonzero((labels == int(sizes.argmax()) + 1).sum(axis=(0, 1)) > 0.02 * SHAPE[0] * SHAPE[1])[0]
    return len(height) > 1 and (height.max() - height.min()) * RESOLUTION > 2.0
