"""Relative pose error by the rules of TUM and evo (the paper's Eq. 26), and KITTI's drift over segments."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from dynslam_bench.core.seeding import stream
from dynslam_bench.evaluation.ape import metrics_with_prefix, statistics
from dynslam_bench.evaluation.comparison import Comparison, Index
from dynslam_bench.evaluation.protocol import RPESpec
from dynslam_bench.geometry import (
    Array,
    are_frame_numbers,
    describe_frame_numbers,
    nearest_gap,
    se3,
)


def relative_metrics(comparison: Comparison) -> dict[str, float]:
    """``rpe_<delta><unit>_trans_<statistic>_m`` and ``..._rot_<statistic>_deg`` for each relative error of a protocol.

    The comparison takes the number of pairs of each; one without pairs is left out, and so is one
    over seconds whose pairs are not so far apart; the diagnostics say so. A sum of squared rates
    means nothing and is left out.
    """
    metrics: dict[str, float] = {}
    for spec in comparison.protocol.rpe:
        take = tum_relative_errors if spec.pairs.startswith("tum") else evo_relative_errors
        errors, seconds = take(comparison, spec)
        # across a gap TUM's rule pairs a pose with itself, which has no rate
        if spec.rate:
            errors = errors[seconds > 0]
            seconds = seconds[seconds > 0]

        # say what is left out, or doubtful
        fault = _not_over_seconds(comparison, spec, seconds)
        if fault:
            comparison.diagnostics.append(
                f"{fault}: the relative error over {spec.key} is left out"
            )
            errors = errors[:0]
            seconds = seconds[:0]
        elif not len(errors):
            comparison.diagnostics.append(
                f"no pair of poses for the relative error over {spec.key}; it is left out"
            )
        elif spec.pairs == "tum-fixed" and spec.unit == "s" and not spec.rate and not seconds.all():
            itself = f"{np.count_nonzero(seconds == 0)} of {len(seconds)} pairs over {spec.key} join a pose with itself"
            comparison.diagnostics.append(
                f"{itself}, as TUM's script has it where the next pose is far"
            )

        # statistics of translation and rotation, of a rate by the second
        comparison.n_pairs_rpe[spec.key] = len(errors)
        over = seconds if spec.rate else 1.0
        translation = np.linalg.norm(errors[:, :3, 3], axis=1) / over
        rotation = np.rad2deg(se3.rotation_angle(errors)) / over
        metrics |= metrics_with_prefix(f"rpe_{spec.key}_trans", translation, spec.unit_of("trans"))
        metrics |= metrics_with_prefix(f"rpe_{spec.key}_rot", rotation, spec.unit_of("rot"))
    return {
        name: value
        for name, value in metrics.items()
        if "_sse_m_per" not in name and "_sse_deg_per" not in name
    }


def _not_over_seconds(comparison: Comparison, spec: RPESpec, seconds: Array) -> str:
    """Why pairs that were chosen over seconds are not so far apart; empty where they are, and for other deltas.

    TUM's rule takes the pose closest to a delta behind, however far it is from there: of poses in
    milliseconds that is the pose itself, and the error is 0.

    Args:
        comparison: What is compared.
        spec: How pairs were chosen.
        seconds: Time between the two poses of each pair ``[P]``.
    """
    if spec.unit != "s" or not len(seconds):
        return ""
    if are_frame_numbers(comparison.estimate.timestamps):
        return f"{describe_frame_numbers(comparison.estimate.timestamps, 'estimate')}, as frame numbers are"
    apart_s = float(np.median(seconds))
    if abs(apart_s - spec.delta) <= MOST_OFF * spec.delta:
        return ""
    return f"the pairs that are closest to {spec.delta:g} s apart are {apart_s:g} s apart by the median"


MOST_OFF = 0.5
"""Share of a delta in seconds by which the pairs may miss it, by the median."""


def tum_relative_errors(comparison: Comparison, spec: RPESpec) -> tuple[Array, Array]:
    """RPE as TUM's ``evaluate_rpe.py`` takes it.

    Pairs are chosen on the whole estimate. Each pose is compared with the true pose nearest in
    time; a pair takes part if both lie within twice the median interval of the ground truth (not
    within the tolerance of the ATE). With ``A = P_i^-1 P_j`` estimated and ``B = Q_i^-1 Q_j`` true
    the error is ``E = A B^-1``. Its rotation angle equals that of the paper's ``E = B^-1 A`` (Eq.
    26). Its translation does not: it has the length ``|t_A - R_A R_B^T t_B|``, that of Eq. 26 ``|t_A - t_B|``.

    Args:
        comparison: Estimate and truth. Of its alignment the scale alone is used: relative motions do
            not depend on the rest.
        spec: A ``tum-fixed`` or ``tum-random`` selection.

    Returns:
        Errors ``[P, 4, 4]``, and the seconds between the two poses of each pair ``[P]``.
    """
    # pairs of poses that both have truth
    estimate = comparison.estimate
    truth = comparison.ground_truth
    pairs = select_pairs(estimate.timestamps, estimate.T_world_cam, spec)
    nearest = closest(truth.timestamps, estimate.timestamps)
    tolerance = 2 * float(np.median(np.diff(truth.timestamps))) if len(truth) > 1 else 0.0
    covered = nearest_gap(estimate.timestamps, truth.timestamps) <= tolerance
    pairs = pairs[covered[pairs[:, 0]] & covered[pairs[:, 1]]]

    # E = A B^-1 of the estimated and the true steps
    steps = se3.between(estimate.T_world_cam, pairs)
    steps[:, :3, 3] *= comparison.similarity.scale
    true_steps = se3.between(truth.T_world_cam, nearest[pairs])
    seconds = np.diff(estimate.timestamps[pairs], axis=1)[:, 0]
    return steps @ se3.inverse(true_steps), seconds


def evo_relative_errors(comparison: Comparison, spec: RPESpec) -> tuple[Array, Array]:
    """RPE as evo takes it: ``E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j)`` (Eq. 26) over pairs of associated, aligned poses.

    Args:
        comparison: The estimate's poses decide which pairs are chosen.
        spec: A ``consecutive`` or ``all`` selection.

    Returns:
        Errors ``[P, 4, 4]``, and the seconds between the two poses of each pair ``[P]``.
    """
    pairs = select_pairs(comparison.stamps, comparison.aligned, spec)
    steps = se3.between(comparison.aligned, pairs)
    true_steps = se3.between(comparison.truth, pairs)
    seconds = np.diff(comparison.stamps[pairs], axis=1)[:, 0]
    return se3.inverse(true_steps) @ steps, seconds


# Which pairs of poses a relative pose error is taken over: TUM's two ways and evo's two.


def select_pairs(stamps: Array, poses: Array, spec: RPESpec) -> Index:
    """Choose the pairs of poses that a relative pose error is taken over.

    Args:
        stamps: Seconds ``[N]``, ascending.
        poses: Camera-to-world poses ``[N, 4, 4]``, of the estimate, as TUM's script and evo choose.
        spec: Mode, delta and unit.

    Returns:
        Indices ``(i, j)`` ``[P, 2]`` into the trajectory, i before j; there may be none. In mode
        ``tum-random`` pairs come in both directions and may join a pose with itself.
    """
    if not len(poses):
        return np.zeros((0, 2), dtype=np.intp)
    if spec.pairs == "tum-random":
        return random_pairs(len(poses), spec.max_pairs)
    # evo: pairs of so many frames, one after the other or from every pose
    if spec.pairs in ("consecutive", "all"):
        frames = round(spec.delta)
        step = frames if spec.pairs == "consecutive" else 1
        starts = np.arange(0, len(poses) - frames, step)
        return np.stack([starts, starts + frames], axis=1).astype(np.intp)
    # TUM: from every pose to the one closest to a delta later; as in evaluate_rpe.py
    # --fixed_delta the last pose ends no pair
    index = path_index(stamps, poses, spec)
    end = closest(index, index + spec.delta)
    keep = end != len(index) - 1
    pairs = np.stack([np.flatnonzero(keep), end[keep]], axis=1)
    # a sample of them, where there are too many
    if spec.max_pairs and len(pairs) > spec.max_pairs:
        order = np.argsort(_uniform("rpe sample of fixed pairs", len(pairs)), kind="stable")
        pairs = pairs[np.sort(order[: spec.max_pairs])]
    return pairs


def path_index(stamps: Array, poses: Array, spec: RPESpec) -> Array:
    """Path length up to every pose ``[N]``, in the unit of the delta."""
    if spec.unit in ("f", "s"):
        return np.arange(len(poses), dtype=np.float64) if spec.unit == "f" else stamps
    steps = se3.inverse(poses[:-1]) @ poses[1:]
    if spec.unit == "m":
        step = np.linalg.norm(steps[:, :3, 3], axis=1)
    else:
        step = se3.rotation_angle(steps) * (180 / np.pi if spec.unit == "deg" else 1.0)
    return np.asarray(np.concatenate([np.zeros(1), np.cumsum(step)]), dtype=np.float64)


def closest(values: Array, targets: Array) -> Index:
    """Index of the value closest to each target, found by bisection as TUM's scripts do it.

    The bisection decides which of equal values, and which of two equally distant ones, is taken:
    the one it meets first (a standing camera makes equal values common).

    Args:
        values: Ascending ``[N]``, at least one.
        targets: ``[M]``.

    Returns:
        ``[M]``; read-only, as equal stamps share one result.
    """
    return _closest(
        np.asarray(values, np.float64).tobytes(), np.asarray(targets, np.float64).tobytes()
    )


@lru_cache(maxsize=256)
def _closest(value_bytes: bytes, target_bytes: bytes) -> Index:
    """`closest` of float64 arrays as bytes; all targets are bisected at once."""
    values = np.frombuffer(value_bytes)
    targets = np.frombuffer(target_bytes)
    # an interval of indices for each target, and the closest value met so far
    low = np.zeros(len(targets), dtype=np.intp)
    best = np.zeros(len(targets), dtype=np.intp)
    high = np.full(len(targets), len(values), dtype=np.intp)
    distance = np.abs(values[0] - targets)
    while (active := low < high).any():
        # the middle of each interval that is not empty
        middle = np.where(active, (low + high) // 2, 0)
        value = values[middle]
        better = active & ((np.abs(value - targets) < distance) | (value == targets))
        best = np.where(better, middle, best)
        distance = np.where(better, np.abs(value - targets), distance)

        # go on in the half that holds the target; an interval with an equal value is done
        high = np.where(active & (value > targets), middle, high)
        low = np.where(
            active & (value < targets), middle + 1, np.where(value == targets, high, low)
        )
    best.flags.writeable = False
    return best


def random_pairs(n: int, count: int) -> Index:
    """`count` random pairs of `n` poses; every pair where ``n < sqrt(count)`` or `count` is 0.

    Drawn from raw PCG64 words, so that every version of Python and NumPy gives the same ones (TUM's
    script draws from Python's generator, whose sequence changed between versions).
    """
    if count == 0 or n < np.sqrt(count):
        return np.ascontiguousarray(np.indices((n, n)).reshape(2, -1).T).astype(np.intp)
    drawn = (_uniform("rpe random pairs", 2 * count) * n).astype(np.intp)
    return np.minimum(drawn, n - 1).reshape(count, 2)


def _uniform(purpose: str, count: int) -> Array:
    """Numbers in [0, 1) from raw generator words, a function of the purpose only."""
    words = np.asarray(stream(0, purpose).bit_generator.random_raw(count), dtype=np.uint64)
    return np.asarray((words >> np.uint64(11)) * 2.0**-53, dtype=np.float64)


# Errors over segments of fixed length, as the KITTI odometry benchmark takes them.

STEP = 10
"""Poses between the starts of segments."""


def segment_errors(
    estimate: Array, ground_truth: Array, lengths_m: Sequence[float]
) -> tuple[Array, Array]:
    """KITTI's odometry drift: error of the motion along segments of given length, as a share of that length.

    As in the devkit, segments begin at every tenth pose and end where the true path has grown by the length.

    Args:
        estimate: Associated camera-to-world poses ``[N, 4, 4]``.
        ground_truth: True poses ``[N, 4, 4]``.
        lengths_m: Lengths in metres.

    Returns:
        Translational drift in percent ``[K]`` and rotational drift in degrees a metre ``[K]``;
        empty where the path is shorter than the shortest length.
    """
    # length of the true path up to every pose
    steps = np.linalg.norm(np.diff(ground_truth[:, :3, 3], axis=0), axis=1)
    travelled = np.concatenate([[0.0], np.cumsum(steps)])

    # every start with every length, where the path is long enough
    grid = np.meshgrid(
        np.arange(0, len(travelled), STEP), np.array(lengths_m, np.float64), indexing="ij"
    )
    starts, metres = (values.ravel() for values in grid)
    ends = np.searchsorted(travelled, travelled[starts] + metres, side="right")
    inside = ends < len(travelled)
    metres = metres[inside]
    pairs = np.stack([starts, ends], axis=1)[inside]

    # error of the motion along each segment, by its length
    error = se3.inverse(se3.between(estimate, pairs)) @ se3.between(ground_truth, pairs)
    percent = np.linalg.norm(error[:, :3, 3], axis=1) / metres * 100
    degrees_per_m = np.rad2deg(se3.rotation_angle(error)) / metres
    return percent, degrees_per_m


def segment_metrics(comparison: Comparison) -> dict[str, float]:
    """KITTI's drift over segments; empty, with a line in the diagnostics, where the path is too short for any."""
    lengths = comparison.protocol.segments_m
    truth = comparison.truth
    if not lengths:
        return {}
    translation, rotation = segment_errors(comparison.aligned, truth, lengths)
    if not len(translation):
        path = float(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum())
        comparison.diagnostics.append(
            f"the path of {path:.1f} m is shorter than a segment of {min(lengths):g} m"
        )
        return {}
    return {
        "kitti_trans_percent": statistics(translation)["mean"],
        "kitti_rot_deg_per_m": statistics(rotation)["mean"],
    }
