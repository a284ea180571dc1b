"""Run a kernel over stripes of rows or points on a few threads."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any


def run_stripes(
    function: Callable[..., Any], count: int, threads: int, pool: ThreadPoolExecutor | None, *arguments: Any
) -> None:
    """Call ``function(start, stop, *arguments)`` on equal parts of ``range(count)`` and wait for all.

    The last part runs in the calling thread. The kernels release the GIL and write disjoint rows, so the result is the
    same for every number of threads.
    """
    parts = min(threads, count) if pool is not None else 1
    if parts <= 1:
        function(0, count, *arguments)
        return
    assert pool is not None
    bounds = [count * part // parts for part in range(parts + 1)]
    futures = [pool.submit(function, bounds[i], bounds[i + 1], *arguments) for i in range(parts - 1)]
    function(bounds[parts - 1], bounds[parts], *arguments)
    for future in futures:
        future.result()
