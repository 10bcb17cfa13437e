"""From an env's settings to the kernels' `Simulation`: robot parameters, reward weights, sizes, memory."""

import math
import os

import torch

from maexp.envs.config import TIME_ON
from maexp.envs.nav_grid import bank_nav_grids, grid_shape
from maexp.kernels.known_grid import news_capacity
from maexp.kernels.reward import RewardWeights
from maexp.kernels.simulation import Settings, Simulation
from maexp.kernels.state import axis_sizes, memory_per_env
from maexp.kernels.types import ACKERMANN, DIFFERENTIAL, OMNIDIRECTIONAL, PICTURE_CHANNELS, PIXELS, TEAM_CHANNELS
from maexp.kernels.wavefront import grid_memory_per_env

KINDS = {
    "ackermann": ACKERMANN,
    "differential": DIFFERENTIAL,
    "omnidirectional": OMNIDIRECTIONAL,
}
TRACK_LENGTH = 625
"""Local steps after which the trajectory has faded below half a grey level: 255 * 0.99^625 < 0.5."""


def build_simulation(env, seed: int, num_threads: int) -> Simulation:
    """The simulation of an `ExplorationEnv` whose settings are complete."""
    return Simulation(
        maps=env.bank.tensors(env.device),
        num_maps=len(env.maps),
        robots=robot_tensors(env),
        weights=reward_weights(env),
        settings=step_settings(env),
        sizes=sizes(env),
        device=env.device,
        seed=seed,
        num_shards=num_threads,
        nav=bank_nav_grids(env.bank, env.device) if env.planner_config.name == "wavefront" else None,
    )


def robot_tensors(env) -> dict[str, torch.Tensor]:
    """Parameters of every robot, [E, N] each (fields of `kernels.types.Robots`)."""
    robots, radars = env.robot_configs, env.radar_configs
    factor = env.planner_config.clearance_factor
    columns = {
        "kind": [KINDS[r.kind] for r in robots],
        "length": [r.length for r in robots],
        "width": [r.width for r in robots],
        "wheelbase": [r.wheelbase for r in robots],
        "center_offset": [0.5 * r.length if r.kind == "ackermann" else 0.0 for r in robots],
        "max_speed": [r.max_speed for r in robots],
        "max_accel": [r.max_accel for r in robots],
        "max_turn": [r.max_steer if r.kind == "ackermann" else r.max_yaw_rate for r in robots],
        "threshold": [r.collision_threshold for r in robots],
        "clearance": [factor * r.collision_threshold for r in robots],
        "radar_range": [r.range for r in radars],
        "radar_cos_fov": [math.cos(0.5 * r.fov) if r.fov < 2.0 * math.pi - 1e-6 else -2.0 for r in radars],
        "radar_cos_beam": [1.0 - r.alpha1 for r in radars],
        "radar_alpha2": [r.alpha2 for r in radars],
    }
    result = {}
    for name, values in columns.items():
        kind = torch.int32 if name == "kind" else torch.float32
        row = torch.tensor(values, dtype=kind, device=env.device)
        result[name] = row.expand(env.num_envs, -1).contiguous()
    return result


def reward_weights(env) -> RewardWeights:
    """The reward's coefficients as the kernels read them."""
    cfg = env.reward_config
    weights = RewardWeights()
    for name in ("explore", "overlap", "time", "unfinished", "success", "collision", "points", "events"):
        setattr(weights, name, float(getattr(cfg, name)))
    weights.time_on = TIME_ON.index(cfg.time_on)
    weights.success_coverage = env.success_coverage
    weights.length = env.local_steps * env.macro_steps
    weights.charge_rest = int(cfg.charge_rest)
    return weights


def step_settings(env) -> Settings:
    """What a local step does."""
    planner, comm = env.planner_config, env.comm_config
    return Settings(
        planner=planner.name,
        num_accel=planner.num_accel,
        num_steering=planner.num_steering,
        horizon=planner.horizon,
        clearance_weight=planner.clearance_weight,
        replan_steps=planner.replan_steps,
        footprint=env.collision == "footprint",
        limited=comm.limited,
        comm_range=min(comm.range, 1e30),
        line_of_sight=comm.line_of_sight,
        draw_known=env.observation_config.map == "known",
        success_coverage=env.success_coverage,
    )


def sizes(env) -> dict[str, int]:
    """Lengths of the axes of state and scratch."""
    finest = min(m.resolution for m in env.maps)
    pixel = float(env.bank.arrays["pixel_size"].min())
    outline = sum(
        2 * (max(2, math.ceil(r.length / finest)) + max(2, math.ceil(r.width / finest))) + 4
        for r in env.robot_configs
    )
    return axis_sizes(
        env.num_envs,
        env.num_robots,
        free=env.bank.max_free,
        boundary=env.bank.max_boundary,
        visible=env.bank.free_in_range,
        occluders=env.bank.occluders_in_range + (outline if env.num_robots > 1 else 0),
        nearby=env.bank.boundary_in_range,
        track=min(env.local_steps * env.macro_steps + 1, TRACK_LENGTH),
        limited=env.comm_config.limited,
        body_pixels=max(body_pixels(r.length / pixel, r.width / pixel) for r in env.robot_configs),
    )


def body_pixels(length: float, width: float) -> int:
    """Most pixels in a body of a size in pixels: a convex shape holds at most area + half its rim + 1 (Nosarzewska).

    One more is the pixel next to its centre, one is for rounding.
    """
    return min(math.ceil(length * width + length + width + 3.0), PIXELS**2 + 1)


def bytes_per_env(env) -> int:
    """What one env of the simulation takes on its device: state, scratch, and the grids of the `wavefront` planner."""
    total = sum(memory_per_env(sizes(env)).values())
    if env.planner_config.name == "wavefront":
        limited, robots = env.comm_config.limited, env.num_robots
        shapes = [grid_shape(one) for one in env.maps]
        cells = max(width * height for width, height in shapes)
        masks = robots if limited else len({one.collision_threshold for one in env.robot_configs})
        total += grid_memory_per_env(
            cells, robots, robots if limited else 1, masks, env.bank.max_free + env.bank.max_boundary,
            max(-(-width // 32) * height for width, height in shapes), news_capacity(cells),
        )  # fmt: skip
    return total


def check_memory(env) -> None:
    """Refuse a batch that the device cannot hold, before anything is allocated.

    Raises:
        ValueError: says how much is needed and free, and what to lower.
    """
    # One observation and the next, and the two bounds that TorchRL's spec keeps as tensors.
    channels = (PICTURE_CHANNELS * env.num_robots + TEAM_CHANNELS) * env.observation_config.pictures
    per_env = bytes_per_env(env) + 4 * channels * PIXELS**2
    if env.device.type == "cuda":
        free = torch.cuda.mem_get_info(env.device)[0]
    else:
        free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        if os.path.exists("/proc/meminfo"):  # pages the kernel would give back count as available
            with open("/proc/meminfo") as file:
                for line in file:
                    if line.startswith("MemAvailable:"):
                        free = int(line.split()[1]) * 1024
    if per_env * env.num_envs > free:
        most = int(free / per_env)
        lower = f"lower num_envs to {most}" if most else "lower num_robots or use a smaller map"
        raise ValueError(
            f"num_envs={env.num_envs} needs {per_env * env.num_envs / 2**30:.1f} GiB "
            f"({per_env / 2**20:.1f} MiB per env) and {env.device} has {free / 2**30:.1f} GiB free: {lower}"
        )
