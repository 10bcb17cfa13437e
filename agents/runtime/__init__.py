"""Goals for a team of real robots: needs NumPy and SciPy, and imports neither torch nor Warp."""

from .choices import CHOICES
from .planner import Plan, TeamPlanner
from .shipped import shipped_names

__all__ = ["CHOICES", "Plan", "TeamPlanner", "shipped_names"]
