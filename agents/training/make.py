"""`make_policy`: a policy for an env, by its name or new."""

from __future__ import annotations

from collections.abc import Callable
from os import PathLike, fspath
from typing import overload

from torchrl.modules import ProbabilisticActor

from maexp.agents.config.model import ModelConfig
from maexp.agents.models import actor
from maexp.agents.policies.registry import find_player
from maexp.envs import ExplorationEnv


@overload
def make_policy(env: ExplorationEnv, model: str | ModelConfig = "small") -> ProbabilisticActor: ...


@overload
def make_policy(name: str | PathLike, env: ExplorationEnv) -> Callable: ...


def make_policy(what=None, /, env=None, model=None):
    """The policy that a name stands for, or a new one that can be trained.

    `make_policy(name, env)`: a classical planner, a policy that ships, the folder of an exported one, a run or a
    checkpoint, `module:function`, or a plug-in: what `policy=` takes on the command line. It reads and writes
    tensordicts of `env`, which must show what it looks at (``env.observation_config``).

    `make_policy(env, model="small")`: new networks of that size for the specs of `env`
    (`maexp.agents.models.actor.make_policy`).

    Raises:
        UserError: no policy of that name, a damaged one, or one that does not fit the env.
        ValueError: the env shows nothing that the networks could read.
    """
    if isinstance(what, str | PathLike):
        return find_player(fspath(what)).make(env)
    what, size = (env, None) if what is None else (what, env)
    return actor.make_policy(what, model or size or "small")
