"""Maps from files: floor plans of ROS, point clouds, meshes, octrees, and MAexp's own arrays."""

from .api import import_map, import_map_with_report
from .export import export_ros_map
from .options import ImportOptions
from .picture import draw_import
from .report import ImportReport, ImportStep

__all__ = [
    "ImportOptions",
    "ImportReport",
    "ImportStep",
    "draw_import",
    "export_ros_map",
    "import_map",
    "import_map_with_report",
]
