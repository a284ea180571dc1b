"""Warnings on doubtful evaluations: values that nobody could mean, too little truth.

Hints look for one fault that explains a whole trajectory. A warning states a measured fact and
changes no number. Like a hint it is one line that begins with its id: ``frame-numbers``,
``slow-stamps``, ``far-stamp``, ``far-positions``, ``little-truth`` or ``static-camera``.
"""

import numpy as np

from dynslam_bench.core.number_text import mm
from dynslam_bench.evaluation.comparison import Comparison
from dynslam_bench.geometry import (
    Trajectory,
    are_frame_numbers,
    describe_frame_numbers,
    median_step,
    se3,
)
from dynslam_bench.geometry.speeds import impossible_motion
from dynslam_bench.geometry.stamp_units import SLOWEST_S

LONGEST_HOLE_S = 86_400.0
"""A day: no recording has such a hole."""
FEWEST_PAIRS = 8
"""An alignment has six or seven degrees of freedom, so that it fits most of the error of fewer poses."""
NEARLY_STATIC = 0.8
"""An error beyond this share of a static camera's hardly tells the estimate from one."""


def warnings_of(comparison: Comparison, metrics: dict[str, float]) -> list[str]:
    """The warnings on an evaluation.

    Args:
        comparison: What was compared.
        metrics: Its metrics.
    """
    lines = [
        *_of_stamps(comparison.estimate, "estimate"),
        *_of_stamps(comparison.ground_truth, "ground truth"),
    ]
    lines += _of_motion(comparison.ground_truth, "ground truth")
    if not comparison.protocol.finds_scale:
        lines += _of_motion(comparison.estimate, "estimate")
    return [*lines, *_of_pairs(comparison), *_of_static_camera(comparison, metrics)]


def _of_stamps(trajectory: Trajectory, whose: str) -> list[str]:
    """Stamps that are no seconds, or that lie far from all others."""
    stamps = trajectory.timestamps
    if are_frame_numbers(stamps):
        fault = describe_frame_numbers(stamps, whose)
        return [
            f"frame-numbers: {fault}: frame numbers? Then give the stamps of the images in seconds"
        ]
    lines = []
    step_s = median_step(stamps)
    if step_s is not None and step_s > SLOWEST_S:
        fault = f"the poses of the {whose} are {step_s:g} s apart by the median"
        lines.append(f"slow-stamps: {fault}: are its stamps in milliseconds? Give seconds")
    holes_s = np.diff(stamps)
    if len(holes_s) and holes_s.max() > LONGEST_HOLE_S:
        # the smaller part of the two that the hole separates
        behind = int(holes_s.argmax()) + 1
        before_is_smaller = 2 * behind <= len(stamps)
        count = behind if before_is_smaller else len(stamps) - behind
        stamp = stamps[behind - 1] if before_is_smaller else stamps[behind]
        apart = f"{count} of {len(stamps)} poses of the {whose} lie {holes_s.max():.3g} s apart from the others"
        lines.append(
            f"far-stamp: {apart}, at the stamp {stamp:.6f}: remove the lines of another recording"
        )
    return lines


def _of_motion(trajectory: Trajectory, whose: str) -> list[str]:
    """Poses that no camera reaches from one to the next."""
    motion = impossible_motion(trajectory, whose)
    return [] if motion is None else [f"far-positions: {motion}"]


def _of_pairs(comparison: Comparison) -> list[str]:
    """Too few poses with ground truth."""
    poses = len(comparison.estimate)
    compared = len(np.unique(comparison.estimate_index))
    if 2 * compared < poses:
        only = f"only {compared} of {poses} poses have ground truth within {comparison.protocol.max_dt:g} s"
        return [f"little-truth: {only}: the absolute errors are over those alone"]
    if compared < FEWEST_PAIRS and comparison.protocol.alignment in ("se3", "sim3", "yaw"):
        return [
            f"little-truth: only {compared} poses have ground truth: the alignment fits most of their error"
        ]
    return []


def _of_static_camera(comparison: Comparison, metrics: dict[str, float]) -> list[str]:
    """An error that hardly differs from that of a camera that does not move."""
    error = metrics["ate_rmse_m"]
    static = metrics["static_camera_ate_rmse_m"]
    if static == 0 or error < NEARLY_STATIC * static or se3.is_static(comparison.truth):
        return []
    share = f"{100 * error / static:.0f} %"
    return [
        f"static-camera: the error of {mm(error)} mm is {share} of a static camera's, {mm(static)} mm"
    ]
