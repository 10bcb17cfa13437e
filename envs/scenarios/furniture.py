"""Furniture: stamps of what a radar near the floor sees, and where they go in a room.

A stamp is an int8 array of grid cells of 0.1 m, axes (along the wall, off the wall): FREE, SOLID or KEEP (to
stay free: the space to sit down or to open a cupboard). Sizes in the code below are metres.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

CELL = 0.1  # [m]
FREE, SOLID, KEEP = 0, 1, 2
# Cells of clearance along every way through a room: 0.2 m, above the 0.18 m a start needs.
CLEARANCE = 2

Stamp = np.ndarray


@dataclass(frozen=True)
class Room:
    """Interior of a room in cells, [x0, x1) x [y0, y1), and what it is used for."""

    x0: int
    y0: int
    x1: int
    y1: int
    kind: str = "room"

    @property
    def area(self) -> float:
        """Floor area [m^2]."""
        return (self.x1 - self.x0) * (self.y1 - self.y0) * CELL**2


class Furnisher:
    """Places furniture in the rooms of one plan without ever closing a way through.

    Args:
        blocked: cells that are wall or furniture, bool (nx, ny); written to.
        reserved: cells that must stay free (in front of doors), bool (nx, ny); written to.
        legs: tables and chairs appear as their legs (a radar at ankle height) instead of as blocks.
    """

    def __init__(self, blocked: np.ndarray, reserved: np.ndarray, legs: bool, rng: np.random.Generator):
        self.blocked, self.reserved, self.legs, self.rng = blocked, reserved, legs, rng

    def furnish(self, room: Room) -> None:
        """Fill `room` with what its kind calls for, as far as it fits."""
        _PROGRAMS[room.kind](self, room)

    def at_wall(self, room: Room, stamp: Stamp, sides: Sequence[int] = (0, 1, 2, 3), corner: float = 0.5) -> int | None:
        """Put `stamp` against a wall; returns the side (0 low y, 1 high y, 2 low x, 3 high x) or None.

        `corner` is the chance that a try goes into a corner of the room.
        """
        for _ in range(16):
            side = int(sides[self.rng.integers(len(sides))])
            turned = _turn(stamp, side)
            room_x, room_y = room.x1 - room.x0 - turned.shape[0], room.y1 - room.y0 - turned.shape[1]
            if room_x < 0 or room_y < 0:
                continue
            slack = room_x if side < 2 else room_y
            along = int(self.rng.integers(slack + 1))
            if self.rng.random() < corner:
                along = slack * int(self.rng.integers(2))
            x = room.x0 + (along if side < 2 else room_x * (side == 3))
            y = room.y0 + (along if side >= 2 else room_y * (side == 1))
            if self._put(room, turned, x, y):
                return side
        return None

    def free_standing(self, room: Room, stamp: Stamp, margin: float = 0.5) -> bool:
        """Put `stamp` somewhere near the middle of the room with `margin` [m] free around it."""
        pad = cells(margin)
        stamp = np.pad(stamp, pad, constant_values=KEEP)
        for attempt in range(12):
            turned = stamp if self.rng.random() < 0.5 else stamp.T
            slack_x, slack_y = room.x1 - room.x0 - turned.shape[0], room.y1 - room.y0 - turned.shape[1]
            if slack_x < 0 or slack_y < 0:
                continue
            reach = 0.1 + 0.4 * attempt / 12  # first the middle, then further out
            x = room.x0 + round(slack_x * self.rng.uniform(0.5 - reach, 0.5 + reach))
            y = room.y0 + round(slack_y * self.rng.uniform(0.5 - reach, 0.5 + reach))
            if self._put(room, turned, x, y):
                return True
        return False

    def _put(self, room: Room, stamp: Stamp, x: int, y: int) -> bool:
        window = (slice(x, x + stamp.shape[0]), slice(y, y + stamp.shape[1]))
        if (self.blocked[window] & (stamp != FREE)).any() or (self.reserved[window] & (stamp == SOLID)).any():
            return False
        before = self.blocked[window].copy()
        self.blocked[window] |= stamp == SOLID
        if not self._is_passable(room):
            self.blocked[window] = before
            return False
        self.reserved[window] |= stamp == KEEP
        return True

    def _is_passable(self, room: Room) -> bool:
        """Whether a robot with clearance still gets from every door to every part of the room."""
        window = (slice(room.x0 - 1, room.x1 + 1), slice(room.y0 - 1, room.y1 + 1))
        passable = ndimage.distance_transform_edt(~self.blocked[window]) >= CLEARANCE
        labels, count = ndimage.label(passable)
        if count == 0:
            return False
        sizes = np.bincount(labels[passable])
        main = int(sizes.argmax())
        doors = np.unique(labels[self.reserved[window] & passable])
        return sizes[main] >= 0.93 * sizes.sum() and (doors == main).all()


def cells(metres: float) -> int:
    """Length in cells."""
    return max(1, round(metres / CELL))


def block(along: float, off: float) -> Stamp:
    """Solid piece of furniture `along` the wall x `off` the wall [m]."""
    return np.full((cells(along), cells(off)), SOLID, dtype=np.int8)


def with_front(stamp: Stamp, depth: float) -> Stamp:
    """The same piece with `depth` [m] kept free before it."""
    return np.pad(stamp, ((0, 0), (0, cells(depth))), constant_values=KEEP)


def table(along: float, off: float, legs: bool) -> Stamp:
    """Table as a block or as its four legs."""
    stamp = block(along, off)
    if legs:
        stamp[:] = FREE
        stamp[[0, 0, -1, -1], [0, -1, 0, -1]] = SOLID
    return stamp


def table_with_chairs(along: float, off: float, ends: bool, legs: bool) -> Stamp:
    """Dining or meeting table, chairs pushed half under its long sides and, with `ends`, at its heads."""
    chair = 4
    out = np.zeros((cells(along) + 2 * 3, cells(off) + 2 * 3), dtype=np.int8)
    top = table(along, off, legs)
    seat = table(chair * CELL, chair * CELL, legs)
    out[3:-3, 3:-3] = top
    count = max(1, int(along / 0.65))
    for k in range(count):
        u = 3 + round((k + 0.5) * cells(along) / count) - chair // 2
        for place in (out[u : u + chair, :chair], out[u : u + chair, -chair:]):
            np.maximum(place, seat, out=place)
    if ends:
        v = out.shape[1] // 2 - chair // 2
        for place in (out[:chair, v : v + chair], out[-chair:, v : v + chair]):
            np.maximum(place, seat, out=place)
    return out


def desk(along: float, legs: bool) -> Stamp:
    """Desk of `along` x 0.7 m with a chair before it and space to get up."""
    out = np.full((cells(along), 14), KEEP, dtype=np.int8)
    out[:, :7] = SOLID
    if legs:
        out[1:-1, 1:7] = FREE
    u = out.shape[0] // 2 - 2
    seat = out[u : u + 4, 7:11]
    seat[:] = SOLID
    if legs:  # the star of a swivel chair
        seat[[0, 0, -1, -1], [0, -1, 0, -1]] = KEEP
    return out


def disc(diameter: float) -> Stamp:
    """Round thing: a plant, a floor lamp."""
    size = cells(diameter)
    x, y = np.mgrid[:size, :size] - (size - 1) / 2
    return (x**2 + y**2 <= (size / 2) ** 2).astype(np.int8)


def _turn(stamp: Stamp, side: int) -> Stamp:
    if side < 2:
        return stamp if side == 0 else stamp[:, ::-1]
    return stamp.T if side == 2 else stamp.T[::-1]


def _bedroom(f: Furnisher, room: Room) -> None:
    rng = f.rng
    double = block(1.6, 2.0)
    if room.area > 9 and rng.random() < 0.8:
        night = np.zeros((5, 20), dtype=np.int8)
        night[:4, :4] = SOLID
        bed = np.concatenate([night, double, night[::-1]])
        if f.at_wall(room, bed, corner=0.0) is None and f.at_wall(room, double, corner=0.8) is None:
            f.at_wall(room, block(2.0, 0.9), corner=1.0)
    else:
        f.at_wall(room, block(2.0, 0.9), corner=1.0)
    f.at_wall(room, with_front(block(rng.uniform(1.0, 2.0), 0.6), 0.5), corner=0.8)
    if rng.random() < 0.6:
        f.at_wall(room, with_front(block(rng.uniform(0.8, 1.2), 0.5), 0.4))
    if rng.random() < 0.5:
        f.at_wall(room, desk(rng.uniform(1.0, 1.4), f.legs))
    if rng.random() < 0.5:
        f.at_wall(room, disc(0.4), corner=1.0)


def _living(f: Furnisher, room: Room) -> None:
    rng = f.rng
    sofa = np.zeros((cells(rng.uniform(1.8, 2.5)), 20), dtype=np.int8)
    sofa[:, :9] = SOLID
    if rng.random() < 0.4:  # a corner sofa
        sofa[:8, :15] = SOLID
    sofa[8:-3, 13:18] = SOLID  # the coffee table
    side = f.at_wall(room, sofa, corner=0.3)
    if side is not None:
        f.at_wall(room, with_front(block(rng.uniform(1.2, 1.9), 0.4), 0.5), sides=[side ^ 1], corner=0.0)
    if room.area > 14:
        f.free_standing(room, _dining(f, rng.uniform(1.2, 2.0)))
    if rng.random() < 0.6:
        f.at_wall(room, block(0.8, 0.8), corner=0.7)
    for _ in range(int(room.area / 10) + 1):
        f.at_wall(room, with_front(block(rng.uniform(0.8, 2.0), 0.3), 0.4))
    for _ in range(2):
        f.at_wall(room, disc(rng.uniform(0.3, 0.5)), corner=1.0)


def _kitchen(f: Furnisher, room: Room) -> None:
    rng = f.rng
    side = None
    long_sides = (0, 1) if room.x1 - room.x0 >= room.y1 - room.y0 else (2, 3)
    span = (room.x1 - room.x0 if long_sides[0] == 0 else room.y1 - room.y0) * CELL
    for share in (1.0, 0.8, 0.6, 0.45):  # as long a counter as doors leave room for
        side = f.at_wall(room, with_front(block(share * span, 0.6), 0.6), sides=long_sides, corner=1.0)
        if side is not None:
            break
    if rng.random() < 0.6:
        short = (2, 3) if long_sides[0] == 0 else (0, 1)
        f.at_wall(room, with_front(block(rng.uniform(0.8, 1.8), 0.6), 0.5), sides=short, corner=1.0)
    f.at_wall(room, block(0.6, 0.6), corner=1.0)
    if room.area > 8:
        f.free_standing(room, _dining(f, 1.2 if room.area < 12 else 1.6), margin=0.4)


def _bathroom(f: Furnisher, room: Room) -> None:
    rng = f.rng
    if room.area > 4 and rng.random() < 0.6:
        f.at_wall(room, block(1.7, 0.7), corner=1.0)
    else:
        f.at_wall(room, block(0.9, 0.9), corner=1.0)
    toilet = np.zeros((6, 6), dtype=np.int8)
    toilet[1:5] = SOLID
    f.at_wall(room, with_front(toilet, 0.3), corner=0.2)
    f.at_wall(room, with_front(block(0.6, 0.4), 0.3), corner=0.2)
    if room.area > 4:
        f.at_wall(room, block(0.6, 0.6), corner=1.0)


def _storage(f: Furnisher, room: Room) -> None:
    for _ in range(2):
        f.at_wall(room, with_front(block(f.rng.uniform(0.8, 1.6), 0.4), 0.4), corner=1.0)


def _corridor(f: Furnisher, room: Room) -> None:
    long_sides = (0, 1) if room.x1 - room.x0 >= room.y1 - room.y0 else (2, 3)
    for _ in range(1 + int(room.area / 8)):
        f.at_wall(room, block(f.rng.uniform(0.6, 1.2), 0.3), sides=long_sides, corner=0.2)


def _study(f: Furnisher, room: Room) -> None:
    rng = f.rng
    f.at_wall(room, desk(rng.uniform(1.2, 1.6), f.legs), corner=0.3)
    for _ in range(2):
        f.at_wall(room, with_front(block(rng.uniform(0.8, 2.0), 0.3), 0.4), corner=0.7)
    if rng.random() < 0.6:
        f.at_wall(room, block(1.8, 0.9), corner=0.8)
    f.at_wall(room, disc(0.4), corner=1.0)


def _office(f: Furnisher, room: Room) -> None:
    rng = f.rng
    for _ in range(max(1, int(room.area / 7))):
        f.at_wall(room, desk(rng.uniform(1.4, 1.6), f.legs), corner=0.3)
    for _ in range(1 + int(room.area / 12)):
        f.at_wall(room, with_front(block(rng.uniform(0.8, 1.6), 0.4), 0.5), corner=0.7)
    if room.area > 24:  # an island of desks back to back
        f.free_standing(room, np.concatenate([desk(2.8, f.legs)[:, ::-1], desk(2.8, f.legs)], axis=1), 0.4)
    f.at_wall(room, disc(0.4), corner=1.0)


def _meeting(f: Furnisher, room: Room) -> None:
    longest = max(room.x1 - room.x0, room.y1 - room.y0) * CELL
    f.free_standing(room, table_with_chairs(min(4.0, longest - 2.4), 1.2, True, f.legs), margin=0.6)
    f.at_wall(room, with_front(block(1.6, 0.4), 0.4), corner=0.3)
    f.at_wall(room, disc(0.5), corner=1.0)


def _washroom(f: Furnisher, room: Room) -> None:
    """Stalls along the long side, basins opposite."""
    long_sides = (0, 1) if room.x1 - room.x0 >= room.y1 - room.y0 else (2, 3)
    span = max(room.x1 - room.x0, room.y1 - room.y0)
    for count in range(min(4, (span - 4) // 10), 0, -1):
        stalls = np.zeros((10 * count + 1, 19), dtype=np.int8)
        stalls[::10, :14] = SOLID
        for k in range(count):
            stalls[10 * k + 4 : 10 * k + 7, :5] = SOLID
        side = f.at_wall(room, stalls, sides=long_sides, corner=1.0)
        if side is not None:
            f.at_wall(room, with_front(block(0.6 * count, 0.4), 0.3), sides=[side ^ 1], corner=0.5)
            return
    _bathroom(f, room)


def _dining(f: Furnisher, along: float) -> Stamp:
    return table_with_chairs(along, 0.8, along > 1.5, f.legs)


_PROGRAMS: dict[str, Callable[[Furnisher, Room], None]] = {
    "bedroom": _bedroom,
    "living": _living,
    "kitchen": _kitchen,
    "bathroom": _bathroom,
    "storage": _storage,
    "corridor": _corridor,
    "study": _study,
    "office": _office,
    "meeting": _meeting,
    "washroom": _washroom,
}
