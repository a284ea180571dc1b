"""Stamps: decimal seconds in text files, integer nanoseconds inside, float64 seconds for arithmetic.

A float64 of today's Unix time resolves 0.24 us, so it cannot hold the nanoseconds of EuRoC's tables
and of ROS bags. What is read from a text and written to one goes through integers. Arithmetic on
differences (association, speeds) uses float64 seconds, as TUM's scripts and evo do: the float of a
stamp of up to nine decimals is the one nearest to its text.
"""

from collections.abc import Callable, Iterable
from decimal import ROUND_HALF_EVEN, Context, Decimal, InvalidOperation
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dynslam_bench.core import DynslamError, TrajectoryError

Index = NDArray[np.intp]
NS_PER_S = 1_000_000_000
"""Nanoseconds a second."""
LEAST_GAP_NS = 1000
"""Stamps of one list that are closer, and not equal, are refused.

No camera and no motion capture is so fast, float64 seconds hardly tell them apart, and files of six
decimals do not.
"""
_EXACT = Context(prec=400, rounding=ROUND_HALF_EVEN)
"""Decimal arithmetic of 400 digits, more than any stamp has."""
_LARGEST_NS = 2**63 - 1
"""The largest stamp that 64 bits hold: the year 2262."""


def parse_ns(text: str, digits: int = 0) -> int:
    """Integer nanoseconds of a number of seconds in decimal text; further digits are rounded to the nearest.

    Args:
        text: The number.
        digits: Decimal digits that its unit is smaller than the second: 3 for milliseconds.

    Raises:
        ValueError: It is no finite number, or beyond the range of 64 bits (292 years from 0).
    """
    try:
        stamp = Decimal(text)
    except InvalidOperation:
        stamp = Decimal("nan")
    if stamp.is_finite() and stamp.adjusted() <= 11 + digits:
        ns = int(stamp.scaleb(9 - digits, _EXACT).to_integral_value(context=_EXACT))
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
        ValueError: The number is not finite, or beyond the range of 64 bits (292 years from 0).
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
    ns: NDArray[np.int64],
    source: str,
    kind: type[DynslamError],
    line_of: Callable[[int], int | None] = lambda _: None,
) -> None:
    """Refuse stamps that differ by less than `LEAST_GAP_NS`; equal ones are not looked at.

    Args:
        ns: Stamps in nanoseconds ``[N]``, ascending.
        source: The file or the sequence.
        kind: What is raised.
        line_of: The line of a stamp in the file; None where it is not known.

    Raises:
        DynslamError: Raised as `kind`, with the measured gap and the lines.
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


# One-to-one association of two lists of stamps, as the TUM RGB-D benchmark's ``associate.py`` does
# it.


def associate(
    first: ArrayLike, second: ArrayLike, max_dt: float, *, strict: bool = True
) -> tuple[Index, Index]:
    """Greedy one-to-one association by absolute time difference.

    All pairs closer than `max_dt` are taken in order of ``(|dt|, first stamp, second stamp)``; a
    pair counts if neither stamp was used before (the rule of TUM's ``associate.py``, including its
    order on ties).

    Args:
        first: Stamps in seconds ``[N]``, in any order.
        second: Stamps in seconds ``[M]``, in any order.
        max_dt: Largest time difference in seconds.
        strict: True for ``|dt| < max_dt`` (TUM), False for ``|dt| <= max_dt``.

    Returns:
        Indices into `first` and into `second` ``[K]`` each, in order of the first stamp; read-only.

    Raises:
        TrajectoryError: A stamp is not finite, or `max_dt` is negative or not a number.
    """
    stamps = (np.asarray(stamps, dtype=np.float64).tobytes() for stamps in (first, second))
    return _associate(*stamps, float(max_dt), strict)


@lru_cache(maxsize=512)
def _associate(first: bytes, second: bytes, max_dt: float, strict: bool) -> tuple[Index, Index]:
    """`associate`, once for equal stamps: all runs on one sequence are compared with the same truth.

    Stamps are the bytes of float64 seconds, which can be remembered.
    """
    # both lists in order of time, and where each stamp stood
    a, order_a = _sorted_stamps(np.frombuffer(first))
    b, order_b = _sorted_stamps(np.frombuffer(second))
    if not max_dt >= 0:
        raise TrajectoryError(
            f"the largest time difference is {max_dt!r}, not a number of seconds >= 0"
        )
    # all pairs that are close enough, in order of the first stamp and then of the second
    candidate_a, candidate_b, dt = _candidates(a, b, max_dt, strict=strict)
    pairs = np.stack([candidate_a, candidate_b], axis=1)
    # Where a stamp has several candidates, the closest pairs are taken first.
    if not (np.diff(pairs, axis=0) > 0).all():
        match_of: dict[int, int] = {}
        taken: set[int] = set()
        for i, j in pairs[np.lexsort((candidate_b, candidate_a, dt))].tolist():
            if i not in match_of and j not in taken:
                match_of[i] = j
                taken.add(j)
        pairs = np.array(sorted(match_of.items()), dtype=np.intp).reshape(-1, 2)

    # back to the order that was given; cached results must not be changed
    index_a = order_a[pairs[:, 0]]
    index_b = order_b[pairs[:, 1]]
    index_a.flags.writeable = False
    index_b.flags.writeable = False
    return index_a, index_b


def nearest_gap(first: ArrayLike, second: ArrayLike) -> NDArray[np.float64]:
    """Distance in seconds ``[N]`` of every (finite) stamp of `first` to the nearest of `second`; inf without any."""
    # infinite stamps at both ends, so that each stamp has one before and one after
    a = np.asarray(first, dtype=np.float64).reshape(-1)
    ordered = np.sort(np.asarray(second, dtype=np.float64).reshape(-1))
    b = np.concatenate([[-np.inf], ordered, [np.inf]])
    after = np.searchsorted(b, a)
    return np.asarray(np.minimum(a - b[after - 1], b[after] - a))


def _sorted_stamps(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], Index]:
    """Stamps in ascending order, and the index of each in `values`."""
    if not np.isfinite(values).all():
        at = int(np.argmin(np.isfinite(values)))
        raise TrajectoryError(
            f"stamp {at} of {len(values)} is {values[at]}, not a finite number of seconds"
        )
    order = np.argsort(values, kind="stable")
    return values[order], order


def _candidates(
    a: NDArray[np.float64], b: NDArray[np.float64], max_dt: float, *, strict: bool
) -> tuple[Index, Index, NDArray[np.float64]]:
    """All pairs of indices within `max_dt` with their |dt|; both lists sorted.

    Args:
        a: Stamps in seconds ``[N]``, ascending.
        b: Stamps in seconds ``[M]``, ascending.
        max_dt: Largest time difference, seconds.
        strict: Whether the difference must be smaller.
    """
    # Look a little farther than `max_dt`, as sums round; the differences decide.
    slack = 1e-9 + 4 * np.spacing(max(np.abs(a).max(initial=0.0), np.abs(b).max(initial=0.0)))
    low = np.searchsorted(b, a - max_dt - slack, side="left")
    count = np.searchsorted(b, a + max_dt + slack, side="right") - low
    # Every stamp of `a` with each of its `count` candidates in `b`, from `low` on.
    index_a = np.repeat(np.arange(len(a)), count)
    number_of_candidate = np.arange(len(index_a)) - np.repeat(np.cumsum(count) - count, count)
    index_b = np.repeat(low, count) + number_of_candidate
    dt = np.abs(a[index_a] - b[index_b])
    keep = dt < max_dt if strict else dt <= max_dt
    return index_a[keep], index_b[keep], dt[keep]
