"""One-to-one association of two lists of stamps, as the TUM RGB-D benchmark's ``associate.py`` does it."""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dynslam_bench.core import TrajectoryError

Index = NDArray[np.intp]


def associate(first: ArrayLike, second: ArrayLike, max_dt: float, *, strict: bool = True) -> tuple[Index, Index]:
    """Greedy one-to-one association by absolute time difference.

    All pairs closer than `max_dt` are taken in order of ``(|dt|, first stamp, second stamp)``; a pair counts if neither
    stamp was used before (the rule of TUM's ``associate.py``, including its order on ties).

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
    """`associate`, once for equal stamps: all runs on one sequence are compared with the same truth."""
    a, order_a = _sorted_stamps(np.frombuffer(first))
    b, order_b = _sorted_stamps(np.frombuffer(second))
    if not max_dt >= 0:
        raise TrajectoryError(f"the largest time difference is {max_dt!r}, not a number of seconds >= 0")
    candidate_a, candidate_b, dt = _candidates(a, b, max_dt, strict=strict)
    pairs = np.stack([candidate_a, candidate_b], axis=1)
    if not (np.diff(pairs, axis=0) > 0).all():  # some stamp has several candidates
        used_a: set[int] = set()
        used_b: set[int] = set()
        matched: list[tuple[int, int]] = []
        for i, j in pairs[np.lexsort((candidate_b, candidate_a, dt))].tolist():
            if i not in used_a and j not in used_b:
                used_a.add(i)
                used_b.add(j)
                matched.append((i, j))
        pairs = np.array(sorted(matched), dtype=np.intp).reshape(-1, 2)
    index_a, index_b = order_a[pairs[:, 0]], order_b[pairs[:, 1]]
    index_a.flags.writeable = index_b.flags.writeable = False
    return index_a, index_b


def nearest_gap(first: ArrayLike, second: ArrayLike) -> NDArray[np.float64]:
    """Distance in seconds ``[N]`` of every (finite) stamp of `first` to the nearest of `second`; inf without any."""
    a = np.asarray(first, dtype=np.float64).reshape(-1)
    b = np.concatenate([[-np.inf], np.sort(np.asarray(second, dtype=np.float64).reshape(-1)), [np.inf]])
    after = np.searchsorted(b, a)
    return np.asarray(np.minimum(a - b[after - 1], b[after] - a))


def _sorted_stamps(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], Index]:
    if not np.isfinite(values).all():
        at = int(np.argmin(np.isfinite(values)))
        raise TrajectoryError(f"stamp {at} of {len(values)} is {values[at]}, not a finite number of seconds")
    order = np.argsort(values, kind="stable")
    return values[order], order


def _candidates(
    a: NDArray[np.float64], b: NDArray[np.float64], max_dt: float, *, strict: bool
) -> tuple[Index, Index, NDArray[np.float64]]:
    """All pairs of indices within `max_dt` with their |dt|; both lists sorted."""
    slack = 1e-9 + 4 * np.spacing(max(np.abs(a).max(initial=0.0), np.abs(b).max(initial=0.0)))
    low = np.searchsorted(b, a - max_dt - slack, side="left")
    count = np.searchsorted(b, a + max_dt + slack, side="right") - low
    index_a = np.repeat(np.arange(len(a)), count)
    index_b = np.repeat(low, count) + (np.arange(len(index_a)) - np.repeat(np.cumsum(count) - count, count))
    dt = np.abs(a[index_a] - b[index_b])
    keep = dt < max_dt if strict else dt <= max_dt
    return index_a[keep], index_b[keep], dt[keep]
