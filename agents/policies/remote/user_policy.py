"""One's own policies: `module:function` of a module in the current folder or installed, and plug-ins.

What is named gets the env and returns a policy on tensordicts; or it is a class with `act`, a foreign policy
(`maexp.agents.policies.remote.numpy_policy`). Whatever goes wrong inside is told in a sentence that names the policy.
"""

from __future__ import annotations

import hashlib
import importlib
import inspect
import os
import re
import sys
from collections.abc import Callable
from functools import reduce
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase

from maexp.agents.errors import UserError
from maexp.agents.policies.names import policy_plugins
from maexp.agents.policies.remote.numpy_policy import as_policy, describe_error
from maexp.agents.policies.remote.worker import GROUP
from maexp.envs import ExplorationEnv
from maexp.kernels.types import REGIONS

REFERENCE = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*(\.[^\W\d]\w*)*")
WANTED = "give a function that takes the env and returns a policy on tensordicts, or a class with act"


def is_module_reference(spec: str) -> bool:
    """Whether a word reads as module:function."""
    return REFERENCE.fullmatch(spec) is not None


def find_user_policy(spec: str, setting: str = "policy") -> Callable[..., Any]:
    """What `spec`, module:function or the name of a plug-in, stands for.

    Raises:
        UserError: there is no such module, it has nothing of that name, or that cannot be called.
    """
    plug_in = policy_plugins().get(spec)
    reference = spec if plug_in is None else plug_in.value.partition("[")[0].replace(" ", "")
    given = f"{setting}={spec}" + ("" if plug_in is None else f" (of the package {_package(plug_in)}, {reference})")
    if not is_module_reference(reference):
        raise UserError(f"{given} names no function: an entry point of {GROUP} is written module:function.")
    module, _, names = reference.partition(":")
    place = _import(module, given)
    try:
        found = reduce(getattr, names.split("."), place)
    except AttributeError as error:
        own = {name: thing for name, thing in vars(place).items() if getattr(thing, "__module__", "") == module}
        there = [name for name, thing in own.items() if callable(thing)]
        listed = f"it has {', '.join(there[:6])}" if there else "it holds no function"
        raise UserError(f"{given}: {module} has no {names}: {listed}.") from error
    if not callable(found):
        instead = "name its class" if hasattr(found, "act") else WANTED
        raise UserError(f"{given}: {names} is a {type(found).__name__}, which cannot be called: {instead}.")
    return found


def _package(plug_in: metadata.EntryPoint) -> str:
    return plug_in.dist.name if plug_in.dist is not None else "?"


def _import(module: str, given: str) -> Any:
    """A module; those of the current folder come first, as in `python -m`."""
    here = os.getcwd()
    sys.path.insert(0, here)
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is not None and (module == error.name or module.startswith(f"{error.name}.")):
            raise UserError(
                f"{given}: there is no module {error.name}, neither in this folder nor installed: "
                "write it as in import, without .py."
            ) from error
        raise UserError(f"{given}: importing {module} raised {describe_error(error)}.") from error
    except (Exception, SystemExit) as error:
        raise UserError(f"{given}: importing {module} raised {describe_error(error)}.") from error
    finally:
        sys.path.remove(here)
        if here not in sys.path:
            sys.path.append(here)  # what the module imports later may lie beside it


def is_numpy_policy(found: Callable) -> bool:
    """Whether this is a class of NumPy policies."""
    return inspect.isclass(found) and callable(getattr(found, "act", None))


def read_source(found: Callable) -> str:
    """Sixteen hexadecimal digits that change with the file of what was found; "" where there is none."""
    try:
        path = inspect.getsourcefile(found)
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()[:16]
    except (OSError, TypeError):
        return ""


def make_user_policy(found: Callable, env: ExplorationEnv, name: str) -> Callable[[TensorDictBase], TensorDictBase]:
    """The policy of what `find_user_policy` has found.

    Raises:
        UserError: making it raises, or gives nothing that can be called.
    """
    if is_numpy_policy(found):
        return as_policy(env, found, name)
    try:
        policy = found(env)
    except Exception as error:
        raise UserError(
            f"policy {name}: calling it with the env raised {describe_error(error)}.{_missing_targets(error, env)}"
        ) from error
    if not callable(policy):
        what = "nothing" if policy is None else f"a {type(policy).__name__}"
        instead = "name its class itself" if hasattr(policy, "act") else "return a policy on tensordicts"
        raise UserError(f"policy {name}: called with the env it returned {what}: {instead}.")
    return OwnPolicy(policy, env, name)


def _missing_targets(error: Exception, env: ExplorationEnv) -> str:
    """What to do where a policy looks for targets that the env does not show."""
    wants = isinstance(error, KeyError) and "target" in str(error) and not env.observation_config.targets
    return " The env shows no targets: add observation.targets=24." if wants else ""


class OwnPolicy:
    """A policy on tensordicts that is looked after: what it raises, or writes instead of an action, is told.

    Args:
        policy: tensordict -> tensordict, or one that writes into the one that it gets.
        env: says which actions there are.
        name: of the policy, for messages.
    """

    def __init__(self, policy: Callable, env: ExplorationEnv, name: str):
        self.policy, self.name, self.env = policy, name, env
        self.shape = (env.num_envs, env.num_robots)
        self.targets = env.observation_config.targets
        self.direct = env.planner_config.name == "direct"

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        try:
            answer = self.policy(tensordict)
        except Exception as error:
            raise UserError(
                f"policy {self.name} raised {describe_error(error)}.{_missing_targets(error, self.env)}"
            ) from error
        answer = tensordict if answer is None else answer
        if not isinstance(answer, TensorDictBase):
            raise UserError(f"policy {self.name} returned a {type(answer).__name__}: return the tensordict it gets.")
        action = answer.get(("agents", "action"), None)
        if wrong := self._find_wrong({} if action is None else dict(action.items())):
            raise UserError(f'policy {self.name} {wrong}: ("agents", "action") must hold {self._wanted()}.')
        return answer

    def _wanted(self) -> str:
        lead = f"[{self.shape[0]}, {self.shape[1]}"
        if self.direct:
            return f"control, float {lead}, 2]"
        goals = f"goal, float {lead}, 2] in metres, or region, int {lead}] from 0 to {REGIONS**2 - 1}, and offset, "
        goals += f"float {lead}, 2]"
        return f"target, int {lead}] from 0 to {self.targets - 1}, or {goals}" if self.targets else goals

    def _find_wrong(self, action: dict[str, torch.Tensor]) -> str:
        """What is wrong with an action, to complete "policy NAME ..."; "" for nothing."""
        whole = {"region": REGIONS**2, "target": self.targets}
        alone = "control" if self.direct else next((key for key in ("target", "goal") if key in action), None)
        heads = (alone,) if alone else ("region", "offset")
        for head in heads:
            value = action.get(head)
            if value is None:
                return f"wrote no {head}" if action else "wrote no action"
            shape = self.shape if head in whole else (*self.shape, 2)
            if tuple(value.shape) != shape:
                return f"wrote a {head} of shape {list(value.shape)}"
            if head in whole and (value.is_floating_point() or value.dtype == torch.bool):
                return f"wrote a {head} of {str(value.dtype).removeprefix('torch.')}"
            if head in whole and not bool(((value >= 0) & (value < whole[head])).all()):
                wrong = value[(value < 0) | (value >= whole[head])]
                return f"wrote {head} {int(wrong[0])}, of {whole[head]} there are"
            if head not in whole and not bool(value.isfinite().all()):
                return f"wrote a {head} that is NaN or infinite"
        return ""
