"""The signatures of the kernels are true: what each array's axes are, what is only read, what is written."""

import re
from pathlib import Path

import pytest
from kernel_source import arguments, functions, kernels, parse, uses

import maexp.kernels

KERNELS = kernels()
FUNCTIONS = functions()
IN = ("Map", "State in", "Scratch in", "In")
BOTH = ("State in and out", "Scratch in and out", "In and out", "Scratch")
OUT = ("State out", "Scratch out", "Out")
"""Headings of arrays: only read; read and written, so that what was there before counts; written."""


@pytest.mark.parametrize("name", KERNELS)
def test_every_array_says_its_axes(name):
    for argument in arguments(KERNELS[name]):
        if argument.dims:
            assert argument.shape is not None and len(argument.shape) == argument.dims, (
                f"{name}: {argument.name} {argument.shape}"
            )


@pytest.mark.parametrize("name", KERNELS)
def test_headings_are_true(name):
    """An array stands under a heading that says whether the kernel reads it, writes it, or both."""
    found = uses(KERNELS[name].func)
    for argument in arguments(KERNELS[name]):
        if argument.dims == 0:
            assert argument.heading in ("Map", "Robots", "Settings"), (
                f"{name}: {argument.name} under {argument.heading!r}"
            )
            continue
        assert argument.heading in IN + BOTH + OUT, f"{name}: {argument.name} under {argument.heading!r}"
        assert (argument.name in found.written) == (argument.heading not in IN), (
            f"{name}: {argument.name} under {argument.heading!r}"
        )
        assert argument.name in found.read or argument.heading in OUT, (
            f"{name}: {argument.name} under {argument.heading!r} is never read"
        )


def test_what_is_written_stands_last():
    for name, kernel in KERNELS.items():
        headings = [argument.heading for argument in arguments(kernel)]
        written = [heading in BOTH + OUT for heading in headings]
        assert written == sorted(written), f"{name}: {headings}"


def test_no_argument_is_there_for_nothing():
    assert len(KERNELS) > 40 and len(FUNCTIONS) > 40
    for name, function in {**KERNELS, **FUNCTIONS}.items():
        taken = [argument.arg for argument in parse(function.func).args.args]
        in_cpp = set(re.findall(r"\w+", getattr(function, "native_snippet", None) or ""))
        assert not set(taken) - uses(function.func).named - in_cpp, name


def test_one_dialect():
    """Constants are plain numbers, and no adjoint code is compiled."""
    files = sorted(Path(maexp.kernels.__path__[0]).glob("*.py"))
    assert len(files) > 25
    for file in files:
        text = file.read_text()
        assert not re.search(r"\bwp_|wp\.constant|enable_backward=", text), file.name
        assert ("@wp.kernel" in text) == ("set_module_options" in text), file.name
