"""Controls, which measure little or nothing of the images, and the replay of a trajectory file."""

import time
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import Frame, TrackResult
from dynslam_bench.core.settings import Settings
from dynslam_bench.geometry import Camera, load_tum, se3
from dynslam_bench.geometry.motion_covariances import (
    at_poses,
    between_poses,
    compose_covariances,
    read_motion_covariances,
)
from dynslam_bench.trackers.adapters.specs import ConstantVelocitySettings, ReplaySettings

MAX_CORNERS = 400
"""Corners that are tracked at most."""
MIN_INLIERS = 12
"""Points that must agree on a motion."""
REPROJECTION_PX = 2.0
"""Largest reprojection error of a point that agrees."""


class NeverMove:
    """The static-camera baseline: the identity pose on every frame.

    Its error is the spread of the ground truth: a tracker that is not better gains nothing from the
    images.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings

    def reset(self, camera: Camera, *, rng: np.random.Generator) -> None:
        """Begin a new sequence; there is nothing to prepare."""

    def track(self, frame: Frame) -> TrackResult:
        """The identity pose, state ``ok``."""
        return TrackResult(T_world_cam=np.eye(4), state="ok")


class ConstantVelocity:
    """The motion model of a SLAM system without its measurements.

    The first `frames` frames are aligned to their predecessors (corners tracked by Lucas-Kanade,
    P3P with RANSAC on their depth). The velocity is their mean twist: the last pose relative to the
    first over the time between. Every later pose is extrapolated with it, by time stamp. Where a
    frame cannot be aligned, the velocity so far is kept, zero at first.
    """

    def __init__(self, settings: ConstantVelocitySettings) -> None:
        self.settings = settings

    def reset(self, camera: Camera, *, rng: np.random.Generator) -> None:
        """Begin a new sequence; nothing here is random."""
        self._camera = camera
        self._velocity: NDArray[np.float64] = np.zeros(6)
        self._pose: NDArray[np.float64] = np.eye(4)
        self._count = 0
        self._previous: tuple[NDArray[np.uint8], NDArray[np.float32]] | None = None

    def track(self, frame: Frame) -> TrackResult:
        """The measured pose of one of the first frames, the extrapolated one of any other; state ``ok`` throughout."""
        start = time.perf_counter()
        if self._count == 0:
            self._first_stamp = self._stamp = frame.timestamp

        # one of the first frames: align it to its predecessor
        motion = None
        inliers = 0
        measured = self._count < self.settings.frames
        if measured:
            grey = np.asarray(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
            if self._previous is not None:
                motion, inliers = relative_motion(self._camera, *self._previous, grey)
            self._previous = grey, frame.depth

        # any other frame: go on with the mean velocity of the first ones
        if motion is None:
            motion = se3.exp(self._velocity * (frame.timestamp - self._stamp))
        self._pose = self._pose @ motion
        if measured and self._count:
            self._velocity = se3.log(self._pose) / max(frame.timestamp - self._first_stamp, 1e-6)
        self._stamp = frame.timestamp
        self._count += 1
        timings = {"tracking": time.perf_counter() - start}
        return TrackResult(self._pose.copy(), "ok", {"inliers": float(inliers)}, timings)


def relative_motion(
    camera: Camera,
    grey_a: NDArray[np.uint8],
    depth_a: NDArray[np.float32],
    grey_b: NDArray[np.uint8],
) -> tuple[NDArray[np.float64] | None, int]:
    """Pose of camera b in the frame of camera a.

    Args:
        camera: The camera of both images.
        grey_a: First image ``[H, W]``.
        depth_a: Its depth ``[H, W]`` in metres, 0 where missing.
        grey_b: Second image ``[H, W]``.

    Returns:
        ``T_a_b`` ``[4, 4]`` and the number of inliers; None and their number if fewer than 12
        points agree.
    """
    # corners with depth; OpenCV gives None where there are none
    detected: object = cv2.goodFeaturesToTrack(grey_a, MAX_CORNERS, 0.01, 8)
    corners = np.zeros((0, 2), np.float32)
    if detected is not None:
        corners = np.asarray(detected, np.float32).reshape(-1, 2)
    column, row = np.rint(corners).astype(np.intp).clip(0, np.array(depth_a.shape[::-1]) - 1).T
    depth = depth_a[row, column].astype(np.float64)
    corners = corners[depth > 0]
    depth = depth[depth > 0]
    if len(corners) < MIN_INLIERS:
        return None, 0

    # track them by Lucas-Kanade
    tracked, status, _ = cv2.calcOpticalFlowPyrLK(
        grey_a, grey_b, corners[:, None], corners[:, None].copy()
    )
    good = status.reshape(-1) == 1
    if good.sum() < MIN_INLIERS:
        return None, 0

    # P3P with RANSAC, then refined on the inliers
    points = camera.unproject(camera.undistort_points(corners[good]), depth[good])
    pixels = camera.undistort_points(tracked.reshape(-1, 2)[good])
    success, rotation, translation, agreeing = cv2.solvePnPRansac(
        points,
        pixels,
        camera.matrix,
        np.zeros(5),
        iterationsCount=200,
        reprojectionError=REPROJECTION_PX,
        flags=cv2.SOLVEPNP_P3P,
    )
    inliers = 0 if agreeing is None else len(agreeing)
    if not success or inliers < MIN_INLIERS:
        return None, inliers
    chosen = np.asarray(agreeing).reshape(-1)
    rotation, translation = cv2.solvePnPRefineLM(
        points[chosen], pixels[chosen], camera.matrix, np.zeros(5), rotation, translation
    )
    T_b_a = np.eye(4)
    T_b_a[:3] = np.column_stack([cv2.Rodrigues(rotation)[0], np.asarray(translation).reshape(3)])
    if not se3.is_pose(T_b_a):
        return None, inliers
    return se3.inverse(T_b_a), inliers


class Replay:
    """A trajectory file as a tracker: each frame gets the pose with the nearest stamp.

    A frame without a pose within the tolerance is lost; poses are not interpolated and keep the
    file's world frame. The covariance of a motion over several poses of the file is composed of
    theirs.

    Args:
        settings: The file and the tolerance.

    Raises:
        TrajectoryError: The file is missing, damaged, or holds no pose; or the covariances are those of
            another trajectory.
    """

    def __init__(self, settings: ReplaySettings) -> None:
        self.settings = settings
        file = load_tum(Path(settings.file).expanduser())
        self._trajectory = file.trajectory
        self._covariances: NDArray[np.float64] | None = None
        self._last_row: int | None = None
        if settings.covariances:
            given = read_motion_covariances(settings.covariances)
            given = at_poses(given, self._trajectory, settings.covariances)
            self._covariances = between_poses(self._trajectory, given)
        self.measured = {"notes": file.notes.describe()}
        """``notes``: what of the file was not taken as it stands."""

    def reset(self, camera: Camera, *, rng: np.random.Generator) -> None:
        """Begin a new sequence; the poses depend on the frames' stamps only."""
        self._last_row = None

    def track(self, frame: Frame) -> TrackResult:
        """The pose of the frame's stamp, ``ok``; or ``lost`` without a pose. Stats: ``stamp_gap_s`` to the nearest."""
        stamps = self._trajectory.timestamps
        nearest = int(np.argmin(np.abs(stamps - frame.timestamp)))
        gap = float(abs(stamps[nearest] - frame.timestamp))
        stats = {"stamp_gap_s": gap}
        # the small term is the rounding of the difference
        if gap > self.settings.tolerance_s + 1e-9:
            return TrackResult(T_world_cam=None, state="lost", stats=stats)
        covariance = self._covariance_to(nearest)
        self._last_row = nearest
        return TrackResult(
            T_world_cam=self._trajectory.T_world_cam[nearest].copy(),
            state="ok",
            stats=stats,
            motion_covariance=covariance,
        )

    def _covariance_to(self, row: int) -> NDArray[np.float64] | None:
        """The covariance of the motion from the last pose that was given to a row's; None where it is not known."""
        if self._covariances is None or self._last_row is None or row <= self._last_row:
            return None
        # a trajectory may be denser than the frames, and frames between may have been lost
        pairs = np.array([[self._last_row, row]], dtype=np.intp)
        matrix = compose_covariances(self._trajectory.T_world_cam, self._covariances, pairs)[0]
        return None if np.isnan(matrix).all() else matrix
