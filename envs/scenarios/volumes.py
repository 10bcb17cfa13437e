"""Scenarios of voxels: the only module of this room that loads what makes them."""

from maexp.envs.volume.generate import build_volume as build
from maexp.envs.volume.map import VoxelMap


def build_volume(index: int, *, scenario: str) -> VoxelMap:
    """Map number ``index`` of a scenario of `maexp.envs.volume.generate`."""
    return build(scenario, index)
