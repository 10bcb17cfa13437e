"""Checks a map of voxels before a team is sent into it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage

from maexp.envs.maps.reachability import ROOM_LIMIT
from maexp.envs.scenarios import find_scenario
from maexp.envs.volume.map import VoxelMap
from maexp.envs.volume.reach import DRIVING, FLYING, Body, count_room, label_reachable, passable
from maexp.envs.volume.visibility import seeable
from maexp.kernels.types import START_CLEARANCE

SEEABLE_SHARE = 0.6  # of the free voxels; below it most of the map is out of sight
PIECE = 0.05  # of the largest piece: smaller ones are not listed


@dataclass
class VolumeReport:
    """Verdict on a map of voxels. `ok` says whether a team can explore it; lengths in metres."""

    name: str
    scenario: str
    resolution: float
    shape: tuple[int, int, int]
    extent: tuple
    num_free: int
    num_occupied: int
    free_volume: float  # [m^3]
    components: list[int]  # free voxels of each piece, joined by faces, largest first
    leaks: int  # free voxels beside unknown ones or at the side of the box
    room: int  # robots that surely find a start in the air of the largest piece; counted up to ROOM_LIMIT
    ground_room: int  # the same on the ground
    flying: list[int]  # places of each piece a flying robot cannot leave, largest first
    driving: list[tuple[int, float, float]]  # places, and lowest and highest [m], of the same of a driving one
    seeable_share: float  # of the free voxels, from the air of all pieces
    num_robots: int
    errors: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        return not self.errors

    @property
    def verdict(self) -> str:
        if self.errors:
            return "unusable"
        return "usable, with warnings" if self.warnings else "good"

    def table(self) -> str:
        """The report as text: one line a finding."""
        (x0, y0, z0), (x1, y1, z1) = self.extent
        nx, ny, nz = self.shape
        ground = "; ".join(f"{count:,} from z = {low:.1f} to {high:.1f} m" for count, low, high in self.driving[:6])
        rows = [
            ("map", f"{self.name} (scenario {self.scenario})"),
            ("verdict", self.verdict),
            ("voxels", f"{nx} x {ny} x {nz} of {self.resolution:g} m"),
            ("free", f"{self.num_free:,} voxels, {self.free_volume:,.1f} m3; {self.num_occupied:,} occupied"),
            ("extent", f"x {x0:.1f} to {x1:.1f}, y {y0:.1f} to {y1:.1f}, z {z0:.1f} to {z1:.1f} m"),
            ("pieces", ", ".join(f"{size:,}" for size in self.components[:6]) + " free voxels"),
            ("closed", "yes" if not self.leaks else f"no: {self.leaks:,} free voxels touch unknown space"),
            ("room", f"{_counted(self.room)} robots that fly, {_counted(self.ground_room)} that drive"),
            ("places in the air", ", ".join(f"{size:,}" for size in self.flying[:6]) or "none"),
            ("places on ground", ground or "none"),
            ("seeable", f"{self.seeable_share:.1%} of the free voxels, from the air"),
        ]
        rows += [("error", text) for text in self.errors] + [("warning", text) for text in self.warnings]
        return "\n".join(f"{name:<18}{text}" for name, text in rows)


def _counted(room: int) -> str:
    return f"at least {room}" if room >= ROOM_LIMIT else str(room)


def check_volume(world: VoxelMap, *, num_robots: int = 3, radius: float | None = None) -> VolumeReport:
    """Whether a team can explore `world`: a closed box, pieces, room, what can be seen.

    Args:
        num_robots: the team that must find room.
        radius: of the robots [m]; None: that of the map's scenario.
    """
    scenario = find_scenario(world.scenario).with_radius(radius)
    radius, side = scenario.collision_threshold, world.resolution
    _, components = _sizes(ndimage.label(world.free)[0])
    fly, drive = Body(FLYING, radius), Body(DRIVING, radius, height=max(2 * radius, side))
    places = [passable(world.free, world.occupied, body, side) for body in (fly, drive)]
    in_air, flying = _sizes(label_reachable(places[0], fly, side)[0])
    on_ground, driving = _sizes(label_reachable(places[1], drive, side)[0])
    apart = START_CLEARANCE * radius
    report = VolumeReport(
        name=world.name,
        scenario=world.scenario,
        resolution=side,
        shape=world.shape,
        extent=world.extent,
        num_free=int(world.free.sum()),
        num_occupied=int(world.occupied.sum()),
        free_volume=world.free_volume,
        components=components,
        leaks=count_leaks(world),
        room=count_room(in_air == 1, side, apart, ROOM_LIMIT),
        ground_room=count_room(on_ground == 1, side, apart, ROOM_LIMIT),
        flying=[size for size in flying if size >= PIECE * flying[0]],
        driving=_span_heights(on_ground, driving, world),
        seeable_share=_share_seen(world, in_air > 0, scenario),
        num_robots=num_robots,
    )
    _judge(report, radius)
    return report


def count_leaks(world: VoxelMap) -> int:
    """Free voxels with a neighbour that is neither free nor occupied, or at the side of the box."""
    known = np.pad(world.free | world.occupied, 1)
    return int((world.free & ~ndimage.binary_erosion(known)[1:-1, 1:-1, 1:-1]).sum())


def _sizes(labels: np.ndarray) -> tuple[np.ndarray, list[int]]:
    """Labels by size, 1 for the largest, and the sizes."""
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    order = np.argsort(-sizes, kind="stable")[: np.count_nonzero(sizes)]
    rank = np.zeros(len(sizes), dtype=np.int32)
    rank[order] = np.arange(1, len(order) + 1)
    return rank[labels], sizes[order].tolist()


def _span_heights(labels: np.ndarray, sizes: list[int], world: VoxelMap) -> list[tuple[int, float, float]]:
    spans = []
    for number, size in enumerate(sizes, start=1):
        if size < PIECE * sizes[0]:
            break
        layers = np.flatnonzero((labels == number).any(axis=(0, 1))) * world.resolution + world.origin[2]
        spans.append((size, float(layers.min()), float(layers.max())))
    return spans


def _share_seen(world: VoxelMap, reachable: np.ndarray, scenario) -> float:
    """Share of the free voxels that can be seen from places in the air."""
    far = min(scenario.radar_range, 20 * world.resolution)
    seen = seeable(world, far, scenario.vertical_fov or 0.5 * np.pi, reachable)
    return float(seen.sum() / world.free.sum())


def _judge(report: VolumeReport, radius: float) -> None:
    if not report.flying:
        report.errors.append(
            f"no room for a robot of {radius:g} m radius: take smaller voxels, or set robot.radius; "
            f"voxels of {report.resolution:g} m leave no passage"
        )
    elif report.room < report.num_robots:
        report.errors.append(
            f"room for {report.room} of {report.num_robots} robots: use fewer (num_robots), or a smaller robot.radius"
        )
    if report.leaks:
        report.errors.append(
            f"{report.leaks:,} free voxels touch unknown space or the side of the box: close it with occupied voxels"
        )
    large = [size for size in report.components if size >= PIECE * report.components[0]]
    if len(large) > 1:
        told = ", ".join(f"{size / report.num_free:.0%}" for size in large)
        report.warnings.append(
            f"{len(large)} pieces of free space are not joined ({told}): a team explores the piece it starts in"
        )
    if report.flying and report.seeable_share < SEEABLE_SHARE:
        report.warnings.append(
            f"only {report.seeable_share:.0%} of the free voxels can be seen from where robots fit; the rest is "
            "narrow: take smaller voxels, or set robot.radius"
        )
