"""Gymnasium's spaces for what enters and leaves the env, and the way between NumPy and tensordicts.

Observations follow the env's specs, so that a key that joins them appears here, too. Actions come in three kinds:

``region_offset``: the env's own, a region of 64 and an offset in it, [-1, 1]^2.
``region``: the region alone; the goal is its centre.
``goal``: a place of the map's extent, [-1, 1]^2, for libraries that know plain boxes only.

With the planner ``direct`` the action is the control, [-1, 1]^2, whatever was chosen.
"""

from __future__ import annotations

import numpy as np
import torch
from gymnasium import spaces
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Composite, TensorSpec

from maexp.kernels.types import REGIONS

ACTIONS = ("region_offset", "region", "goal")


def observation_space(spec: Composite, lead: int) -> spaces.Dict:
    """The space of one observation: ``spec`` without its first ``lead`` dimensions."""
    inner = {
        name: observation_space(one, lead) if isinstance(one, Composite) else _leaf(one, lead)
        for name, one in spec.items()
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


def to_numpy(values: TensorDictBase, space: spaces.Dict) -> dict:
    """``values`` in the shapes and types of ``space``."""
    return {
        name: to_numpy(values[name], one)
        if isinstance(one, spaces.Dict)
        else values[name].cpu().numpy().reshape(one.shape).astype(one.dtype, copy=False)
        for name, one in space.items()
    }


def check_kind(action: str) -> None:
    if action not in ACTIONS:
        raise ValueError(f"action={action!r} is unknown: choose one of {', '.join(ACTIONS)}")


def action_space(kind: str, direct: bool, robots: tuple[int, ...] = ()) -> spaces.Space:
    """The action of one robot, or of ``robots`` = (N,) together."""
    box = spaces.Box(-1.0, 1.0, (*robots, 2), np.float32)
    if direct or kind == "goal":
        return box
    count = REGIONS**2
    region = spaces.MultiDiscrete(np.full(robots, count)) if robots else spaces.Discrete(count)
    return region if kind == "region" else spaces.Dict(region=region, offset=box)


def to_action(actions, kind: str, direct: bool, shape: tuple[int, int], device) -> TensorDict:
    """The env's action, batch [E], from arrays of ``shape`` = (E, N), in the form that `action_space` describes."""
    if direct:
        parts = {"control": _box("control", actions, (*shape, 2))}
    elif kind == "goal":
        parts = _region_of(_box("goal", actions, (*shape, 2)))
    elif kind == "region":
        parts = {"region": _region(actions, shape), "offset": np.zeros((*shape, 2), np.float32)}
    else:
        if not isinstance(actions, dict) or not {"region", "offset"} <= set(actions):
            raise ValueError(f"the action is {type(actions).__name__}: give a dict of region and offset")
        parts = {"region": _region(actions["region"], shape), "offset": _box("offset", actions["offset"], (*shape, 2))}
    tensors = {name: torch.as_tensor(one, device=device) for name, one in parts.items()}
    inner = TensorDict(tensors, batch_size=shape, device=device)
    return TensorDict({"agents": {"action": inner}}, batch_size=shape[:1], device=device)


def _region_of(goal: np.ndarray) -> dict[str, np.ndarray]:
    """Region and offset of a goal in shares of half the extent; a goal outside counts as its border."""
    side = REGIONS
    cell = (np.nan_to_num(goal).clip(-1, 1) + 1) / 2 * side  # NaN is refused by the env, by the offset
    index = np.floor(cell).clip(0, side - 1)
    offset = np.where(np.isnan(goal), goal, 2 * (cell - index) - 1).astype(np.float32)
    index = index.astype(np.int64)
    return {"region": index[..., 0] * side + index[..., 1], "offset": offset}


def _region(values, shape) -> np.ndarray:
    region, last = _shaped("region", values, shape), REGIONS**2 - 1
    if region.dtype.kind not in "iu" or (region < 0).any() or (region > last).any():
        raise ValueError(f"region={region.tolist()} must hold whole numbers of 0 to {last}")
    return region.astype(np.int64)


def _box(name: str, values, shape) -> np.ndarray:
    return _shaped(name, values, shape).astype(np.float32)


def _shaped(name: str, values, shape) -> np.ndarray:
    array = np.asarray(values)
    if array.shape != tuple(shape) or array.dtype.kind not in "iuf":
        raise ValueError(f"{name} has shape {list(array.shape)} of {array.dtype}: give numbers of shape {list(shape)}")
    return array
