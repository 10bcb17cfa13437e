"""Where kernels are launched: on torch's current stream, at once, or recorded and replayed with little Python.

Nothing else calls `wp.launch`: Warp's own stream on a GPU knows nothing of torch's, so tensors that torch has just
filled, or is about to read, would be met too early or too late.
"""

import ctypes
import os
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from typing import Any

import torch
import warp as wp

from maexp.kernels.startup import KNOWN

Launch = Callable[[wp.Kernel, int | tuple[int, ...], Sequence], None]
"""``launch(kernel, dim, arguments)`` launches a kernel at once, or records it."""

EAGER = os.environ.get("MAEXP_EAGER", "0") not in ("", "0")
"""Debugging: every stage runs anew instead of being replayed, so that a breakpoint in it stops. Same results,
slower."""

CPU_LANES = 1
"""Threads that share the work of a robot or a row on the CPU, where a thread costs more than an item."""


def lanes_on(device: wp.Device, most: int) -> int:
    """Threads that share the work of a robot or a row."""
    return CPU_LANES if device.is_cpu else most


def current_stream(device: wp.Device) -> wp.Stream | None:
    """Torch's current stream on a device; None on the CPU."""
    return None if device.is_cpu else wp.stream_from_torch(torch.cuda.current_stream(wp.device_to_torch(device)))


def launch_on(device: wp.Device | torch.device | str) -> Launch:
    """``launch(kernel, dim, arguments)`` on a device, in order with what torch does there."""
    device = wp.get_device(str(device))

    def launch(kernel: wp.Kernel, dim: int | tuple[int, ...], arguments: Sequence) -> None:
        wp.launch(kernel, dim=dim, inputs=arguments, device=device, stream=current_stream(device))

    return launch


def launch_named(launch: Launch, kernel: wp.Kernel, dim: int | tuple[int, ...], values: Mapping[str, Any]) -> None:
    """Launch a kernel with the values that its parameters are named after; there may be more."""
    names = [argument.label for argument in kernel.adj.args]
    missing = [name for name in names if name not in values]
    if missing:
        raise ValueError(f"{kernel.key} takes {', '.join(missing)}, which nothing here is named")
    launch(kernel, dim, [values[name] for name in names])


def view(tensor: torch.Tensor, dtype: type | None = None) -> Any:
    """What a kernel takes for a contiguous tensor that outlives the launch, in half the time of `wp.from_torch`.

    ``dtype`` is given for vectors. The kernel believes that the numbers are of its own type: nobody checks.
    """
    return wp.from_torch(tensor, dtype=dtype, return_ctype=True)


def finish_filling(device: wp.Device | torch.device | str) -> None:
    """Wait for arrays that Warp has filled on its own stream before they are used on torch's."""
    device = wp.get_device(str(device))
    if not device.is_cpu:
        wp.synchronize_device(device)


@cache
def arguments_struct(types: tuple[type, ...]) -> type[ctypes.Structure]:
    """The C struct in which a CPU kernel takes arguments of these types."""
    fields = [(f"argument_{k}", kind) for k, kind in enumerate(types)]
    return type("Arguments", (ctypes.Structure,), {"_fields_": fields})


class RecordedLaunch:
    """A launch that may be repeated. On the CPU its arguments are packed once.

    Warp packs them anew at every launch of a recorded command: 5 us each, a fifth of what 32 robots take.
    """

    def __init__(self, kernel: wp.Kernel, dim: int | tuple[int, ...], arguments: Sequence, device: wp.Device):
        self.kernel, self.device = kernel, device
        self.command = wp.launch(kernel, dim=dim, inputs=arguments, device=device, record_cmd=True)
        self.call: Any = None
        if KNOWN and device.is_cpu and self.command.block_dim == 1:
            bounds, *arguments = self.command.params
            packed = arguments_struct(tuple(type(argument) for argument in arguments))(*arguments)
            self.call = partial(self.command.hooks.forward, ctypes.byref(bounds), ctypes.byref(packed))

    def launch(self, stream: wp.Stream | None = None) -> None:
        if self.call is None:
            self.command.launch(stream)
        else:
            self.call()


class EagerStage:
    """A stage in the place of its recorded launches: it runs from its first line each time (`EAGER`)."""

    def __init__(self, stage: Callable[[Launch], None], device: wp.Device):
        self.stage, self.device = stage, device

    def launch(self, stream: wp.Stream | None = None) -> None:
        self.stage(launch_on(self.device))


def record(stage: Callable[[Launch], None], device: wp.Device) -> list[RecordedLaunch] | list[EagerStage]:
    """The launches of ``stage(launch)``, for `replay`."""
    if EAGER:
        return [EagerStage(stage, device)]
    launches: list[RecordedLaunch] = []
    stage(lambda kernel, dim, arguments: launches.append(RecordedLaunch(kernel, dim, arguments, device)))
    return launches


def replay(launches: list[RecordedLaunch] | list[EagerStage]) -> None:
    """Launch again, one after the other, in order with what torch does there."""
    stream = current_stream(launches[0].device) if launches else None
    for launch in launches:
        launch.launch(stream)
