"""Relative pose error (the paper's Eq. 26)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.seeding import stream
from dynslam_bench.evaluation.alignment import Similarity
from dynslam_bench.evaluation.ape import named, statistics
from dynslam_bench.evaluation.association import Association
from dynslam_bench.evaluation.protocol import Protocol, RPESpec
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.association import nearest_gap
from dynslam_bench.geometry.trajectory import Trajectory

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class RelativeErrors:
    """Errors over pairs of poses.

    Attributes:
        pairs: Indices of the poses of each pair ``[P, 2]``.
        translation_m: Length of the translation of E in metres ``[P]``.
        rotation_deg: Rotation angle of E in degrees ``[P]``.
        dropped: Pairs left out because one of their poses had no ground truth.
    """

    pairs: Index
    translation_m: Array
    rotation_deg: Array
    dropped: int = 0


def tum_relative_errors(
    estimate: Trajectory, ground_truth: Trajectory, spec: RPESpec, *, scale: float = 1.0
) -> RelativeErrors:
    """RPE as TUM's ``evaluate_rpe.py`` takes it.

    Pairs are chosen on the whole estimate. Each pose is compared with the true pose nearest in time; a pair takes part
    if both lie within twice the median interval of the ground truth (not within the tolerance of the ATE). With
    ``A = P_i^-1 P_j`` estimated and ``B = Q_i^-1 Q_j`` true the error is ``E = A B^-1``; its rotation angle equals
    that of the paper's ``E = B^-1 A`` (Eq. 26), its translation differs by a rotation of its parts.

    Args:
        estimate: Estimated camera-to-world poses; need not be aligned.
        ground_truth: True poses.
        spec: A ``tum-fixed`` or ``tum-random`` selection.
        scale: Factor applied to the estimate's relative translations.
    """
    pairs = select_pairs(estimate.timestamps, estimate.T_world_cam, spec)
    nearest = closest(ground_truth.timestamps, estimate.timestamps)
    covered = _covered(estimate.timestamps.tobytes(), ground_truth.timestamps.tobytes())
    kept = pairs[covered[pairs[:, 0]] & covered[pairs[:, 1]]]
    estimated = _relative(estimate.T_world_cam, kept)
    estimated[:, :3, 3] *= scale
    back = _true_steps_back(ground_truth.T_world_cam.tobytes(), nearest[kept].tobytes())
    return _errors(kept, estimated @ back, dropped=len(pairs) - len(kept))


@lru_cache(maxsize=8)
def _true_steps_back(ground_truth: bytes, pairs: bytes) -> Array:
    """Inverse steps ``[P, 4, 4]`` between true poses, once for all runs on one sequence; read-only."""
    steps = _relative(np.frombuffer(ground_truth).reshape(-1, 4, 4), np.frombuffer(pairs, np.intp).reshape(-1, 2))
    back = se3.inverse(steps)
    back.flags.writeable = False
    return back


@lru_cache(maxsize=256)
def _covered(estimate: bytes, ground_truth: bytes) -> NDArray[np.bool_]:
    """Which stamps have a true pose near enough; once for equal stamps; read-only."""
    truth = np.frombuffer(ground_truth)
    intervals = np.diff(truth)
    tolerance = 2 * float(np.median(intervals)) if len(intervals) else 0.0
    covered: NDArray[np.bool_] = np.asarray(nearest_gap(np.frombuffer(estimate), truth) <= tolerance)
    covered.flags.writeable = False
    return covered


def evo_relative_errors(stamps: Array, estimate: Array, ground_truth: Array, spec: RPESpec) -> RelativeErrors:
    """RPE as evo takes it: ``E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j)`` (Eq. 26) over pairs of associated poses.

    Args:
        stamps: Seconds ``[N]``, of the estimate.
        estimate: Associated (and aligned) camera-to-world poses ``[N, 4, 4]``; the pairs are chosen on them.
        ground_truth: Their counterparts ``[N, 4, 4]``.
        spec: A ``consecutive`` or ``all`` selection.
    """
    pairs = select_pairs(stamps, estimate, spec)
    return _errors(pairs, se3.inverse(_relative(ground_truth, pairs)) @ _relative(estimate, pairs))


def _relative(poses: Array, pairs: Index) -> Array:
    return np.asarray(se3.inverse(poses[pairs[:, 0]]) @ poses[pairs[:, 1]])


def _errors(pairs: Index, error: Array, dropped: int = 0) -> RelativeErrors:
    translation = np.linalg.norm(error[:, :3, 3], axis=1)
    rotation = np.rad2deg(se3.rotation_angle(error)) if len(error) else np.zeros(0)
    return RelativeErrors(pairs, translation, rotation, dropped)


# Which pairs of poses a relative pose error is taken over: TUM's two ways and evo's two.


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
    """Path length up to every pose ``[N]``, in the unit of the delta."""
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
        ``[M]``; read-only, as equal stamps share one result.
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
    """Non-overlapping pairs: a new one begins where the path since the last reaches delta."""
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
    if spec.unit in ("deg", "rad"):  # the angle between the two poses, not the path between them
        factor = 180 / np.pi if spec.unit == "deg" else 1.0
        blocks = []
        for i in range(n - 1):
            angle = se3.rotation_angle(se3.inverse(poses[i]) @ poses[i + 1 :]) * factor
            j = np.flatnonzero((angle >= spec.delta - tolerance) & (angle <= spec.delta + tolerance)) + i + 1
            blocks.append(np.stack([np.full(len(j), i), j], axis=1))
        return np.concatenate(blocks).astype(np.intp) if blocks else np.zeros((0, 2), dtype=np.intp)
    index = path_index(stamps, poses, spec)
    pairs = []
    for i in range(n - 1):
        distance = np.abs(index[i + 1 :] - index[i] - spec.delta)
        at = int(np.argmin(distance))
        if distance[at] <= tolerance:
            pairs.append((i, i + 1 + at))
    return np.array(pairs, dtype=np.intp).reshape(-1, 2)


# Errors over segments of fixed length, as the KITTI odometry benchmark takes them.

STEP = 10


def segment_errors(estimate: Array, ground_truth: Array, lengths_m: Sequence[float]) -> tuple[Array, Array]:
    """Drift over segments that begin at every tenth pose and end where the true path has grown by a length.

    Args:
        estimate: Associated camera-to-world poses ``[N, 4, 4]``.
        ground_truth: True poses ``[N, 4, 4]``.
        lengths_m: Lengths in metres.

    Returns:
        Translational drift in percent ``[K]`` and rotational drift in degrees a metre ``[K]``; empty where the path is
        shorter than the shortest length.
    """
    steps = np.linalg.norm(np.diff(ground_truth[:, :3, 3], axis=0), axis=1)
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    first, last, length = [], [], []
    for start in range(0, len(travelled), STEP):
        for wanted in lengths_m:
            end = int(np.searchsorted(travelled, travelled[start] + wanted, side="right"))
            if end < len(travelled):
                first.append(start)
                last.append(end)
                length.append(wanted)
    if not first:
        return np.zeros(0), np.zeros(0)
    true = se3.inverse(ground_truth[first]) @ ground_truth[last]
    estimated = se3.inverse(estimate[first]) @ estimate[last]
    error = se3.inverse(estimated) @ true
    metres = np.array(length)
    translation = np.linalg.norm(error[:, :3, 3], axis=1) / metres * 100
    rotation = np.rad2deg(se3.rotation_angle(error)) / metres
    return translation, rotation


# Relative and segment errors of a trajectory under their metric names.


def relative_metrics(
    estimate: Trajectory,
    ground_truth: Trajectory,
    association: Association,
    aligned: np.ndarray,
    similarity: Similarity,
    protocol: Protocol,
) -> tuple[dict[str, float], dict[str, int]]:
    """The relative errors of a protocol, and the number of pairs of each.

    Args:
        estimate: The whole estimate, on which TUM's pairs are chosen.
        ground_truth: The whole truth.
        association: Which poses belong together.
        aligned: Associated estimated poses, aligned ``[K, 4, 4]``.
        similarity: The alignment; its scale is that of the estimate's steps.
        protocol: Names the relative errors.
    """
    metrics: dict[str, float] = {}
    counts: dict[str, int] = {}
    for spec in protocol.rpe:
        stamps = estimate.timestamps
        if spec.pairs in ("tum-fixed", "tum-random"):
            errors = tum_relative_errors(estimate, ground_truth, spec, scale=similarity.scale)
        else:
            stamps = stamps[association.estimate]
            errors = evo_relative_errors(stamps, aligned, ground_truth.T_world_cam[association.ground_truth], spec)
        counts[spec.key] = len(errors.pairs)
        metrics.update(_statistics(spec, errors, stamps))
    return metrics, counts


def segment_metrics(
    aligned: np.ndarray, truth: np.ndarray, protocol: Protocol, diagnostics: list[str]
) -> dict[str, float]:
    """KITTI's drift over segments; empty, with a line in the diagnostics, where the path is too short for any.

    Args:
        aligned: Associated estimated poses ``[K, 4, 4]``.
        truth: Their true counterparts ``[K, 4, 4]``.
        protocol: Names the segments.
        diagnostics: Takes the line.
    """
    translation, rotation = segment_errors(aligned, truth, protocol.segments_m)
    if not len(translation):
        length = float(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum())
        diagnostics.append(f"the path of {length:.1f} m is shorter than a segment of {min(protocol.segments_m):g} m")
        return {}
    return {
        "kitti_trans_percent": statistics(translation)["mean"],
        "kitti_rot_deg_per_m": statistics(rotation)["mean"],
    }


def _statistics(spec: RPESpec, errors: RelativeErrors, stamps: np.ndarray) -> dict[str, float]:
    """The statistics of a relative error; a sum of squared rates means nothing and is left out."""
    times = np.diff(stamps[errors.pairs], axis=1)[:, 0] if spec.rate else np.ones(len(errors.pairs))
    metrics = named(f"rpe_{spec.key}_trans", errors.translation_m / times, spec.unit_of("trans"))
    metrics |= named(f"rpe_{spec.key}_rot", errors.rotation_deg / times, spec.unit_of("rot"))
    return {name: value for name, value in metrics.items() if not (spec.rate and "_sse_" in name)}
