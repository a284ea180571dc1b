"""Segmentation networks: Mask R-CNN, ONNX files, and where their weights lie."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def pinned_threads(
    get: Callable[[], int], put: Callable[[int], None], threads: int
) -> Iterator[None]:
    """Pin the thread count of a library while the block runs (it is one number for the whole process)."""
    before = get()
    put(threads)
    try:
        yield
    finally:
        put(before)
