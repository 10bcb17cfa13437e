"""Networks, the six algorithms, training and evaluation.

Names are looked up on first use, so that `maexp maps ...` need not wait for TorchRL.
"""

import importlib

_HOMES = {
    "make_policy": "actor",
    "make_critic": "algorithms",
    "make_loss": "algorithms",
    "ALGORITHMS": "algorithms",
    "ModelConfig": "model",
}
__all__ = ["ALGORITHMS", "ModelConfig", "make_critic", "make_loss", "make_policy"]


def __getattr__(name: str):
    if name not in _HOMES:
        raise AttributeError(f"module 'maexp.agents' has no attribute {name!r}")
    return getattr(importlib.import_module(f"maexp.agents.{_HOMES[name]}"), name)
