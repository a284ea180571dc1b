"""Relative and segment errors of a trajectory under their metric names."""

from __future__ import annotations

import numpy as np

from dynslam_bench.geometry.trajectory import Trajectory

from .alignment import Similarity
from .association import Association
from .error_statistics import named, statistics
from .protocol import Protocol, RPESpec
from .rpe import RelativeErrors, evo_relative_errors, tum_relative_errors
from .segments import segment_errors


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
        errors: RelativeErrors
        stamps = estimate.timestamps
        if spec.pairs in ("tum-fixed", "tum-random"):
            errors = tum_relative_errors(estimate, ground_truth, spec, scale=similarity.scale)
        else:
            stamps = stamps[association.estimate]
            errors = evo_relative_errors(
                stamps,
                aligned,
                ground_truth.T_world_cam[association.ground_truth],
                spec,
            )
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
    found = named(f"rpe_{spec.key}_trans", errors.translation_m / times, spec.unit_of("trans"))
    found |= named(f"rpe_{spec.key}_rot", errors.rotation_deg / times, spec.unit_of("rot"))
    return {name: value for name, value in found.items() if not (spec.rate and "_sse_" in name)}
