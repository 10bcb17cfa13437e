"""Messages to policies in processes of their own: there and back, and what is none."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from maexp.agents.policies.remote import protocol


def test_messages_go_over_the_wire_and_back():
    sent = {
        "type": "act",
        "n": 3,
        "name": "å",
        "none": None,
        "origin": (1.5, -2.0),
        "big": np.float32(2.5),
        "grid": np.arange(-6, 6, dtype=np.int8).reshape(2, 3, 2),
        "poses": np.array([[np.nan, np.inf]]),
        "heard": np.eye(2, dtype=bool),
        "turned": np.arange(6.0).reshape(2, 3).T,
    }
    body = protocol.pack(sent)
    assert struct.unpack("<I", body[:4])[0] == len(body) - 4
    got = protocol.unpack(body[4:])
    for name, value in sent.items():
        if isinstance(value, np.ndarray):
            same = np.array_equal(got[name], value, equal_nan=value.dtype.kind == "f")
            assert got[name].dtype == value.dtype and same
        else:
            assert got[name] == (list(value) if isinstance(value, tuple) else value)
    with pytest.raises(TypeError, match="complex128 cannot be sent"):
        protocol.pack({"a": np.zeros(1, complex)})


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=80))
def test_garbage_is_told_as_such(body):
    try:
        assert isinstance(protocol.unpack(body)["type"], str)
    except ValueError:
        pass


@pytest.mark.parametrize(
    "array",
    [
        {"dtype": "object", "shape": [1], "data": b"x" * 8},
        {"dtype": "float64", "shape": [2], "data": b"x" * 8},
        {"dtype": "float64", "shape": [-1], "data": b"x" * 8},
        {"dtype": "float64", "shape": [2**30, 2**30], "data": b""},
        {"dtype": "float64", "shape": "1", "data": b"x" * 8},
        {"dtype": 3, "shape": [1], "data": b"x" * 8},
    ],
)
def test_arrays_that_are_none_are_garbage(array):
    with pytest.raises(ValueError):
        protocol.unpack(protocol.pack({"type": "goals", "goals": array})[4:])
