"""Goals for a team of real robots: needs NumPy and SciPy, and imports neither torch nor Warp."""

from .choices import CHOICES
from .planner import Plan, TeamPlanner
from .robot import RobotPlanner
from .shipped import shipped_names
from .words import Word

__all__ = ["CHOICES", "Plan", "RobotPlanner", "TeamPlanner", "Word", "shipped_names"]
