"""Segmentation networks: Mask R-CNN, ONNX files, and where their weights lie."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def pinned_threads(
    get: Callable[[], int], put: Callable[[int], None], threads: int
) -> Iterator[None]:
    """Pin the thread count of a library while the block runs (it is one number for the whole process).

    Args:
        get: The library's function that tells the count.
        put: The library's function that sets it.
        threads: The count.
    """
    before = get()
    put(threads)
    try:
        yield
    finally:
        put(before)
