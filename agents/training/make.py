"""Policies for an env: `make_policy` makes a new one, `load_policy` loads one by its name."""

from __future__ import annotations

from collections.abc import Callable
from os import PathLike, fspath
from typing import overload

from torchrl.modules import ProbabilisticActor

from maexp.agents.config.model import ModelConfig
from maexp.agents.models import actor
from maexp.agents.policies.registry import find_named_policy
from maexp.envs import ExplorationEnv


@overload
def make_policy(env: ExplorationEnv, model: str | ModelConfig = "small") -> ProbabilisticActor: ...


@overload
def make_policy(name: str | PathLike, env: ExplorationEnv) -> Callable: ...


def make_policy(what=None, /, env=None, model=None):
    """A new policy that can be trained: networks of a size for the specs of `env` (`maexp.agents.models.actor`).

    Args:
        env: the environment.
        model: "small", "paper" or a `ModelConfig`.

    `make_policy(name, env)` is `load_policy(name, env)`.

    Raises:
        ValueError: the env shows nothing that the networks could read.
    """
    if isinstance(what, str | PathLike):
        return load_policy(what, env)
    what, size = (env, None) if what is None else (what, env)
    return actor.make_policy(what, model or size or "small")


def load_policy(name: str | PathLike, env: ExplorationEnv) -> Callable:
    """The policy of that name, which reads and writes tensordicts of `env`.

    Args:
        name: what `policy=` takes on the command line: a classical planner, a policy that ships, the folder of an
            exported one, a run or a checkpoint, `module:function`, or a plug-in.
        env: it must show what the policy looks at (``env.observation_config``).

    Raises:
        UserError: no policy of that name, a damaged one, or one that does not fit the env.
    """
    return find_named_policy(fspath(name)).make(env)
