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
        if known[row, column] == OBSTACLE
        and max(abs(row - math.floor(y)), abs(column - math.floor(x))) <= look
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
