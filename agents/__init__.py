"""Networks, the six algorithms, training and evaluation.

Names are looked up on first use, so that `maexp maps ...` need not wait for TorchRL.
"""

from maexp.envs.lazy import lazy_names

_HOMES = {
    "make_policy": "actor",
    "make_critic": "algorithms",
    "make_loss": "algorithms",
    "ALGORITHMS": "algorithms",
    "ModelConfig": "model",
}
__all__ = ["ALGORITHMS", "ModelConfig", "make_critic", "make_loss", "make_policy"]

__getattr__ = lazy_names(__name__, _HOMES)
