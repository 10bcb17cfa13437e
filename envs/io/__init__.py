"""Maps from files: floor plans of ROS, point clouds, meshes, octrees, and MAexp's own arrays.

Names are looked up on first use: the settings alone need neither torch nor Warp.
"""

from maexp.kernels.lazy import lazy_names

_HOMES = {
    "ImportOptions": "options",
    "ImportReport": "report",
    "ImportStep": "report",
    "draw_import": "report",
    "export_ros_map": "map_server",
    "import_map": "formats",
    "import_map_with_report": "formats",
}
__all__ = [
    "ImportOptions",
    "ImportReport",
    "ImportStep",
    "draw_import",
    "export_ros_map",
    "import_map",
    "import_map_with_report",
]

__getattr__ = lazy_names(__name__, _HOMES)
