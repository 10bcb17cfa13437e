"""Single kernels as functions of torch tensors: the radar, map merging and radios."""

import math

import torch
import warp as wp

from maexp.kernels import merge, visibility
from maexp.kernels.dynamics import Robots
from maexp.kernels.launches import finish_filling, lanes_on, launch_named, launch_on
from maexp.kernels.occlusion import BINS
from maexp.kernels.occupancy_grid import NavGrids
from maexp.kernels.radio import Radio, _measure_signals
from maexp.kernels.types import ROBOTS_PER_WORD, Maps


def visible_points(
    free: torch.Tensor,
    obstacles: torch.Tensor,
    origin: torch.Tensor,
    radar_range: float = 10.0,
    alpha1: float = 1e-3,
    alpha2: float = 1e-6,
    obstacle_radius: float | torch.Tensor = 0.0,
    heading: float = 0.0,
    field_of_view: float = 2.0 * math.pi,
) -> torch.Tensor:
    """Free points that a radar at ``origin`` sees (ray-masked point filtering; paper, section IV-A).

    Args:
        free: free points [m], shape [n_free, 3] (or [n_free, 2], taken as z = 0).
        obstacles: obstacle points [m], shape [n_obstacles, 3] or [n_obstacles, 2].
        origin: sensor position [m], shape [3] or [2].
        radar_range: range [m], inclusive.
        alpha1: 1 - cos(angular half-width) of the shadow of a point.
        alpha2: by how much an obstacle must not be farther than the free point it masks [m].
        obstacle_radius: radius [m] of the obstacles, one value or shape [n_obstacles].
        heading: direction of the sensor in the xy plane [rad]; matters for a limited field of view.
        field_of_view: full opening angle [rad], 2 pi for all round.

    Returns:
        bool tensor [n_free] on the device of ``free``.

    Raises:
        ValueError: a shape does not fit, or a value is not finite or out of its range.
    """
    origin = _points("origin", torch.as_tensor(origin).reshape(1, -1)).to(free.device)[0]
    free = _points("free", free)
    obstacles = _points("obstacles", obstacles).to(free.device)
    radius = torch.as_tensor(obstacle_radius, dtype=torch.float32, device=free.device)
    if radius.dim() > 1 or (radius.dim() == 1 and radius.shape[0] != obstacles.shape[0]):
        raise ValueError(
            f"obstacle_radius has shape {tuple(radius.shape)}; "
            f"give one number or one per obstacle ({obstacles.shape[0]})"
        )
    for name, value in (("radar_range", radar_range), ("alpha1", alpha1), ("field_of_view", field_of_view)):
        if not value >= 0.0:
            raise ValueError(f"{name}={value} must not be negative or NaN")
    if not (math.isfinite(alpha2) and math.isfinite(heading)):
        raise ValueError(f"alpha2={alpha2} and heading={heading} must be finite")
    if not bool(torch.isfinite(radius).all()) or bool((radius < 0).any()):
        raise ValueError("obstacle_radius must be finite and not negative")
    if free.shape[0] == 0:
        return torch.zeros(0, dtype=torch.bool, device=free.device)
    near = (free - origin).float().contiguous()
    block = (obstacles - origin).float().contiguous()
    # An infinite range is the largest finite one, so that distances stay comparable.
    reach = min(float(radar_range), 1e15)
    return _scan_once(
        near, block, radius.expand(block.shape[0]).contiguous(), reach, alpha1, alpha2, heading, field_of_view
    )


def _points(name: str, points: torch.Tensor) -> torch.Tensor:
    """Points as float64 [n, 3], so that subtracting the origin loses nothing."""
    points = torch.as_tensor(points)
    if points.dim() != 2 or points.shape[1] not in (2, 3):
        raise ValueError(f"{name} has shape {tuple(points.shape)}; points have shape [n, 3]")
    points = points.detach().double()
    if not bool(torch.isfinite(points).all()):
        raise ValueError(f"{name} holds NaN or infinite coordinates; remove them first")
    if points.shape[1] == 2:
        points = torch.nn.functional.pad(points, (0, 1))
    return points


def _scan_once(free, occluders, radius, reach, alpha1, alpha2, heading, field_of_view) -> torch.Tensor:
    """One env, one robot at zero, one cell that holds every point: the kernels of the step, as they are."""
    device = free.device
    count, blocks = free.shape[0], max(occluders.shape[0], 1)

    def ints(*values):
        return wp.from_torch(torch.tensor(values, dtype=torch.int32, device=device), dtype=wp.int32)

    def zeros(*shape, dtype=torch.int32):
        return torch.zeros(shape, dtype=dtype, device=device)

    def full(value):
        return wp.from_torch(torch.full((1, 1), value, dtype=torch.float32, device=device))

    everything = torch.cat([free[:, :2], occluders[:, :2]])
    low = everything.amin(0) - 1.0
    size = (everything.amax(0) - low).amax() + 1.0
    maps = Maps()
    maps.free = wp.from_torch(free, dtype=wp.vec3)
    maps.free_begin, maps.free_cell = ints(0, count), ints(0, count)
    padded = torch.zeros((blocks, 3), dtype=torch.float32, device=device)
    padded[: occluders.shape[0]] = occluders
    radii = torch.zeros(blocks, dtype=torch.float32, device=device)
    radii[: occluders.shape[0]] = radius
    maps.occluder, maps.occluder_radius = wp.from_torch(padded, dtype=wp.vec3), wp.from_torch(radii)
    maps.occluder_radius_max = wp.from_torch(radii.amax().reshape(1))
    maps.occluder_begin = maps.occluder_cell = ints(0, occluders.shape[0])
    maps.cells_x, maps.cells_y, maps.cell_begin = ints(1), ints(1), ints(0)
    maps.cell_origin = wp.from_torch(low.reshape(1, 2).contiguous(), dtype=wp.vec2)
    maps.cell_size = wp.from_torch(size.reshape(1))
    maps.resolution = maps.outline_radius_max = wp.from_torch(torch.ones(1, dtype=torch.float32, device=device))
    robots = Robots()
    robots.radar_range, robots.radar_cos_beam, robots.radar_alpha2 = full(reach), full(1.0 - alpha1), full(alpha2)
    robots.radar_cos_fov = full(math.cos(0.5 * field_of_view) if field_of_view < 2.0 * math.pi else -2.0)
    pose, center = zeros(1, 1, 4, dtype=torch.float32), zeros(1, 1, 3, dtype=torch.float32)
    pose[..., 3] = heading
    views, dim, lanes = zeros(1, 1, count), (1, 1), lanes_on(wp.device_from_torch(device), 4096)
    values = {
        "maps": maps,
        "map_id": ints(0),
        "robots": robots,
        "active": ints(1),
        "lanes": lanes,
        "failed": wp.from_torch(zeros(1, 1)),
        "planar": int(not free[:, 2].any() and not occluders[:, 2].any()),
        "pose": wp.from_torch(pose, dtype=wp.vec4),
        "center": wp.from_torch(center, dtype=wp.vec3),
        "near": wp.from_torch(zeros(1, 1, 1)),
        "near_count": wp.from_torch(zeros(1, 1)),  # nobody else is there
        "facing": wp.from_torch(zeros(1, 1, 2, dtype=torch.float32), dtype=wp.vec2),  # only other robots' are read
        "bins": wp.from_torch(zeros(1, 1, 3 * BINS, dtype=torch.float32)),
        "direction": wp.from_torch(zeros(1, 1, blocks, 3, dtype=torch.float32), dtype=wp.vec3),
        "limit": wp.from_torch(zeros(1, 1, blocks, 2, dtype=torch.float32), dtype=wp.vec2),
        "occluder_count": wp.from_torch(zeros(1, 1)),
        "wall_count": wp.from_torch(zeros(1, 1)),
        "visible": wp.from_torch(zeros(1, 1, count)),
        "visible_count": wp.from_torch(zeros(1, 1)),
        "viewers_free": wp.from_torch(views),
        "error": wp.from_torch(zeros(1)),
    }
    launch = launch_on(device)
    launch_named(launch, visibility._collect_occluders, dim, values)
    launch_named(launch, visibility._scan_free, (*dim, lanes), values)
    return views[0, 0] != 0


def merge_maps(seen: torch.Tensor, comm: torch.Tensor) -> torch.Tensor:
    """What every robot knows once each has heard the others it can hear.

    Args:
        seen: bool [E, N, n], which points each robot has seen.
        comm: bool [E, N, N], ``comm[e, i, j]``: robot i hears robot j. Every robot hears itself.

    Returns:
        bool [E, N, n]: the union of a robot's own points and those of the robots it hears.

    Raises:
        ValueError: shapes do not fit together.
    """
    if seen.dim() != 3 or tuple(comm.shape) != (seen.shape[0], seen.shape[1], seen.shape[1]):
        raise ValueError(
            f"seen {tuple(seen.shape)} and comm {tuple(comm.shape)} do not fit: give [E, N, n] and [E, N, N]"
        )
    if seen.numel() == 0:
        return seen.bool()
    robots = seen.shape[1]
    hears = _pack(comm.bool().to(seen.device), 2)
    flags = _pack(seen.bool(), 1)
    known = torch.zeros_like(flags)
    active = torch.ones(seen.shape[0], dtype=torch.int32, device=seen.device)
    words, told = wp.from_torch(flags), wp.from_torch(torch.zeros_like(flags))
    lanes = lanes_on(words.device, 1024)
    values = {"active": wp.from_torch(active), "hears": wp.from_torch(hears), "seen": words, "told": told}
    values |= {"known": wp.from_torch(known), "lanes": lanes, "maps": Maps(), "map_id": values["active"]}
    values |= {"weighed": 0, "known_weight": wp.from_torch(torch.zeros_like(active).view(-1, 1))}
    values["cells_sent"] = wp.from_torch(torch.zeros_like(active, dtype=torch.int64))
    dim = (seen.shape[0], lanes)
    launch_named(launch_on(words.device), merge._share_points, dim, values)
    return unpack_flags(known, robots)


def received_power(
    free: torch.Tensor,
    senders: torch.Tensor,
    receivers: torch.Tensor,
    edge: float = 1.0,
    cell: float = 1.0,
    power: float = -20.0,
) -> torch.Tensor:
    """Power that arrives of signals, without fading (`maexp.kernels.radio`).

    A robot that predicts a link gives what it knows to be free: the unknown blocks.

    Args:
        free: bool [H, W], free ground; entry [y, x] is the cell from (x, y) to (x + 1, y + 1) times ``edge``.
        senders, receivers: where the radios of each pair are [m], shape [K, 2].
        edge: of the grid's cells [m].
        cell: edge of the cells that the model counts [m].
        power: sent [dBm].

    Returns:
        float32 [K] on the device of ``free`` [dBm].

    Raises:
        ValueError: a shape does not fit, a place is not finite, or a length is not positive.
    """
    if free.dim() != 2 or not free.numel():
        raise ValueError(f"free has shape {tuple(free.shape)}: give a grid [H, W] with cells")
    ends = [
        torch.as_tensor(places, dtype=torch.float32, device=free.device).contiguous() for places in (senders, receivers)
    ]
    if any(end.dim() != 2 or end.shape[1] != 2 for end in ends) or len(ends[0]) != len(ends[1]):
        raise ValueError(f"senders {tuple(ends[0].shape)} and receivers {tuple(ends[1].shape)} must both be [K, 2]")
    if not all(bool(end.isfinite().all()) for end in ends):
        raise ValueError("senders and receivers must be finite numbers of metres")
    for name, value in (("edge", edge), ("cell", cell)):
        if not 0.0 < value < math.inf:
            raise ValueError(f"{name}={value} must be a positive number of metres")
    grids, radio = NavGrids(), Radio()
    radio.power, radio.cell = power, cell
    device = wp.device_from_torch(free.device)
    numbers = {"cell": (edge, wp.float32), "width": (free.shape[1], wp.int32), "height": (free.shape[0], wp.int32)}
    for name, (value, kind) in (numbers | {"origin": ((0.0, 0.0), wp.vec2), "cell_begin": (0, wp.int32)}).items():
        setattr(grids, name, wp.array([value], dtype=kind, device=device))
    finish_filling(device)
    arrived = torch.empty(len(ends[0]), dtype=torch.float32, device=free.device)
    values = {"senders": wp.from_torch(ends[0], dtype=wp.vec2), "receivers": wp.from_torch(ends[1], dtype=wp.vec2)}
    values |= {"grids": grids, "open": wp.from_torch(free.flatten().to(torch.uint8)), "radio": radio}
    values["power"] = wp.from_torch(arrived)
    if len(arrived):
        launch_named(launch_on(free.device), _measure_signals, len(arrived), values)
    return arrived


def _pack(flags: torch.Tensor, axis: int) -> torch.Tensor:
    """Pack a bool axis of robots into words of 32 bits (int32)."""
    count = flags.shape[axis]
    words = []
    for start in range(0, count, ROBOTS_PER_WORD):
        part = flags.narrow(axis, start, min(ROBOTS_PER_WORD, count - start)).long()
        shape = [1] * flags.dim()
        shape[axis] = part.shape[axis]
        bits = (1 << torch.arange(part.shape[axis], device=flags.device)).reshape(shape)
        word = (part * bits).sum(axis)
        words.append(torch.where(word >= 2**31, word - 2**32, word).int())
    return torch.stack(words, axis)


def unpack_flags(words: torch.Tensor, robots: int) -> torch.Tensor:
    """Flags of robots from words of 32: int32 [E, W, n] -> bool [E, robots, n]."""
    index = torch.arange(robots, device=words.device)
    picked = words[:, index // ROBOTS_PER_WORD]
    return (picked >> (index % ROBOTS_PER_WORD)[None, :, None]) & 1 != 0
