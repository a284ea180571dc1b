"""What the environment demands of a tracker's results, checked on every frame."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from dynslam_bench.core.errors import TrackerError
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.trajectory import Trajectory

from .result import TrackResult
from .sequence import Frame

_STATES = ("initialising", "ok", "lost")


class TrackerContractError(TrackerError):
    """A tracker returned something that is no valid result: its run counts as ``invalid``, not as crashed."""


def check_result(result: object, frame: Frame, tracker: str) -> TrackResult:
    """The result, if it keeps the contract; statistics that are not finite are left out.

    Args:
        result: What ``track`` returned.
        frame: The frame it was given.
        tracker: The tracker's id, for the message.

    Raises:
        TrackerContractError: Wrong type, unknown state, a pose that is not finite or no rigid transformation, state
            ``ok`` without a pose, or a mask of another size than the image.
    """
    where = f"tracker '{tracker}' at frame {frame.index}"
    if not isinstance(result, TrackResult):
        raise TrackerContractError(f"{where} returned a {type(result).__name__}", "track() returns a TrackResult")
    if result.state not in _STATES:
        raise TrackerContractError(f"{where} returned state {result.state!r}", f"expected one of {', '.join(_STATES)}")
    if result.T_world_cam is not None:
        _check_pose(result.T_world_cam, where)
    elif result.state == "ok":
        raise TrackerContractError(f"{where} returned state 'ok' without a pose", "return 'lost' instead")
    mask = result.dynamic_mask
    if mask is not None and np.shape(mask) != frame.depth.shape:
        raise TrackerContractError(
            f"{where} returned a dynamic mask of shape {np.shape(mask)}, the image has {frame.depth.shape}"
        )
    stats = {str(key): float(value) for key, value in result.stats.items() if math.isfinite(value)}
    return replace(result, stats=stats)


def check_trajectory(trajectory: object, tracker: str) -> Trajectory:
    """What ``finalize`` returned, if it is a trajectory of rigid transformations.

    Raises:
        TrackerContractError: It is not.
    """
    where = f"tracker '{tracker}' in finalize()"
    if not isinstance(trajectory, Trajectory):
        raise TrackerContractError(f"{where} returned a {type(trajectory).__name__}, not a Trajectory")
    for pose in trajectory.T_world_cam:
        _check_pose(pose, where)
    return trajectory


def _check_pose(pose: object, where: str) -> None:
    if not isinstance(pose, np.ndarray) or pose.shape != (4, 4):
        found = f"an array of shape {pose.shape}" if isinstance(pose, np.ndarray) else f"a {type(pose).__name__}"
        raise TrackerContractError(f"{where} returned {found} as pose, expected a 4x4 matrix")
    if not np.isfinite(pose).all():
        bad = int(np.count_nonzero(~np.isfinite(pose)))
        raise TrackerContractError(f"{where} returned a pose with {bad} values that are not finite")
    if not se3.is_pose(pose):
        rotation = pose[:3, :3]
        off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
        raise TrackerContractError(
            f"{where} returned a pose that is no rigid transformation: |R R^T - I| = {off:.2g}, "
            f"det R = {float(np.linalg.det(rotation)):.4g}"
        )
