"""Maps in three dimensions: voxels, their generators, what sensors can see of them, and their import.

Names are looked up on first use.
"""

from maexp.kernels.lazy import lazy_names

_HOMES = {
    "Body": "reach",
    "VolumeReport": "checker",
    "VoxelMap": "map",
    "check_volume": "checker",
    "draw_volume": "picture",
    "import_volume": "importing",
    "seeable": "visibility",
}
__all__ = [
    "Body",
    "VolumeReport",
    "VoxelMap",
    "check_volume",
    "draw_volume",
    "import_volume",
    "seeable",
]

__getattr__ = lazy_names(__name__, _HOMES)
