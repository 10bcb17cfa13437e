"""How near a waypoint is drawn, what clearance is kept, and what is to be seen from a place: plain loops.

Grids are arrays (H, W), rows along y; positions and lengths in cells, a cell's centre at (column + 0.5, row + 0.5).
"""

import math

OBSTACLE = 2


def nearest_obstacle(known, x: float, y: float, look: int) -> float:
    """Distance from (x, y) to the centre of the nearest obstacle cell, no more than `look`.

    Cells up to `look` columns and rows from the cell of (x, y) count.
    """
    height, width = known.shape
    gaps = [
        math.hypot(column + 0.5 - x, row + 0.5 - y)
        for row in range(height)
        for column in range(width)
        if known[row, column] == OBSTACLE and max(abs(row - math.floor(y)), abs(column - math.floor(x))) <= look
    ]
    return min([*gaps, look])


def room(known, team, i: int, p) -> float:
    """Room of robot i to brake. `team`: dicts with x, y, vx, vy, stopped, target, goal; `p`: the constants."""
    me = team[i]
    tx, ty = me["target"][0] - me["x"], me["target"][1] - me["y"]
    rooms = []
    if tuple(me["target"]) == tuple(me["goal"]):
        rooms.append(math.hypot(tx, ty))
    for j, other in enumerate(team):
        dx, dy = other["x"] - me["x"], other["y"] - me["y"]
        if j != i and dx * tx + dy * ty > 0:
            free = math.hypot(dx, dy) - 2 * p["clearance"]
            rooms.append(max(0.0, free if other["stopped"] else 0.5 * free))
    speed = math.hypot(me["vx"], me["vy"])
    ux, uy = (me["vx"] / speed, me["vy"] / speed) if speed else (0.0, 0.0)
    span = speed**2 / (2 * p["accel"]) + p["clearance"]
    for k in range(p["samples"] + 1):
        s = span * k / p["samples"]
        gap = nearest_obstacle(known, me["x"] + ux * s, me["y"] + uy * s, p["look"]) - p["threshold"]
        rooms.append(p["brake"] * s + p["headroom"] * max(gap, 0.0))
    return min(rooms)


def held_back(known, team, i: int, p) -> tuple[float, float]:
    """The waypoint of robot i after it has been drawn nearer."""
    me = team[i]
    later = me["x"] + me["vx"] * p["slack_time"], me["y"] + me["vy"] * p["slack_time"]
    gap = min(nearest_obstacle(known, x, y, p["look"]) for x, y in ((me["x"], me["y"]), later))
    spare = max(gap - p["threshold"], 0.0)
    reach = p["lead"] * math.sqrt(2 * p["accel"] * room(known, team, i, p))
    reach += p["slack"] * spare * min(spare / (p["slack_gap"] * p["threshold"]), 1.0)
    reach = max(reach, p["creep"] * p["clearance"])
    tx, ty = me["target"][0] - me["x"], me["target"][1] - me["y"]
    share = min(1.0, reach / max(math.hypot(tx, ty), 1e-12))
    return me["x"] + tx * share, me["y"] + ty * share


def free_way(known, me, heading: float, turn: float, keep: float, span: float, p) -> float:
    """How far robot `me` gets on a way that turns by `turn` at its rate and speed and then goes straight on: it looks
    ahead as far as the gap to the nearest obstacle allows, and stops looking where that is less than `keep`."""
    x, y, s, wanted = me["x"], me["y"], 0.0, 0.0
    bend = abs(turn) * max(me["speed"], p["slowest"]) / p["rate"]
    for _ in range(p["looks"]):
        while s < wanted - 1e-9:  # driven in small steps
            step = min(wanted - s, p["fine"])
            angle = heading + (turn * min(s + step / 2, bend) / bend if bend else 0.0)
            x, y, s = x + step * math.cos(angle), y + step * math.sin(angle), s + step
        if wanted >= span:
            break
        gap = nearest_obstacle(known, x, y, p["look"]) - keep
        if gap < 0:
            break
        wanted += max(gap, p["least_look"])
    return min(wanted, span)


def held_turn(known, me, mates, p) -> tuple[float, float, float]:
    """Where the waypoint of a differential drive lies once it can stop on its way, and what clearance it keeps.

    `me`: x, y, speed (without sign), heading (of the motion), target, keeps (the clearance so far). `mates`: x, y,
    stopped of each.
    """
    dx, dy = me["target"][0] - me["x"], me["target"][1] - me["y"]
    lead = p["horizon"] * p["dt"]
    span = p["top"] ** 2 / (2 * p["ease"] * p["accel"]) + lead * p["top"]
    span = min(span, p["radar"] - p["threshold"] - 1)
    keep = min(p["threshold"] + p["spare"], nearest_obstacle(known, me["x"], me["y"], p["look"]))
    turn = (math.atan2(dy, dx) - me["heading"] + math.pi) % (2 * math.pi) - math.pi
    straight = free = free_way(known, me, me["heading"], 0.0, keep, span, p)
    if abs(turn) > p["straight_on"]:
        free = free_way(known, me, me["heading"], turn, keep, span, p)
    fastest = math.sqrt(2 * p["ease"] * p["accel"] * max(free - lead * me["speed"], 0))
    for x, y, stopped in mates:
        gap = x - me["x"], y - me["y"]
        if gap[0] * math.cos(me["heading"]) + gap[1] * math.sin(me["heading"]) > 0:
            room = max(math.hypot(*gap) - 2 * p["clearance"], 0) * (1 if stopped else 0.5)
            fastest = min(fastest, math.sqrt(2 * p["ease"] * p["accel"] * room))
    soonest = sum(me["speed"] - p["accel"] * k * p["dt"] for k in range(p["horizon"])) * p["dt"]
    length = max(min(math.hypot(dx, dy), max(lead * fastest, p["nudge"] * p["clearance"])), soonest, 0)
    angle, keeps = math.atan2(dy, dx), me["keeps"]
    if fastest < me["speed"]:
        keeps = min(keeps, p["narrow"] * p["threshold"])
        if straight > free:
            angle, length = me["heading"], max(soonest, 0)
    return me["x"] + length * math.cos(angle), me["y"] + length * math.sin(angle), keeps


def fitted_clearance(known, x: float, y: float, path, p) -> float:
    """What the path's cells (column, row) around (x, y) have of room, between the least and the usual clearance."""
    gaps = [math.inf]
    for column, row in path:
        if math.hypot(column + 0.5 - x, row + 0.5 - y) <= p["ahead"] * p["clearance"]:
            gaps.append(nearest_obstacle(known, column + 0.5, row + 0.5, p["look"]))
    return min(max(p["fit"] * min(gaps), p["least"] * p["threshold"]), p["clearance"])


def look_around(known, column: int, row: int, reach: int, rays: int) -> tuple[float, float, float]:
    """Unknown cells (0) in sight of a cell, and the middle of them from there (x, y)."""
    height, width = known.shape
    area = mx = my = 0.0
    for ray in range(rays):
        angle = (ray + 0.5) * 2 * math.pi / rays
        last = (column, row)
        for step in range(1, reach + 1):
            here = column + round(step * math.cos(angle)), row + round(step * math.sin(angle))
            if not (0 <= here[0] < width and 0 <= here[1] < height) or known[here[1], here[0]] == OBSTACLE:
                break
            if known[here[1], last[0]] == OBSTACLE and known[last[1], here[0]] == OBSTACLE:
                break
            if known[here[1], here[0]] == 0:
                part = step * 2 * math.pi / rays
                area, mx, my = area + part, mx + part * step * math.cos(angle), my + part * step * math.sin(angle)
            last = here
    return area, mx / max(area, 1e-6), my / max(area, 1e-6)
