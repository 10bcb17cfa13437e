"""Networks, the six algorithms, training and evaluation.

Names are looked up on first use, so that `maexp maps ...` need not wait for TorchRL.
"""

from maexp.kernels.lazy import lazy_names

_HOMES = {
    "make_env": "cli.env",
    "make_policy": "training.make",
    "make_critic": "algorithms.registry",
    "make_loss": "algorithms.registry",
    "ALGORITHMS": "algorithms.registry",
    "ModelConfig": "config.model",
}
__all__ = ["ALGORITHMS", "ModelConfig", "make_critic", "make_env", "make_loss", "make_policy"]

__getattr__ = lazy_names(__name__, _HOMES)
