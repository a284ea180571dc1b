"""The command lines of the benchmarks, whose options are named, typed and repeated as their defaults are; and times."""

import argparse
import time
from collections.abc import Callable
from typing import Any


def parser_of(doc: str | None, **options: Any) -> argparse.ArgumentParser:
    """A parser with these options; what it takes besides is added to it.

    Args:
        doc: The script's docstring.
        options: Defaults by name: a list takes several values, False is a switch.
    """
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, default in options.items():
        several = isinstance(default, (list, tuple))
        kind = type(default[0] if several else default)
        how: dict[str, Any] = (
            {"action": "store_true"} if default is False else {"type": kind, "default": default}
        )
        how |= {"nargs": "+"} if several else {}
        parser.add_argument(f"--{name.replace('_', '-')}", **how)
    return parser


def timed(work: Callable[[], object], repeats: int) -> tuple[list[float], list[float]]:
    """Wall and processor times in milliseconds, after one warm-up."""
    work()
    wall = []
    processor = []
    for _ in range(repeats):
        start = time.perf_counter()
        used = time.process_time()
        work()
        wall.append(1e3 * (time.perf_counter() - start))
        processor.append(1e3 * (time.process_time() - used))
    return wall, processor
