"""Pictures of an episode: frames, grids of frames, films. NumPy and Pillow only; needs no display.

A frame shows what the team has done so far: unexplored free space pale yellow, explored space green, space
that two or more robots have seen blue, walls dark once discovered and light before. Each robot is a rectangle
with a light front in its own colour, with its trail (fading), its radar range (circle), what it sees now (the
points lit up) and its goal (cross). Robots smaller than a few pixels are drawn larger than they are. Teams of more
than eight have numbers beside their robots, since colours alone do not tell so many apart.
"""

import colorsys
import math
from functools import lru_cache

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torchrl.envs.utils import step_mdp

from maexp.envs.maps.raster import MapRaster, map_raster
from maexp.envs.render.video import write_gif, write_mp4
from maexp.envs.volume.map import VoxelMap
from maexp.kernels.constants import DT

__all__ = ["draw_frame", "draw_grid", "draw_teams", "record_episode", "watch_episode", "write_gif", "write_mp4"]


# Lightness falls from unexplored to overlap, so that the classes differ without colour, too.
NOTHING = (255, 255, 255)
UNEXPLORED = (250, 238, 170)
EXPLORED = (150, 208, 140)
OVERLAP = (120, 170, 225)
WALL_UNSEEN = (196, 196, 196)
WALL_SEEN = (52, 52, 56)
INK = (30, 30, 34)
STRIP = (246, 246, 246)
_LEGEND = (
    ("unexplored", UNEXPLORED),
    ("explored", EXPLORED),
    ("by 2+", OVERLAP),
    ("wall", WALL_SEEN),
    ("unseen wall", WALL_UNSEEN),
)
# Distinct in hue and lightness for the colour-blind, none close to a class above (after Okabe-Ito and Tol).
ROBOT_COLOURS = (
    (213, 94, 0),
    (106, 30, 150),
    (215, 50, 130),
    (0, 60, 140),
    (130, 65, 15),
    (0, 90, 60),
    (235, 160, 0),
    (20, 20, 20),
)
LIGHT = 0.45  # share of white in what a robot sees now; a tint in its colour would blur the classes
TRAIL_STEPS = 200  # local steps until a trail has faded away
_TRAIL_BANDS = 20
SMALLEST_ROBOT = 1 / 30  # length of a drawn robot, at least this share of the picture; less in a large team
_ROOMY = 12  # robots that fit a picture at that size
_MOST_CIRCLES, _MOST_NUMBERS = 40, 100  # larger teams are drawn without these, which would hide the map
_AA = 2  # overlays are drawn this many times larger, then averaged


def robot_colour(index: int) -> tuple[int, int, int]:
    """Colour of robot ``index``: the eight of ROBOT_COLOURS, then dark to middling ones in steps of the golden angle.

    More than eight cannot be told apart by colour alone, so pictures number the robots of larger teams.
    """
    if index < len(ROBOT_COLOURS):
        return ROBOT_COLOURS[index]
    step = index - len(ROBOT_COLOURS)
    shade = colorsys.hls_to_rgb((0.12 + step * 0.618034) % 1.0, (0.26, 0.35, 0.44)[step % 3], 0.75)
    return tuple(round(255 * channel) for channel in shade)


def smallest_robot(count: int) -> float:
    """Least length of a drawn robot in a team of ``count``, as a share of the picture."""
    return SMALLEST_ROBOT * min(1.0, (_ROOMY / max(count, 1)) ** 0.5)


def draw_frame(snapshot: dict, size: int = 512) -> np.ndarray:
    """Picture of one team, uint8 (height, width, 3).

    Args:
        snapshot: what ``ExplorationEnv.snapshot(i)`` or ``Episode.snapshot(k)`` returns.
        size: width in pixels, at least 64; the map keeps its proportions within size x size, and a caption
            strip with coverage, time, scale and legend comes below.

    Raises:
        ValueError: size is not an integer of at least 64, or the snapshot's flags do not fit its map.
    """
    if int(size) != size or size < 64:
        raise ValueError(f"size={size} is not a picture width; give an integer of at least 64 pixels")
    size = int(size)
    if isinstance(snapshot["map"], VoxelMap):
        from maexp.envs.volume.render import draw_volume  # builds on what this file draws

        return draw_volume(snapshot, size)
    raster = map_raster(snapshot["map"], size)
    picture = Image.fromarray(raster.paint(point_colours(snapshot, raster.num_free, raster.num_boundary)))
    picture = _draw_moving(snapshot, raster, picture)
    strip = Image.fromarray(draw_caption(snapshot, size, raster.scale))
    height = raster.height + strip.height
    frame = Image.new("RGB", (size + size % 2, height + height % 2), STRIP)  # even sides, for video codecs
    frame.paste(NOTHING, (0, 0, frame.width, raster.height))
    frame.paste(picture, (0, 0))
    frame.paste(strip, (0, raster.height))
    return np.array(frame)


def add_headline(frame: np.ndarray, text: str, height: int | None = None) -> np.ndarray:
    """A picture with a line of text on top, uint8 (height, width, 3); the line's `height` is even, for video codecs."""
    height = height or frame.shape[1] // 14 // 2 * 2
    strip = Image.new("RGB", (frame.shape[1], height), STRIP)
    font = _font(max(10, int(0.7 * height)))
    at = (frame.shape[1] // 2, height // 2)
    ImageDraw.Draw(strip).text(at, _fit(text, font, 0.96 * frame.shape[1]), INK, font, "mm")
    return np.concatenate([np.asarray(strip), frame])


def draw_grid(frames, columns: int | None = None, gap: int = 6) -> np.ndarray:
    """Several pictures (of any sizes) in one, row by row, about as wide as high; uint8 (height, width, 3)."""
    frames = [np.asarray(frame) for frame in frames]
    if not frames:
        raise ValueError("frames is empty; give at least one picture")
    columns = columns or int(np.ceil(np.sqrt(len(frames))))
    height, width = (max(frame.shape[axis] for frame in frames) for axis in (0, 1))
    rows = -(-len(frames) // columns)
    grid = np.full((rows * (height + gap) - gap, columns * (width + gap) - gap, 3), 255, dtype=np.uint8)
    for k, frame in enumerate(frames):
        top, left = (k // columns) * (height + gap), (k % columns) * (width + gap)
        grid[top : top + frame.shape[0], left : left + frame.shape[1]] = frame
    return grid


def record_episode(env, policy, env_index=0, every: int | None = 2, size: int = 512) -> list:
    """Plays one episode from ``env.reset()`` and draws team ``env_index``: a list of uint8 pictures.

    Args:
        env: an :class:`ExplorationEnv`; call ``env.set_episodes`` before to choose an evaluation episode.
        policy: a TensorDictModule that writes the action.
        env_index: number of the team, or several numbers: these teams side by side.
        every: local steps from one picture to the next (a tenth of a second each); None: as many as make
            about 150 pictures of a full episode.
        size: width of a team's picture in pixels.

    The other teams of the batch play along, undrawn. The first picture is the start, the last one the end.
    """
    frames = []
    watch_episode(env, policy, lambda inputs: frames.append(draw_teams(inputs, size)), env_index, every)
    return frames


def draw_teams(snapshots: list[dict], size: int = 512) -> np.ndarray:
    """One team's picture, or those of several side by side, ``size`` pixels wide each."""
    frames = [draw_frame(snapshot, size) for snapshot in snapshots]
    return frames[0] if len(frames) == 1 else draw_grid(frames)


def watch_episode(env, policy, watch, teams=0, every: int | None = 2) -> None:
    """Plays one episode from ``env.reset()`` and calls ``watch(snapshots)``, one per team in ``teams``.

    That happens at the start, after every ``every``-th local step in which one of these teams moved, and at the
    end; a team that is done keeps its last snapshot. Arguments as in :func:`record_episode`.

    Raises:
        ValueError: a team's number is not one of the env's.
    """
    teams = check_teams(env, teams)
    every = every or max(1, env.local_steps * env.macro_steps // 150)
    latest: dict[int, dict] = {}

    def look(env) -> None:
        steps = env.simulation.tensors["local_step"].tolist()
        moved = [team for team in teams if team not in latest or latest[team]["local_step"] != steps[team]]
        latest.update({team: env.snapshot(team) for team in moved})
        if moved:
            watch([latest[team] for team in teams])

    env.set_step_hook(look, every=every)
    try:
        with torch.no_grad():
            state = env.reset()
            done = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
            while not bool(done[teams].all()):
                state = env.step(policy(state))
                done = done | state["next", "done"].reshape(-1)
                state = step_mdp(state)
    finally:
        env.set_step_hook(None)


def check_teams(env, teams) -> list[int]:
    """The numbers of one team or of several as a list."""
    numbers = np.atleast_1d(np.asarray(teams))
    whole = numbers.size and numbers.dtype.kind in "iu" and numbers.ndim == 1
    if not whole or numbers.min() < 0 or numbers.max() >= env.num_envs:
        raise ValueError(f"team {teams} is none of this env's: give numbers from 0 to {env.num_envs - 1}")
    return numbers.tolist()


# Colours of the points


def point_colours(snapshot: dict, num_free: int, num_boundary: int) -> np.ndarray:
    """Colours of nothing, the free points, the boundary points and all other obstacles: uint8 (entries, 3)."""
    seen_free, seen_boundary = np.asarray(snapshot["seen_free"]), np.asarray(snapshot["seen_boundary"])
    visible = np.asarray(snapshot["visible"])
    for name, flags, count in (
        ("seen_free", seen_free, num_free),
        ("visible", visible, num_free),
        ("seen_boundary", seen_boundary, num_boundary),
    ):
        if flags.ndim != 2 or flags.shape[1] != count:
            raise ValueError(f"snapshot {name} has shape {flags.shape}; the map needs (robots, {count})")
    classes = np.array([UNEXPLORED, EXPLORED, OVERLAP], dtype=np.uint8)
    table = np.empty((2 + num_free + num_boundary, 3), dtype=np.uint8)
    table[0], table[-1] = NOTHING, WALL_UNSEEN
    free, boundary = table[1 : 1 + num_free], table[1 + num_free : -1]
    free[:] = classes[np.minimum(np.count_nonzero(seen_free, axis=0), 2)]
    boundary[:] = np.where(seen_boundary.any(axis=0)[:, None], WALL_SEEN, WALL_UNSEEN)
    now = visible.any(axis=0)
    free[now] = np.rint((1 - LIGHT) * free[now] + LIGHT * 255)
    return table


# Robots, trails, goals, radar


def _draw_moving(snapshot: dict, raster: MapRaster, picture: Image.Image) -> Image.Image:
    """The picture of the points with everything that moves on top, smoothed."""
    large = picture.resize((raster.width * _AA, raster.height * _AA), Image.Resampling.NEAREST)
    unit = max(large.size) / 512  # line widths follow the picture's size
    _draw_trails(large, raster.to_pixels(smooth_trail(snapshot["trail"], snapshot["center"])) * _AA, unit)
    draw = ImageDraw.Draw(large, "RGBA")
    centers = raster.to_pixels(snapshot["center"]) * _AA
    for i, (x, y) in enumerate(centers):
        radius = float(snapshot["radar_range"][i]) * raster.scale * _AA
        box = (x - radius, y - radius, x + radius, y + radius)
        if len(centers) > _MOST_CIRCLES:
            break
        if radius > math.hypot(*large.size):  # all outside of the picture, and drawn point by point
            continue
        draw.ellipse(box, outline=(*robot_colour(i), 150), width=max(1, round(1.5 * unit)))
    corners, part = np.array(large.size), max(smallest_robot(len(centers)) / SMALLEST_ROBOT, 0.35)
    for i, goal in enumerate(raster.to_pixels(snapshot["goal"]) * _AA):
        if np.isfinite(goal).all():
            _draw_goal(draw, np.clip(goal, 8 * unit, corners - 8 * unit), robot_colour(i), part * unit)
    least = smallest_robot(len(centers)) * max(large.size)
    for i, center in enumerate(centers):
        length, width = np.asarray(snapshot["body"][i], dtype=float) * raster.scale * _AA
        grow = max(1.0, least / length)
        body = (length * grow, max(width * grow, 0.55 * least))
        heading = float(snapshot["pose"][i][3])
        _draw_robot(draw, center, heading, body, robot_colour(i), unit, bool(snapshot["collided"][i]))
    if len(ROBOT_COLOURS) < len(centers) <= _MOST_NUMBERS:
        _draw_numbers(draw, centers, 0.7 * least, unit)
    return large.reduce(_AA)


def smooth_trail(trail, center) -> np.ndarray:
    """Latest part of a trail (steps, robots, 2), smoothed: it may come off a grid. Ends at ``center``."""
    trail = np.array(trail[-TRAIL_STEPS - 1 :], dtype=np.float64)
    padded = np.pad(trail, ((3, 3), (0, 0), (0, 0)), mode="edge")
    smooth = np.lib.stride_tricks.sliding_window_view(padded, 7, axis=0).mean(axis=-1)
    smooth[-1:] = center
    return smooth


def _draw_trails(large: Image.Image, trail: np.ndarray, unit: float) -> None:
    """Trails (steps, robots, 2) [px]: the latest TRAIL_STEPS steps in bands that fade with age."""
    edges = np.linspace(len(trail) - 1 - TRAIL_STEPS, len(trail) - 1, _TRAIL_BANDS + 1)
    edges = np.maximum(np.rint(edges).astype(int), 0)
    width = max(1, round(2 * unit))
    for i in range(trail.shape[1]):
        corner = np.floor(trail[:, i].min(axis=0)).astype(int) - width
        mask = Image.new("L", tuple(np.ceil(trail[:, i].max(axis=0)).astype(int) - corner + width))
        draw = ImageDraw.Draw(mask)
        points = trail[:, i] - corner
        for band, (first, last) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
            if last > first:  # oldest first: a newer band covers it
                alpha = 30 + 225 * (band + 1) // _TRAIL_BANDS
                draw.line(points[first : last + 1].ravel().tolist(), fill=alpha, width=width, joint="curve")
        large.paste(robot_colour(i), tuple(corner.tolist()), mask)


def _draw_robot(draw, center, heading: float, body, colour, unit: float, collided: bool) -> None:
    """Oriented rectangle ``body`` (length, width) [px]; a light triangle forward, or a cross: collided."""
    forward = np.array([np.cos(heading), -np.sin(heading)])  # rows grow downward
    left = np.array([forward[1], -forward[0]])

    def outline(along: float, across: float, signs=((1, 1), (1, -1), (-1, -1), (-1, 1))) -> list[tuple]:
        return [tuple(center + a * along * forward + b * across * left) for a, b in signs]

    half_length, half_width = 0.5 * body[0], 0.5 * body[1]
    white = (255, 255, 255, 255)
    draw.polygon(outline(half_length + 1.5 * unit, half_width + 1.5 * unit), fill=white)
    draw.polygon(outline(half_length, half_width), fill=(*colour, 255))
    if collided:  # the arms of a cross
        for sign in (1, -1):
            ends = outline(0.8 * half_length, 0.8 * half_width, ((1, sign), (-1, -sign)))
            draw.line(ends, fill=white, width=max(1, round(2.5 * unit)))
    else:
        nose = outline(0.85 * half_length, 0.75 * half_width, ((1, 0), (0.1, 1), (0.1, -1)))
        draw.polygon(nose, fill=white)


def _draw_numbers(draw: ImageDraw.ImageDraw, centers: np.ndarray, aside: float, unit: float) -> None:
    """Each robot's number, counted from 0, to the upper right of it."""
    font, rim = _font(max(12, round(11 * unit))), max(1, round(1.2 * unit))
    for i, (x, y) in enumerate(centers):
        at = (x + 0.6 * aside, y - 0.6 * aside)
        draw.text(at, str(i), (*INK, 255), font, "ls", stroke_width=rim, stroke_fill=(255, 255, 255, 255))


def _draw_goal(draw: ImageDraw.ImageDraw, goal, colour, unit: float) -> None:
    _draw_cross(draw, goal, 6.5 * unit, (255, 255, 255, 255), round(5 * unit))
    _draw_cross(draw, goal, 5.5 * unit, (*colour, 255), round(2.5 * unit))


def _draw_cross(draw: ImageDraw.ImageDraw, at, arm: float, colour, width: int) -> None:
    x, y = at
    for dx in (arm, -arm):
        draw.line([(x - dx, y - arm), (x + dx, y + arm)], fill=colour, width=max(1, width))


# The strip below the map


@lru_cache(maxsize=8)
def _font(pixels: int):
    return ImageFont.load_default(size=pixels)  # Pillow's own: the same on every machine


def draw_caption(snapshot: dict, width: int, scale: float | None = None, text: int | None = None) -> np.ndarray:
    """Map, team and time; a bar of coverage; legend, and a length at ``scale`` [px / m]: uint8 (height, width, 3).

    ``text`` is the height of the letters in pixels; by default they fill the width.
    """
    text = text or max(8, width // 34)
    small = max(7, text * 34 // 42)
    pad, row = width // 64, int(1.45 * text)
    strip = Image.new("RGB", (width, 3 * row + 2 * pad), STRIP)
    draw = ImageDraw.Draw(strip)
    right, seconds = width - pad, int(snapshot["local_step"]) * DT
    robots, collided = len(snapshot["pose"]), int(np.count_nonzero(snapshot["collided"]))
    team = f"{robots} robot{'s' * (robots != 1)}" + (f", {collided} collided" if collided else "")
    clock = f"{seconds:.1f} s, step {int(snapshot['local_step'])}"
    names = [name for name in (snapshot["map"].name, snapshot.get("policy"), team) if name]
    title = _fit(" · ".join(names), _font(text), width - 3 * pad - _font(text).getlength(clock))
    draw.text((pad, pad + row // 2), title, INK, _font(text), "lm")
    draw.text((right, pad + row // 2), clock, INK, _font(text), "rm")
    bar = (pad, pad + row, right, pad + 2 * row - pad // 2)
    _draw_bar(draw, bar, float(snapshot["coverage"]), _font(text))
    _draw_legend(draw, (pad, int(pad + 2.5 * row)), _font(small), small)
    if scale is not None:
        _draw_scale(draw, (right, int(pad + 2.5 * row)), scale, width, _font(small))
    return np.asarray(strip)


def _fit(text: str, font, width: float) -> str:
    """Text, cut in the middle of what does not fit into ``width`` pixels."""
    if font.getlength(text) <= width:
        return text
    keep = len(text)
    while keep > 2 and font.getlength(text[: keep // 2] + "…" + text[-(keep - keep // 2) :]) > width:
        keep -= 1
    return text[: keep // 2] + "…" + text[-(keep - keep // 2) :]


def _draw_bar(draw: ImageDraw.ImageDraw, box, coverage: float, font) -> None:
    """Share explored, with marks at 85 % and 95 %, where the metrics are taken."""
    left, top, right, bottom = box
    draw.rectangle(box, fill=UNEXPLORED)
    if coverage > 0:
        draw.rectangle((left, top, left + coverage * (right - left), bottom), fill=EXPLORED)
    for mark in (0.85, 0.95):
        x = left + mark * (right - left)
        draw.line([(x, top), (x, bottom)], fill=INK)
    label = f"explored {percent(coverage):.1f} %"
    draw.text((left + (right - left) // 64, (top + bottom) // 2), label, INK, font, "lm")
    draw.rectangle(box, outline=INK)


def percent(coverage: float) -> float:
    """Coverage in percent to one digit, rounded down: never 95 before that is reached."""
    return float(np.floor(coverage * 1000 + 1e-3) / 10)


def _draw_legend(draw: ImageDraw.ImageDraw, at, font, box: int) -> None:
    x, y = at
    for label, colour in _LEGEND:
        draw.rectangle((x, y - box // 2, x + box, y + box // 2), fill=colour, outline=INK)
        draw.text((x + 1.4 * box, y), label, INK, font, "lm")
        x += int(2.1 * box + font.getlength(label))


def _draw_scale(draw: ImageDraw.ImageDraw, at, scale: float, width: int, font) -> None:
    """A bar of 1, 2 or 5 times a power of ten metres, right-aligned at ``at``."""
    longest = 0.14 * width / scale
    power = 10.0 ** np.floor(np.log10(longest))
    metres = max(step * power for step in (1, 2, 5) if step * power <= longest)
    x, y = at
    left = x - metres * scale
    draw.line([(left, y), (x, y)], fill=INK, width=max(1, width // 256))
    for end in (left, x):
        draw.line([(end, y - width // 128), (end, y + width // 128)], fill=INK)
    draw.text((left - width // 100, y), f"{metres:g} m", INK, font, "rm")
