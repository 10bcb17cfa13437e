"""No result depends on the order in which a launch's threads run: the nearest thing to a race detector on a CPU."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import warp as wp
from launch_order import ORDERS
from test_compile import kernel_modules

SCRIPT = Path(__file__).parents[1] / "helpers" / "launch_order.py"


@pytest.fixture(scope="module")
def played() -> dict:
    """What `launch_order.py` prints. Its kernels stay beside Warp's own cache: compiling them takes half a minute."""
    wp.init()
    cache = Path(wp.config.kernel_cache_dir)
    command = [sys.executable, str(SCRIPT), str(cache.with_name(f"{cache.name}-orders"))]
    one_thread = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=one_thread, timeout=600)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
def test_threads_run_in_another_order(played):
    """The patch of Warp's loop works: each order has another last thread."""
    last = played["last_thread"]
    assert last["forward"] == 45 and last["reversed"] == 0
    assert len(set(last.values())) == len(ORDERS)


def test_the_order_of_threads_changes_no_bit(played):
    for setup, by_order in played["hashes"].items():
        assert set(by_order) == set(ORDERS)
        differ = [name for name, found in by_order.items() if found != by_order["forward"]]
        assert not differ, f"{setup}: other bits with threads {differ}"


def test_every_kernel_has_run_in_these_orders(played):
    ours = {
        f"{kernel.module.name}.{kernel.key}"
        for name in kernel_modules()
        for kernel in vars(sys.modules[name]).values()
        if isinstance(kernel, wp.Kernel)
    }
    assert len(ours) > 40 and not ours - set(played["kernels"])
