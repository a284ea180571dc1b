"""Two trajectories prepared, associated and aligned under a protocol: what every metric is computed from."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dynslam_bench.core import EvaluationError
from dynslam_bench.core.records import Record
from dynslam_bench.evaluation.alignment import Similarity, align
from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.geometry import (
    Array,
    Trajectory,
    are_frame_numbers,
    associate,
    describe_frame_numbers,
    nearest_gap,
)
from dynslam_bench.geometry.rigs import (
    BONN_R_BODY_CAM,
    bonn_as_droid_w,
    bonn_camera,
    in_camera_axes,
)
from dynslam_bench.geometry.stamp_units import LATEST_S, UNIX_S

Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Comparison:
    """An estimate beside the ground truth.

    Attributes:
        protocol: How they are compared.
        estimate: All poses that take part, also those without ground truth (TUM's relative errors
            need them).
        ground_truth: All true poses, corrected as the protocol has it.
        estimate_index: Rows ``[K]`` of `estimate` that are associated.
        truth_index: Rows ``[K]`` of `ground_truth` that these are associated with.
        association: What was dropped.
        similarity: The alignment.
        input_timestamps: Stamps in seconds of all input frames; None where they are not known.
        diagnostics: One line for each fact that the numbers depend on; metrics add to it.
        n_pairs_rpe: Pairs of poses of each relative error; `relative_metrics` fills it in.
    """

    protocol: Protocol
    estimate: Trajectory
    ground_truth: Trajectory
    estimate_index: Index
    truth_index: Index
    association: AssociationRecord
    similarity: Similarity
    input_timestamps: ArrayLike | None
    diagnostics: list[str]
    n_pairs_rpe: dict[str, int] = field(default_factory=dict)

    @property
    def stamps(self) -> Array:
        """Stamps of the associated poses of the estimate in seconds ``[K]``."""
        return self.estimate.timestamps[self.estimate_index]

    @cached_property
    def aligned(self) -> Array:
        """Associated poses of the estimate, aligned ``[K, 4, 4]``."""
        return self.similarity.apply(self.estimate.T_world_cam[self.estimate_index])

    @cached_property
    def truth(self) -> Array:
        """The true poses that they are compared with ``[K, 4, 4]``."""
        return self.ground_truth.T_world_cam[self.truth_index]


def compare(
    estimate: Trajectory,
    ground_truth: Trajectory,
    protocol: Protocol,
    input_timestamps: ArrayLike | None = None,
    diagnostics: list[str] | None = None,
) -> Comparison:
    """Prepare, associate and align an estimate; what the protocol makes of lost frames is left out.

    Args:
        estimate: Estimated camera-to-world poses.
        ground_truth: True poses.
        protocol: The protocol.
        input_timestamps: Stamps in seconds of all input frames.
        diagnostics: Takes a line on everything that the numbers depend on.

    Raises:
        EvaluationError: Fewer than two poses have ground truth (with the measured gaps), or a
            position is so large that its square is no number.
    """
    diagnostics = [] if diagnostics is None else diagnostics
    for whose, trajectory in (("estimate", estimate), ("ground truth", ground_truth)):
        _refuse_infinite(trajectory, whose)
    # the protocol's corrections of the truth, and its choice of frames
    estimate, ground_truth = compared(
        estimate, ground_truth, protocol, input_timestamps, diagnostics
    )
    # pairs of poses by their stamps
    estimate_index, truth_index, association = match(estimate, ground_truth, protocol)
    dropped = association.describe(protocol.max_dt)
    if len(estimate_index) < 2:
        fault = f"only {len(estimate_index)} of {len(estimate)} poses has ground truth within {protocol.max_dt:g} s"
        raise EvaluationError(f"{fault}, at least 2 are needed", dropped)
    if dropped:
        diagnostics.append(dropped)
    # evo's rule may use an estimated pose several times
    if (taken := len(np.unique(estimate_index))) < len(estimate_index):
        diagnostics.append(
            f"{len(estimate_index)} pairs are made of {taken} estimated poses: the estimate has more poses than the "
            "ground truth, so each true pose takes its nearest one"
        )
    # the alignment of the pairs, by least squares
    matched = estimate.T_world_cam[estimate_index]
    truth = ground_truth.T_world_cam[truth_index]
    similarity = align(matched, truth, protocol.alignment)
    return Comparison(
        protocol,
        estimate,
        ground_truth,
        estimate_index,
        truth_index,
        association,
        similarity,
        input_timestamps,
        diagnostics,
    )


LARGEST_M = 1e150
"""Squares of larger numbers are no numbers any more."""


def _refuse_infinite(trajectory: Trajectory, whose: str) -> None:
    """Refuse a trajectory with a pose farther away than `LARGEST_M`."""
    sizes = np.abs(trajectory.positions).max(axis=1, initial=0.0)
    if len(sizes) and sizes.max() > LARGEST_M:
        at = int(sizes.argmax())
        raise EvaluationError(
            f"the pose of the {whose} at the stamp {trajectory.timestamps[at]:.6f} lies {sizes[at]:.3g} m away",
            "correct or remove it",
        )


# Association of the two, with the reasons for what was dropped.


class AssociationRecord(Record):
    """Counts of the compared and the dropped poses, as records hold them.

    Attributes:
        n_estimate: Poses of the estimate.
        n_ground_truth: Poses of the ground truth.
        outside: Estimated poses dropped because they lie before the first or behind the last true
            pose.
        in_holes: Estimated poses dropped because they lie in a hole of the ground truth.
        taken: Estimated poses dropped because a closer one had already taken their true pose (or,
            for evo's rule, because the ground truth is the shorter trajectory and no pose of it
            chose them).
        median_dt_s: Median |dt| of the pairs.
        largest_hole_s: Largest distance between true poses within the time of the estimate.
        hole_at_s: Stamp at which that hole begins.
    """

    n_estimate: int
    n_ground_truth: int
    outside: int
    in_holes: int
    taken: int
    median_dt_s: float
    largest_hole_s: float
    hole_at_s: float

    def describe(self, max_dt: float) -> str:
        """One line with the measured numbers; empty if nothing was dropped."""
        dropped = self.outside + self.in_holes + self.taken
        if not dropped:
            return ""
        reasons = [
            (self.outside, f"{self.outside} outside the ground truth's time"),
            (self.in_holes, f"{self.in_holes} in holes of it"),
            (self.taken, f"{self.taken} not chosen, a closer one was there"),
        ]
        return (
            f"no ground truth within {max_dt:g} s for {dropped} of {self.n_estimate} poses ("
            + ", ".join(text for count, text in reasons if count)
            + f"; largest hole {self.largest_hole_s:.2f} s at t={self.hole_at_s:.6f}; median |dt| "
            f"{self.median_dt_s:.4f} s)"
        )


def match(
    estimate: Trajectory, ground_truth: Trajectory, protocol: Protocol
) -> tuple[Index, Index, AssociationRecord]:
    """Associate two trajectories under a protocol.

    Returns:
        Indices into the estimate and into the ground truth ``[K]``, ascending in the estimate, and
        what was dropped.

    Raises:
        EvaluationError: A trajectory is empty or no pair is close enough; the message carries the
            measured gap.
    """
    if not (len(estimate) and len(ground_truth)):
        raise EvaluationError(
            f"the {'ground truth' if len(estimate) else 'estimate'} holds no poses"
        )
    # TUM's rule, one to one, or evo's, the nearest for each pose of the shorter
    t_est = estimate.timestamps
    t_gt = ground_truth.timestamps
    max_dt = protocol.max_dt
    strict = protocol.strict
    if protocol.one_to_one:
        index_gt, index_est = associate(t_gt, t_est, max_dt, strict=strict)
        order = np.argsort(index_est, kind="stable")
        index_gt = index_gt[order]
        index_est = index_est[order]
    # evo starts from the shorter one, and from the second of equal ones
    elif len(t_est) > len(t_gt):
        index_gt, index_est = nearest_match(t_gt, t_est, max_dt, strict=strict)
    else:
        index_est, index_gt = nearest_match(t_est, t_gt, max_dt, strict=strict)
    # no pair at all: most likely the clocks differ
    if not len(index_est):
        raise EvaluationError(
            f"none of {len(t_est)} poses has ground truth within {max_dt:g} s: the nearest is "
            f"{nearest_gap(t_est, t_gt).min():.3f} s away; the estimate covers {t_est[0]:.3f} to {t_est[-1]:.3f} s, "
            f"the ground truth {t_gt[0]:.3f} to {t_gt[-1]:.3f} s",
            clock_hint(t_est, t_gt),
        )
    return index_est, index_gt, _record(t_est, t_gt, index_est, index_gt, max_dt, strict=strict)


def clock_hint(stamps: ArrayLike, true_stamps: ArrayLike) -> str:
    """Advice on putting the stamps of an estimate and of its truth, seconds ``[N]`` and ``[M]``, on one clock."""
    own, true = (np.asarray(values, dtype=np.float64) for values in (stamps, true_stamps))
    # frame numbers on one side
    if are_frame_numbers(own) != are_frame_numbers(true):
        whose, numbers = ("estimate", own) if are_frame_numbers(own) else ("ground truth", true)
        return f"{describe_frame_numbers(numbers, whose)}: frame numbers? Then give the stamps of the images in seconds"
    # Unix time on one side
    own_is_unix, true_is_unix = (
        UNIX_S <= float(np.abs(values).max()) <= LATEST_S for values in (own, true)
    )
    if own_is_unix != true_is_unix and max(np.abs(own).max(), np.abs(true).max()) <= LATEST_S:
        whose, other = ("estimate", "ground truth") if own_is_unix else ("ground truth", "estimate")
        later_s = abs(float(true.min() - own.min()))
        return (
            f"only the {whose} has Unix time: if both begin with the same frame, add {later_s:.6f} s to each stamp of "
            f"the {other}"
        )
    # nanoseconds on one side
    if not 1e-5 <= np.abs(own).max() / max(np.abs(true).max(), 1e-9) <= 1e5:
        return "are the stamps of one of them in nanoseconds? Give seconds"
    return "do the files belong together, and do their clocks agree?"


def nearest_match(
    stamps: Array, others: Array, max_dt: float, *, strict: bool
) -> tuple[Index, Index]:
    """For every stamp the nearest of the others, the earlier on a tie (evo's rule: stamps may be used repeatedly).

    Args:
        stamps: Seconds ``[N]``, ascending; equal ones are allowed here.
        others: Seconds ``[M]``, ascending, not empty; of equal ones the first is chosen.
        max_dt: Tolerance in seconds.
        strict: Whether a difference that equals it is too much.

    Returns:
        Indices into both lists ``[K]``, in order of `stamps`.
    """
    # the neighbours on both sides of each stamp, and how far off they are
    right = np.clip(np.searchsorted(others, stamps, side="right"), 0, len(others) - 1)
    left = np.maximum(right - 1, 0)
    right_dt = others[right] - stamps
    left_dt = np.where(right > 0, stamps - others[left], np.inf)
    # the nearer one; of equal stamps the first
    chosen = np.searchsorted(others, others[np.where(right_dt < left_dt, right, left)])
    dt = np.minimum(right_dt, left_dt)
    keep = dt < max_dt if strict else dt <= max_dt
    keep &= (stamps >= others[0] - max_dt) & (stamps <= others[-1] + max_dt)
    return np.flatnonzero(keep), chosen[keep]


def _record(
    t_est: Array, t_gt: Array, index_est: Index, index_gt: Index, max_dt: float, *, strict: bool
) -> AssociationRecord:
    """Count the associated poses, and the others by the reason why they have no partner; stamps in seconds."""
    # why a pose has no partner: beyond the ends, in a hole, or another was nearer
    unmatched = ~np.isin(np.arange(len(t_est)), index_est)
    gap = nearest_gap(t_est, t_gt)
    far = gap >= max_dt if strict else gap > max_dt
    outside = far & ((t_est < t_gt[0]) | (t_est > t_gt[-1]))
    # the largest hole of the truth within the estimate's time
    within = t_gt[(t_gt > t_est[0]) & (t_gt < t_est[-1])]
    edges = np.concatenate([t_est[:1], within, t_est[-1:]])
    hole = int(np.argmax(np.diff(edges)))
    return AssociationRecord(
        n_estimate=len(t_est),
        n_ground_truth=len(t_gt),
        outside=int((unmatched & outside).sum()),
        in_holes=int((unmatched & far & ~outside).sum()),
        taken=int((unmatched & ~far).sum()),
        median_dt_s=float(np.median(np.abs(t_est[index_est] - t_gt[index_gt]))),
        largest_hole_s=float(edges[hole + 1] - edges[hole]),
        hole_at_s=float(edges[hole]),
    )


# What is done to both before: the truth's corrections, which frames, lost frames.


def truth_of_file(truth: Trajectory, protocol: Protocol) -> Trajectory:
    """A ground-truth file's poses as `evaluate` takes them.

    Bonn's files hold the orientations of the markers, its sequences those of the camera; the
    protocols that move the positions start from the latter. For all others a file is taken as it
    stands.
    """
    if protocol.truth == "as-is":
        return truth
    return truth.with_poses(in_camera_axes(truth.T_world_cam, BONN_R_BODY_CAM))


def compared(
    estimate: Trajectory,
    ground_truth: Trajectory,
    protocol: Protocol,
    input_timestamps: ArrayLike | None,
    diagnostics: list[str],
) -> tuple[Trajectory, Trajectory]:
    """The trajectories that a protocol compares: the truth corrected, the estimate on the frames that count.

    Args:
        estimate: Estimated poses.
        ground_truth: True poses, with the camera's orientations.
        protocol: The protocol.
        input_timestamps: Stamps in seconds of all input frames; without them those of the estimate
            count.
        diagnostics: Takes a line on what was left out.

    Raises:
        EvaluationError: None of the frames that count was tracked.
    """
    # Bonn's markers are not the camera
    if protocol.truth != "as-is":
        correct = bonn_camera if protocol.truth == "bonn-camera" else bonn_as_droid_w
        ground_truth = ground_truth.with_poses(correct(ground_truth.T_world_cam))
    # protocols that compare every frame end here
    if not protocol.thins:
        return estimate, ground_truth
    stamps = (
        estimate.timestamps
        if input_timestamps is None
        else np.asarray(input_timestamps, np.float64).reshape(-1)
    )
    # the frames that are compared: every so many of those with ground truth
    matched = np.sort(
        associate(ground_truth.timestamps, stamps, protocol.max_dt, strict=protocol.strict)[1]
    )
    chosen = stamps[matched[:: protocol.every][: protocol.most_frames or None]]
    # of these, the ones that were tracked
    index = associate(chosen, estimate.timestamps, STAMP_TOLERANCE, strict=False)[1]
    if not len(index):
        raise EvaluationError(
            f"none of {len(estimate)} poses is of the {len(chosen)} frames that {protocol.id} compares "
            f"(every {protocol.every} of {len(matched)} matched ones, at most {protocol.most_frames})"
        )
    diagnostics.append(
        f"{len(index)} poses on {len(chosen)} frames are compared: every {protocol.every} of {len(matched)} matched"
    )
    return estimate.select(np.sort(index)), ground_truth


def apply_policy(
    estimate: Trajectory,
    protocol: Protocol,
    input_timestamps: ArrayLike | None,
    diagnostics: list[str],
) -> tuple[Trajectory, NDArray[np.bool_] | None]:
    """The estimate with its lost frames held or left out, as the protocol has it.

    Args:
        estimate: Camera-to-world poses as the tracker gave them.
        protocol: Its `lost_frames` policy is applied.
        input_timestamps: Stamps of all input frames, seconds; None if they are not known.
        diagnostics: Gains a line on what was held or left out.

    Returns:
        The estimate, and which input frames were tracked ``[N]``; None where the input frames are
        not known.

    Raises:
        EvaluationError: The policy needs the input frames.
    """
    if input_timestamps is None:
        if protocol.lost_frames != "exclude":
            raise EvaluationError(
                f"protocol {protocol.id} ({protocol.lost_frames}) needs the stamps of the input frames",
                "pass input_timestamps, or use a protocol that excludes lost frames",
            )
        return estimate, None
    # hold the last pose on lost frames, or leave them out
    tracked = tracked_frames(estimate, input_timestamps)
    n_input = len(tracked)
    n_tracked = int(tracked.sum())
    if n_tracked == n_input:
        return estimate, tracked
    lost = f"{n_input - n_tracked} of {n_input} frames were lost (coverage {100 * n_tracked / n_input:.1f} %)"
    held = protocol.lost_frames == "hold"
    diagnostics.append(f"{lost} and {'held at the last tracked pose' if held else 'take no part'}")
    return (hold(estimate, input_timestamps) if held else estimate), tracked


# Which frames take part: coverage, and held poses of lost frames.

STAMP_TOLERANCE = 1e-3
"""Seconds within which two stamps name the same input frame (trajectory files round to a microsecond or worse)."""


LONGEST_STEP_S = 1.0
"""Poses that are farther apart in time have a hole between them, unless the trajectory has keyframes alone."""
LONGEST_STEP = 5.0
"""Time between poses of a trajectory of keyframes that is no hole yet, in its median steps."""


def share_of_time(stamps: ArrayLike, true_stamps: ArrayLike) -> float:
    """Share of the ground truth's time that a trajectory has poses for, 0 to 1; holes do not count.

    It takes the place of the coverage where the input frames are not known. A ground truth that is
    longer than the recording makes it smaller than the coverage.

    Args:
        stamps: Stamps of the poses in seconds, in order.
        true_stamps: Stamps of the ground truth in seconds, in order.
    """
    poses = np.asarray(stamps, dtype=np.float64)
    truth = np.asarray(true_stamps, dtype=np.float64)
    if min(len(poses), len(truth)) < 2:
        return 0.0
    whole_s = float(truth[-1] - truth[0])
    if whole_s <= 0:
        return 0.0

    # steps between poses, as far as they lie within the truth's time
    longest_s = max(LONGEST_STEP_S, LONGEST_STEP * float(np.median(np.diff(poses))))
    is_step = np.diff(poses) <= longest_s
    within_s = np.diff(np.clip(poses, truth[0], truth[-1]))
    return min(1.0, float(within_s[is_step].sum()) / whole_s)


def tracked_frames(estimate: Trajectory, input_timestamps: ArrayLike) -> NDArray[np.bool_]:
    """Flags ``[N]`` of input frames that have a pose in the estimate.

    A pose belongs to the frame nearest in time, one-to-one, within half a frame interval: some
    systems write the depth image's stamp, and files round.

    Raises:
        EvaluationError: The estimate has poses at stamps that are no input frame's.
    """
    poses = estimate.timestamps
    stamps = np.asarray(input_timestamps, dtype=np.float64).reshape(-1)
    interval = float(np.median(np.diff(np.sort(stamps)))) if len(stamps) > 1 else 0.0
    index, _ = associate(stamps, poses, max(interval / 2, STAMP_TOLERANCE), strict=False)
    if len(index) < len(poses):
        raise EvaluationError(
            f"{len(poses) - len(index)} of {len(poses)} estimated poses belong to none of {len(stamps)} input frames",
            "the estimate has to carry the stamps of the images",
        )
    return np.isin(np.arange(len(stamps)), index)


def hold(estimate: Trajectory, input_timestamps: ArrayLike) -> Trajectory:
    """The trajectory with a pose for every input frame: lost frames stay at the last tracked pose.

    Frames before the first tracked one take its pose.

    Raises:
        EvaluationError: Nothing was tracked, or the estimate does not belong to the input frames.
    """
    if not len(estimate):
        raise EvaluationError("no frame was tracked, so there is no pose to hold")
    stamps = np.asarray(input_timestamps, dtype=np.float64).reshape(-1)
    return Trajectory(
        stamps, estimate.T_world_cam[np.maximum(np.cumsum(tracked_frames(estimate, stamps)) - 1, 0)]
    )
