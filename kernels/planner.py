"""Local planners: goals of the policy, direct controls from the policy, and which planner drives."""

import warp as wp

from maexp.kernels.braking import hold_turns
from maexp.kernels.dwa import _plan_dwa
from maexp.kernels.dynamics import Robots, turn_limit
from maexp.kernels.launches import Launch
from maexp.kernels.odometry import take_aim
from maexp.kernels.shards import Shard
from maexp.kernels.speed_limits import fit_clearance, hold_back
from maexp.kernels.startup import MODULE_OPTIONS
from maexp.kernels.types import ERROR_ACTION, Maps

wp.set_module_options(MODULE_OPTIONS)


@wp.kernel
def _plan_direct(
    # Robots:
    robots: Robots,
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    # Scratch in:
    command: wp.array2d(dtype=wp.vec2),  # [env, robot]
    # State out:
    control: wp.array2d(dtype=wp.vec2),  # [env, robot]
):
    """Take the controls from the policy: shares of the robot's limits in [-1, 1]."""
    e, i = wp.tid()
    if active[e] == 0:
        return
    first = wp.clamp(command[e, i][0], -1.0, 1.0) * robots.max_accel[e, i]
    second = wp.clamp(command[e, i][1], -1.0, 1.0) * turn_limit(robots, e, i)
    control[e, i] = wp.vec2(first, second)


@wp.kernel
def _set_goal(
    # Map:
    maps: Maps,
    map_id: wp.array(dtype=wp.int32),  # [env]
    # State in:
    active: wp.array(dtype=wp.int32),  # [env]
    # Scratch in:
    wanted: wp.array2d(dtype=wp.vec2),  # [env, robot]
    # State in and out:
    error: wp.array(dtype=wp.int32),  # [env]
    # State out:
    goal: wp.array2d(dtype=wp.vec2),  # [env, robot]
    waypoint: wp.array2d(dtype=wp.vec2),  # [env, robot]
):
    """Take the goals that the policy wants, those beyond the map to its edge."""
    e, i = wp.tid()
    if active[e] == 0:
        return
    at = wanted[e, i]
    if not (wp.isfinite(at[0]) and wp.isfinite(at[1])):
        wp.atomic_or(error, e, ERROR_ACTION)
        return
    low = maps.lower[map_id[e]]
    high = low + (maps.upper[map_id[e]] - low)  # where the last region ends: it may be an ulp beyond `upper`
    x = wp.clamp(at[0], low[0], high[0])
    y = wp.clamp(at[1], low[1], high[1])
    goal[e, i] = wp.vec2(x, y)
    waypoint[e, i] = wp.vec2(x, y)


def set_goals(launch: Launch, shard: Shard) -> None:
    """Take the goals that the policy wants."""
    if shard.settings.planner != "direct":
        shard.call(launch, _set_goal)


def plan(launch: Launch, shard: Shard) -> None:
    """How to go: controls of every robot. Under `wavefront` DWA drives to its waypoints with its clearances."""
    if shard.settings.planner == "direct":
        shard.call(launch, _plan_direct)
        return
    robots = shard.robots
    if shard.wavefront is None:
        take_aim(launch, shard)
    else:
        robots = shard.wavefront.narrowed
    boundary, waypoint = shard.known("boundary"), shard.aims["waypoint"]
    shard.call(launch, _plan_dwa, robots=robots, known_boundary=boundary, waypoint=waypoint)


def find_paths(launch: Launch, shard: Shard) -> None:
    """Bring maps and paths up to date, if the planner is `wavefront`: every `replan_steps` local steps."""
    if shard.wavefront is not None:
        s, own = shard.view, shard.wavefront
        own.known.paint(launch)
        own.passable.paint(launch)
        own.paths.find(launch, s.active, s.collided, shard.believed["center"], s.goal, s.waypoint)


def pick_waypoints(launch: Launch, shard: Shard) -> None:
    """Bring `waypoint` and the clearances up to date, if the planner is `wavefront`: every local step."""
    if shard.wavefront is not None:
        s, own = shard.view, shard.wavefront
        center = shard.believed["center"]
        own.paths.pick(launch, s.active, s.collided, center, s.goal, shard.robots.radar_range, s.waypoint)
        fit_clearance(launch, shard)
        take_aim(launch, shard)
        hold_back(launch, shard)
        hold_turns(launch, shard)
