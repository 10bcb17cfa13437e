"""Recorded launches, replayed with little Python in between."""

import ctypes
from collections.abc import Sequence
from functools import cache, partial
from typing import Any

import warp as wp

KNOWN = wp.config.version.startswith("1.19.")
"""Whether this is a Warp whose way of calling CPU kernels (nowhere documented) is the one below."""


CPU_LANES = 1
"""Threads that share the work of a robot or a row on the CPU, where a thread costs more than an item."""


def lanes_on(device: wp.Device, most: int) -> int:
    """Threads that share the work of a robot or a row."""
    return CPU_LANES if device.is_cpu else most


@cache
def arguments_struct(types: tuple[type, ...]) -> type[ctypes.Structure]:
    """The C struct in which a CPU kernel takes arguments of these types."""
    fields = [(f"argument_{k}", one) for k, one in enumerate(types)]
    return type("Arguments", (ctypes.Structure,), {"_fields_": fields})


class RecordedLaunch:
    """A launch that may be repeated. On the CPU its arguments are packed once.

    Warp packs them anew at every launch of a recorded command: 5 us each, a fifth of what 32 robots take.
    """

    def __init__(
        self, kernel: wp.Kernel, dim: int | tuple[int, ...], inputs: Sequence, outputs: Sequence, device: wp.Device
    ):
        self.kernel = kernel
        self.command = wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=device, record_cmd=True)
        self.call: Any = None
        if KNOWN and device.is_cpu and self.command.block_dim == 1:
            bounds, *arguments = self.command.params
            packed = arguments_struct(tuple(type(one) for one in arguments))(*arguments)
            self.call = partial(self.command.hooks.forward, ctypes.byref(bounds), ctypes.byref(packed))

    def launch(self, stream: wp.Stream | None = None) -> None:
        if self.call is None:
            self.command.launch(stream)
        else:
            self.call()
