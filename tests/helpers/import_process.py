"""Imports in a process of their own: hangs, crashes and memory are seen from outside.

`Importer().ask(path)` is what `import_map` made of a file. Run as a program this file is that process: it reads a
line of JSON a file and answers with one.
"""

import json
import os
import select
import subprocess
import sys
import time
import traceback
from pathlib import Path

MEMORY_MIB = 2048  # more than this for one file is a failure
LINE = 1500  # characters of an error; paths are part of it


class Importer:
    """One process that imports file after file, started anew when it died or hung."""

    def __init__(self, timeout: float = 60.0):
        self.timeout = timeout
        self.process: subprocess.Popen | None = None

    def ask(self, path: Path, **options) -> dict:
        """{"kind": "map" | "error" | "crash" | "hang" | "death", ...} for the file."""
        if self.process is None or self.process.poll() is not None:
            self.process = subprocess.Popen(
                [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
            )
            self.process.stdout.readline()  # ready
        self.process.stdin.write(json.dumps({"path": str(path), "options": options}).encode() + b"\n")
        self.process.stdin.flush()
        ready, _, _ = select.select([self.process.stdout], [], [], self.timeout)
        if not ready:
            self.close()
            return {"kind": "hang"}
        line = self.process.stdout.readline()
        if not line:
            return {"kind": "death", "status": self.process.wait()}
        return json.loads(line)

    def close(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self.process = None


def assert_sound(answer: dict) -> dict:
    """A usable map or one sentence, within the memory; returns the answer."""
    assert answer["kind"] in ("map", "error"), answer
    if answer["kind"] == "map":
        assert answer["ok"] and answer["finite"] and answer["free"] > 0, answer
    else:
        assert "\n" not in answer["text"] and 10 < len(answer["text"]) < LINE, answer
    assert answer["mib"] < MEMORY_MIB, answer
    return answer


def try_import(path: str, options: dict) -> dict:
    """What came of one file."""
    import numpy as np

    from maexp.envs.io import import_map
    from maexp.envs.maps.checker import check_map
    from maexp.envs.maps.point_cloud import MapError

    try:
        world = import_map(path, **options)
    except MapError as error:
        return {"kind": "error", "text": str(error)}
    except BaseException:
        return {"kind": "crash", "text": traceback.format_exc()}
    clouds = (world.free, world.obstacles, world.boundary, world.free_spacing)
    verdict = check_map(world)
    return {
        "kind": "map",
        "ok": verdict.ok,
        "finite": all(bool(np.isfinite(c).all()) for c in clouds),
        "free": len(world.free),
        "area": world.free_area,
        "name": world.name,
    }


def memory(field: str) -> float:
    """A field of this process's status [MiB]."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field):
            return int(line.split()[1]) / 1024
    return 0.0


def main() -> None:
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # libraries print what they like
    import laspy  # noqa: F401
    import open3d  # noqa: F401
    import pyoctomap  # noqa: F401
    import trimesh  # noqa: F401

    import maexp.envs  # noqa: F401

    answers.write("ready\n")
    for line in sys.stdin:
        Path("/proc/self/clear_refs").write_text("5")  # forget the highest memory so far
        before, begin = memory("VmRSS"), time.perf_counter()
        answer = try_import(**json.loads(line))
        answer |= {"mib": memory("VmHWM") - before, "seconds": time.perf_counter() - begin}
        answers.write(json.dumps(answer) + "\n")


if __name__ == "__main__":
    main()
