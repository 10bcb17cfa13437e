"""Goals for a team of real robots: needs NumPy and SciPy, and imports neither torch nor Warp."""

from maexp.agents.deploy.planner.align import Alignment, align_grids
from maexp.agents.deploy.planner.bundle import shipped_names
from maexp.agents.deploy.planner.messages import Word
from maexp.agents.deploy.planner.robot_planner import RobotPlanner
from maexp.agents.deploy.planner.scene import CHOICES
from maexp.agents.deploy.planner.team_planner import Plan, TeamPlanner

__all__ = ["CHOICES", "Alignment", "Plan", "RobotPlanner", "TeamPlanner", "Word", "align_grids", "shipped_names"]
