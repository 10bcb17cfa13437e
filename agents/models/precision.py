"""Networks have float32 weights, whatever the default dtype of torch is: observations are float32."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def float32_modules() -> Iterator[None]:
    """Modules that are built within it, or by a function that it decorates, have float32 parameters and buffers."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        yield
    finally:
        torch.set_default_dtype(before)
