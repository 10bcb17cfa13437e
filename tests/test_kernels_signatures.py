"""The signatures of the kernels are true: every array says its axes."""

import pytest
from kernel_source import arguments, kernels

KERNELS = kernels()


@pytest.mark.parametrize("name", KERNELS)
def test_every_array_says_its_axes(name):
    for one in arguments(KERNELS[name]):
        if one.dims:
            assert one.shape is not None and len(one.shape) == one.dims, f"{name}: {one.name} {one.shape}"
