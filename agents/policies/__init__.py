"""Policies to play and compare: the classical planners, and trained ones as a folder, written and read.

Names are looked up on first use, as those of `maexp.agents`.
"""

from maexp.kernels.lazy import lazy_names

_NAMES = ("CLASSICAL", "POLICIES", "REFERENCES", "FrontierPlanner")
__all__ = ["CLASSICAL", "POLICIES", "REFERENCES", "FrontierPlanner"]

__getattr__ = lazy_names(__name__, dict.fromkeys(_NAMES, "classical"))
