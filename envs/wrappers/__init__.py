"""The env under other projects' interfaces: PettingZoo's ParallelEnv, Gymnasium's VectorEnv and Env."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from maexp.envs.wrappers.gymnasium import TeamEnv, TeamVectorEnv
    from maexp.envs.wrappers.pettingzoo import TeamParallelEnv

__all__ = ["parallel_env", "team_env", "vector_env"]


def parallel_env(map, num_robots: int = 3, **settings) -> TeamParallelEnv:
    """One team as a PettingZoo ``ParallelEnv``; see `maexp.envs.wrappers.pettingzoo.TeamParallelEnv` for the settings.

    Args:
        map: a `PointCloudMap`, or several of which every reset chooses one.
        num_robots: robots of the team, the agents ``robot_0``, ``robot_1``, ...

    Raises:
        ImportError: PettingZoo is not installed.
    """
    try:
        from maexp.envs.wrappers.pettingzoo import TeamParallelEnv
    except ImportError as error:
        raise ImportError('parallel_env needs PettingZoo: pip install "maexp[pettingzoo]"') from error
    return TeamParallelEnv(map, num_robots, **settings)


def vector_env(maps, num_envs: int = 1, num_robots: int = 3, **settings) -> TeamVectorEnv:
    """``num_envs`` teams as a Gymnasium ``VectorEnv``; see `maexp.envs.wrappers.gymnasium.TeamVectorEnv`.

    Args:
        maps: a `PointCloudMap`, or several of which every reset chooses one.
        num_envs: teams in the batch.
        num_robots: robots of a team, which acts as one agent.

    Raises:
        ImportError: Gymnasium is not installed.
    """
    try:
        from maexp.envs.wrappers.gymnasium import TeamVectorEnv
    except ImportError as error:
        raise ImportError('vector_env needs Gymnasium: pip install "maexp[gymnasium]"') from error
    return TeamVectorEnv(maps, num_envs, num_robots, **settings)


def team_env(map, num_robots: int = 3, **settings) -> TeamEnv:
    """One team as a Gymnasium ``Env``; see `maexp.envs.wrappers.gymnasium.TeamEnv`.

    Args:
        map: a `PointCloudMap`, or several of which every reset chooses one.
        num_robots: robots of the team, which acts as one agent.

    Raises:
        ImportError: Gymnasium is not installed.
    """
    try:
        from maexp.envs.wrappers.gymnasium import TeamEnv
    except ImportError as error:
        raise ImportError('team_env needs Gymnasium: pip install "maexp[gymnasium]"') from error
    return TeamEnv(map, num_robots, **settings)
