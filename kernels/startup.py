"""Importing this starts Warp, quietly: on a machine without a GPU its native code warns on every start of that."""

import os
import sys
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
import warp as wp

KNOWN = wp.config.version.startswith("1.19.")
"""Whether this is a Warp whose inner workings, nowhere documented, are those that we lean on to be faster."""


def module_options() -> dict[str, object]:
    """Options of every module of kernels: no gradients, which halves the time to compile; cheap loops (`loops.h`).

    `wp.config.cpu_compiler_flags` counts as it is when `maexp` is imported.
    """
    options: dict[str, object] = {"enable_backward": False}
    header = Path(__file__).with_name("loops.h")
    if KNOWN and len(str(header).split()) == 1:  # Warp cuts flags at spaces
        version = zlib.crc32(header.read_bytes())  # for Warp's cache of kernels, which knows flags, not files
        flags = "-march=native" if wp.config.cpu_compiler_flags is None else wp.config.cpu_compiler_flags
        options["cpu_compiler_flags"] = f"{flags} -DMAEXP_LOOPS={version} -include {header}"
    return options


MODULE_OPTIONS = module_options()


def start_warp() -> None:
    """Initialise Warp without its banner, and so that several threads may launch the same kernel on the CPU.

    With tiles in stack memory (Warp 1.19's default) every CPU kernel keeps a pointer to its own stack frame in
    a static variable of its module and writes through it, whether it uses tiles or not: two shards in two
    threads then write into each other's stack (a crash in debug mode, in release only as the optimiser likes).
    """
    wp.config.enable_tiles_in_stack_memory = False
    wp.config.log_level = wp.LOG_WARNING
    if torch.cuda.is_available():
        note = _start_with_cache()
    else:
        with _silent_stderr():
            note = _start_with_cache()
    if note:
        print(note, file=sys.stderr)


def _start_with_cache() -> str:
    """Initialise Warp; where its cache cannot be written (no home, as in many containers), with one that can.

    Returns a note for the user, empty where all is as usual.
    """
    try:
        wp.init()
        found = str(wp.config.kernel_cache_dir)
        if os.access(found, os.W_OK):
            return ""
    except OSError as error:
        found = str(wp.config.kernel_cache_dir or error.filename)
    wp.config.kernel_cache_dir = _temporary_cache()  # Warp reads it whenever it compiles
    wp.init()
    told = f"{found} cannot be written, so compiled kernels are kept in {wp.config.kernel_cache_dir}"
    return f"maexp: note: {told}; WARP_CACHE_PATH names another folder"


def _temporary_cache() -> str:
    """A folder of this user alone, the same in every process."""
    folder = os.path.join(tempfile.gettempdir(), f"maexp-warp-{getattr(os, 'getuid', int)()}")
    try:
        os.makedirs(folder, mode=0o700, exist_ok=True)
        ours = not hasattr(os, "getuid") or os.stat(folder).st_uid == os.getuid()
    except OSError:
        ours = False
    return folder if ours and os.access(folder, os.W_OK) else tempfile.mkdtemp(prefix="maexp-warp-")


@contextmanager
def _silent_stderr() -> Iterator[None]:
    """Native code writes to the file descriptor, past sys.stderr. Python exceptions still come through."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


start_warp()
