"""A policy of the arena in Python, in a process of its own: `python -m maexp.agents.policies.remote.worker WORD`.

WORD is module:Class, the name of a plug-in (entry point of the group `maexp.policies`), or what
`maexp.agents.deploy.planner.TeamPlanner` takes. Needs NumPy and msgpack, and what the policy itself imports. What the
policy
prints goes to standard error: standard output is the wire's.
"""

from __future__ import annotations

import importlib
import os
import sys
import traceback
from collections.abc import Callable
from functools import partial, reduce
from importlib import metadata
from typing import Any

import numpy as np

from maexp.agents.policies.remote import protocol

GROUP = "maexp.policies"


def main(spec: str) -> int:
    """Answer until the input ends."""
    inbox, outbox = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    agent = None
    while (message := protocol.read(inbox)) is not None:
        try:
            if message["type"] == "hello":
                make = find(spec)
                agent = None if make is None else make()
                answer = {"type": "hello", "version": protocol.VERSION, "foreign": make is not None}
            elif message["type"] == "reset":
                if hasattr(agent, "reset"):
                    agent.reset(message["episode"])
                answer = {"type": "ready"}
            else:
                answer = {"type": "goals", "goals": to_array(agent.act(message["observation"]))}
        except Exception as error:
            traceback.print_exc()
            answer = {"type": "error", "message": describe(error)}
        protocol.write(outbox, answer)
    return 0


def find(spec: str) -> Callable[[], Any] | None:
    """What makes the policy; None: the word names something that is no class with `act`."""
    plug_in = next(
        (entry_point for entry_point in metadata.entry_points(group=GROUP) if entry_point.name == spec), None
    )
    reference = spec if plug_in is None else plug_in.value.partition("[")[0].replace(" ", "")
    if ":" not in reference or os.path.exists(reference):
        from maexp.agents.deploy.planner.arena_policy import TeamAgent

        return partial(TeamAgent, spec)
    module, _, names = reference.partition(":")
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    found = reduce(getattr, names.split("."), importlib.import_module(module))
    if isinstance(found, type) and not any({"act", "__call__"} & set(vars(base)) for base in found.__mro__):
        raise TypeError(f"{names} is a class without act(observation)")
    return found if callable(found) and hasattr(found, "act") else None


def to_array(goals: Any) -> np.ndarray:
    """Goals as an array that can be sent; the run checks its shape.

    Raises:
        ValueError: they are no numbers.
    """
    array = np.asarray(goals)
    if array.dtype.kind not in "iuf":
        what = "nothing" if goals is None else f"a {type(goals).__name__}"
        raise ValueError(f"act() returned {what}, and no goals: numbers [robots, 2] in metres, NaN for one that stays")
    return array.astype(np.float64)


def describe(error: BaseException) -> str:
    """ValueError in planner.py, line 12: what it says."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if frame.filename != __file__]
    place = f" in {os.path.basename(own[-1].filename)}, line {own[-1].lineno}" if own else ""
    text = " ".join(str(error).split()).rstrip(".")[:300]
    return f"{type(error).__name__}{place}{f': {text}' if text else ''}"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
