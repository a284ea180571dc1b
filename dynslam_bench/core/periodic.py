"""A call that is repeated in a thread while a block of code runs."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def call_periodically(interval_s: float, call: Callable[[], object]) -> Iterator[None]:
    """Make a call every so many seconds while the block lasts; the first one after the first interval."""
    ended = threading.Event()

    def repeat() -> None:
        while not ended.wait(interval_s):
            call()

    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
