"""The name that `maexp.agents.config.algorithms` had up to version 0.2."""

from maexp.agents.config.algorithms import *  # noqa: F403
