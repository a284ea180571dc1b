"""Checks of a tracker's results: written once, for the environment and for the conformance suite.

A *fault* makes a run ``invalid``: the environment refuses the result. A *blemish* is refused by the
conformance suite only: no number is wrong because of it.
"""

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.sequence import Frame, Sequence
from dynslam_bench.contracts.tracker import TrackerSpec, TrackingState, TrackResult
from dynslam_bench.core import SequenceError, TrackerError
from dynslam_bench.geometry import Camera, Trajectory, se3
from dynslam_bench.geometry.motion_covariances import check_covariances

STATES = get_args(TrackingState)
FARTHEST_M = 1e9
"""No camera is so far from where its world begins, not even in coordinates of the Earth: a solver diverged."""


class TrackerContractError(TrackerError):
    """A tracker returned something that is no valid result: its run counts as ``invalid``, not as crashed."""


_MARK = "_dynslam_raised_by_tracker"
"""Attribute of an exception that came out of a tracker's own code."""


@contextmanager
def tracker_code() -> Iterator[None]:
    """Mark every exception that leaves the block: the tracker's own code raised it (see `raised_by_tracker`)."""
    try:
        yield
    except BaseException as error:
        setattr(error, _MARK, True)
        raise


def raised_by_tracker(error: BaseException) -> bool:
    """Whether an exception came out of the tracker's own code, not out of what reads its data or measures it."""
    return isinstance(error, TrackerError) or getattr(error, _MARK, False)


def check_frame(frame: Frame, camera: Camera) -> None:
    """Refuse what is no frame of this camera.

    Raises:
        SequenceError: Colour is not uint8, depth no floating point in metres, sizes differ from the
            camera's, or the timestamp is not finite.
    """
    rgb = np.asarray(frame.rgb)
    depth = np.asarray(frame.depth)
    if rgb.dtype != np.uint8:
        raise SequenceError(
            f"frame {frame.index} has colour of type {rgb.dtype}", "it must be uint8"
        )
    if depth.dtype.kind != "f":
        raise SequenceError(
            f"frame {frame.index} has depth of type {depth.dtype}", "it must be float32, in metres"
        )
    size = (camera.height, camera.width)
    if rgb.shape != (*size, 3) or depth.shape != size:
        raise SequenceError(
            f"frame {frame.index} has colour {rgb.shape} and depth {depth.shape}, "
            f"the camera is {camera.width}x{camera.height}"
        )
    if not np.isfinite(frame.timestamp):
        raise SequenceError(
            f"frame {frame.index} has the timestamp {frame.timestamp}", "it must be finite seconds"
        )


@dataclass(frozen=True)
class Fault:
    """Fault of a returned value.

    Attributes:
        found: What was returned, to be read after "returned".
        cause: The likely cause, or what to return instead.
    """

    found: str
    cause: str = ""


def faults(result: object, frame: Frame) -> Iterator[Fault]:
    """Faults that make a result invalid: type, state, pose, numbers, keypoints, or a mask of another size.

    Lazily, the most basic first: what comes later takes for granted that the earlier is in order.
    """
    # type, state and pose
    if not isinstance(result, TrackResult):
        yield Fault(
            f"a {type(result).__name__}, not a TrackResult",
            "track() returns a TrackResult; wrap a bare pose: TrackResult(T_world_cam, 'ok')",
        )
        return
    if result.state not in STATES:
        yield Fault(f"state {result.state!r}", f"expected one of {', '.join(STATES)}")
    if result.T_world_cam is not None:
        yield from _pose_faults(result.T_world_cam)
    elif result.state == "ok":
        yield Fault("state 'ok' without a pose", "a lost frame says 'lost'")

    # the mask of what moves
    mask = result.dynamic_mask
    if mask is not None and np.shape(mask) != frame.depth.shape:
        yield Fault(f"a dynamic mask of shape {np.shape(mask)}, the image has {frame.depth.shape}")

    # statistics and times
    numbers: dict[str, Any] = {"stats": result.stats, "timings": result.timings}
    for name, values in numbers.items():
        if not isinstance(values, Mapping):
            yield Fault(f"{name} of type {type(values).__name__}", "expected numbers by name")
            continue
        bad = {
            key: value for key, value in values.items() if not isinstance(value, Real | np.bool_)
        }
        if bad:
            yield Fault(f"{name} with values that are no numbers: {bad}")

    yield from _keypoint_faults(result)


def _keypoint_faults(result: TrackResult) -> Iterator[Fault]:
    """Faults of the keypoints' pixels, or of the flags of those that were kept."""
    xy: Any = result.keypoints_xy
    keep = result.keypoints_keep
    if xy is not None and not _is_number_array(xy, columns=2):
        kind = getattr(xy, "dtype", type(xy).__name__)
        yield Fault(f"keypoints_xy of shape {np.shape(xy)} as {kind}", "expected numbers [N, 2]")
    elif xy is not None and not np.isfinite(xy).all():
        yield Fault("keypoints_xy that are not finite", "leave out features without a pixel")
    elif keep is not None and (xy is None or np.shape(keep) != (len(xy),)):
        yield Fault("keypoints_keep that does not fit keypoints_xy")


def blemishes(result: TrackResult) -> Iterator[Fault]:
    """Faults of a valid result in values that no metric is made of: stats, timings, mask."""
    for name, values in (("stats", result.stats), ("timings", result.timings)):
        bad = {key: value for key, value in values.items() if not _is_number(value)}
        if bad:
            yield Fault(f"{name} with values that are no finite numbers: {bad}")
    if any(_is_number(value) and value < 0 for value in result.timings.values()):
        yield Fault("a timing that is negative")
    if result.motion_covariance is not None:
        yield from _covariance_blemishes(result.motion_covariance)
    mask = result.dynamic_mask
    if mask is not None and getattr(mask, "dtype", None) != np.bool_:
        yield Fault(
            f"a dynamic mask of type {getattr(mask, 'dtype', type(mask).__name__)}, expected bool"
        )


def _covariance_blemishes(value: Any) -> Iterator[Fault]:
    """Faults of a motion covariance; runs state it, and score the others."""
    expected = "expected a 6x6 covariance of (translation in m, rotation in rad)"
    matrix = as_covariance(value)
    if not np.isfinite(matrix).all():
        yield Fault(
            f"a motion covariance of shape {np.asarray(value).shape}, or not finite", expected
        )
        return
    # as runs check them
    checks = check_covariances(matrix[None])
    if not checks.symmetric[0]:
        off = float(np.abs(matrix - matrix.T).max())
        yield Fault(f"a motion covariance that is not symmetric, by {off:.2g}", expected)
    elif not checks.positive[0]:
        yield Fault("a motion covariance that is not positive definite", expected)


def trajectory_faults(trajectory: object) -> Iterator[Fault]:
    """Faults that make a final trajectory invalid: its type, or a pose that is no rigid transformation."""
    if not isinstance(trajectory, Trajectory):
        yield Fault(f"a {type(trajectory).__name__}, not a Trajectory")
        return
    for pose in trajectory.T_world_cam:
        yield from _pose_faults(pose)


def check_result(result: object, frame: Frame, tracker: str) -> TrackResult:
    """Refuse a result with faults.

    Args:
        result: What ``track`` returned.
        frame: The frame it was given.
        tracker: The tracker's id, for the message.

    Returns:
        The result, pose and covariance in float64, without statistics that are not finite.

    Raises:
        TrackerContractError: It has a fault.
    """
    for fault in faults(result, frame):
        raise TrackerContractError(
            f"tracker '{tracker}' at frame {frame.index} returned {fault.found}", fault.cause
        )
    assert isinstance(result, TrackResult)
    stats = {str(key): float(value) for key, value in result.stats.items() if math.isfinite(value)}
    pose = None if result.T_world_cam is None else np.asarray(result.T_world_cam, dtype=np.float64)
    covariance = result.motion_covariance
    if covariance is not None:
        covariance = as_covariance(covariance)
    return replace(result, stats=stats, T_world_cam=pose, motion_covariance=covariance)


def as_covariance(value: object) -> NDArray[np.float64]:
    """A covariance float64 ``[6, 6]`` of what a tracker gave; NaN where that is neither 6x6 nor 36 numbers."""
    try:
        matrix = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return np.full((6, 6), np.nan)
    return matrix.reshape(6, 6) if matrix.shape in {(6, 6), (36,)} else np.full((6, 6), np.nan)


def check_sensors(spec: TrackerSpec, sequence: Sequence) -> None:
    """Refuse, before anything runs, a tracker that needs depth on a sequence that says that it has none.

    Raises:
        TrackerError: Names both.
    """
    if spec.sensors == "rgbd" and not getattr(sequence, "has_depth", True):
        raise TrackerError(
            f"tracker '{spec.id}' needs depth, and sequence '{sequence.id}' has colour images alone",
            "run a monocular one, e.g. emfoa-oft-mono or orb-slam2-mono (`trackers list`: sensors rgb)",
        )


def check_trajectory(trajectory: object, tracker: str) -> Trajectory:
    """Refuse a final trajectory with faults.

    Args:
        trajectory: What ``finalize`` returned.
        tracker: The tracker's id, for the message.

    Returns:
        The trajectory.

    Raises:
        TrackerContractError: The trajectory has a fault.
    """
    fault = next(iter(trajectory_faults(trajectory)), None)
    if fault is not None:
        raise TrackerContractError(
            f"tracker '{tracker}' in finalize() returned {fault.found}", fault.cause
        )
    assert isinstance(trajectory, Trajectory)
    return trajectory


def _pose_faults(pose: object) -> Iterator[Fault]:
    """Faults of a camera-to-world pose: shape, type, numbers, or that it is no rigid transformation."""
    if not isinstance(pose, np.ndarray):
        yield Fault(f"a {type(pose).__name__} as pose, expected a 4x4 matrix")
    elif pose.shape != (4, 4):
        yield Fault(f"an array of shape {pose.shape} as pose, expected a 4x4 matrix")
    # positions in float16 are rounded to millimetres
    elif pose.dtype.kind not in "fiu" or pose.dtype == np.float16:
        yield Fault(
            f"a pose of the type {pose.dtype}, expected real numbers of enough digits",
            "return float64",
        )
    elif not np.isfinite(pose).all():
        yield Fault(
            f"a pose with {np.count_nonzero(~np.isfinite(pose))} values that are not finite",
            "a solver diverged; say 'lost' instead",
        )
    elif (far := float(np.abs(pose).max())) > FARTHEST_M:
        yield Fault(f"a pose {far:.3g} m away", "a solver diverged; say 'lost' instead")
    elif not se3.is_pose(pose.astype(np.float64)):
        rotation = pose[:3, :3].astype(np.float64)
        off = np.abs(rotation @ rotation.T - np.eye(3)).max()
        determinant = np.linalg.det(rotation)
        yield Fault(
            f"a pose that is no rigid transformation: |R R^T - I| = {off:.2g}, det R = {determinant:.4g}",
            "the rotation drifted from orthonormal, or world-to-camera scale is mixed in",
        )


def _is_number_array(values: object, columns: int) -> bool:
    """Whether this is an array of real numbers with so many columns."""
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiu":
        return False
    return bool(values.shape[1:] == (columns,))


def _is_number(value: object) -> bool:
    """Whether this is a finite number."""
    return isinstance(value, (int, float)) and math.isfinite(value)
