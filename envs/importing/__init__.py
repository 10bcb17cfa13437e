"""Maps from files: floor plans of ROS, point clouds, meshes, octrees, and MAexp's own arrays.

Names are looked up on first use: the settings alone need neither torch nor Warp.
"""

import importlib

_HOMES = {
    "ImportOptions": "options",
    "ImportReport": "report",
    "ImportStep": "report",
    "draw_import": "picture",
    "export_ros_map": "export",
    "import_map": "api",
    "import_map_with_report": "api",
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


def __getattr__(name: str):
    if name not in _HOMES:
        raise AttributeError(f"module 'maexp.envs.importing' has no attribute {name!r}")
    return getattr(importlib.import_module(f"maexp.envs.importing.{_HOMES[name]}"), name)
