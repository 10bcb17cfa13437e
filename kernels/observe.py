"""What the policy sees: pictures, poses, region offsets (paper, section IV-D).

Picture: a square frame around the extent, x along the first axis, flattened to 125 * 125 pixels.
Which points a pixel shows is fixed per map (`Maps.pixel_point`, and the other way `Maps.point_pixel`).
"""

import torch
import warp as wp

from maexp.kernels.dynamics import Robots
from maexp.kernels.geometry import rectangle_distance
from maexp.kernels.launches import Launch, lanes_on
from maexp.kernels.shards import Shard
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.types import (
    CHANNEL_EXPLORED,
    CHANNEL_OBSTACLE,
    CHANNEL_POSITION,
    CHANNEL_TRAJECTORY,
    CHANNEL_VIEWERS,
    ERROR_CAPACITY,
    PI,
    PICTURE_CHANNELS,
    PIXEL_SHARED,
    PIXELS,
    REGIONS,
    ROBOTS_PER_WORD,
    TEAM_CHANNELS,
    Maps,
    point_xy,
)

wp.set_module_options(MODULE_OPTIONS)

ON = 255  # grey levels: seen, a wall, the own body
OTHER = 128  # the body of another
FADE = 0.99  # of the trajectory, a local step


def picture_shapes(envs: int, robots: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Shapes of the pictures of every robot and of every team.

    [E, N, PICTURE_CHANNELS, 125, 125] and [E, TEAM_CHANNELS, 125, 125].
    """
    side = PIXELS
    return (envs, robots, PICTURE_CHANNELS, side, side), (envs, TEAM_CHANNELS, side, side)


@wp.func
def pixel_of(maps: Maps, m: int, p: wp.vec2) -> wp.vec2i:
    """Pixel whose centre is nearest, clamped to the picture."""
    q = (p - maps.frame_origin[m]) / maps.pixel_size[m]
    return wp.vec2i(
        wp.clamp(int(wp.floor(q[0] + 0.5)), 0, PIXELS - 1), wp.clamp(int(wp.floor(q[1] + 0.5)), 0, PIXELS - 1)
    )


@wp.func
def count_viewers(
    maps: Maps,
    m: int,
    e: int,
    p: int,
    free_count: int,
    seen_free: wp.array3d(dtype=wp.int32),
) -> int:
    """Robots that have seen a free point shown by pixel p."""
    pixel = m * PIXELS * PIXELS + p
    begin = maps.pixel_point_begin[pixel]
    end = maps.pixel_point_begin[pixel + 1]
    viewers = int(0)
    for w in range(seen_free.shape[1]):
        word = int(0)
        for k in range(begin, end):
            j = maps.pixel_point[k]
            if j < free_count:
                word = word | seen_free[e, w, j]
        viewers += wp.bit_count(word)
    return viewers


@wp.func
def draw_pixel(
    p: int,
    channel: int,
    team_bits: int,
    drawn: wp.array2d(dtype=wp.int32),  # [word, point]
    j: int,
    picture: wp.array3d(dtype=wp.uint8),  # [robot, channel, pixel]
):
    """Enter pixel p, which shows point j, into the pictures of the robots that the point is drawn for."""
    if team_bits != 0:
        for i in range(picture.shape[0]):
            picture[i, channel, p] = wp.uint8(ON)
        return
    for w in range(drawn.shape[0]):
        bits = wp.uint32(drawn[w, j])
        while bits != wp.uint32(0):  # those that are set only: few of a large team have seen a point
            below = bits - wp.uint32(1)
            i = w * ROBOTS_PER_WORD + int(wp.bit_count(below & ~bits))
            if i < picture.shape[0]:  # a base station has no picture
                picture[i, channel, p] = wp.uint8(ON)
            bits = bits & below


@wp.kernel
def _draw_points(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    team_bits: int,
    lanes: int,
    # State in:
    draw_free: wp.array3d(dtype=wp.int32),  # [env, word, free]
    draw_boundary: wp.array3d(dtype=wp.int32),  # [env, word, boundary]
    seen_free: wp.array3d(dtype=wp.int32),  # [env, word, free]
    viewers_free: wp.array3d(dtype=wp.int32),  # [env, 1, free]
    viewers_boundary: wp.array3d(dtype=wp.int32),  # [env, 1, boundary]
    # Scratch in:
    mask: wp.array(dtype=wp.int32),  # [env]
    # Out:
    picture: wp.array4d(dtype=wp.uint8),  # [env, robot, channel, pixel]
    team: wp.array3d(dtype=wp.uint8),  # [env, channel, pixel]
):
    """Enter every known point of env e into the pictures of the robots (explored, obstacle) and of the team.

    ``draw_*`` are the flags drawn for the robots (seen or known), the others tell of the team's map;
    with ``team_bits`` every robot is drawn the team's map (what it knows under perfect communication).
    The pictures come in as zeros, so a point nobody has seen costs only its reading.
    """
    e, lane = wp.tid()
    if mask[e] == 0:
        return
    m = map_id[e]
    free_count = maps.free_begin[m + 1] - maps.free_begin[m]
    boundary_count = maps.boundary_begin[m + 1] - maps.boundary_begin[m]
    first = maps.shown_begin[m]
    team_explored = team[e, CHANNEL_EXPLORED]
    team_viewers = team[e, CHANNEL_VIEWERS]
    team_obstacle = team[e, CHANNEL_OBSTACLE]
    pictures = picture[e]
    drawn_free = draw_free[e]
    drawn_boundary = draw_boundary[e]
    viewed_free = viewers_free[e, 0]
    viewed_boundary = viewers_boundary[e, 0]
    for j in range(lane, free_count, lanes):
        viewers = viewed_free[j]
        if viewers != 0:
            start = maps.point_pixel_begin[first + j]
            stop = maps.point_pixel_begin[first + j + 1]
            for k in range(start, stop):
                p = maps.point_pixel[k] & (PIXEL_SHARED - 1)
                shown = viewers
                if maps.point_pixel[k] >= PIXEL_SHARED:
                    shown = count_viewers(maps, m, e, p, free_count, seen_free)
                team_explored[p] = wp.uint8(ON)
                team_viewers[p] = wp.uint8(wp.min(shown, 255))
                draw_pixel(p, CHANNEL_EXPLORED, team_bits, drawn_free, j, pictures)
    for j in range(lane, boundary_count, lanes):
        if viewed_boundary[j] != 0:
            start = maps.point_pixel_begin[first + free_count + j]
            stop = maps.point_pixel_begin[first + free_count + j + 1]
            for k in range(start, stop):
                p = maps.point_pixel[k]
                team_obstacle[p] = wp.uint8(ON)
                draw_pixel(p, CHANNEL_OBSTACLE, team_bits, drawn_boundary, j, pictures)


@wp.kernel
def _list_bodies(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Robots:
    robots: Robots,
    # State in:
    pose: wp.array2d(dtype=wp.vec4),  # [env, robot]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    # Scratch in:
    mask: wp.array(dtype=wp.int32),  # [env]
    # State in and out:
    error: wp.array(dtype=wp.int32),  # [env]
    # Scratch out:
    body_pixel: wp.array3d(dtype=wp.int32),  # [env, robot, slot]
    body_count: wp.array2d(dtype=wp.int32),  # [env, robot]
):
    """List the pixels whose centres lie in the body of robot (e, i), and the one nearest to its centre."""
    e, i = wp.tid()
    if mask[e] == 0:
        return
    m = map_id[e]
    at = point_xy(center[e, i])
    length = robots.length[e, i]
    width = robots.width[e, i]
    reach = wp.vec2(1.0, 1.0) * (0.5 * (length + width))
    low = pixel_of(maps, m, at - reach)
    high = pixel_of(maps, m, at + reach)
    middle = pixel_of(maps, m, at)
    body_pixel[e, i, 0] = middle[0] * PIXELS + middle[1]
    count = int(1)
    for ix in range(low[0], high[0] + 1):
        for iy in range(low[1], high[1] + 1):
            p = maps.frame_origin[m] + maps.pixel_size[m] * wp.vec2(float(ix), float(iy))
            if rectangle_distance(p, at, pose[e, i][3], length, width) == 0.0:
                if count < body_pixel.shape[2]:
                    body_pixel[e, i, count] = ix * PIXELS + iy
                count += 1
    if count > body_pixel.shape[2]:
        wp.atomic_or(error, e, ERROR_CAPACITY)
        count = body_pixel.shape[2]
    body_count[e, i] = count


@wp.func
def draw_segment(p: int, q: int, value: wp.uint8, e: int, i: int, picture: wp.array4d(dtype=wp.uint8)):
    """Draw from pixel p (excluded unless equal) to pixel q."""
    if p == q:
        picture[e, i, CHANNEL_TRAJECTORY, q] = value
        return
    dx = q / PIXELS - p / PIXELS
    dy = q % PIXELS - p % PIXELS
    steps = wp.max(wp.abs(dx), wp.abs(dy))
    for k in range(1, steps + 1):
        t = float(k) / float(steps)
        ix = p / PIXELS + int(wp.floor(float(dx) * t + 0.5))
        iy = p % PIXELS + int(wp.floor(float(dy) * t + 0.5))
        picture[e, i, CHANNEL_TRAJECTORY, ix * PIXELS + iy] = value


@wp.kernel
def _draw_robots(
    # State in:
    comm: wp.array3d(dtype=wp.bool),  # [env, robot, robot]
    local_step: wp.array(dtype=wp.int32),  # [env]
    track: wp.array3d(dtype=wp.int32),  # [env, robot, step]
    # Scratch in:
    mask: wp.array(dtype=wp.int32),  # [env]
    body_pixel: wp.array3d(dtype=wp.int32),  # [env, robot, slot]
    body_count: wp.array2d(dtype=wp.int32),  # [env, robot]
    # Out:
    picture: wp.array4d(dtype=wp.uint8),  # [env, robot, channel, pixel]
):
    """Draw bodies (own 255, others it hears 128) and the fading trajectory, 255 * 0.99^age, over cleared channels."""
    e, i = wp.tid()
    if mask[e] == 0:
        return
    for other in range(body_count.shape[1]):
        if other != i and comm[e, i, other]:
            for k in range(body_count[e, other]):
                picture[e, i, CHANNEL_POSITION, body_pixel[e, other, k]] = wp.uint8(OTHER)
    for k in range(body_count[e, i]):
        picture[e, i, CHANNEL_POSITION, body_pixel[e, i, k]] = wp.uint8(ON)
    last = local_step[e]
    depth = track.shape[2]
    oldest = wp.max(0, last - depth + 1)
    value = float(ON) * wp.pow(FADE, float(last - oldest))
    before = track[e, i, oldest % depth]
    for step in range(oldest, last + 1):
        here = track[e, i, step % depth]
        draw_segment(before, here, wp.uint8(value + 0.5), e, i, picture)
        before = here
        value = value / FADE


@wp.kernel
def _record_track(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Settings:
    ahead: int,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    local_step: wp.array(dtype=wp.int32),  # [env]
    # State out:
    track: wp.array3d(dtype=wp.int32),  # [env, robot, step]
):
    """Note the pixel of robot (e, i) under the step that is being finished (``ahead`` = 1) or starts (0)."""
    e, i = wp.tid()
    if active[e] == 0:
        return
    pixel = pixel_of(maps, map_id[e], point_xy(center[e, i]))
    track[e, i, (local_step[e] + ahead) % track.shape[2]] = pixel[0] * PIXELS + pixel[1]


@wp.kernel
def _observe_pose(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # Robots:
    robots: Robots,
    # State in:
    pose: wp.array2d(dtype=wp.vec4),  # [env, robot]
    slip: wp.array2d(dtype=wp.float32),  # [env, robot]
    center: wp.array2d(dtype=wp.vec3),  # [env, robot]
    goal: wp.array2d(dtype=wp.vec2),  # [env, robot]
    # Out:
    scaled_pose: wp.array2d(dtype=wp.vec4),  # [env, robot]
    grid: wp.array4d(dtype=wp.float32),  # [env, robot, channel, region]
):
    """Pose scaled to about [-1, 1]; offsets of the region centres to the robot and to its last goal, in frame sides."""
    e, i = wp.tid()
    m = map_id[e]
    middle = 0.5 * (maps.lower[m] + maps.upper[m])
    side = maps.pixel_size[m] * float(PIXELS)
    at = point_xy(center[e, i])
    last = goal[e, i]
    rel = (at - middle) * (2.0 / side)
    speed = wp.length(wp.vec2(pose[e, i][2], slip[e, i]))
    if pose[e, i][2] < 0.0 and slip[e, i] == 0.0:
        speed = -speed
    scaled_pose[e, i] = wp.vec4(rel[0], rel[1], speed / robots.max_speed[e, i], pose[e, i][3] / PI)
    cell = (maps.upper[m] - maps.lower[m]) / float(REGIONS)
    for r in range(REGIONS * REGIONS):
        x = maps.lower[m][0] + cell[0] * (float(r / REGIONS) + 0.5)
        y = maps.lower[m][1] + cell[1] * (float(r % REGIONS) + 0.5)
        grid[e, i, 0, r] = (x - at[0]) / side
        grid[e, i, 1, r] = (y - at[1]) / side
        grid[e, i, 2, r] = (x - last[0]) / side
        grid[e, i, 3, r] = (y - last[1]) / side


def record_track(launch: Launch, shard: Shard, running: wp.array, ahead: int) -> None:
    """Note where the robots are, where ``running`` [env] is set: in the step being finished (1) or at its start (0)."""
    shard.call(launch, _record_track, active=running, ahead=ahead, **shard.believed)


def draw_pictures(launch: Launch, shard: Shard, picture: torch.Tensor, team: torch.Tensor) -> None:
    """Pictures of the envs of ``mask``.

    Args:
        picture, team: zeros, uint8 [env, robot, channel, 125, 125] and [env, channel, 125, 125], of this shard's envs.
    """
    s, settings = shard.view, shard.settings
    drawn = "known" if settings.draw_known and settings.limited else "seen"
    given = {
        "picture": wp.from_torch(picture.flatten(3), dtype=wp.uint8),
        "team": wp.from_torch(team.flatten(2), dtype=wp.uint8),
        "draw_free": getattr(s, f"{drawn}_free"),
        "draw_boundary": getattr(s, f"{drawn}_boundary"),
        "team_bits": int(settings.draw_known and not settings.limited),
        "lanes": lanes_on(shard.device, 1024),
    }
    shard.call(launch, _draw_points, (shard.shape[0], given["lanes"]), **given)
    shard.call(launch, _list_bodies, **shard.believed)
    shard.call(launch, _draw_robots, picture=given["picture"])


def observe_pose(launch: Launch, shard: Shard, pose: torch.Tensor, grid: torch.Tensor) -> None:
    """Poses and region offsets.

    Args:
        pose, grid: float32 [env, robot, 4] and [env, robot, 4, 8, 8], of this shard's envs.
    """
    given = {"scaled_pose": wp.from_torch(pose, dtype=wp.vec4), "grid": wp.from_torch(grid.flatten(3))}
    shard.call(launch, _observe_pose, **given, **shard.believed)
