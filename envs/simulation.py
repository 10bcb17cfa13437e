"""From an env's settings to the kernels' `Simulation`: robot parameters, reward weights, sizes, memory."""

import math
import os
from dataclasses import fields

import numpy as np
import torch
import warp as wp

from maexp.envs.config import CELLS_OF_RADAR, DONE, TIME_ON, EnvSettings, RobotConfig
from maexp.envs.maps.map_batch import MapBank
from maexp.envs.maps.nav_grid import bank_block_sides, bank_nav_grids, build_nav_grid, grid_shape, open_cells
from maexp.kernels.arrays import count_bytes
from maexp.kernels.constants import DT
from maexp.kernels.dynamics import KINDS, Robots
from maexp.kernels.frontier_clusters import BLOCKS
from maexp.kernels.occupancy_grid import news_capacity
from maexp.kernels.path_steps import PATH_CELLS
from maexp.kernels.radio import Radio
from maexp.kernels.reward import RewardWeights
from maexp.kernels.sensing import Sensing, return_chance
from maexp.kernels.shards import Settings
from maexp.kernels.simulation import Simulation
from maexp.kernels.state import axis_sizes, memory_per_env
from maexp.kernels.types import PICTURE_CHANNELS, PIXELS, TEAM_CHANNELS
from maexp.kernels.wavefront import grid_bytes

TRACK_LENGTH = 625
"""Local steps after which the trajectory has faded below half a grey level: 255 * 0.99^625 < 0.5."""


def build_simulation(settings: EnvSettings, bank: MapBank, together: bool = False) -> Simulation:
    """The simulation of an env with these settings on these maps; ``together``: teams start in one place."""
    need_grids = settings.planner.name == "wavefront" or settings.comm.signal or settings.odometry.map_errors
    simulation = Simulation(
        maps=bank.tensors(settings.device),
        num_maps=len(bank.maps),
        robots=robot_tensors(settings),
        weights=reward_weights(settings),
        radio=radio_struct(settings),
        fault_at=fault_steps(settings),
        settings=step_settings(settings, together),
        sizes=sizes(settings, bank),
        device=settings.device,
        seed=settings.seed,
        num_shards=settings.num_threads,
        nav=bank_nav_grids(bank, settings.device) if need_grids else None,
        open_cells=open_ground(bank).to(settings.device) if settings.comm.signal else None,
        sensing=None if perfect_radars(settings) else radar_sensing(settings, bank),
    )
    simulation.tensors["env_id"] += settings.first_env
    return simulation


def robot_tensors(settings: EnvSettings) -> dict[str, torch.Tensor]:
    """Parameters of every robot, [E, N] each (fields of `kernels.dynamics.Robots`)."""
    robots, radars = settings.robot, settings.radar
    factor = settings.planner.clearance_factor
    same = [field.name for field in fields(RobotConfig) if field.name in Robots.vars]
    columns = {name: [getattr(r, name) for r in robots] for name in same} | {
        "kind": [KINDS[r.kind] for r in robots],
        "center_offset": [0.5 * r.length if r.kind == "ackermann" else 0.0 for r in robots],
        "max_turn": [r.max_steer if r.kind == "ackermann" else r.max_yaw_rate for r in robots],
        "clearance": [factor * r.collision_threshold for r in robots],
        "radar_range": [r.range for r in radars],
        "radar_cos_fov": [math.cos(0.5 * r.fov) if r.fov < 2.0 * math.pi - 1e-6 else -2.0 for r in radars],
        "radar_cos_beam": [1.0 - r.alpha1 for r in radars],
        "radar_alpha2": [r.alpha2 for r in radars],
    }
    result = {}
    for name, values in columns.items():
        kind = torch.int32 if name == "kind" else torch.float32
        row = torch.tensor(values, dtype=kind, device=settings.device)
        result[name] = row.expand(settings.num_envs, -1).contiguous()
    return result


def reward_weights(settings: EnvSettings) -> RewardWeights:
    """The reward's coefficients as the kernels read them."""
    weights = RewardWeights()
    for name, value in vars(settings.reward).items():
        setattr(weights, name, TIME_ON.index(value) if isinstance(value, str) else value)
    weights.success_coverage = settings.success_coverage
    weights.length = settings.episode_steps
    return weights


def radio_struct(settings: EnvSettings) -> Radio:
    """The radios as the kernels read them."""
    comm, radio = settings.comm, Radio()
    radio.power, radio.threshold, radio.noise = comm.power, comm.threshold, comm.noise
    reach = max(radar.range for radar in settings.radar)
    radio.cell = reach / CELLS_OF_RADAR if comm.cell == "auto" else comm.cell
    return radio


def perfect_radars(settings: EnvSettings) -> bool:
    """Whether robots know at once all that is in view."""
    return all(radar.perfect for radar in settings.radar)


def false_alarms(settings: EnvSettings) -> bool:
    """Whether robots may take free ground for walls."""
    return any(radar.false_alarm > 0.0 for radar in settings.radar)


def radar_sensing(settings: EnvSettings, bank: MapBank) -> Sensing:
    """What radars miss, as the kernels read it."""
    chance = [[return_chance(radar.missed, radar.noise, m.resolution) for radar in settings.radar] for m in bank.maps]
    sensing, device = Sensing(), str(settings.device)
    sensing.chance = wp.array(chance, dtype=wp.float32, device=device)
    sensing.false_alarm = wp.array([radar.false_alarm for radar in settings.radar], dtype=wp.float32, device=device)
    sensing.needed = wp.array([radar.evidence for radar in settings.radar], dtype=wp.int32, device=device)
    return sensing


def fault_steps(settings: EnvSettings) -> torch.Tensor:
    """Local step in which each robot is to fail, int32 [N]; -1: none is given."""
    steps = torch.full((settings.num_robots,), -1, dtype=torch.int32, device=settings.device)
    for robot, step in settings.faults.steps.items():
        steps[robot] = step
    return steps


def open_ground(bank: MapBank) -> torch.Tensor:
    """Cells of the navigation grids of all maps, one after the other, uint8: 1 on free ground."""
    return torch.from_numpy(np.concatenate([open_cells(build_nav_grid(world)) for world in bank.maps]).astype(np.uint8))


def step_settings(settings: EnvSettings, together: bool = False) -> Settings:
    """What a local step does."""
    planner, comm, faults, odometry = settings.planner, settings.comm, settings.faults, settings.odometry
    base = (math.inf, math.inf) if isinstance(comm.base_station, bool) else comm.base_station
    return Settings(
        planner=planner.name,
        num_accel=planner.num_accel,
        num_steering=planner.num_steering,
        horizon=planner.horizon,
        clearance_weight=planner.clearance_weight,
        replan_steps=planner.replan_steps,
        footprint=settings.collision == "footprint",
        limited=settings.limited,
        comm_range=min(comm.range, 1e30),
        line_of_sight=comm.line_of_sight,
        loss=comm.loss,
        messages=comm.messages,
        message_cells=comm.message_cells,
        message_delay=comm.message_steps,
        signal=comm.signal,
        base_x=base[0],
        base_y=base[1],
        faults=faults.enabled,
        fault_probability=faults.probability,
        fault_steps=max(1, round(min(faults.duration, 1e8) / DT)),
        false_alarms=false_alarms(settings),
        drifts=odometry.enabled,
        odometry_drift=odometry.drift,
        odometry_turn=odometry.turn,
        odometry_jump=odometry.jump,
        odometry_jump_rate=odometry.jump_rate,
        map_errors=odometry.map_errors,
        episode_steps=settings.episode_steps,
        done=DONE.index(settings.done) if settings.limited else 0,  # else all know the same
        draw_known=settings.observation.map == "known",
        success_coverage=settings.success_coverage,
        together=together,
    )


def sizes(settings: EnvSettings, bank: MapBank) -> dict[str, int]:
    """Lengths of the axes of state and scratch."""
    finest = min(m.resolution for m in bank.maps)
    pixel = float(bank.arrays["pixel_size"].min())
    outline = sum(
        2 * (max(2, math.ceil(r.length / finest)) + max(2, math.ceil(r.width / finest))) + 4 for r in settings.robot
    )
    return axis_sizes(
        settings.num_envs,
        settings.num_robots,
        free=bank.max_free,
        boundary=bank.max_boundary,
        visible=bank.free_in_range,
        occluders=bank.occluders_in_range + (outline if settings.num_robots > 1 else 0),
        nearby=bank.boundary_in_range,
        track=min(settings.episode_steps + 1, TRACK_LENGTH),
        limited=settings.limited,
        base_station=settings.comm.has_base,
        sensing=not perfect_radars(settings),
        drifts=settings.odometry.enabled,
        messages=settings.comm.messages,
        false_alarms=false_alarms(settings),
        map_errors=settings.odometry.map_errors,
        cells=max(math.prod(grid_shape(world)) for world in bank.maps) if settings.odometry.map_errors else 1,
        body_pixels=max(body_pixels(r.length / pixel, r.width / pixel) for r in settings.robot),
    )


def body_pixels(length: float, width: float) -> int:
    """Most pixels in a body of a size in pixels: a convex shape holds at most area + half its rim + 1 (Nosarzewska).

    One more is the pixel next to its centre, one is for rounding.
    """
    return min(math.ceil(length * width + length + width + 3.0), PIXELS**2 + 1)


def bytes_per_env(settings: EnvSettings, bank: MapBank) -> int:
    """What one env takes on its device: state, scratch, grids of the `wavefront` planner and of targets it shows."""
    total = sum(memory_per_env(sizes(settings, bank)).values())
    if settings.planner.name == "wavefront":
        total += grid_bytes(grid_sizes(settings, bank))
    return total + (navigation_bytes(settings, bank) if settings.observation.targets else 0)


def grid_sizes(settings: EnvSettings, bank: MapBank) -> dict[str, int]:
    """Lengths of the axes of the planner's arrays for one env (`KNOWN`, `PASSABLE`, `SEARCH`, `PATHS`)."""
    limited, robots = settings.limited, settings.num_robots
    shapes = [grid_shape(world) for world in bank.maps]
    cells = max(width * height for width, height in shapes)
    return {
        "env": 1,
        "row": robots if limited else 1,
        "item": robots,
        "place": robots,
        "mask": robots if limited else len({robot.collision_threshold for robot in settings.robot}),
        "cell": cells,
        "slot": news_capacity(cells),
        "word": max(-(-width // 32) * height for width, height in shapes),
        "point": bank.max_free * (1 + false_alarms(settings)) + bank.max_boundary,
        "ring": 2,
        "source": 1,
        "end": 2,
        "step": PATH_CELLS,
    }


def navigation_bytes(settings: EnvSettings, bank: MapBank) -> int:
    """What a `Navigation` and the targets that it finds keep of one env."""
    sides = zip(bank.maps, bank_block_sides(bank, min(radar.range for radar in settings.radar)).tolist(), strict=True)
    blocks = max(math.prod(-(-cells // side) for cells in grid_shape(world)) for world, side in sides)
    lengths = grid_sizes(settings, bank) | {"block": blocks, "two": 2}
    if settings.device.type == "cpu":
        lengths["place"] = 0  # all search in one place, which no env counts
    in_vain = 4 * settings.num_robots * blocks  # decisions in vain of every robot (`TargetTracker`)
    return grid_bytes(lengths) + sum(count_bytes(BLOCKS, lengths).values()) + in_vain


def check_memory(settings: EnvSettings, bank: MapBank) -> None:
    """Refuse a batch that the device cannot hold, before anything is allocated.

    Raises:
        ValueError: says how much is needed and free, and what to lower.
    """
    # One observation and the next, and the two bounds that TorchRL's spec keeps as tensors.
    channels = (PICTURE_CHANNELS * settings.num_robots + TEAM_CHANNELS) * settings.observation.pictures
    refuse_too_many(settings, bytes_per_env(settings, bank) + 4 * channels * PIXELS**2)


def free_memory(device: torch.device) -> int:
    """Bytes that can still be had on a device."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    if os.path.exists("/proc/meminfo"):  # pages the kernel would give back count as available
        with open("/proc/meminfo") as file:
            for line in file:
                if line.startswith("MemAvailable:"):
                    return int(line.split()[1]) * 1024
    return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def refuse_too_many(settings: EnvSettings, per_env: int) -> None:
    """Raise ValueError if what is about to be allocated, bytes for each env, is more than there is."""
    free = free_memory(settings.device)
    if per_env * settings.num_envs > free:
        most = int(free / per_env)
        lower = f"lower num_envs to {most}" if most else "lower num_robots or use a smaller map"
        raise ValueError(
            f"num_envs={settings.num_envs} needs {per_env * settings.num_envs / 2**30:.1f} GiB "
            f"({per_env / 2**20:.1f} MiB per env) and {settings.device} has {free / 2**30:.1f} GiB free: {lower}"
        )
