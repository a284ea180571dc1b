"""One trajectory against the ground truth under one protocol."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from dynslam_bench.core.number_text import mm
from dynslam_bench.core.records import Record, schema
from dynslam_bench.evaluation.ape import (
    absolute_errors,
    absolute_metrics,
    false_motion_metrics,
    static_camera_metrics,
)
from dynslam_bench.evaluation.comparison import (
    AssociationRecord,
    Comparison,
    apply_policy,
    compare,
    share_of_time,
    truth_of_file,
)
from dynslam_bench.evaluation.plausibility import warnings_of
from dynslam_bench.evaluation.protocol import Alignment, Protocol, get_protocol
from dynslam_bench.evaluation.rpe import relative_metrics, segment_metrics
from dynslam_bench.evaluation.uncertainty import (
    PoseNoise,
    Uncertainty,
    motion_uncertainty,
)
from dynslam_bench.geometry import LoadedTrajectory, Trajectory, load_trajectory
from dynslam_bench.geometry.motion_covariances import MotionCovariances

SCHEMA_VERSION = 1
METRICS: tuple[Callable[[Comparison], dict[str, float]], ...] = (
    absolute_metrics,
    relative_metrics,
    segment_metrics,
    static_camera_metrics,
    false_motion_metrics,
)
"""Everything that is measured. To add a metric, add a function here that gives plain floats by name with their unit."""


class AlignmentRecord(Record):
    """The alignment that was applied: ``p_gt = scale * R p_est + t``; see `Similarity`."""

    mode: Alignment
    rotation: list[list[float]]
    translation_m: list[float]
    scale: float
    degenerate: bool
    uncertainty_deg: float | None = None


class Evaluation(Record):
    """The errors of one trajectory, with the protocol that they hold under.

    Attributes:
        schema_version: Version of this record's fields.
        protocol_id: Id of the protocol.
        protocol_digest: Its digest; numbers of different digests are not comparable.
        protocol: Its one-line description.
        metrics: Plain floats. Absolute errors ``ate_<statistic>_m`` (translation) and
            ``ape_rot_<statistic>_deg``, relative ones ``rpe_<delta><unit>_trans_<statistic>_m`` and
            ``..._rot_<statistic>_deg``, KITTI's ``kitti_trans_percent`` and
            ``kitti_rot_deg_per_m``, and ``static_camera_ate_rmse_m``: what a camera that does not
            move scores under the same alignment. The statistics are rmse, mean, median, std, min,
            max, sse. Where the true camera stands still, the false motion: ``false_motion_path_m``,
            the length of the estimated path, and ``false_motion_max_m``, its largest distance from
            its first pose. Where the tracker gave covariances of its motions, their scores, see
            `Uncertainty`.
        n_pairs: Pairs of poses that the absolute error is taken over.
        n_pairs_rpe: Pairs of poses that each relative error is taken over, by its key.
        n_input: Input frames; None where they are not known.
        n_tracked: Input frames with a tracked pose; None where the input frames are not known.
        coverage: Share of the input frames with a tracked pose, 0 to 1; None where they are not
            known.
        truth_share: Share of the ground truth's time that the estimate has poses for, 0 to 1, see
            `share_of_time`; it tells what the coverage cannot where the input frames are not known.
        alignment: How the estimate was aligned.
        association: What was associated and what was dropped.
        diagnostics: One line for each fact that the numbers depend on.
        warnings: What makes the numbers doubtful, a line each.
    """

    schema_version: int = schema(SCHEMA_VERSION)
    protocol_id: str
    protocol_digest: str
    protocol: str
    metrics: dict[str, float]
    n_pairs: int
    n_pairs_rpe: dict[str, int]
    n_input: int | None = None
    n_tracked: int | None = None
    coverage: float | None = None
    truth_share: float | None = None
    alignment: AlignmentRecord
    association: AssociationRecord
    diagnostics: list[str]
    warnings: list[str] = Field(default_factory=list)

    def summary(self) -> str:
        """The ATE with what it depends on, e.g. ``ATE (rmse) 14.2 mm over 848 poses [tum-rgbd/v1 ...]``."""
        covered = ""
        if self.coverage is not None:
            covered = f", {100 * self.coverage:.1f} % of {self.n_input} frames tracked"
        elif self.truth_share is not None:
            covered = f", {100 * self.truth_share:.1f} % of the truth's time"
        return (
            f"ATE (rmse) {mm(self.metrics['ate_rmse_m'])} mm over {self.n_pairs} poses{covered} "
            f"[{self.protocol_id} {self.protocol_digest}]"
        )


def evaluate(
    estimate: Trajectory,
    ground_truth: Trajectory,
    protocol: Protocol | str = "tum-rgbd/v1",
    *,
    input_timestamps: ArrayLike | None = None,
    motion_covariances: MotionCovariances | None = None,
    truth_noise: PoseNoise | None = None,
) -> Evaluation:
    """Absolute and relative pose errors of a trajectory.

    Args:
        estimate: Camera-to-world poses of the tracked frames, in any world frame that the
            protocol's alignment undoes.
        ground_truth: True camera-to-world poses at their own stamps; may have holes.
        protocol: A protocol or the id of a registered one.
        input_timestamps: Stamps in seconds of all input frames; needed for coverage and for the
            lost-frame policy ``hold``.
        motion_covariances: What the tracker says of its errors, see `motion_uncertainty`; they are
            scored with poses in metres alone.
        truth_noise: Noise of the true poses, for the covariances; `NO_NOISE` if they are exact, None if it is
            not known.

    Returns:
        Every metric that is defined. A relative error whose delta is longer than the trajectory is
        left out and the diagnostics say so.

    Raises:
        EvaluationError: Fewer than two poses have ground truth (with the measured gaps), or the
            policy needs the input frames.
    """
    # the policy for lost frames, then association and alignment
    protocol = get_protocol(protocol)
    diagnostics: list[str] = []
    uncertainty = Uncertainty()
    if motion_covariances is not None and not protocol.finds_scale:
        uncertainty = motion_uncertainty(estimate, motion_covariances, ground_truth, truth_noise)
    truth_share = share_of_time(estimate.timestamps, ground_truth.timestamps)
    estimate, tracked = apply_policy(estimate, protocol, input_timestamps, diagnostics)
    comparison = compare(estimate, ground_truth, protocol, input_timestamps, diagnostics)
    if protocol.finds_scale:
        diagnostics.append(
            f"the alignment scales the estimate by {comparison.similarity.scale:.6g}"
        )
    diagnostics += comparison.similarity.doubts(comparison.truth)

    metrics: dict[str, float] = {}
    for measure in METRICS:
        metrics |= measure(comparison)
    metrics |= uncertainty.metrics
    diagnostics += uncertainty.diagnostics
    similarity = comparison.similarity
    return Evaluation(
        protocol_id=protocol.id,
        protocol_digest=protocol.digest(),
        protocol=protocol.describe(),
        metrics=metrics,
        n_pairs=len(comparison.truth),
        n_pairs_rpe=comparison.n_pairs_rpe,
        n_input=None if tracked is None else len(tracked),
        n_tracked=None if tracked is None else int(tracked.sum()),
        coverage=None if tracked is None else float(tracked.mean()),
        truth_share=truth_share,
        alignment=AlignmentRecord(
            mode=protocol.alignment,
            rotation=similarity.rotation.tolist(),
            translation_m=similarity.translation.tolist(),
            scale=similarity.scale,
            degenerate=similarity.degenerate,
            uncertainty_deg=similarity.uncertainty_deg,
        ),
        association=comparison.association,
        diagnostics=diagnostics,
        warnings=[*warnings_of(comparison, metrics), *uncertainty.warnings],
    )


def evaluate_files(
    estimate: str | Path,
    ground_truth: str | Path,
    protocol: Protocol | str = "tum-rgbd/v1",
    *,
    timestamps: str | Path | None = None,
) -> Evaluation:
    """Evaluate a trajectory file against a ground-truth file, each in a format of `load_trajectory`.

    The diagnostics count skipped, sorted and replaced lines.

    Args:
        estimate: The trajectory.
        ground_truth: The truth, as its publisher wrote it.
        protocol: How to evaluate.
        timestamps: A file whose lines begin with the stamps of the poses in KITTI's format, in
            seconds.

    Raises:
        TrajectoryError: A file cannot be read.
        EvaluationError: Fewer than two poses have ground truth, or the policy for lost frames needs
            the input frames, see `evaluate`.
    """
    return evaluate_loaded(
        load_trajectory(estimate, timestamps), load_trajectory(ground_truth, timestamps), protocol
    )


def evaluate_loaded(
    estimate: LoadedTrajectory, ground_truth: LoadedTrajectory, protocol: Protocol | str
) -> Evaluation:
    """Evaluate a trajectory that was read against a truth that was, with the notes on both files.

    Under evo's association all lines with the same stamp take part, else the last of them.

    Raises:
        EvaluationError: Fewer than two poses have ground truth, or the policy for lost frames needs
            the input frames, see `evaluate`.
    """
    protocol = get_protocol(protocol)
    repeats = not protocol.one_to_one
    poses = estimate.poses(repeats=repeats)
    truth = ground_truth.poses(repeats=repeats)
    result = evaluate(poses, truth_of_file(truth, protocol), protocol)

    # what was in disorder in the files comes first
    notes = [f"estimate: {note}" for note in estimate.notes.describe(repeats=repeats)]
    notes += [f"ground truth: {note}" for note in ground_truth.notes.describe(repeats=repeats)]
    if protocol.only_for:
        notes.append(
            f"{protocol.id} means something for {protocol.only_for}* only, which files do not tell"
        )
    return result.model_copy(update={"diagnostics": notes + result.diagnostics})


def pose_errors(
    estimate: Trajectory, ground_truth: Trajectory, protocol: Protocol | str = "tum-rgbd/v1"
) -> tuple[Trajectory, Trajectory, dict[str, np.ndarray]]:
    """The aligned estimate, its true counterparts, and the absolute error of every associated pose, for plots.

    Returns:
        Aligned estimated poses and true poses (both at the estimate's stamps), and the series
        ``trans_m``, ``rot_deg`` ``[K]`` each.

    Raises:
        EvaluationError: Nothing can be associated.
    """
    comparison = compare(estimate, ground_truth, get_protocol(protocol))
    translation, rotation = absolute_errors(comparison.aligned, comparison.truth)
    stamps, first = np.unique(comparison.stamps, return_index=True)
    return (
        Trajectory(stamps, comparison.aligned[first]),
        Trajectory(stamps, comparison.truth[first]),
        {"trans_m": translation[first], "rot_deg": rotation[first]},
    )
