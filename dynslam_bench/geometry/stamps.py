"""Stamps: decimal seconds in text files, integer nanoseconds inside, float64 seconds for arithmetic.

A float64 of today's Unix time resolves 0.24 us, so it cannot hold the nanoseconds of EuRoC's tables and of ROS bags.
What is read from a text and written to one goes through integers. Arithmetic on differences (association, speeds) uses
float64 seconds, as TUM's scripts and evo do: the float of a stamp of up to nine decimals is the one
nearest to its text.
"""

from collections.abc import Callable, Iterable
from decimal import ROUND_HALF_EVEN, Context, Decimal, InvalidOperation

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core import DynslamError

NS_PER_S = 1_000_000_000
LEAST_GAP_NS = 1000
"""Stamps of one list that are closer, and not equal, are refused.

No camera and no motion capture is so fast, float64 seconds hardly tell them apart, and files of six decimals do not.
"""
_EXACT = Context(prec=400, rounding=ROUND_HALF_EVEN)
_LARGEST_NS = 2**63 - 1


def parse_ns(text: str) -> int:
    """Integer nanoseconds of a number of seconds in decimal text; further digits are rounded to the nearest.

    Raises:
        ValueError: It is no finite number, or beyond the range of 64 bits (292 years from 0).
    """
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        seconds = Decimal("nan")
    if seconds.is_finite() and seconds.adjusted() <= 11:
        ns = int(seconds.scaleb(9, _EXACT).to_integral_value(context=_EXACT))
        if abs(ns) <= _LARGEST_NS:
            return ns
    raise ValueError(f"{text[:40]!r} is not a number of seconds that 64 bits of nanoseconds hold")


def format_ns(ns: int) -> str:
    """Seconds with nine decimals, exactly: ``1403636579.763555584``."""
    whole, fraction = divmod(abs(ns), NS_PER_S)
    return f"{'-' if ns < 0 else ''}{whole}.{fraction:09d}"


def ns_of(seconds: float) -> int:
    """Integer nanoseconds of a float's shortest decimal text: 1305031102.175304 is 1305031102175304000.

    Raises:
        ValueError: As `parse_ns`.
    """
    return parse_ns(repr(float(seconds)))


def from_seconds(seconds: Iterable[float]) -> NDArray[np.int64]:
    """`ns_of` of every stamp, int64 ``[N]``."""
    return np.array([ns_of(stamp) for stamp in seconds], dtype=np.int64)


def to_seconds(ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Float64 seconds ``[N]`` nearest to the exact values: the floats of the same stamps in decimal text."""
    ns = np.asarray(ns, dtype=np.int64)
    whole, fraction = np.divmod(ns, NS_PER_S)
    # below 2^53 one division rounds once; above, the sum's rounding absorbs that of the fraction
    return np.where(np.abs(ns) < 2**53, ns / NS_PER_S, whole + fraction / NS_PER_S)


def refuse_close(
    ns: NDArray[np.int64], source: str, kind: type[DynslamError], line_of: Callable[[int], int | None] = lambda _: None
) -> None:
    """Refuse stamps that differ by less than `LEAST_GAP_NS`; equal ones are not looked at.

    Args:
        ns: Stamps in nanoseconds ``[N]``, ascending.
        source: The file or the sequence.
        kind: What is raised.
        line_of: The line of a stamp in the file; None where it is not known.

    Raises:
        DynslamError: Of the given kind, with the measured gap and the lines.
    """
    gaps = np.diff(ns)
    close = np.flatnonzero((gaps > 0) & (gaps < LEAST_GAP_NS))
    if not len(close):
        return
    first, second = (int(stamp) for stamp in ns[close[0] : close[0] + 2])
    lines = [line for line in (line_of(first), line_of(second)) if line is not None]
    at = f" line{'s' * (len(lines) > 1)} {' and '.join(map(str, lines))}" if lines else ""
    raise kind(
        f"{source}{at}: stamps {format_ns(first)} and {format_ns(second)} s are {second - first} ns apart "
        f"({len(close)} such pairs)",
        "stamps less than 1 us apart cannot be told apart: remove one of each pair",
    )
