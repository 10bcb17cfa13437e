"""The order of the stages: of a local step, a macro step, a reset and an observation; nothing else.

Every stage is a function of the file of its kernels: ``stage(launch, shard)`` launches them over the envs of a shard.
"""

import torch

from maexp.kernels.collision import detect_collisions
from maexp.kernels.drifting_maps import draw_maps
from maexp.kernels.dynamics import move_robots
from maexp.kernels.faults import fail_robots
from maexp.kernels.launches import Launch
from maexp.kernels.merge import merge_scan, share_maps
from maexp.kernels.neighbours import list_near
from maexp.kernels.observe import draw_pictures, observe_pose, record_track
from maexp.kernels.odometry import drift_odometry, estimate_poses
from maexp.kernels.planner import find_paths, pick_waypoints, plan
from maexp.kernels.radio import note_links, place_base
from maexp.kernels.reset import place_teams, start_episodes
from maexp.kernels.reward import close_step, reward_robots
from maexp.kernels.sensing import settle_walls
from maexp.kernels.shards import Shard
from maexp.kernels.visibility import scan


def local_step(launch: Launch, shard: Shard) -> None:
    """Plan, fail, drift, move, collide, scan, merge, draw, reward, terminate, in the envs that are active."""
    active = shard.view.active
    list_near(launch, shard, active)
    plan(launch, shard)
    fail_robots(launch, shard, active)
    drift_odometry(launch, shard)
    move_robots(launch, shard)
    detect_collisions(launch, shard)
    estimate_poses(launch, shard, active, begins=0)
    scan(launch, shard, active, ahead=1)
    merge_scan(launch, shard, active)
    share_maps(launch, shard, active)
    settle_walls(launch, shard, active)
    draw_maps(launch, shard, active, ahead=1)
    note_links(launch, shard)
    reward_robots(launch, shard)
    record_track(launch, shard, active, ahead=1)
    close_step(launch, shard)


def run_steps(shard: Shard, start: int, count: int) -> None:
    """Local steps ``start`` to ``start + count`` of a macro step; the planner `wavefront` plans before each."""
    for k in range(start, start + count):
        if k % shard.settings.replan_steps == 0:
            shard.replay(find_paths)
        shard.replay(pick_waypoints)
        shard.replay(local_step)


def reset(launch: Launch, shard: Shard) -> None:
    """Start the envs of ``mask`` anew: place their teams and take the first scan."""
    mask = shard.view.mask
    place_teams(launch, shard)
    place_base(launch, shard)
    fail_robots(launch, shard, mask)
    estimate_poses(launch, shard, mask, begins=1)
    list_near(launch, shard, mask)
    scan(launch, shard, mask, ahead=0)
    merge_scan(launch, shard, mask)
    share_maps(launch, shard, mask)
    settle_walls(launch, shard, mask)
    draw_maps(launch, shard, mask, ahead=0)
    record_track(launch, shard, mask, ahead=0)
    start_episodes(launch, shard)


def observe(
    launch: Launch,
    shard: Shard,
    picture: torch.Tensor | None,
    team: torch.Tensor | None,
    pose: torch.Tensor,
    grid: torch.Tensor,
) -> None:
    """Draw into tensors of all envs: pictures of those of ``mask`` (None: no pictures), poses and region offsets."""
    rows = slice(shard.first, shard.last)
    if picture is not None:
        draw_pictures(launch, shard, picture[rows], team[rows])
    observe_pose(launch, shard, pose[rows], grid[rows])
