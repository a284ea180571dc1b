"""Two trajectories prepared, associated and aligned under a protocol: what every metric is computed from."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dynslam_bench.core.errors import EvaluationError
from dynslam_bench.evaluation.alignment import Similarity, align
from dynslam_bench.evaluation.association import AssociationRecord, Index, match
from dynslam_bench.evaluation.prepare import compared
from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.geometry.trajectory import Trajectory

Array = NDArray[np.float64]


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
        found = f"only {len(estimate_index)} of {len(estimate)} poses has ground truth within {protocol.max_dt:g} s"
        raise EvaluationError(f"{found}, at least 2 are needed", dropped)
    if dropped:
        diagnostics.append(dropped)
    matched, truth = estimate.T_world_cam[estimate_index], ground_truth.T_world_cam[truth_index]
    similarity = align(matched, truth, protocol.alignment)
    return Comparison(
        protocol, estimate, ground_truth, estimate_index, truth_index, association, similarity, input_timestamps,
        diagnostics,
    )  # fmt: skip
