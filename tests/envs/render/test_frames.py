"""Pictures and films: colours at known places, fading trails, readable files, recording from an env."""

import builtins

import numpy as np
import pytest
import torch
from PIL import Image
from scipy import ndimage
from worlds import index_of

from maexp.envs.maps.point_cloud import PointCloudMap
from maexp.envs.maps.raster import map_raster
from maexp.envs.render.frames import (
    EXPLORED,
    LIGHT,
    NOTHING,
    OVERLAP,
    ROBOT_COLOURS,
    TRAIL_STEPS,
    UNEXPLORED,
    WALL_SEEN,
    WALL_UNSEEN,
    draw_frame,
    draw_grid,
    record_episode,
    write_gif,
    write_mp4,
)

SIZE = 256


def room(width=14, height=10, spacing=1.0, turn=0.0, jitter=0.0) -> PointCloudMap:
    """A walled room of width x height points, corner (0, 0), turned by `turn` [rad] about it."""
    x, y = np.meshgrid(np.arange(width), np.arange(height), indexing="ij")
    wall = (x == 0) | (y == 0) | (x == width - 1) | (y == height - 1)
    points = np.stack([x, y, 0 * x], axis=-1).astype(float)
    points[..., :2] += np.random.default_rng(0).uniform(-jitter, jitter, points[..., :2].shape)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    points[..., :2] = spacing * points[..., :2] @ rotation.T
    return PointCloudMap(points[~wall], points[wall], spacing, name="room")


def team(place: PointCloudMap, num_robots=2, **changes) -> dict:
    """Snapshot of a team that has seen nothing and stands in the middle; robots a metre apart along x."""
    center = np.tile(place.free[:, :2].mean(axis=0), (num_robots, 1)) + np.arange(num_robots)[:, None] * [1, 0]
    snapshot = {
        "map": place,
        "pose": np.column_stack([center, np.zeros((num_robots, 2))]),
        "center": center,
        "body": np.tile([0.6, 0.4], (num_robots, 1)),
        "goal": np.full((num_robots, 2), np.nan),
        "radar_range": np.full(num_robots, 0.1),
        "seen_free": np.zeros((num_robots, len(place.free)), bool),
        "seen_boundary": np.zeros((num_robots, len(place.boundary)), bool),
        "visible": np.zeros((num_robots, len(place.free)), bool),
        "coverage": 0.0,
        "local_step": 0,
        "collided": np.zeros(num_robots, bool),
        "trail": center[None],
    }
    return snapshot | changes


def colour_at(frame, place, position, size=SIZE) -> tuple:
    raster = map_raster(place, size)
    column, row = np.floor(raster.to_pixels(position)).astype(int)
    return tuple(frame[row, column].tolist())


def near(points, position, reach) -> np.ndarray:
    return np.linalg.norm(points[:, :2] - position, axis=1) <= reach


def test_every_class_has_its_colour():
    place = room()
    seen = np.zeros((2, len(place.free)), bool)
    seen[0, index_of(place.free, (2, 2))] = seen[1, index_of(place.free, (2, 7))] = True
    seen[:, index_of(place.free, (4, 2))] = True
    walls = np.zeros((2, len(place.boundary)), bool)
    walls[1, index_of(place.boundary, (0, 3))] = True
    frame = draw_frame(team(place, seen_free=seen, seen_boundary=walls), SIZE)
    assert frame.dtype == np.uint8 and frame.shape[1:] == (SIZE, 3)
    assert colour_at(frame, place, (2, 2)) == EXPLORED
    assert colour_at(frame, place, (2, 7)) == EXPLORED
    assert colour_at(frame, place, (4, 2)) == OVERLAP
    assert colour_at(frame, place, (11, 7)) == UNEXPLORED
    assert colour_at(frame, place, (0, 3)) == WALL_SEEN
    assert colour_at(frame, place, (0, 6)) == WALL_UNSEEN
    assert tuple(frame[0, 0]) == NOTHING


def test_x_points_right_and_y_up():
    place = room()
    seen = near(place.free, (1, 8), 1.5)[None]
    frame = draw_frame(team(place, 1, seen_free=seen), SIZE)
    rows, columns = np.nonzero((frame == EXPLORED).all(axis=-1)[: map_raster(place, SIZE).height])
    assert rows.max() < 0.4 * SIZE and columns.max() < 0.3 * SIZE


def test_three_robots_overlap_like_two():
    place = room()
    seen = np.ones((3, len(place.free)), bool)
    assert colour_at(draw_frame(team(place, 3, seen_free=seen), SIZE), place, (2, 7)) == OVERLAP


def test_visible_points_are_lit():
    place = room()
    seen = np.ones((1, len(place.free)), bool)
    visible = near(place.free, (3, 3), 1.2)[None]
    frame = draw_frame(team(place, 1, seen_free=seen, visible=visible), SIZE)
    lit = np.rint((1 - LIGHT) * np.array(EXPLORED) + LIGHT * 255)
    assert colour_at(frame, place, (3, 3)) == tuple(lit.astype(int))
    assert colour_at(frame, place, (3, 7)) == EXPLORED


@pytest.mark.parametrize("spacing", [0.05, 1.0, 2.0])
@pytest.mark.parametrize("turn, jitter", [(0.0, 0.0), (0.6, 0.0), (0.3, 0.15)])
def test_no_holes_and_closed_walls(spacing, turn, jitter):
    place = room(40, 30, spacing, turn, jitter)
    raster = map_raster(place, SIZE)
    free = (raster.owner >= 1) & (raster.owner <= raster.num_free)
    outside, areas = ndimage.label(raster.owner == 0)
    border = {*outside[0], *outside[-1], *outside[:, 0], *outside[:, -1]} - {0}
    assert len(border) == areas, "pixels that show nothing lie around the room, never inside"
    grown = ndimage.binary_dilation(outside > 0, structure=np.ones((3, 3)))
    assert free.any() and not (grown & free).any(), "no gap in the wall"


def test_thin_walls_survive_when_points_are_denser_than_pixels():
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(400), np.arange(400), indexing="ij"))
    points = np.stack([x, y], axis=1) * 0.1
    wall = x == 201
    place = PointCloudMap(points[~wall], points[wall], 0.1)
    owner = map_raster(place, 96).owner
    is_wall = owner > len(place.free)
    assert is_wall.any(axis=1)[3:-3].all()


def test_spacing_may_differ_from_point_to_point():
    coarse = np.stack(np.meshgrid(np.arange(0, 8, 2.0), np.arange(0, 8, 2.0)), axis=-1).reshape(-1, 2)
    fine = np.stack(np.meshgrid(np.arange(7.25, 10, 0.5), np.arange(-0.75, 7, 0.5)), axis=-1).reshape(-1, 2)
    spacing = np.r_[np.full(len(coarse), 2.0), np.full(len(fine), 0.5)]
    place = PointCloudMap(np.r_[coarse, fine], np.array([[-2.0, 0.0]]), 2.0, free_spacing=spacing)
    raster = map_raster(place, SIZE)
    first, last = (np.floor(raster.to_pixels(corner)).astype(int) for corner in ((-0.5, 6.5), (9.5, -0.5)))
    block = raster.owner[first[1] : last[1], first[0] : last[0]]
    assert (block > 0).all()
    assert set(np.unique(raster.owner)) == {0, *range(1, len(place.free) + 2)}, "every point shows"


def test_robot_has_its_colour_and_heading():
    place = room()
    pictures = []
    for heading in (0.0, np.pi / 2, np.pi):
        snapshot = team(place, 1, body=np.array([[4.0, 2.0]]))
        snapshot["pose"][0, 3] = heading
        frame = draw_frame(snapshot, SIZE)
        at = np.array(snapshot["center"][0])
        forward = np.array([np.cos(heading), np.sin(heading)])
        assert colour_at(frame, place, at - 1.2 * forward) == ROBOT_COLOURS[0]
        assert colour_at(frame, place, at + 0.8 * forward) == (255, 255, 255)  # the light front
        assert colour_at(frame, place, at + 2.6 * forward) == UNEXPLORED
        pictures.append(frame)
    assert not np.array_equal(pictures[0], pictures[2])


def test_collided_robot_and_its_count_are_marked():
    place = room()
    apart = np.array([[4.0, 3.0], [9.0, 6.0]])
    moving = team(place, 2, body=np.tile([2.0, 1.0], (2, 1)), center=apart, trail=apart[None])
    stopped = moving | {"collided": np.array([True, False])}
    before, after = draw_frame(moving, SIZE), draw_frame(stopped, SIZE)
    changed = (before != after).any(axis=-1)
    assert changed[map_raster(place, SIZE).height :].any(), "the caption tells"
    rows, columns = np.nonzero(changed[: map_raster(place, SIZE).height])
    column, row = map_raster(place, SIZE).to_pixels(moving["center"][0])
    assert np.abs(rows - row).max() < 30 and np.abs(columns - column).max() < 30
    assert sum(colour_at(after, place, moving["center"][0])) > sum(ROBOT_COLOURS[0]) + 60, "a light cross"


def test_goal_is_a_cross_in_the_robots_colour():
    place = room()
    goal = np.array([[2.0, 2.0], [11.0, 7.0]])
    frame = draw_frame(team(place, goal=goal), SIZE)
    assert colour_at(frame, place, goal[0]) == ROBOT_COLOURS[0]
    assert colour_at(frame, place, goal[1]) == ROBOT_COLOURS[1]
    outside = draw_frame(team(place, goal=goal + 1000.0), SIZE)
    assert not np.array_equal(outside, draw_frame(team(place), SIZE)), "far goals are drawn at the border"


def test_radar_circle_has_its_range():
    place = room()
    snapshot = team(place, 1, radar_range=np.array([3.0]))
    frame, plain = draw_frame(snapshot, SIZE), draw_frame(team(place, 1, radar_range=np.array([0.01])), SIZE)
    raster = map_raster(place, SIZE)
    rows, columns = np.nonzero((frame != plain).any(axis=-1)[: raster.height])
    column, row = raster.to_pixels(snapshot["center"][0])
    distance = np.hypot(columns + 0.5 - column, rows + 0.5 - row) / raster.scale
    distance = distance[distance > 1.5]
    assert abs(np.median(distance) - 3.0) < 0.1 and distance.min() > 2.8 and distance.max() < 3.2


def test_trail_fades():
    place = room(40, 10)
    steps = 150
    trail = np.linspace((4.0, 3.0), (34.0, 3.0), steps)[:, None]
    frame = draw_frame(team(place, 1, trail=trail, center=trail[-1]), SIZE).astype(int)
    strength = []
    for share in (0.1, 0.5, 0.9):
        position = trail[int(share * (steps - 1)), 0]
        strength.append(np.abs(np.array(colour_at(frame, place, position)) - UNEXPLORED).sum())
    assert 0 < strength[0] < strength[1] < strength[2]
    there = np.repeat(trail[:1] + [0.0, 4.0], 300, axis=0)
    for since, gone in ((150, False), (TRAIL_STEPS + 20, True)):
        later = np.concatenate([there, np.linspace((4.0, 3.0), (34.0, 3.0), since)[:, None]])
        frame = draw_frame(team(place, 1, trail=later, center=later[-1]), SIZE)
        assert (colour_at(frame, place, (4.0, 6.0)) == UNEXPLORED) == gone


def test_coverage_bar_and_time():
    place = room()
    strip = map_raster(place, SIZE).height
    green = []
    for coverage in (0.0, 0.25, 0.9499, 1.0):
        frame = draw_frame(team(place, coverage=coverage), SIZE)[strip:]
        green.append((frame == EXPLORED).all(axis=-1).sum(axis=1).max() / SIZE)
    assert green == sorted(green) and green[1] < 0.3 and green[2] > 0.85
    assert not np.array_equal(
        draw_frame(team(place, local_step=7), SIZE)[strip:], draw_frame(team(place), SIZE)[strip:]
    )


def test_the_same_snapshot_gives_the_same_picture_and_the_map_is_not_touched():
    place = room()
    snapshot = team(place, goal=np.array([[2.0, 2.0], [3.0, 7.0]]), coverage=0.3)
    copies = {name: np.copy(value) for name, value in snapshot.items() if name != "map"}
    first = draw_frame(snapshot, SIZE)
    assert np.array_equal(first, draw_frame(snapshot, SIZE))
    assert np.array_equal(first, draw_frame(team(room(), goal=snapshot["goal"], coverage=0.3), SIZE))
    for name, value in copies.items():
        np.testing.assert_array_equal(snapshot[name], value)


@pytest.mark.parametrize("width, height, size", [(30, 6, 128), (6, 30, 128), (14, 10, 129), (14, 10, 1024)])
def test_shapes_are_even_and_hold_the_map(width, height, size):
    frame = draw_frame(team(room(width, height)), size)
    assert frame.shape[0] % 2 == 0 and frame.shape[1] == size + size % 2
    assert frame.shape[0] > map_raster(room(width, height), size).height


def test_forty_robots():
    place = room(60, 50)
    frame = draw_frame(team(place, 40, seen_free=np.ones((40, len(place.free)), bool)), SIZE)
    assert (frame == OVERLAP).all(axis=-1).mean() > 0.3


def test_bad_input_is_named():
    place = room()
    with pytest.raises(ValueError, match="size=10"):
        draw_frame(team(place), 10)
    with pytest.raises(ValueError, match="seen_free"):
        draw_frame(team(place, seen_free=np.zeros((2, 5), bool)), SIZE)
    with pytest.raises(ValueError, match="frames is empty"):
        draw_grid([])


def test_grid_keeps_every_picture():
    frames = [np.full((10 + k, 20, 3), 10 * k, np.uint8) for k in range(5)]
    grid = draw_grid(frames, gap=4)
    assert grid.shape == (2 * 14 + 4, 3 * 20 + 2 * 4, 3)
    for k in range(5):
        top, left = (k // 3) * 18, (k % 3) * 24
        assert (grid[top : top + 10 + k, left : left + 20] == 10 * k).all()
    assert (grid[18:, 48:] == 255).all()


def film(count=12) -> list[np.ndarray]:
    place = room()
    frames = []
    for k in range(count):
        center = np.array([[2.0 + 0.5 * k, 3.0]])
        seen = near(place.free, center[0], 3.0)[None]
        frames.append(draw_frame(team(place, 1, center=center, seen_free=seen, local_step=k), SIZE))
    return frames


def test_gif_can_be_read_and_keeps_colours(tmp_path):
    frames = film()
    path = write_gif(frames, tmp_path / "a.gif", fps=10)
    with Image.open(path) as image:
        assert image.n_frames == len(frames) and image.info["loop"] == 0 and image.info["duration"] == 100
        for k in (0, 5, 11):
            image.seek(k)
            shown = np.asarray(image.convert("RGB")).astype(int)
            assert shown.shape == frames[k].shape
            difference = np.abs(shown - frames[k]).max(axis=-1)
            assert (difference <= 4).mean() > 0.97 and difference.mean() < 2.0
        assert image.info["duration"] >= 1000, "the end is held"
    assert [child.name for child in tmp_path.iterdir()] == ["a.gif"]
    assert write_gif(frames, tmp_path / "b.gif", fps=10).read_bytes() == path.read_bytes()


def test_gif_is_small(tmp_path):
    frames = [frame for frame in film(30) for _ in range(1)]
    assert write_gif(frames, tmp_path / "a.gif").stat().st_size < 30 * 20_000


def test_failed_film_leaves_the_earlier_one(tmp_path, monkeypatch):
    path = write_gif(film(3), tmp_path / "a.gif")
    before = path.read_bytes()

    def fail(*args, **kwargs):
        raise OSError("disk full")

    monkeypatch.setattr(Image.Image, "save", fail)
    with pytest.raises(OSError, match="disk full"):
        write_gif(film(4), path)
    assert path.read_bytes() == before and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("write", [write_gif, write_mp4])
def test_films_refuse_bad_frames(write, tmp_path):
    with pytest.raises(ValueError, match="empty"):
        write([], tmp_path / "a")
    with pytest.raises(ValueError, match="shape"):
        write([np.zeros((4, 4, 3), np.uint8), np.zeros((4, 6, 3), np.uint8)], tmp_path / "a")
    with pytest.raises(ValueError, match="float64"):
        write([np.zeros((4, 4, 3))], tmp_path / "a")
    with pytest.raises(ValueError, match="fps=0"):
        write([np.zeros((4, 4, 3), np.uint8)], tmp_path / "a", fps=0)
    assert not list(tmp_path.iterdir())


def test_mp4_can_be_read(tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="the extra maexp[video] is not installed")
    frames = film(9)
    path = write_mp4([frame[:-1] for frame in frames], tmp_path / "a.mp4", fps=10)  # odd height on purpose
    reader = ffmpeg.read_frames(str(path))
    size = next(reader)["size"]
    shown = [np.frombuffer(data, np.uint8).reshape(size[1], size[0], 3) for data in reader]
    assert len(shown) == 9 and size == (frames[0].shape[1], frames[0].shape[0])
    assert np.abs(shown[-1].astype(int) - frames[-1])[:-2].mean() < 6


def test_missing_mp4_package_is_named(tmp_path, monkeypatch):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name == "imageio_ffmpeg":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ImportError, match=r'pip install "maexp\[video\]"'):
        write_mp4(film(2), tmp_path / "a.mp4")


def make_env(num_envs=3):
    from maexp.envs import ExplorationEnv, make_map

    return ExplorationEnv([make_map("maze_small", 0)], num_envs=num_envs, num_robots=2, macro_steps=3, local_steps=5)


def test_record_episode_of_an_env():
    env = make_env()
    env.set_seed(0)
    torch.manual_seed(0)
    asked, snapshot = [], env.snapshot
    env.snapshot = lambda index: asked.append((index, snapshot(index)["local_step"])) or snapshot(index)
    frames = record_episode(env, env.rand_action, env_index=1, every=2)
    assert {index for index, _ in asked} == {1}
    assert sorted({step for _, step in asked}) == [0, 2, 4, 5, 7, 9, 10, 12, 14, 15]
    assert len(frames) == 10, "no picture twice"
    assert all(not np.array_equal(a, b) for a, b in zip(frames[:-1], frames[1:], strict=True))
    assert np.array_equal(frames[-1], env.render(1))
    count = len(asked)
    env.reset()
    assert len(asked) == count, "the hook is taken away again"


def test_a_failing_policy_leaves_no_hook():
    env = make_env(1)

    def fail(state):
        raise RuntimeError("no idea")

    with pytest.raises(RuntimeError, match="no idea"):
        record_episode(env, fail)
    assert env._hook is None
