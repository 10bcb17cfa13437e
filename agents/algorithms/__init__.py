"""The algorithms: their table, losses, estimates of advantages and updaters."""

from maexp.kernels.lazy import lazy_names

__all__ = ["ALGORITHMS"]

__getattr__ = lazy_names(__name__, {"ALGORITHMS": "registry"})
