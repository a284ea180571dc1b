"""Two trajectories prepared, associated and aligned under a protocol: what every metric is computed from."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dynslam_bench.core.errors import EvaluationError
from dynslam_bench.core.records import Record
from dynslam_bench.evaluation.alignment import Similarity, align
from dynslam_bench.evaluation.prepare import compared
from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.geometry.association import associate, nearest_gap
from dynslam_bench.geometry.trajectory import Trajectory

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Comparison:
    """An estimate beside the ground truth.

    Attributes:
        protocol: How they are compared.
        estimate: All poses that take part, also those without ground truth (TUM's relative errors need them).
        ground_truth: All true poses, corrected as the protocol has it.
        estimate_index: Associated poses of the estimate ``[K]``.
        truth_index: Their counterparts in the ground truth ``[K]``.
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
        EvaluationError: Fewer than two poses have ground truth (with the measured gaps).
    """
    diagnostics = [] if diagnostics is None else diagnostics
    estimate, ground_truth = compared(estimate, ground_truth, protocol, input_timestamps, diagnostics)
    estimate_index, truth_index, association = match(estimate, ground_truth, protocol)
    dropped = association.describe(protocol.max_dt)
    if len(estimate_index) < 2:
        fault = f"only {len(estimate_index)} of {len(estimate)} poses has ground truth within {protocol.max_dt:g} s"
        raise EvaluationError(f"{fault}, at least 2 are needed", dropped)
    if dropped:
        diagnostics.append(dropped)
    matched, truth = estimate.T_world_cam[estimate_index], ground_truth.T_world_cam[truth_index]
    similarity = align(matched, truth, protocol.alignment)
    return Comparison(
        protocol, estimate, ground_truth, estimate_index, truth_index, association, similarity, input_timestamps,
        diagnostics,
    )  # fmt: skip


# Association of the two, with the reasons for what was dropped.


class AssociationRecord(Record):
    """What was compared and what was dropped, as records hold it.

    Attributes:
        n_estimate: Poses of the estimate.
        n_ground_truth: Poses of the ground truth.
        outside: Estimated poses dropped because they lie before the first or behind the last true pose.
        in_holes: Estimated poses dropped because they lie in a hole of the ground truth.
        taken: Estimated poses dropped because a closer one had already taken their true pose (or, for evo's rule,
            because the ground truth is the shorter trajectory and no pose of it chose them).
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


def match(estimate: Trajectory, ground_truth: Trajectory, protocol: Protocol) -> tuple[Index, Index, AssociationRecord]:
    """Associate two trajectories under a protocol.

    Returns:
        Indices into the estimate and into the ground truth ``[K]``, ascending in the estimate, and what was dropped.
        The arrays are read-only, as equal stamps share one result.

    Raises:
        EvaluationError: A trajectory is empty or no pair is close enough; the message carries the measured gap.
    """
    for name, trajectory in (("estimate", estimate), ("ground truth", ground_truth)):
        if not len(trajectory):
            raise EvaluationError(f"the {name} holds no poses")
    rule = protocol.max_dt, protocol.strict, protocol.one_to_one
    return _matched(estimate.timestamps.tobytes(), ground_truth.timestamps.tobytes(), *rule)


@lru_cache(maxsize=256)
def _matched(
    estimate: bytes, ground_truth: bytes, max_dt: float, strict: bool, one_to_one: bool
) -> tuple[Index, Index, AssociationRecord]:
    """`match`, once for equal stamps."""
    t_est, t_gt = np.frombuffer(estimate), np.frombuffer(ground_truth)
    if one_to_one:
        index_gt, index_est = associate(t_gt, t_est, max_dt, strict=strict)
        order = np.argsort(index_est, kind="stable")
        index_gt, index_est = index_gt[order], index_est[order]
    elif len(t_est) > len(t_gt):  # evo starts from the shorter one, and from the second of equal ones
        index_gt, index_est = nearest_match(t_gt, t_est, max_dt, strict=strict)
    else:
        index_est, index_gt = nearest_match(t_est, t_gt, max_dt, strict=strict)
    if not len(index_est):
        raise _nothing_matched(t_est, t_gt, max_dt)
    index_est.flags.writeable = index_gt.flags.writeable = False
    return index_est, index_gt, _record(t_est, t_gt, index_est, index_gt, max_dt, strict=strict)


def nearest_match(stamps: Array, others: Array, max_dt: float, *, strict: bool) -> tuple[Index, Index]:
    """For every stamp the nearest of the others, the earlier on a tie (evo's rule: stamps may be used repeatedly).

    Args:
        stamps: Seconds ``[N]``, ascending.
        others: Seconds ``[M]``, ascending, not empty.
        max_dt: Tolerance in seconds.
        strict: Whether a difference that equals it is too much.

    Returns:
        Indices into both lists ``[K]``, in order of `stamps`.
    """
    right = np.clip(np.searchsorted(others, stamps, side="right"), 0, len(others) - 1)
    left = np.maximum(right - 1, 0)
    right_dt = others[right] - stamps
    left_dt = np.where(right > 0, stamps - others[left], np.inf)
    chosen = np.where(right_dt < left_dt, right, left)
    dt = np.minimum(right_dt, left_dt)
    keep = dt < max_dt if strict else dt <= max_dt
    keep &= (stamps >= others[0] - max_dt) & (stamps <= others[-1] + max_dt)
    return np.flatnonzero(keep), chosen[keep]


def _record(
    t_est: Array, t_gt: Array, index_est: Index, index_gt: Index, max_dt: float, *, strict: bool
) -> AssociationRecord:
    unmatched = np.ones(len(t_est), dtype=bool)
    unmatched[index_est] = False
    gap = nearest_gap(t_est, t_gt)
    far = gap >= max_dt if strict else gap > max_dt
    outside = far & ((t_est < t_gt[0]) | (t_est > t_gt[-1]))
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


def _nothing_matched(t_est: Array, t_gt: Array, max_dt: float) -> EvaluationError:
    gap = nearest_gap(t_est, t_gt)
    message = (
        f"none of {len(t_est)} poses has ground truth within {max_dt:g} s: the nearest is {gap.min():.3f} s "
        f"away; the estimate covers {t_est[0]:.3f} to {t_est[-1]:.3f} s, "
        f"the ground truth {t_gt[0]:.3f} to {t_gt[-1]:.3f} s"
    )
    other_unit = not 1e-5 <= np.abs(t_est).max() / max(np.abs(t_gt).max(), 1e-9) <= 1e5
    hint = "are the stamps of one file in nanoseconds or frame numbers?"
    return EvaluationError(message, hint if other_unit else "do the files belong together, and do their clocks agree?")
