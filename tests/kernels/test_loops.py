"""Loops of CPU kernels: what `kernels/loops.h` puts in the place of Warp's `range` goes through the same numbers."""

from pathlib import Path

import pytest
import warp as wp

from maexp.kernels import startup

wp.set_module_options(startup.MODULE_OPTIONS)


@wp.kernel
def _count(start: int, end: int, step: int, numbers: wp.array(dtype=wp.int32), count: wp.array(dtype=wp.int32)):
    for i in range(start, end, step):
        numbers[count[0]] = i
        count[0] = count[0] + 1


@wp.kernel
def _nest(rows: int, numbers: wp.array(dtype=wp.int32), count: wp.array(dtype=wp.int32)):
    for i in range(rows):
        for j in range(i, rows):
            if j == 3:
                continue
            if j > 5:
                break
            numbers[count[0]] = 10 * i + j
            count[0] = count[0] + 1


def run(kernel, *inputs) -> list[int]:
    numbers, count = wp.zeros(64, dtype=wp.int32, device="cpu"), wp.zeros(1, dtype=wp.int32, device="cpu")
    wp.launch(kernel, dim=1, inputs=inputs, outputs=[numbers, count], device="cpu")
    return numbers.numpy()[: int(count.numpy()[0])].tolist()


@pytest.mark.parametrize("step", [1, 2, 7, -1, -3])
def test_loops_go_through_the_numbers_of_range(step):
    for start, end in ((0, 9), (3, 3), (5, 2), (-4, 4), (8, -8)):
        assert run(_count, start, end, step) == list(range(start, end, step))
    assert run(_count, 0, 9, 0) == []  # as Warp's own: Python refuses it


def test_loops_in_loops_skip_and_end():
    want = [10 * i + j for i in range(8) for j in range(i, 8) if j != 3 and j <= 5]
    assert run(_nest, 8) == want


@pytest.mark.parametrize(("flags", "kept"), [("-O1 -g", "-O1 -g"), ("", ""), (None, "-march=native")])
def test_a_warp_that_is_known_is_given_cheap_loops(monkeypatch, tmp_path, flags, kept):
    """With the flags it has; anew where the header is another; not where Warp would cut the path at a space."""
    monkeypatch.setattr(startup, "KNOWN", True)
    monkeypatch.setattr(wp.config, "cpu_compiler_flags", flags)
    seen = []
    for content in ("one", "two"):
        header = tmp_path / "loops.h"
        header.write_text(content)
        monkeypatch.setattr(startup, "__file__", str(tmp_path / "startup.py"))
        seen.append(startup.module_options()["cpu_compiler_flags"])
        assert seen[-1].startswith(f"{kept} -DMAEXP_LOOPS=") and seen[-1].endswith(f" -include {header}")
    assert seen[0] != seen[1]
    monkeypatch.setattr(startup, "__file__", "/a folder/startup.py")
    assert startup.module_options() == {"enable_backward": False}


def test_a_warp_that_is_not_known_keeps_its_own_loops(monkeypatch):
    monkeypatch.setattr(startup, "KNOWN", False)
    assert startup.module_options() == {"enable_backward": False}


def test_every_module_of_kernels_has_these_options():
    options = wp.get_module("maexp.kernels.visibility").options
    assert startup.MODULE_OPTIONS.items() <= options.items() and Path(startup.__file__).with_name("loops.h").exists()
