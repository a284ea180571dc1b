"""What is done to both trajectories before they are associated: lost frames, the truth's corrections, which frames."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, reduce

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
    input_timestamps: ArrayLike | None = None,
    diagnostics: list[str] | None = None,
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
    if protocol.truth == "bonn-camera":
        ground_truth = Trajectory(ground_truth.timestamps, bonn_camera(ground_truth.T_world_cam))
    elif protocol.truth == "bonn-droid-w":
        ground_truth = Trajectory(ground_truth.timestamps, bonn_as_droid_w(ground_truth.T_world_cam))
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
    if diagnostics is not None:
        diagnostics.append(
            f"{len(index)} poses on {len(chosen)} frames are compared: every {protocol.every} of {len(matched)} matched"
        )
    return estimate.select(np.sort(index)), ground_truth


def apply_policy(
    estimate: Trajectory,
    protocol: Protocol,
    input_timestamps: ArrayLike | None,
    n_input: int | None,
    n_tracked: int | None,
    diagnostics: list[str],
) -> Trajectory:
    """The estimate with its lost frames held, left out, or refused, as the protocol has it.

    Raises:
        EvaluationError: The policy needs the input frames, or allows no lost frame.
    """
    if input_timestamps is None or n_input is None or n_tracked is None:
        if protocol.lost_frames != "exclude":
            raise EvaluationError(
                f"protocol {protocol.id} ({protocol.lost_frames}) needs the stamps of the input frames",
                "pass input_timestamps, or use a protocol that excludes lost frames",
            )
        return estimate
    lost = n_input - n_tracked
    if not lost:
        return estimate
    percent = f"coverage {100 * n_tracked / n_input:.1f} %"
    if protocol.lost_frames == "fail":
        raise EvaluationError(f"{lost} of {n_input} frames were lost ({percent}), {protocol.id} allows none")
    if protocol.lost_frames == "hold":
        diagnostics.append(f"{lost} of {n_input} frames were lost ({percent}) and held at the last tracked pose")
        return hold(estimate, input_timestamps)
    diagnostics.append(f"{lost} of {n_input} frames were lost ({percent}) and take no part")
    return estimate


# Which frames take part: coverage, frames common to several trajectories, and held poses of lost frames.

STAMP_TOLERANCE = 1e-3
"""Seconds within which two stamps name the same input frame (trajectory files round to a microsecond or worse)."""


def tracked_frames(estimate: Trajectory, input_timestamps: ArrayLike) -> NDArray[np.bool_]:
    """Which input frames ``[N]`` have a pose in the estimate; read-only.

    A pose belongs to the frame nearest in time, one-to-one, within half a frame interval: some systems write the depth
    image's stamp, and files round.

    Raises:
        EvaluationError: The estimate has poses at stamps that are no input frame's.
    """
    return _tracked(estimate.timestamps.tobytes(), np.asarray(input_timestamps, dtype=np.float64).tobytes())


@lru_cache(maxsize=64)
def _tracked(estimate: bytes, inputs: bytes) -> NDArray[np.bool_]:
    """`tracked_frames`, once for equal stamps: most runs on one sequence have them."""
    poses, stamps = np.frombuffer(estimate), np.frombuffer(inputs)
    interval = float(np.median(np.diff(np.sort(stamps)))) if len(stamps) > 1 else 0.0
    index, _ = associate(stamps, poses, max(interval / 2, STAMP_TOLERANCE), strict=False)
    if len(index) < len(poses):
        raise EvaluationError(
            f"{len(poses) - len(index)} of {len(poses)} estimated poses belong to none of {len(stamps)} input frames",
            "the estimate has to carry the stamps of the images",
        )
    tracked = np.zeros(len(stamps), dtype=bool)
    tracked[index] = True
    tracked.flags.writeable = False
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
    tracked = tracked_frames(estimate, stamps)
    latest = np.maximum(np.cumsum(tracked) - 1, 0)
    return Trajectory(stamps, estimate.T_world_cam[latest])


def common_frames(trajectories: Sequence[Trajectory], tolerance: float = STAMP_TOLERANCE) -> list[Trajectory]:
    """Each trajectory reduced to the frames that all of them have, for a comparison free of coverage.

    Args:
        trajectories: At least one.
        tolerance: Seconds within which two stamps name the same frame.

    Raises:
        EvaluationError: There are no trajectories.
    """
    if not trajectories:
        raise EvaluationError("there are no trajectories to find common frames of")

    def shared(stamps: NDArray[np.float64], other: Trajectory) -> NDArray[np.float64]:
        index, _ = associate(stamps, other.timestamps, tolerance, strict=False)
        return stamps[index]

    stamps = reduce(shared, trajectories[1:], trajectories[0].timestamps)
    return [one.select(associate(stamps, one.timestamps, tolerance, strict=False)[1]) for one in trajectories]
