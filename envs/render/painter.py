"""A scene as shaded quadrilaterals, and a painter of them that needs no graphics driver."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw
from scipy.spatial import cKDTree

from maexp.envs.render.stage import DrawnScene

SHADES = {"top": 1.0, "south": 0.80, "east": 0.68, "west": 0.74, "north": 0.62}  # light from above, a little from -y
_SIDES = {"south": (0, -1), "east": (1, 0), "north": (0, 1), "west": (-1, 0)}  # outward normals
WHITE = np.array([255, 255, 255])


@dataclass(frozen=True, eq=False)
class Quads:
    """Q quadrilaterals, counter-clockwise seen from outside.

    Attributes:
        corners: [Q, 4, 3] [m]; a triangle has its last corner twice.
        colour: uint8 [Q, 3].
        at: where what it belongs to stands, [Q, 2] [m]: painters draw the farthest first,
        reach: counted as this much nearer, [Q] [m]: what lies on the ground covers the tiles around it,
        layer: and at one distance the lowest layer first, [Q].
    """

    corners: np.ndarray
    colour: np.ndarray
    at: np.ndarray
    reach: np.ndarray
    layer: np.ndarray

    @classmethod
    def join(cls, parts: list[Quads]) -> Quads:
        """All of `parts`."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls.__dataclass_fields__))

    def pick(self, chosen: np.ndarray) -> Quads:
        """Those of a mask or of indices."""
        return Quads(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))


def make_quads(scene: DrawnScene) -> Quads:
    """All quadrilaterals of a scene."""
    unit = float(np.ptp(np.stack(scene.bounds), axis=0).max()) / 400  # width of a line
    tile, across = 1.5 * float(scene.ground_size.max()), float(np.linalg.norm(np.ptp(np.stack(scene.bounds), axis=0)))
    pin = 6 * unit + 1.6 * (float(np.median(scene.wall_height)) if len(scene.walls) else 0.0)
    parts = [_ground(scene), _columns(scene)]
    for i in range(len(scene.robots)):
        colour, lift = scene.robot_colour[i], 0.5 * unit
        trail = scene.trails[:, i]
        fade = np.linspace(0.35, 1.0, max(len(trail) - 1, 1))[: len(trail) - 1, None]
        parts.append(_ribbon(trail, 1.5 * unit, fade * colour + (1 - fade) * 235, lift, tile, layer=2))
        if scene.radar_range[i] <= across:  # a wider one lies outside, and would be cut into millions of pieces
            parts.append(_ring(scene.robots[i], scene.radar_range[i], 0.6 * unit, colour, lift, tile))
        if np.isfinite(scene.goals[i]).all():
            parts.append(_goal(scene.goals[i], unit, colour, pin, tile))
        parts.append(_robot(scene, i, tile))
    return Quads.join(parts)


def _ground(scene: DrawnScene) -> Quads:
    """The tiles, with sides where an obstacle beside them lies lower, as water in a canal does."""
    size = np.asarray(scene.ground_size, dtype=np.float64)
    offsets = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    corners = scene.ground[:, None] + 0.5 * size[:, None, None] * offsets
    tiles = _quads(corners, scene.ground_colour, scene.ground[:, :2], 0.0, 0)
    tops = scene.walls[:, 2] + scene.wall_height
    if not len(tops) or tops.min() >= scene.ground[:, 2].min() and not np.ptp(scene.ground[:, 2]):
        return tiles
    far, beside = cKDTree(scene.walls[:, :2]).query(scene.ground[:, :2])
    drop = scene.ground[:, 2] - tops[beside]
    cliff = (far < 1.6 * size) & (drop > 1e-3)
    feet, sizes = scene.ground - drop[:, None] * [0, 0, 1], np.column_stack([size, size, drop])
    return Quads.join([tiles, *_boxes(feet[cliff], sizes[cliff], scene.ground_colour[cliff], layer=0)[1:]])


def _quads(corners, colour, at, reach: float, layer: int) -> Quads:
    return Quads(corners, colour, at, np.full(len(corners), reach), np.full(len(corners), layer))


def _columns(scene: DrawnScene) -> Quads:
    """Top and sides of the obstacles' columns; a side hidden by a neighbour that is as high is left out."""
    size, top = np.asarray(scene.wall_size, dtype=np.float64), scene.walls[:, 2] + scene.wall_height
    boxes = _boxes(scene.walls, np.column_stack([size, size, scene.wall_height]), scene.wall_colour)
    if not len(scene.walls):
        return Quads.join(boxes)
    tree = cKDTree(scene.walls[:, :2])
    for k, normal in enumerate(_SIDES.values(), start=1):
        far, beside = tree.query(scene.walls[:, :2] + size[:, None] * normal)
        hidden = (far < 0.05 * size) & (top[beside] >= top - 1e-6)
        boxes[k] = boxes[k].pick(~hidden)
    return Quads.join(boxes)


def _boxes(feet, sizes, colours, heading=None, reach: float = 0.0, layer: int = 3) -> list[Quads]:
    """Boxes on their feet [n, 3], sizes [n, 3]: a Quads of the tops, then one of each side."""
    heading = np.zeros(len(feet)) if heading is None else heading
    cos, sin = np.cos(heading)[:, None, None], np.sin(heading)[:, None, None]
    half, height = 0.5 * np.asarray(sizes)[:, None, :2], np.asarray(sizes)[:, 2]

    def place(unit_corners, heights) -> np.ndarray:
        flat = half * np.asarray(unit_corners)[None]
        x, y = flat[..., :1], flat[..., 1:]
        turned = np.concatenate([cos * x - sin * y, sin * x + cos * y], axis=-1)
        z = feet[:, 2:] + np.asarray(heights)[None] * height[:, None]
        return np.concatenate([feet[:, None, :2] + turned, z[..., None]], axis=-1)

    faces = {"top": place([[-1, -1], [1, -1], [1, 1], [-1, 1]], [1, 1, 1, 1])}
    for name, (x, y) in _SIDES.items():
        first, second = (x + y, y - x), (x - y, y + x)  # ends of the side, clockwise and counter-clockwise
        faces[name] = place([first, second, second, first], [0, 0, 1, 1])
    shaded = {name: np.rint(SHADES[name] * np.asarray(colours)).astype(np.uint8) for name in faces}
    return [_quads(corners, shaded[name], feet[:, :2], reach, layer) for name, corners in faces.items()]


def _robot(scene: DrawnScene, i: int, tile: float) -> Quads:
    """A box on its heading, with a light arrow forward on its roof; a collided one has a light roof."""
    feet, body, heading = scene.robots[i : i + 1], scene.body[i : i + 1], scene.heading[i : i + 1]
    foot = feet + [0, 0, 0.1 * body[0, 2]]
    rim, reach = body * [1.18, 1.3, 0.1], tile + 0.7 * body[0, 0]
    parts = _boxes(feet, rim, WHITE[None], heading, reach, 4)
    parts += _boxes(foot, body, scene.robot_colour[i : i + 1], heading, reach, 5)
    length, width, height = body[0]
    arrow = np.array([[0.42 * length, 0], [-0.1 * length, 0.36 * width], [-0.1 * length, -0.36 * width]])
    if scene.collided[i]:
        arrow = np.array([[0.4, 0.4], [-0.4, 0.4], [-0.4, -0.4], [0.4, -0.4]]) * [length, width]
    cos, sin = np.cos(heading[0]), np.sin(heading[0])
    flat = arrow @ np.array([[cos, sin], [-sin, cos]]) + foot[0, :2]
    corners = np.column_stack([flat, np.full(len(flat), foot[0, 2] + 1.02 * height)])
    corners = np.concatenate([corners, corners[-1:]])[:4]
    parts.append(_quads(corners[None], WHITE[None].astype(np.uint8), feet[:, :2], reach, 6))
    return Quads.join(parts)


def _goal(goal: np.ndarray, unit: float, colour: np.ndarray, height: float, tile: float) -> Quads:
    """A pin: a cross on the ground, a pole `height` m high and a cube on it."""
    ends = [goal + [dx * 4 * unit, dy * 4 * unit, 0] for dx, dy in ((-1, -1), (1, 1), (-1, 1), (1, -1))]
    reach, parts = tile + 4 * unit, []
    for k, (width, tint) in enumerate(((3.4 * unit, WHITE), (1.6 * unit, colour))):
        for first, last in (ends[:2], ends[2:]):
            parts.append(_ribbon(np.stack([first, last]), width, tint[None], (0.6 + 0.2 * k) * unit, reach, 3 + k))
    pole = np.array([[0.8 * unit, 0.8 * unit, height]])
    parts += _boxes(goal[None], pole, colour[None], reach=reach, layer=5)
    cube, turn = np.full((1, 3), 4 * unit), np.array([np.pi / 4])
    parts += _boxes(goal[None] + [0, 0, height], cube, colour[None], turn, reach, 6)
    return Quads.join(parts)


def _ring(center: np.ndarray, radius: float, width: float, colour, lift: float, tile: float) -> Quads:
    angle = np.linspace(0, 2 * np.pi, 73)
    circle = center + radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    return _ribbon(circle, width, 0.6 * np.asarray(colour)[None] + 0.4 * 235, lift, tile, layer=1)


def _ribbon(points: np.ndarray, width: float, colours, lift: float, reach: float, layer: int) -> Quads:
    """A flat band along points (n, 3); colours (n - 1, 3) or (1, 3)."""
    ahead = np.diff(points, axis=0)
    moved = np.linalg.norm(ahead[:, :2], axis=1) > 1e-9
    first, last, ahead = points[:-1][moved], points[1:][moved], ahead[moved]
    along = ahead / np.linalg.norm(ahead[:, :2], axis=1, keepdims=True)
    side = 0.5 * width * np.column_stack([-along[:, 1], along[:, 0], np.zeros(len(along))])
    over = 0.25 * width * along * [1, 1, 0]  # ends overlap, or bends would gape
    first, last = first - over + [0, 0, lift], last + over + [0, 0, lift]
    corners = np.stack([first - side, last - side, last + side, first + side], axis=1)
    colours = np.rint(np.broadcast_to(colours, (len(moved), 3))[moved]).astype(np.uint8)
    return _quads(corners, colours, 0.5 * (first + last)[:, :2], reach, layer)


BACKGROUND = (255, 255, 255)
FOV = 30.0  # [degrees], vertical
_AA = 2  # drawn this many times larger, then averaged


@dataclass(frozen=True)
class Camera:
    """Where a picture is taken from: eye and target [m], picture size [px], vertical field of view [degrees]."""

    eye: np.ndarray
    target: np.ndarray
    width: int
    height: int
    fov: float = FOV

    @property
    def axes(self) -> np.ndarray:
        """Right, up and back of the picture, rows of [3, 3]."""
        back = (self.eye - self.target) / np.linalg.norm(self.eye - self.target)
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(back, right), back])

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (..., 2), column then row, and depth (...) of points (..., 3)."""
        seen = (points - self.eye) @ self.axes.T
        depth = np.maximum(-seen[..., 2], 1e-9)
        focal = 0.5 * self.height / np.tan(np.radians(0.5 * self.fov))
        pixels = seen[..., :2] / depth[..., None] * [focal, -focal] + [0.5 * self.width, 0.5 * self.height]
        return pixels, depth


def look_at(bounds, width: int, height: int, azimuth: float = -60.0, elevation: float = 50.0) -> Camera:
    """A camera that sees all between two corners.

    Args:
        bounds: lowest and highest corner [m]
        width, height: of the picture [px]
        azimuth: where the camera stands, seen from the middle, counter-clockwise from x [degrees]
        elevation: of the camera over the ground [degrees], above 0 and below 90
    """
    low, high = bounds
    target = 0.5 * (low + high)
    a, e = np.radians(azimuth), np.radians(np.clip(elevation, 1.0, 89.0))
    direction = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    distance = 1.2 * float(np.linalg.norm(high - low)) / np.tan(np.radians(0.5 * FOV))
    frame = np.array([width, height])
    for _ in range(12):  # centre the picture and fill it; each round halves what is left
        camera = Camera(target + distance * direction, target, width, height)
        pixels, _ = camera.project(corners)
        middle = 0.5 * (pixels.min(axis=0) + pixels.max(axis=0)) - 0.5 * frame
        per_metre = 0.5 * height / np.tan(np.radians(0.5 * FOV)) / distance
        target = target + (camera.axes[0] * middle[0] - camera.axes[1] * middle[1]) / per_metre
        distance *= max(float((np.ptp(pixels, axis=0) / (0.94 * frame)).max()), 0.2)
    return Camera(target + distance * direction, target, width, height)


def paint(quads: Quads, camera: Camera) -> np.ndarray:
    """The picture, uint8 (height, width, 3)."""
    corners = quads.corners
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing = ((camera.eye - corners[:, 0]) * normal).sum(axis=1) > 0
    pixels = camera.project(corners)[0] * _AA
    frame = _AA * np.array([camera.width, camera.height])
    inside = ((pixels.max(axis=1) > 0) & (pixels.min(axis=1) < frame)).all(axis=1)
    chosen = np.flatnonzero(facing & inside)
    far = np.linalg.norm(quads.at[chosen] - camera.eye[:2], axis=1) - quads.reach[chosen]
    order = chosen[np.lexsort((quads.layer[chosen], -far))]
    grown = pixels + 0.5 * np.sign(pixels - pixels.mean(axis=1, keepdims=True))  # no hairline between tiles
    image = Image.new("RGB", (camera.width * _AA, camera.height * _AA), BACKGROUND)
    draw = ImageDraw.Draw(image)
    for points, colour in zip(grown[order].reshape(len(order), 8).tolist(), quads.colour[order].tolist(), strict=True):
        draw.polygon(points, fill=tuple(colour))
    return np.asarray(image.reduce(_AA))
