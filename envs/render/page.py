"""A page in the browser that replays episodes over their map: play, scrub, follow a robot. Needs viser."""

from __future__ import annotations

import contextlib
import threading
import time
from pathlib import Path

import numpy as np

from maexp.envs.atomic_write import whole_file
from maexp.envs.render.episode import Episode
from maexp.envs.render.frames import EXPLORED, OVERLAP, UNEXPLORED, WALL_SEEN, WALL_UNSEEN, percent
from maexp.envs.render.painter import look_at
from maexp.envs.render.stage import DrawnScene, Stage
from maexp.kernels.constants import DT

HOST = "127.0.0.1"  # this machine only: the page has no password
RATE = 20.0  # pictures per second, at most
SPEEDS = ("0.5x", "1x", "2x", "4x", "8x", "16x")
AMBIENT, SUN = 4.0, 2.65  # intensities; together LIGHT * pi on level ground
LIGHT = 2.0  # how bright a white surface is, before the browser's tone mapping darkens it to nearly white
_ACES_IN = np.array([[0.59719, 0.35458, 0.04823], [0.076, 0.90834, 0.01566], [0.0284, 0.13383, 0.83777]])
_ACES_OUT = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])
TEAM = "the team"
MOST_LABELS = 40  # robots with a number over them
LEGEND = (
    ("unexplored", UNEXPLORED),
    ("explored", EXPLORED),
    ("explored by two or more", OVERLAP),
    ("wall, seen", WALL_SEEN),
    ("wall, unseen", WALL_UNSEEN),
)
_TILE = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]], dtype=np.float32)
_TILE_FACES = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.uint32)
_ARROW = np.array([[0.42, 0, 1.03], [-0.1, 0.36, 1.03], [-0.1, -0.36, 1.03]], dtype=np.float32)
_BOX = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)], dtype=np.float32)
_BOX_FACES = np.array(
    [
        [1, 5, 7],
        [1, 7, 3],
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
    ],
    dtype=np.uint32,
)


def import_viser():
    """The package viser.

    Raises:
        ImportError: it is missing; the message says how to install it.
    """
    try:
        import viser
    except ImportError as error:
        raise ImportError('The page in the browser needs viser: pip install "maexp[view]"') from error
    return viser


def start_server(viser, port: int):
    """A server for this machine's browsers, on `port` or the next free one; viser's own banner is left out."""
    with contextlib.redirect_stdout(None):
        return viser.ViserServer(host=HOST, port=port, label="MAexp", verbose=False)


def stop_server(server) -> None:
    """End a server, quietly."""
    with contextlib.redirect_stdout(None):
        server.stop()


class Actors:
    """The nodes of a scene on a viser server, moved from scene to scene."""

    def __init__(self, server, scene: DrawnScene):
        self.server, self.labels = server, []
        add, scale = server.scene, np.asarray(scene.ground_size, dtype=np.float32)
        self.ground = add.add_batched_meshes_simple(
            "/ground",
            _TILE,
            _TILE_FACES,
            _turns(np.zeros(len(scale))),
            _floats(scene.ground),
            batched_scales=scale,
            batched_colors=_paint(scene.ground_colour),
            side="double",
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )
        self.walls = None
        if len(scene.walls):
            sizes = np.column_stack([scene.wall_size, scene.wall_size, scene.wall_height])
            self.walls = self._boxes("/walls", scene.walls, sizes, scene.wall_colour)
        self.moving: dict = {}
        if not len(scene.robots):
            return
        self.moving["robots"] = self._boxes("/robots", scene.robots, scene.body, scene.robot_colour)
        white = np.full((len(scene.robots), 3), 255, dtype=np.uint8)
        self.moving["arrows"] = add.add_batched_meshes_simple(
            "/arrows",
            _ARROW,
            np.array([[0, 1, 2]], dtype=np.uint32),
            _turns(scene.heading),
            _floats(scene.robots),
            batched_scales=_floats(scene.body),
            batched_colors=white,
            side="double",
            lod="off",
            cast_shadow=False,
        )
        self.moving["goals"] = self._boxes("/goals", scene.robots, scene.body, scene.robot_colour)
        lines, colours = np.zeros((1, 2, 3), dtype=np.float32), np.zeros((1, 2, 3), dtype=np.uint8)
        for name, width in (("trails", 3.0), ("radar", 1.5)):
            self.moving[name] = add.add_line_segments(
                f"/{name}", lines, colours, thickness=width, thickness_units="screen"
            )
        if len(scene.robots) <= MOST_LABELS:
            self.labels = [add.add_label(f"/number/{i}", str(i)) for i in range(len(scene.robots))]
        self.show(scene)

    def _boxes(self, name: str, feet, sizes, colours):
        return self.server.scene.add_batched_meshes_simple(
            name,
            _BOX,
            _BOX_FACES,
            _turns(np.zeros(len(feet))),
            _floats(feet),
            batched_scales=_floats(sizes),
            batched_colors=_paint(colours),
            flat_shading=True,
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )

    def show(self, scene: DrawnScene, radar: bool = True) -> None:
        """Move everything to where it is in `scene`."""
        _change(self.ground, "batched_colors", _paint(scene.ground_colour))
        if self.walls is not None:
            _change(self.walls, "batched_colors", _paint(scene.wall_colour))
        if not self.moving:
            return
        turns = _turns(scene.heading)
        colours = np.where(scene.collided[:, None], scene.robot_colour // 2, scene.robot_colour).astype(np.uint8)
        for name in ("robots", "arrows"):
            _change(self.moving[name], "batched_positions", _floats(scene.robots))
            _change(self.moving[name], "batched_wxyzs", turns)
        _change(self.moving["robots"], "batched_colors", _paint(colours))
        side = 0.35 * scene.body[:, :1]
        goals = np.nan_to_num(scene.goals) - [0, 0, 1e3] * ~np.isfinite(scene.goals).all(axis=1, keepdims=True)
        _change(self.moving["goals"], "batched_positions", _floats(goals))
        _change(self.moving["goals"], "batched_scales", _floats(np.concatenate([side, side, 6 * side], axis=1)))
        points, tints = trail_lines(scene)
        self._draw("trails", points, tints, True)
        self._draw("radar", *radar_lines(scene), radar)
        for label, at in zip(self.labels, scene.robots + 1.3 * scene.body[:, :1] * [0, 0, 1], strict=True):
            label.position = tuple(at.tolist())

    def _draw(self, name: str, points: np.ndarray, colours: np.ndarray, visible: bool) -> None:
        node = self.moving[name]
        node.visible = visible and len(points) > 0
        if node.visible:
            node.points, node.colors = _floats(points), _linear(colours)


def trail_lines(scene: DrawnScene) -> tuple[np.ndarray, np.ndarray]:
    """Line segments of the trails [S, 2, 3] and their colours, paler with age; at most about 50 a robot."""
    count = len(scene.trails)
    picked = np.unique(np.linspace(0, count - 1, min(count, 51)).round().astype(int))
    trail = scene.trails[picked] + [0, 0, 0.02 * scene.body[0, 2]]
    points = np.stack([trail[:-1], trail[1:]], axis=2)
    fade = np.linspace(0.35, 1.0, max(len(points), 1))[: len(points), None, None]
    colours = np.broadcast_to(fade * scene.robot_colour + (1 - fade) * 235, points.shape[:2] + (3,))
    colours = np.repeat(np.rint(colours).astype(np.uint8)[:, :, None], 2, axis=2)
    return points.reshape(-1, 2, 3), colours.reshape(-1, 2, 3)


def radar_lines(scene: DrawnScene) -> tuple[np.ndarray, np.ndarray]:
    """Circles of the radars' range as line segments [S, 2, 3], and their colours."""
    angle = np.linspace(0, 2 * np.pi, 49)
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    rings = scene.robots[:, None] + scene.radar_range[:, None, None] * circle + [0, 0, 0.02 * scene.body[0, 2]]
    points = np.stack([rings[:, :-1], rings[:, 1:]], axis=2)
    colours = np.broadcast_to(scene.robot_colour[:, None, None], points.shape)
    return points.reshape(-1, 2, 3), np.ascontiguousarray(colours).reshape(-1, 2, 3)


class Page:
    """The server of the page. `run` plays until interrupted; `stop` ends it.

    Args:
        stages: the maps, one per episode; one map alone where there are no episodes
        episodes: what can be replayed; the page chooses between them
        port: wanted; the next free one is taken
        seen_by: colour the points by what this robot has seen

    Raises:
        ImportError: viser is missing.
    """

    def __init__(self, stages: list[Stage], episodes: list[Episode], port: int = 8080, seen_by: int | None = None):
        viser = import_viser()
        self.stages, self.episodes = stages, episodes
        self.server = start_server(viser, port)
        self.address = f"http://{HOST}:{self.server.get_port()}"
        self.number, self.record, self.playing = 0, 0, False
        self._lock = threading.RLock()
        self._clock = 0.0  # seconds into the episode
        self._moved: np.ndarray | None = None  # where the followed robot was
        prepare_scene(self.server, stages[0])
        self._add_controls(seen_by)
        self.open_episode(0)

    @property
    def episode(self) -> Episode | None:
        return self.episodes[self.number] if self.episodes else None

    def _add_controls(self, seen_by: int | None) -> None:
        gui = self.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        self.status = gui.add_markdown("")
        if not self.episodes:
            return
        names = [f"{k}: {episode.map.name}, {episode.policy}" for k, episode in enumerate(self.episodes)]
        self.play = gui.add_button("Play")
        self.time = gui.add_slider("time [s]", 0.0, 1.0, 0.1, 0.0)
        self.speed = gui.add_dropdown("speed", SPEEDS, initial_value="2x")
        self.team = gui.add_dropdown("episode", names, initial_value=names[0])
        fewest = min(episode.num_robots for episode in self.episodes)
        robots = [TEAM, *[f"robot {i}" for i in range(fewest)]]
        chosen = robots[0 if seen_by is None else 1 + seen_by]
        self.robot = gui.add_dropdown("explored by", robots, initial_value=chosen)
        self.follow = gui.add_checkbox("follow the robot", False)
        self.radar = gui.add_checkbox("radar range", True)
        gui.add_html(legend_html())
        self.play.on_click(lambda _: self.toggle())
        self.time.on_update(lambda event: self.seek(self.time.value) if event.client else None)
        self.team.on_update(lambda _: self.open_episode(names.index(self.team.value)))
        for control in (self.robot, self.radar, self.follow):
            control.on_update(lambda _: self.show())

    def open_episode(self, number: int) -> None:
        """Show another episode, from its start."""
        with self._lock:
            self.number, self.record, self._moved = number, 0, None
            stage = self.stages[number]
            if self.episode is None:
                self.actors = Actors(self.server, stage.empty())
                self.status.content = f"**{stage.map.name}**"
                return
            self.server.scene.reset()
            prepare_scene(self.server, stage)
            self.actors = Actors(self.server, stage.inputs(self.episode.snapshot(0)))
            self.time.max = max(float(self.episode.seconds[-1]), 0.1)
            self.seek(0.0)

    def toggle(self) -> None:
        """Play, or pause; at the end, play from the start."""
        with self._lock:
            self.playing = not self.playing
            self.play.label = "Pause" if self.playing else "Play"
            if self.playing and self._clock >= self.episode.seconds[-1]:
                self.seek(0.0)

    def seek(self, seconds: float) -> None:
        """Show the moment `seconds` into the episode."""
        with self._lock:
            self._clock = float(seconds)
            self.record = max(int(np.searchsorted(self.episode.seconds, seconds + 1e-6, side="right")) - 1, 0)
            self.show()

    def advance(self, elapsed: float) -> None:
        """Time has gone by: move on if it plays, and pause at the end."""
        with self._lock:
            if not self.playing:
                return
            end = float(self.episode.seconds[-1])
            self.seek(min(self._clock + elapsed * float(self.speed.value.rstrip("x")), end))
            self.time.value = round(self._clock, 1)
            if self._clock >= end:
                self.toggle()

    def show(self) -> None:
        """Bring the scene and the text to the current record."""
        with self._lock, self.server.atomic():
            snapshot = self.episode.snapshot(self.record)
            chosen = None if self.robot.value == TEAM else int(self.robot.value.split()[1])
            scene = self.stages[self.number].inputs(snapshot, chosen)
            self.actors.show(scene, self.radar.value)
            self._follow(scene, chosen)
            self.status.content = describe(snapshot, chosen)

    def _follow(self, scene: DrawnScene, chosen: int | None) -> None:
        """Move every camera along with the chosen robot."""
        if chosen is None or not self.follow.value:
            self._moved = None
            return
        at = scene.robots[chosen]
        for client in self.server.get_clients().values():
            step = at - (client.camera.look_at if self._moved is None else self._moved)
            client.camera.position = client.camera.position + step
            client.camera.look_at = client.camera.look_at + step
        self._moved = at

    def run(self, seconds: float = float("inf")) -> None:
        """Play as the page asks, for so long."""
        end, last = time.monotonic() + seconds, time.monotonic()
        while (now := time.monotonic()) < end:
            if self.episodes:
                self.advance(now - last)
            last = now
            time.sleep(max(1 / RATE - (time.monotonic() - now), 0.005))

    def stop(self) -> None:
        """Close the server."""
        stop_server(self.server)


def prepare_scene(server, stage: Stage) -> None:
    """Light from above, z up, a camera that sees the whole map."""
    scene = server.scene
    scene.set_up_direction("+z")
    scene.world_axes.visible = False
    scene.configure_default_lights(enabled=False)
    scene.configure_environment_map(None)
    scene.add_light_ambient("/light/sky", intensity=AMBIENT)
    scene.add_light_directional("/light/sun", intensity=SUN, position=(0.3, -0.5, 1.0))
    camera = look_at(stage.empty().bounds, 1200, 800)
    server.initial_camera.position = tuple(camera.eye.tolist())
    server.initial_camera.look_at = tuple(camera.target.tolist())
    server.initial_camera.fov = float(np.radians(camera.fov))


def describe(snapshot: dict, chosen: int | None = None) -> str:
    """The page's text on a moment, in Markdown."""
    crashed = int(np.count_nonzero(snapshot["collided"]))
    lines = [
        f"**{snapshot['map'].name}**, {snapshot['policy']}, {len(snapshot['pose'])} robots"
        + (f", {crashed} collided" if crashed else ""),
        f"explored **{percent(snapshot['coverage']):.1f} %** after **{DT * snapshot['local_step']:.1f} s**",
    ]
    if chosen is not None:
        weight = snapshot["map"].free_spacing.astype(np.float64) ** 2
        share = float((weight * snapshot["seen_free"][chosen]).sum() / weight.sum())
        speed = snapshot["pose"][chosen][2]
        lines.append(f"robot {chosen} has seen {percent(share):.1f} % itself, drives at {speed:.1f} m/s")
    return "\n\n".join(lines)


def legend_html() -> str:
    """What the colours mean."""
    rows = [
        f'<div><span style="display:inline-block;width:1em;height:1em;vertical-align:-0.15em;margin-right:0.5em;'
        f'border:1px solid #333;background:rgb{colour}"></span>{name}</div>'
        for name, colour in LEGEND
    ]
    rows.append("<div>robot: box with its number and trail; goal: column</div>")
    return f'<div style="font-size:0.85em;padding:0.5em 0.75em">{"".join(rows)}</div>'


def write_page(stage: Stage, episode: Episode | None, path: Path, seen_by: int | None = None) -> Path:
    """The replay as one .html file that needs no server; it appears whole or not at all.

    Raises:
        ImportError: viser is missing.
    """
    server = start_server(import_viser(), 0)
    try:
        prepare_scene(server, stage)
        scene = stage.empty() if episode is None else stage.inputs(episode.snapshot(0), seen_by)
        actors = Actors(server, scene)
        recording = server.get_scene_serializer()
        for record in range(1, 0 if episode is None else len(episode)):
            recording.insert_sleep(float(episode.seconds[record] - episode.seconds[record - 1]))
            actors.show(stage.inputs(episode.snapshot(record), seen_by))
        recording.insert_sleep(1.0 if episode is not None else 0.0)
        html = recording.as_html()
    finally:
        stop_server(server)
    with whole_file(path) as part:
        Path(part).write_text(html, encoding="utf-8")
    return path


def _change(node, name: str, value: np.ndarray) -> None:
    """Set what differs: each assignment is sent to every browser."""
    if not np.array_equal(getattr(node, name), value):
        setattr(node, name, value)


def _linear(colours) -> np.ndarray:
    """Colours for viser's lines: intensities, where pictures hold sRGB; uint8."""
    return np.rint(255 * _intensity(colours)).astype(np.uint8)


def _intensity(colours) -> np.ndarray:
    """Intensities in [0, 1] of sRGB colours, uint8."""
    share = np.asarray(colours) / 255.0
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def _paint(colours) -> np.ndarray:
    """Colours for viser's meshes, such that level ones look as in our pictures; uint8.

    The browser (three.js) shows lit surfaces through the ACES film curve, which pales them: this is its inverse,
    of the fit by S. Hill that three.js uses (its exposure is 1 / 0.6).
    """
    y = np.clip(_intensity(colours) @ np.linalg.inv(_ACES_OUT).T, 0.0, 0.99)
    a, b, c = 1 - 0.983729 * y, 0.0245786 - 0.432951 * y, -0.000090537 - 0.238081 * y  # y = fit(x), solved for x
    x = (-b + np.sqrt(b * b - 4 * a * c)) / (2 * a)
    return np.rint(255 * np.clip(0.6 * x @ np.linalg.inv(_ACES_IN).T / LIGHT, 0, 1)).astype(np.uint8)


def _floats(values) -> np.ndarray:
    return np.ascontiguousarray(values, dtype=np.float32)


def _turns(heading) -> np.ndarray:
    """Quaternions (w, x, y, z) of turns about z [rad], float32 [n, 4]."""
    half = 0.5 * np.asarray(heading, dtype=np.float64)
    zero = np.zeros_like(half)
    return _floats(np.stack([np.cos(half), zero, zero, np.sin(half)], axis=-1))
