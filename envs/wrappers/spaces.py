"""Gymnasium's spaces for what enters and leaves the env, and the way between NumPy and tensordicts.

Observations follow the env's specs, so that a key that joins them appears here, too. Actions come in four kinds:

``targets``: one of the frontier targets that the robot is shown; ``action_mask`` tells which there are.
``region_offset``: a region of 64 and an offset in it, [-1, 1]^2.
``region``: the region alone; the goal is its centre.
``goal``: a place of the map's extent, [-1, 1]^2, for libraries that know plain boxes only.

With the planner ``direct`` the action is the control, [-1, 1]^2, whatever was chosen. Where nothing was chosen it is
what the env itself takes: targets with ``ObservationConfig(targets=...)``, else ``region_offset``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from gymnasium import spaces
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Composite, TensorSpec

from maexp.envs.config import ObservationConfig, PlannerConfig
from maexp.kernels.types import REGIONS

if TYPE_CHECKING:
    from maexp.envs.environment import ExplorationEnv

ACTIONS = ("targets", "region_offset", "region", "goal")
SHOWN = 24  # targets that ``action="targets"`` shows unless ``observation`` says how many
MASK = "action_mask"  # what other projects call ``targets_mask``


def settle(action: str | None, settings: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """The kind of action, "control" with the planner ``direct``, and the settings of an env that takes it.

    Raises:
        ValueError: there is no such kind, or the planner cannot take it.
    """
    planner, observation = (settings.get(name) for name in ("planner", "observation"))
    direct = isinstance(planner, PlannerConfig) and planner.name == "direct"
    if action is None:
        shows = isinstance(observation, ObservationConfig) and observation.targets
        action = "targets" if shows else "region_offset"
    elif action not in ACTIONS:
        raise ValueError(f"action={action!r} is unknown: choose one of {', '.join(ACTIONS)}")
    if action == "targets" and not direct:
        observation = ObservationConfig(pictures=False) if observation is None else observation
        if isinstance(observation, ObservationConfig):  # the env tells what else it is
            settings = settings | {"observation": replace(observation, targets=observation.targets or SHOWN)}
    elif action == "targets":
        raise ValueError("planner=direct takes controls, action='targets' chooses goals: leave out one of the two")
    return "control" if direct else action, settings


def named(observation: Mapping[str, Any], kind: str) -> dict[str, Any]:
    """What a robot sees, or its spec, under the names that other projects expect."""
    return {
        MASK if kind == "targets" and name == "targets_mask" else name: value for name, value in observation.items()
    }


def observation_space(spec: Mapping[str, TensorSpec], lead: int) -> spaces.Dict:
    """The space of one observation: ``spec`` without its first ``lead`` dimensions."""
    inner = {
        name: observation_space(part, lead) if isinstance(part, Composite) else _leaf(part, lead)
        for name, part in spec.items()
    }
    return spaces.Dict(inner)


def _leaf(spec: TensorSpec, lead: int) -> spaces.Space:
    shape = tuple(spec.shape[lead:]) or (1,)
    if spec.dtype == torch.bool:
        return spaces.MultiBinary(shape if len(shape) > 1 else shape[0])
    kind = np.dtype(str(spec.dtype).removeprefix("torch."))
    if kind.kind == "f":
        return spaces.Box(-np.inf, np.inf, shape, kind.type)
    return spaces.Box(np.iinfo(kind).min, np.iinfo(kind).max, shape, kind.type)


def to_numpy(values: Mapping[str, torch.Tensor] | TensorDictBase, space: spaces.Dict) -> dict:
    """``values`` in the shapes and types of ``space``."""
    return {
        name: to_numpy(values[name], part)
        if isinstance(part, spaces.Dict)
        else values[name].cpu().numpy().reshape(part.shape).astype(part.dtype, copy=False)
        for name, part in space.items()
    }


def action_space(kind: str, targets: int, robots: tuple[int, ...] = ()) -> spaces.Space:
    """The action of one robot, or of ``robots`` = (N,) together, where it is shown so many targets."""
    box = spaces.Box(-1.0, 1.0, (*robots, 2), np.float32)
    if kind in ("control", "goal"):
        return box
    count = targets if kind == "targets" else REGIONS**2
    choice = spaces.MultiDiscrete(np.full(robots, count)) if robots else spaces.Discrete(count)
    return spaces.Dict(region=choice, offset=box) if kind == "region_offset" else choice


def to_action(actions, kind: str, targets: int, env: ExplorationEnv) -> TensorDict:
    """The env's action, batch [E], from arrays of shape [E, N], in the form that `action_space` describes."""
    shape = (env.num_envs, env.num_robots)
    if kind == "control":
        parts = {"control": _box("control", actions, (*shape, 2))}
    elif kind == "targets":
        parts = {"target": _choice("target", actions, shape, targets)}
    elif kind == "goal":
        parts = {"goal": _in_metres(env, _box("goal", actions, (*shape, 2)))}
    elif kind == "region":
        parts = {"region": _choice("region", actions, shape), "offset": np.zeros((*shape, 2), np.float32)}
    else:
        if not isinstance(actions, dict) or not {"region", "offset"} <= set(actions):
            raise ValueError(f"the action is {type(actions).__name__}: give a dict of region and offset")
        region, offset = _choice("region", actions["region"], shape), actions["offset"]
        parts = {"region": region, "offset": _box("offset", offset, (*shape, 2))}
    tensors = {name: torch.as_tensor(part, device=env.device) for name, part in parts.items()}
    inner = TensorDict(tensors, batch_size=shape, device=env.device)
    return TensorDict({"agents": {"action": inner}}, batch_size=shape[:1], device=env.device)


def check_seed(seed) -> int:
    """The seed that `reset` is given.

    Raises:
        ValueError: it is no whole number, 0 or more.
    """
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise ValueError(f"seed={seed!r} must be a whole number, 0 or more: all random numbers come from it")
    return int(seed)


def _in_metres(env: ExplorationEnv, goal: np.ndarray) -> torch.Tensor:
    """Goals [m] in shares of half the extent, from its middle; one outside counts as its border, NaN stays."""
    number = env.simulation.tensors["map_id"].long()
    low, high = (env.simulation.map_tensors[name][number].unsqueeze(1) for name in ("lower", "upper"))
    return low + (torch.from_numpy(goal).to(env.device).clamp(-1.0, 1.0) + 1.0) / 2.0 * (high - low)


def _choice(name: str, values, shape, count: int = REGIONS**2) -> np.ndarray:
    chosen = _shaped(name, values, shape)
    if chosen.dtype.kind not in "iu" or (chosen < 0).any() or (chosen >= count).any():
        raise ValueError(f"{name}={chosen.tolist()} must hold whole numbers of 0 to {count - 1}")
    return chosen.astype(np.int64)


def _box(name: str, values, shape) -> np.ndarray:
    return _shaped(name, values, shape).astype(np.float32)


def _shaped(name: str, values, shape) -> np.ndarray:
    array = np.asarray(values)
    if array.shape != tuple(shape) or array.dtype.kind not in "iuf":
        raise ValueError(f"{name} has shape {list(array.shape)} of {array.dtype}: give numbers of shape {list(shape)}")
    return array
