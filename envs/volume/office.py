"""Offices of two storeys: rooms with doors and windows, pillars, desks, and stairs that a ground robot climbs."""

from dataclasses import dataclass

import numpy as np

STOREYS = ((1, 11), (12, 23))  # layers of air; a slab between, floor and ceiling at the ends
STEPS = STOREYS[1][0] - STOREYS[0][0]  # one voxel each, as deep as high
STAIR_WIDTH, LANDING = 6, 6
LEAST_SIDE = 15  # of a room, 3.75 m
DOOR, DOOR_HEIGHT = 5, 8
WINDOW, SILL, WINDOW_HEIGHT = (6, 14), 3, 4
EXTRA_DOORS = 0.35  # of the walls that the tree of doors leaves shut


@dataclass(frozen=True)
class Room:
    """Voxels x0 <= x < x1, y0 <= y < y1 of a storey."""

    x0: int
    y0: int
    x1: int
    y1: int


def draw_office(shape: tuple[int, int, int], rng: np.random.Generator) -> np.ndarray:
    """Free voxels of an office; bool [X, Y, Z]."""
    nx, ny, _ = shape
    free = np.zeros(shape, dtype=bool)
    inside = Room(1, 1, nx - 1, ny - 1)
    for low, high in STOREYS:
        _furnish_storey(free[:, :, low:high], inside, rng)
    notch = _draw_notch(shape, rng)
    for _ in range(int(rng.integers(1, 3))):
        _build_stairs(free, notch, rng)
    free[notch] = False
    return free


def _furnish_storey(air: np.ndarray, inside: Room, rng: np.random.Generator) -> None:
    """Rooms, doors, windows and what stands in the rooms; `air` is a view of the layers of one storey."""
    rooms: list[Room] = []
    _cut(inside, float(rng.uniform(700, 1600)), rng, rooms)
    for room in rooms:
        air[room.x0 : room.x1, room.y0 : room.y1] = True
    for room in rooms:
        _furnish_room(air, room, rng)
    _open_walls(air, rooms, rng)


def _cut(room: Room, largest: float, rng: np.random.Generator, rooms: list[Room]) -> None:
    """Cut a rectangle by walls of one voxel until its parts are no larger than `largest` [voxels]."""
    width, depth = room.x1 - room.x0, room.y1 - room.y0
    if width * depth <= largest or max(width, depth) < 2 * LEAST_SIDE + 1:
        rooms.append(room)
        return
    if width >= depth:
        x = room.x0 + int(rng.integers(LEAST_SIDE, width - LEAST_SIDE))
        parts = Room(room.x0, room.y0, x, room.y1), Room(x + 1, room.y0, room.x1, room.y1)
    else:
        y = room.y0 + int(rng.integers(LEAST_SIDE, depth - LEAST_SIDE))
        parts = Room(room.x0, room.y0, room.x1, y), Room(room.x0, y + 1, room.x1, room.y1)
    for part in parts:
        _cut(part, largest * float(rng.uniform(0.8, 1.25)), rng, rooms)


def _furnish_room(air: np.ndarray, room: Room, rng: np.random.Generator) -> None:
    """Pillars in large rooms, desks and cupboards that leave a way around."""
    width, depth = room.x1 - room.x0, room.y1 - room.y0
    if min(width, depth) >= 28:
        for x in range(room.x0 + 9, room.x1 - 8, 12):
            for y in range(room.y0 + 9, room.y1 - 8, 12):
                air[x : x + 2, y : y + 2] = False
    for _ in range(width * depth // 150):
        long, short = int(rng.integers(5, 9)), int(rng.integers(3, 5))
        size = (long, short) if rng.random() < 0.5 else (short, long)
        if width <= size[0] + 10 or depth <= size[1] + 10:
            continue
        x = room.x0 + 5 + int(rng.integers(0, width - size[0] - 9))
        y = room.y0 + 5 + int(rng.integers(0, depth - size[1] - 9))
        around = air[x - 4 : x + size[0] + 4, y - 4 : y + size[1] + 4, 0]
        if around.all():
            height = 3 if rng.random() < 0.7 else int(rng.integers(5, 9))
            air[x : x + size[0], y : y + size[1], :height] = False


def _open_walls(air: np.ndarray, rooms: list[Room], rng: np.random.Generator) -> None:
    """Doors along a random tree of the rooms and in some further walls; windows in some walls beside."""
    parent = list(range(len(rooms)))

    def find_root(k: int) -> int:
        while parent[k] != k:
            parent[k] = parent[parent[k]]
            k = parent[k]
        return k

    walls = _shared_walls(rooms)
    for k in rng.permutation(len(walls)):
        first, second, axis, at, low, high = walls[k]
        roots = find_root(first), find_root(second)
        if roots[0] != roots[1] or rng.random() < EXTRA_DOORS:
            parent[roots[0]] = roots[1]
            start = low + 1 + int(rng.integers(0, high - low - DOOR - 1))
            _open(air, axis, at, start, start + DOOR, slice(0, DOOR_HEIGHT))
        elif rng.random() < 0.5:
            width = min(int(rng.integers(*WINDOW)), high - low - 2)
            start = low + 1 + int(rng.integers(0, high - low - width - 1))
            _open(air, axis, at, start, start + width, slice(SILL, SILL + WINDOW_HEIGHT))


def _shared_walls(rooms: list[Room]) -> list[tuple[int, int, int, int, int, int]]:
    """Walls wide enough for a door: both rooms, the axis across, where it stands, and from where to where it runs."""
    walls = []
    for i, a in enumerate(rooms):
        for j, b in enumerate(rooms):
            for axis, at, touching, low, high in (
                (0, a.x1, a.x1 + 1 == b.x0, max(a.y0, b.y0), min(a.y1, b.y1)),
                (1, a.y1, a.y1 + 1 == b.y0, max(a.x0, b.x0), min(a.x1, b.x1)),
            ):
                if touching and high - low >= DOOR + 4:
                    walls.append((i, j, axis, at, low, high))
    return walls


def _open(air: np.ndarray, axis: int, at: int, start: int, stop: int, layers: slice) -> None:
    if axis == 0:
        air[at, start:stop, layers] = True
    else:
        air[start:stop, at, layers] = True


def _draw_notch(shape: tuple[int, int, int], rng: np.random.Generator) -> tuple[slice, slice]:
    """A corner of the box that the building leaves out, often an empty one."""
    nx, ny, _ = shape
    if rng.random() < 0.4:
        return slice(0, 0), slice(0, 0)
    width, depth = int(rng.integers(20, 50)), int(rng.integers(20, 50))
    return (slice(0, width) if rng.random() < 0.5 else slice(nx - width, nx)), (
        slice(0, depth) if rng.random() < 0.5 else slice(ny - depth, ny)
    )


def _build_stairs(free: np.ndarray, notch: tuple[slice, slice], rng: np.random.Generator) -> None:
    """A flight of stairs with landings, away from the notch; walls and desks in its way are left out."""
    nx, ny, _ = free.shape
    long, wide = STEPS + 2 * LANDING, STAIR_WIDTH + 2
    outside = np.zeros((nx, ny), dtype=bool)
    outside[notch] = True
    turned = bool(rng.random() < 0.5)
    view = free.transpose(1, 0, 2) if turned else free
    outside = outside.T if turned else outside
    for _ in range(50):
        x = int(rng.integers(2, view.shape[0] - long - 1))
        y = int(rng.integers(2, view.shape[1] - wide - 1))
        if not outside[x - 1 : x + long + 1, y - 1 : y + wide + 1].any():
            break
    else:
        return
    low, top = STOREYS[0][0], STOREYS[1][1]
    for bottom, ceiling in STOREYS:
        view[x : x + long, y : y + wide, bottom:ceiling] = True
    first = x + LANDING
    view[first - 1 : first + STEPS, y + 1 : y + 1 + STAIR_WIDTH, low:top] = True
    for k in range(STEPS):
        view[first + k, y + 1 : y + 1 + STAIR_WIDTH, low : low + k + 1] = False
