"""Two tasks at once, for networks whose operations are too small for torch to share among threads."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import Any

import torch

Task = Callable[[], Any]
Both = Callable[[Task, Task], tuple[Any, Any]]
"""``both(first, second)`` runs two tasks and returns what they return."""


@contextmanager
def at_once(wanted: bool) -> Iterator[Both]:
    """Inside, two tasks run at once: the second in a thread of its own, each with half of torch's threads.

    They must not write what the other reads; random numbers are the first one's. Where it is not wanted, or torch has a
    single thread, they run one after the other. With two threads results are those of a single one, bit for bit.
    """
    threads = torch.get_num_threads()
    if not wanted or threads == 1:
        yield lambda first, second: (first(), second())
        return
    with ThreadPoolExecutor(1, initializer=torch.set_num_threads, initargs=(threads // 2,)) as pool:
        pool.submit(torch.get_num_threads).result()  # it has set its share: what follows is for this thread

        def both(first: Task, second: Task) -> tuple[Any, Any]:
            other = pool.submit(second)
            try:
                mine = first()
            finally:
                wait([other])
            return mine, other.result()

        torch.set_num_threads(threads - threads // 2)
        try:
            yield both
        finally:
            torch.set_num_threads(threads)
