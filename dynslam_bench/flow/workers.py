"""Threads of the flow's kernels."""

from __future__ import annotations

import operator
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any


class Workers:
    """Threads over which a kernel's rows or points are divided.

    Args:
        threads: Number of threads, the calling thread included.

    Attributes:
        run: ``run(kernel, start, stop, *arguments)`` calls ``kernel(start, stop, *arguments)`` on
            equal parts of the range and waits for all; with one thread it calls the kernel itself.
    """

    def __init__(self, threads: int = 1) -> None:
        self.threads = max(1, threads)
        # Python 3.10 has no `operator.call`
        self.run: Callable[..., Any] = getattr(
            operator, "call", lambda kernel, *arguments: kernel(*arguments)
        )
        if self.threads > 1:
            self.run = self._divide
            self._pool = ThreadPoolExecutor(self.threads - 1, "flow")

    def _divide(self, kernel: Callable[..., Any], start: int, stop: int, *arguments: Any) -> None:
        """Run the last part in the calling thread, the others in the pool.

        The kernels release the GIL and write disjoint rows, so that the result is the same for
        every number of threads.
        """
        bounds = [start + (stop - start) * part // self.threads for part in range(self.threads + 1)]
        futures = [self._pool.submit(kernel, *part, *arguments) for part in pairwise(bounds[:-1])]
        kernel(*bounds[-2:], *arguments)
        for future in futures:
            future.result()
