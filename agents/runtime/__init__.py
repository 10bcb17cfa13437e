"""The robots' API, public name of `maexp.agents.deploy.planner`: NumPy and SciPy, neither torch nor Warp."""

from maexp.agents.deploy.planner import *  # noqa: F403
from maexp.agents.deploy.planner import __all__ as __all__
