"""Furnished floor plans: flats and offices with corridors, doors of 0.8 to 0.9 m and furniture, at 0.1 m."""

from dataclasses import replace

import numpy as np
from scipy import ndimage

from maexp.envs.maps.point_cloud import PointCloudMap
from maexp.envs.scenarios.furniture import CELL, CLEARANCE, Furnisher, Room, cells
from maexp.envs.scenarios.lattice import grid_points, largest_component, make_generator

OUTER_WALL = 3  # cells
INNER_WALL = 1
MIN_SIDE = 17  # of a room: 1.7 m
WALL_HEIGHT, FURNITURE_HEIGHT = 2.5, 0.8  # [m], for drawing
BAND = 24  # least depth of the rooms along a corridor
CORRIDOR = 14  # largest breadth of a corridor
TWO_BANDS = 2 * (BAND + INNER_WALL) + CORRIDOR  # what a corridor with rooms on both sides needs


def build_indoor(index: int, *, scenario: str, longest: tuple[float, float]) -> PointCloudMap:
    """Floor plan `index`; `longest` is the range of its longer outside measure [m]."""
    rng = make_generator(scenario, index)
    free, walls, footprint = _draw_plan(longest, rng)
    while not _is_roomy(free):  # about one plan in a hundred
        free, walls, footprint = _draw_plan(longest, rng)
    obstacles = footprint & ~free
    return PointCloudMap(
        grid_points(free, CELL),
        grid_points(obstacles, CELL),
        CELL,
        name=f"{scenario}_{index}",
        scenario=scenario,
        free_height=np.zeros(int(free.sum()), dtype=np.float32),
        obstacle_height=np.where(walls[obstacles], WALL_HEIGHT, FURNITURE_HEIGHT).astype(np.float32),
    )


def _draw_plan(longest: tuple[float, float], rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One furnished plan: cells that are free, wall, and inside the outer walls, bool (nx, ny) each."""
    width = cells(rng.uniform(*longest))
    depth = cells(width * CELL * rng.uniform(0.68, 0.95))
    is_office = rng.random() < (0.0 if width < 100 else 0.25 if width < 140 else 0.5)
    rooms = _plan_rooms(width, depth, is_office, rng)
    blocked = np.ones((width, depth), dtype=bool)
    for room in rooms:
        blocked[room.x0 : room.x1, room.y0 : room.y1] = False
    footprint = ndimage.binary_dilation(~blocked, np.ones((3, 3)), iterations=OUTER_WALL)
    reserved = _open_doors(rooms, blocked, is_office, rng)
    walls = blocked.copy()
    furnisher = Furnisher(blocked, reserved, legs=bool(rng.random() < 0.5), rng=rng)
    for room in rooms:
        furnisher.furnish(room)
    # Slits one cell wide (between a shelf and a wall) are neither swept nor seen: they count as furniture.
    free = largest_component(ndimage.binary_opening(~blocked, np.ones((2, 2))))
    if rng.random() < 0.5:
        return free.T, walls.T, footprint.T
    return free, walls, footprint


def _is_roomy(free: np.ndarray) -> bool:
    """Whether all but 3 % of the places with clearance hang together: no door is furnished shut."""
    passable = ndimage.distance_transform_edt(free) >= CLEARANCE
    return largest_component(passable).sum() >= 0.97 * passable.sum()


def _plan_rooms(width: int, depth: int, is_office: bool, rng: np.random.Generator) -> list[Room]:
    """Rooms that tile the inside of a `width` x `depth` plan, walls between them, kinds assigned."""
    inside = Room(OUTER_WALL, OUTER_WALL, width - OUTER_WALL, depth - OUTER_WALL)
    rooms: list[Room] = []
    largest = rng.uniform(14, 22) if is_office else rng.uniform(10, 17)  # m^2
    if depth < TWO_BANDS + 2 * OUTER_WALL or (depth < 80 and rng.random() < 0.4):
        _cut_freely(inside, largest, rng, rooms)
    else:
        _lay_corridor(inside, 0, largest, rng, rooms)
    rooms = _drop_corner(rooms, inside, rng)
    return _assign_offices(rooms) if is_office else _assign_flat(rooms, rng)


def _cut(room: Room, axis: int, at: int, wall: int = INNER_WALL) -> tuple[Room, Room]:
    """Two parts of `room` with a wall of `wall` cells between, `at` cells from its low side along `axis`."""
    if axis == 0:
        return replace(room, x1=room.x0 + at), replace(room, x0=room.x0 + at + wall)
    return replace(room, y1=room.y0 + at), replace(room, y0=room.y0 + at + wall)


def _lengths(room: Room) -> tuple[int, int]:
    return room.x1 - room.x0, room.y1 - room.y0


def _cut_freely(room: Room, largest: float, rng: np.random.Generator, out: list[Room]) -> None:
    """Binary space partition: cut the longer side until rooms are no larger than `largest` [m^2]."""
    lengths = _lengths(room)
    axis = int(lengths[1] > lengths[0])
    length = lengths[axis]
    if length < 2 * MIN_SIDE + 4 or (room.area < largest and length < 2 * min(lengths)):
        out.append(room)
        return
    for part in _cut(room, axis, int(length * rng.uniform(0.36, 0.64))):
        _cut_freely(part, largest, rng, out)


def _lay_corridor(room: Room, axis: int, largest: float, rng: np.random.Generator, out: list[Room]) -> None:
    """A corridor along `axis` through `room`, rooms on both sides; it may stop short of an end room."""
    along, across = _lengths(room)[axis], _lengths(room)[1 - axis]
    if along > 80 and rng.random() < 0.5:
        end = int(rng.integers(32, 45))
        if rng.random() < 0.5:
            room, last = _cut(room, axis, along - end - INNER_WALL)
        else:
            last, room = _cut(room, axis, end)
        _cut_band(last, 1 - axis, largest, rng, out)
    breadth = int(rng.integers(11, CORRIDOR + 1))
    below = int(rng.integers(BAND, across - breadth - 2 * INNER_WALL - BAND + 1))
    first, rest = _cut(room, 1 - axis, below)
    corridor, second = _cut(rest, 1 - axis, breadth)
    out.append(replace(corridor, kind="corridor"))
    for band in (first, second):
        _cut_band(band, axis, largest, rng, out)


def _cut_band(band: Room, axis: int, largest: float, rng: np.random.Generator, out: list[Room]) -> None:
    """Cut the band beside a corridor along `axis` so that rooms keep a side on the corridor."""
    along, across = _lengths(band)[axis], _lengths(band)[1 - axis]
    if across > 62 and TWO_BANDS <= along <= 120:
        _lay_corridor(band, 1 - axis, largest, rng, out)
    elif along >= 2 * MIN_SIDE + 8 and (band.area > largest or along > 2 * across):
        narrow = rng.random() < 0.3 and along > 50  # a bathroom or a store beside a larger room
        at = int(rng.integers(MIN_SIDE, 23)) if narrow else int(along * rng.uniform(0.38, 0.62))
        for part in _cut(band, axis, at if rng.random() < 0.5 else along - at - INNER_WALL):
            _cut_band(part, axis, largest, rng, out)
    elif across >= 2 * MIN_SIDE + 8 and across > 2 * along:
        out.extend(_cut(band, 1 - axis, int(across * rng.uniform(0.38, 0.62))))
    else:
        out.append(band)


def _drop_corner(rooms: list[Room], inside: Room, rng: np.random.Generator) -> list[Room]:
    """In two plans of three: leave out a room at a corner of the building, which makes it L-shaped."""
    total = sum(room.area for room in rooms)
    corners = [
        room
        for room in rooms
        if (room.x0 == inside.x0) != (room.x1 == inside.x1)
        and (room.y0 == inside.y0) != (room.y1 == inside.y1)  # at a corner, and no whole end of the building
        and room.kind != "corridor"
        and room.area < 0.16 * total
    ]
    if len(rooms) < 5 or not corners or rng.random() < 1 / 3:
        return rooms
    dropped = corners[int(rng.integers(len(corners)))]
    kept = [room for room in rooms if room is not dropped]
    return kept if len(_spanning_doors(kept, rng)) == len(kept) - 1 else rooms


def _by_area(rooms: list[Room]) -> list[int]:
    """Indices of the rooms that are no corridors, largest first."""
    return sorted((k for k in range(len(rooms)) if rooms[k].kind != "corridor"), key=lambda k: -rooms[k].area)


def _assign_flat(rooms: list[Room], rng: np.random.Generator) -> list[Room]:
    """Kinds of a flat: the largest room is the living room, the smallest ones bathroom and store."""
    order = _by_area(rooms)
    kinds = {order[0]: "living"}
    if len(order) > 1:
        kinds[order[-1]] = "bathroom"
    middle = [k for k in order if k not in kinds and 5 < rooms[k].area < 16]
    near = [k for k in middle if _shared(rooms[k], rooms[order[0]])]
    if near or middle:
        kinds[(near or middle)[0]] = "kitchen"
    for k in order:
        if k not in kinds:
            small = ["storage", "bathroom"][int(rng.integers(2))] if rooms[k].area < 5.5 else None
            kinds[k] = small or ("bedroom" if rng.random() < 0.75 else "study")
    if len(order) > 7:  # a large flat has a second living room
        kinds[order[1]] = "living" if kinds[order[1]] != "kitchen" else "kitchen"
    return [replace(room, kind=kinds.get(k, room.kind)) for k, room in enumerate(rooms)]


def _assign_offices(rooms: list[Room]) -> list[Room]:
    """Kinds of an office floor."""
    order = _by_area(rooms)
    kinds = {k: "office" for k in order}
    kinds |= {k: "storage" for k in order if rooms[k].area < 5.5}
    kinds |= dict(zip(order[::-1], ["washroom", "kitchen"], strict=False))
    kinds |= {k: "meeting" for k in order[: 1 + len(order) // 6]}
    return [replace(room, kind=kinds.get(k, room.kind)) for k, room in enumerate(rooms)]


def _shared(a: Room, b: Room) -> tuple[int, int, int, int] | None:
    """Wall (axis, position, start, stop) that two rooms share, in cells, or None; axis 0: it has one x."""
    for axis in (0, 1):
        (a0, a1), (b0, b1) = (((r.x0, r.x1) if axis == 0 else (r.y0, r.y1)) for r in (a, b))
        (c0, c1), (d0, d1) = (((r.y0, r.y1) if axis == 0 else (r.x0, r.x1)) for r in (a, b))
        start, stop = max(c0, d0), min(c1, d1)
        if stop - start >= 11 and (a1 + INNER_WALL == b0 or b1 + INNER_WALL == a0):
            return axis, a1 if a1 + INNER_WALL == b0 else b1, start, stop
    return None


def _spanning_doors(rooms: list[Room], rng: np.random.Generator) -> list[tuple[int, int]]:
    """Pairs of rooms to join: a spanning tree that prefers corridors and passes through no small room."""
    edges = []
    for i in range(len(rooms)):
        for j in range(i):
            if _shared(rooms[i], rooms[j]):
                kinds = {rooms[i].kind, rooms[j].kind}
                cost = 0.0 if kinds == {"corridor"} else 1.0 if "corridor" in kinds else 3.0
                cost += 2.0 * (min(rooms[i].area, rooms[j].area) < 6) - 1.0 * ("living" in kinds)
                edges.append((cost + 0.5 * rng.random(), i, j))
    group = list(range(len(rooms)))
    tree = []
    for _, i, j in sorted(edges):
        if group[i] != group[j]:
            old = group[i]
            group = [group[j] if g == old else g for g in group]
            tree.append((i, j))
    return tree


def _open_doors(rooms: list[Room], blocked: np.ndarray, is_office: bool, rng: np.random.Generator) -> np.ndarray:
    """Cut doors into `blocked`; returns the cells before and behind them that furniture must leave free."""
    reserved = np.zeros_like(blocked)
    tree = _spanning_doors(rooms, rng)
    loops = [(i, j) for i in range(len(rooms)) for j in range(i) if (i, j) not in tree]
    extra = [pair for pair in loops if _wants_door(rooms[pair[0]], rooms[pair[1]], is_office, rng)]
    for i, j in tree + extra:
        wall = _shared(rooms[i], rooms[j])
        if wall is None:
            continue
        axis, position, start, stop = wall
        kinds = {rooms[i].kind, rooms[j].kind}
        gap = int(rng.integers(8, 10))
        if kinds == {"corridor"}:
            start, gap = start, stop - start
        elif "living" in kinds and kinds & {"corridor", "kitchen", "living"} and rng.random() < 0.6:
            gap = min(stop - start - 2, int(rng.integers(12, 26)))  # an open passage without a door
        first = start + int(rng.integers(0, stop - start - gap + 1))
        if gap < 10 and rng.random() < 0.7:  # doors stand near the corner of a room
            first = start + 1 if rng.random() < 0.5 else stop - gap - 1
        _carve(blocked, reserved, axis, position, first, gap)
        if gap < 10 and kinds != {"corridor"} and rng.random() < 0.4:
            high = rooms[i] if (rooms[i].x0, rooms[i].y0)[axis] > position else rooms[j]
            inward = high.kind != "corridor"
            _hang_leaf(blocked, axis, position, first - 1 if rng.random() < 0.5 else first + gap, gap, inward)
    return reserved


def _wants_door(a: Room, b: Room, is_office: bool, rng: np.random.Generator) -> bool:
    """Whether two rooms get a door that the spanning tree does not need: the loops of the plan."""
    kinds = {a.kind, b.kind}
    if kinds == {"corridor"}:
        return True
    if kinds & {"bathroom", "storage", "washroom"}:
        return False
    chance = 0.15 if is_office else 0.6 if "living" in kinds and kinds & {"kitchen", "corridor"} else 0.08
    return rng.random() < chance


def _carve(blocked: np.ndarray, reserved: np.ndarray, axis: int, position: int, first: int, gap: int) -> None:
    """Open `gap` cells of a wall and reserve 0.7 m before and behind."""
    along = slice(first, first + gap)
    wall, ahead = slice(position, position + INNER_WALL), slice(position - 7, position + INNER_WALL + 7)
    blocked[(wall, along) if axis == 0 else (along, wall)] = False
    reserved[(ahead, along) if axis == 0 else (along, ahead)] = True


def _hang_leaf(blocked: np.ndarray, axis: int, position: int, hinge: int, length: int, towards_high: bool) -> None:
    """Draw a door standing open at right angles to its wall."""
    span = slice(position + 1, position + 1 + length) if towards_high else slice(position - length, position)
    blocked[(span, hinge) if axis == 0 else (hinge, span)] = True
