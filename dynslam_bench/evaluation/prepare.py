"""What is done to both trajectories before they are associated: lost frames, the truth's corrections, which frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dynslam_bench.core.errors import EvaluationError
from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.geometry.association import associate
from dynslam_bench.geometry.rigs import BONN_R_BODY_CAM, bonn_as_droid_w, bonn_camera, in_camera_axes
from dynslam_bench.geometry.trajectory import Trajectory


def truth_of_file(truth: Trajectory, protocol: Protocol) -> Trajectory:
    """A ground-truth file's poses as `evaluate` takes them.

    Bonn's files hold the orientations of the markers, its sequences those of the camera; the protocols that move the
    positions start from the latter. For all others a file is taken as it stands.
    """
    if protocol.truth == "as-is":
        return truth
    return Trajectory(truth.timestamps, in_camera_axes(truth.T_world_cam, BONN_R_BODY_CAM))


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
        input_timestamps: Stamps in seconds of all input frames; without them those of the estimate count.
        diagnostics: Takes a line on what was left out.

    Raises:
        EvaluationError: None of the frames that count was tracked.
    """
    if protocol.truth != "as-is":
        correct = bonn_camera if protocol.truth == "bonn-camera" else bonn_as_droid_w
        ground_truth = Trajectory(ground_truth.timestamps, correct(ground_truth.T_world_cam))
    if not protocol.thins:
        return estimate, ground_truth
    stamps = estimate.timestamps if input_timestamps is None else np.asarray(input_timestamps, np.float64).reshape(-1)
    matched = np.sort(associate(ground_truth.timestamps, stamps, protocol.max_dt, strict=protocol.strict)[1])
    chosen = stamps[matched[:: protocol.every][: protocol.most_frames or None]]
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
    """The estimate with its lost frames held, left out, or refused, as the protocol has it.

    Returns:
        The estimate, and which input frames were tracked ``[N]``; None where the input frames are not known.

    Raises:
        EvaluationError: The policy needs the input frames, or allows no lost frame.
    """
    if input_timestamps is None:
        if protocol.lost_frames != "exclude":
            raise EvaluationError(
                f"protocol {protocol.id} ({protocol.lost_frames}) needs the stamps of the input frames",
                "pass input_timestamps, or use a protocol that excludes lost frames",
            )
        return estimate, None
    tracked = tracked_frames(estimate, input_timestamps)
    n_input, n_tracked = len(tracked), int(tracked.sum())
    if n_tracked == n_input:
        return estimate, tracked
    lost = f"{n_input - n_tracked} of {n_input} frames were lost (coverage {100 * n_tracked / n_input:.1f} %)"
    if protocol.lost_frames == "fail":
        raise EvaluationError(f"{lost}, {protocol.id} allows none")
    held = protocol.lost_frames == "hold"
    diagnostics.append(f"{lost} and {'held at the last tracked pose' if held else 'take no part'}")
    return (hold(estimate, input_timestamps) if held else estimate), tracked


# Which frames take part: coverage, and held poses of lost frames.

STAMP_TOLERANCE = 1e-3
"""Seconds within which two stamps name the same input frame (trajectory files round to a microsecond or worse)."""


def tracked_frames(estimate: Trajectory, input_timestamps: ArrayLike) -> NDArray[np.bool_]:
    """Which input frames ``[N]`` have a pose in the estimate.

    A pose belongs to the frame nearest in time, one-to-one, within half a frame interval: some systems write the depth
    image's stamp, and files round.

    Raises:
        EvaluationError: The estimate has poses at stamps that are no input frame's.
    """
    poses, stamps = estimate.timestamps, np.asarray(input_timestamps, dtype=np.float64).reshape(-1)
    interval = float(np.median(np.diff(np.sort(stamps)))) if len(stamps) > 1 else 0.0
    index, _ = associate(stamps, poses, max(interval / 2, STAMP_TOLERANCE), strict=False)
    if len(index) < len(poses):
        raise EvaluationError(
            f"{len(poses) - len(index)} of {len(poses)} estimated poses belong to none of {len(stamps)} input frames",
            "the estimate has to carry the stamps of the images",
        )
    tracked = np.zeros(len(stamps), dtype=bool)
    tracked[index] = True
    return tracked


def coverage(estimate: Trajectory, input_timestamps: ArrayLike) -> float:
    """Tracked frames over associated input frames; 0 for no input frames.

    Args:
        estimate: Poses of the frames whose state was ``ok``.
        input_timestamps: Stamps in seconds of all frames of the sequence (after colour-depth association).
    """
    tracked = tracked_frames(estimate, input_timestamps)
    return float(tracked.mean()) if len(tracked) else 0.0


def hold(estimate: Trajectory, input_timestamps: ArrayLike) -> Trajectory:
    """The trajectory with a pose for every input frame: lost frames stay at the last tracked pose.

    Frames before the first tracked one take its pose.

    Raises:
        EvaluationError: Nothing was tracked, or the estimate does not belong to the input frames.
    """
    if not len(estimate):
        raise EvaluationError("no frame was tracked, so there is no pose to hold")
    stamps = np.asarray(input_timestamps, dtype=np.float64).reshape(-1)
    return Trajectory(stamps, estimate.T_world_cam[np.maximum(np.cumsum(tracked_frames(estimate, stamps)) - 1, 0)])
