"""What a foreign program answers, as poses and numbers; anything else is one clear error."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, cast, get_args

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.result import TrackingState, TrackResult
from dynslam_bench.core.errors import DynslamError, TrackerError
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.trajectory import Trajectory


def read_track_answer(answer: Mapping[str, Any], who: str, elapsed_s: Callable[[], float]) -> TrackResult:
    """The result of one frame.

    Args:
        answer: What the program said.
        who: Program and frame, for messages.
        elapsed_s: Seconds since it was asked; what its own timings do not explain becomes ``transfer``.

    Raises:
        TrackerError: It is no pose.
    """
    state = answer.get("state")
    if not isinstance(state, str) or state not in get_args(TrackingState):
        known = ", ".join(get_args(TrackingState))
        raise TrackerError(f"{who}: answered state {str(state)[:80]!r}", f"known: {known}")
    pose = _pose(answer.get("T_world_cam"), who)
    if pose is None and state == "ok":
        raise TrackerError(f"{who}: answered state 'ok' without T_world_cam")
    stats = _numbers(answer.get("stats"), "stats", who)
    timings = _numbers(answer.get("timings"), "timings", who)
    timings["transfer"] = max(0.0, elapsed_s() - sum(timings.values()))
    return TrackResult(pose, cast(TrackingState, state), stats, timings)


def read_final_answer(answer: Mapping[str, Any], who: str) -> Trajectory:
    """The final trajectory; rows ``[timestamp, tx, ty, tz, qx, qy, qz, qw]``, camera to world.

    Raises:
        TrackerError: It is no trajectory.
    """
    try:
        rows = np.asarray(answer.get("trajectory"), dtype=np.float64).reshape(-1, 8)
    except (TypeError, ValueError, OverflowError):
        raise TrackerError(
            f"{who}: 'trajectory' is not a list of rows of 8 numbers", "timestamp tx ty tz qx qy qz qw"
        ) from None
    norms = np.linalg.norm(rows[:, 4:], axis=1)
    if not (np.abs(norms - 1) < 1e-3).all():  # also catches NaN
        raise TrackerError(f"{who}: a quaternion has norm {norms[np.abs(norms - 1).argmax()]:g}")
    try:
        return Trajectory(rows[:, 0], se3.from_quaternion(rows[:, 1:4], rows[:, 4:]))
    except DynslamError as error:
        raise TrackerError(f"{who}: {error}") from error


def _pose(value: Any, who: str) -> NDArray[np.float64] | None:
    if value is None:
        return None
    try:
        pose = np.asarray(value, dtype=np.float64).reshape(4, 4)
    except (TypeError, ValueError, OverflowError):
        raise TrackerError(
            f"{who}: T_world_cam is not 16 numbers: {str(value)[:80]}", "row by row, camera to world"
        ) from None
    if not se3.is_pose(pose):
        raise TrackerError(f"{who}: T_world_cam is no rigid pose: {pose.tolist()}")
    return pose


def _numbers(value: Any, what: str, who: str) -> dict[str, float]:
    try:
        return {str(key): float(number) for key, number in (value or {}).items()}
    except (AttributeError, TypeError, ValueError, OverflowError):
        raise TrackerError(f"{who}: {what} is not an object of numbers: {str(value)[:80]}") from None
