"""Goals for a team of real robots: needs NumPy and SciPy, and imports neither torch nor Warp."""

from .choices import CHOICES
from .planner import Plan, TeamPlanner
from .robot import RobotPlanner, Word
from .shipped import shipped_names

__all__ = ["CHOICES", "Plan", "RobotPlanner", "TeamPlanner", "Word", "shipped_names"]
