"""Which pairs of poses a relative pose error is taken over: TUM's two ways and evo's two."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.seeding import stream
from dynslam_bench.geometry import se3

from .protocol import RPESpec

Array = NDArray[np.float64]
Index = NDArray[np.intp]


def select_pairs(stamps: Array, poses: Array, spec: RPESpec) -> Index:
    """Index pairs ``(i, j)`` ``[P, 2]`` of a trajectory.

    Args:
        stamps: Seconds ``[N]``, ascending.
        poses: Camera-to-world poses ``[N, 4, 4]`` (of the estimate, as both tools have it).
        spec: Mode, delta and unit.

    Returns:
        Possibly none. In mode ``tum-random`` pairs come in both directions and may join a pose with itself.
    """
    if not len(poses):
        return np.zeros((0, 2), dtype=np.intp)
    if spec.pairs == "tum-random":
        return random_pairs(len(poses), spec.max_pairs)
    if spec.pairs == "tum-fixed":
        return _thin(tum_fixed_pairs(path_index(stamps, poses, spec), spec.delta), spec.max_pairs)
    if spec.pairs == "consecutive":
        return _consecutive(stamps, poses, spec)
    return _all_pairs(stamps, poses, spec)


def path_index(stamps: Array, poses: Array, spec: RPESpec) -> Array:
    """The way travelled up to every pose ``[N]``, in the unit of the delta."""
    if spec.unit == "f":
        return np.arange(len(poses), dtype=np.float64)
    if spec.unit == "s":
        return stamps
    steps = se3.inverse(poses[:-1]) @ poses[1:]
    if spec.unit == "m":
        step = np.asarray(np.linalg.norm(steps[:, :3, 3], axis=1), dtype=np.float64)
    else:
        step = se3.rotation_angle(steps) * (180 / np.pi if spec.unit == "deg" else 1.0)
    return np.asarray(np.concatenate([np.zeros(1), np.cumsum(step)]), dtype=np.float64)


def tum_fixed_pairs(index: Array, delta: float) -> Index:
    """``evaluate_rpe.py --fixed_delta``: every pose with the one closest to `delta` further on, the last one never."""
    end = closest(index, index + delta)
    keep = end != len(index) - 1
    return np.stack([np.flatnonzero(keep), end[keep]], axis=1)


def closest(values: Array, targets: Array) -> Index:
    """Index of the value closest to each target, found by bisection as TUM's scripts do it.

    The bisection decides which of equal values, and which of two equally distant ones, is taken: the one it meets
    first (a standing camera makes equal values common).

    Args:
        values: Ascending ``[N]``, at least one.
        targets: ``[M]``.

    Returns:
        ``[M]``; nobody may write into it: all runs on one sequence share what is found for their stamps.
    """
    return _closest(np.asarray(values, np.float64).tobytes(), np.asarray(targets, np.float64).tobytes())


@lru_cache(maxsize=256)
def _closest(value_bytes: bytes, target_bytes: bytes) -> Index:
    values, targets = np.frombuffer(value_bytes), np.frombuffer(target_bytes)
    low = np.zeros(len(targets), dtype=np.intp)
    high = np.full(len(targets), len(values), dtype=np.intp)
    best = np.zeros(len(targets), dtype=np.intp)
    distance = np.abs(values[0] - targets)
    active = low < high
    while active.any():
        middle = np.where(active, (low + high) // 2, 0)
        gap = np.abs(values[middle] - targets)
        better = active & (gap < distance)
        exact = active & (values[middle] == targets)
        best = np.where(better | exact, middle, best)
        distance = np.where(better, gap, distance)
        above = values[middle] > targets
        high = np.where(active & above, middle, high)
        low = np.where(active & ~above, middle + 1, low)
        active &= ~exact & (low < high)
    best.flags.writeable = False
    return best


def random_pairs(n: int, count: int) -> Index:
    """`count` random pairs of `n` poses; every pair where ``n < sqrt(count)`` or `count` is 0.

    Drawn from raw PCG64 words, so that every version of Python and NumPy gives the same ones (TUM's script draws
    from Python's generator, whose sequence changed between versions).
    """
    if count == 0 or n < np.sqrt(count):
        grid = np.indices((n, n)).reshape(2, -1)
        return np.ascontiguousarray(grid.T).astype(np.intp)
    return np.minimum((_uniform("rpe random pairs", 2 * count) * n).astype(np.intp), n - 1).reshape(count, 2)


def _uniform(purpose: str, count: int) -> Array:
    """Numbers in [0, 1) from raw generator words, a function of the purpose only."""
    words = np.asarray(stream(0, purpose).bit_generator.random_raw(count), dtype=np.uint64)
    return np.asarray((words >> np.uint64(11)) * 2.0**-53, dtype=np.float64)


def _thin(pairs: Index, most: int) -> Index:
    if not most or len(pairs) <= most:
        return pairs
    order = np.argsort(_uniform("rpe sample of fixed pairs", len(pairs)), kind="stable")
    return pairs[np.sort(order[:most])]


def _consecutive(stamps: Array, poses: Array, spec: RPESpec) -> Index:
    """Non-overlapping pairs: a new one begins where the way since the last reaches delta."""
    if spec.unit == "f":
        starts = np.arange(0, len(poses), max(1, round(spec.delta)))
        return np.stack([starts[:-1], starts[1:]], axis=1).astype(np.intp)
    ends = [0]
    travelled = 0.0
    for at, step in enumerate(np.diff(path_index(stamps, poses, spec)).tolist(), start=1):
        travelled += step
        if travelled >= spec.delta:
            ends.append(at)
            travelled = 0.0
    return np.stack([ends[:-1], ends[1:]], axis=1).astype(np.intp)


def _all_pairs(stamps: Array, poses: Array, spec: RPESpec) -> Index:
    """Overlapping pairs whose distance is delta within the relative tolerance."""
    n = len(poses)
    if spec.unit == "f":
        delta = max(1, round(spec.delta))
        start = np.arange(max(0, n - delta))
        return np.stack([start, start + delta], axis=1).astype(np.intp)
    tolerance = spec.delta * spec.tolerance
    if spec.unit in ("deg", "rad"):  # the angle between the two poses, not the way between them
        factor = 180 / np.pi if spec.unit == "deg" else 1.0
        found = []
        for i in range(n - 1):
            angle = se3.rotation_angle(se3.inverse(poses[i]) @ poses[i + 1 :]) * factor
            j = np.flatnonzero((angle >= spec.delta - tolerance) & (angle <= spec.delta + tolerance)) + i + 1
            found.append(np.stack([np.full(len(j), i), j], axis=1))
        return np.concatenate(found).astype(np.intp) if found else np.zeros((0, 2), dtype=np.intp)
    index = path_index(stamps, poses, spec)
    pairs = []
    for i in range(n - 1):
        distance = np.abs(index[i + 1 :] - index[i] - spec.delta)
        at = int(np.argmin(distance))
        if distance[at] <= tolerance:
            pairs.append((i, i + 1 + at))
    return np.array(pairs, dtype=np.intp).reshape(-1, 2)
