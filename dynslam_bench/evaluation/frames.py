"""Which frames take part: coverage, frames common to several trajectories, and held poses of lost frames."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, reduce

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dynslam_bench.core.errors import EvaluationError
from dynslam_bench.geometry.association import associate
from dynslam_bench.geometry.trajectory import Trajectory

STAMP_TOLERANCE = 1e-3
"""Seconds within which two stamps name the same input frame (trajectory files round to a microsecond or worse)."""


def tracked_frames(estimate: Trajectory, input_timestamps: ArrayLike) -> NDArray[np.bool_]:
    """Which input frames ``[N]`` have a pose in the estimate; nobody may write into it.

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
        EvaluationError: Nothing was tracked, or the estimate does not belong to the frames.
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
