"""Checksums of maps: a run that goes on or is played on a map that has changed since says so."""

import hashlib
import warnings

from maexp.envs import PointCloudMap


def checksum(world: PointCloudMap) -> str:
    """Sixteen hexadecimal digits that follow from the points of a map."""
    digest = hashlib.sha256()
    for points in (world.free, world.obstacles, world.boundary):
        digest.update(str(points.shape).encode() + points.tobytes())
    return digest.hexdigest()[:16]


def checksums(maps: list[PointCloudMap]) -> dict[str, str]:
    """Name and checksum of every map."""
    return {world.name: checksum(world) for world in maps}


def changed_maps(saved: dict, maps: list[PointCloudMap]) -> str:
    """Which of `maps` are not what they were when the checkpoint `saved` was written: "a and b have", "" for none."""
    before = saved["maps"]
    changed = [name for name, digest in checksums(maps).items() if before.get(name, digest) != digest]
    more = f" and {len(changed) - 3} more" if len(changed) > 3 else ""
    return f"{', '.join(changed[:3])}{more} {'has' if len(changed) == 1 else 'have'}" if changed else ""


def warn_of_changed_maps(saved: dict, maps: list[PointCloudMap]) -> None:
    """Warn of those."""
    if changed := changed_maps(saved, maps):
        warnings.warn(f"{changed} changed since the run was started: its results are of other maps", stacklevel=2)
