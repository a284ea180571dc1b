"""The camera's motion between frames of one RGB-D sequence, measured by tracked corners and their depth."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.geometry.camera import Camera

Array = NDArray[np.float64]
Pixels = NDArray[np.float32]

CORNERS = 300
FAR_ENOUGH_PX = 25.0
"""Median displacement of the corners at which a pair of frames ends: far above the tracker's noise."""
MOST_FRAMES_APART = 6
INLIER_PX = 4.0
"""Reprojection error of an inlier: leaves room for a rolling shutter and for the depth sensor's noise."""
LEAST_INLIERS = 25
LEAST_INLIER_SHARE = 0.4
_BACK_AND_FORTH_PX = 0.7
_DEPTH_EDGE = 0.1


@dataclass(frozen=True, eq=False)
class RgbdPair:
    """Two frames, the corners that were tracked between them, and the motion that most of these agree on.

    Attributes:
        first: Index of the earlier frame in the sequence.
        second: Index of the later frame.
        pixels_first: Undistorted pixels of all tracked corners in the first frame ``[N, 2]``.
        depth_first: Their z-depth in metres ``[N]``.
        pixels_second: Undistorted pixels of the same corners in the second frame ``[N, 2]``.
        depth_second: Their z-depth in the second depth image ``[N]``; 0 where it is missing.
        inliers: Which corners agree with the motion ``[N]``.
        T_first_second: Pose of the second camera in the first one's frame ``[4, 4]``, metres; None if too few corners
            agree on any motion.
        displacement_px: Median displacement of the corners.
        depth_share: Part of the first depth image that holds depth.
    """

    first: int
    second: int
    pixels_first: Array
    depth_first: Array
    pixels_second: Array
    depth_second: Array
    inliers: NDArray[np.bool_]
    T_first_second: Array | None
    displacement_px: float
    depth_share: float


def rgbd_pairs(frames: Iterable[Frame], camera: Camera) -> Iterator[RgbdPair]:
    """Pairs of frames of one stretch, each as far apart as the corners need to move by `FAR_ENOUGH_PX`.

    Corners of Shi and Tomasi (CVPR 1994) are tracked by pyramidal Lucas-Kanade, there and back; the motion is found by
    PnP with RANSAC on the first frame's depth. A pair ends where the corners have moved far enough, after
    `MOST_FRAMES_APART` frames, or with the stretch; the next one begins there.

    Args:
        frames: Consecutive frames, all of the camera's size.
        camera: Its intrinsics; the motion holds in their units.
    """
    key: Frame | None = None
    gray_key = gray_last = np.zeros((0, 0), np.uint8)
    start: Pixels = np.zeros((0, 2), np.float32)
    points: Pixels = start
    last: Frame | None = None
    for frame in frames:
        gray = np.asarray(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), np.uint8)
        if key is not None and last is not None and len(points):
            tracked, good = _track(gray_last, gray, points)
            start, points = start[good], tracked[good]
            moved = float(np.median(np.linalg.norm(points - start, axis=1))) if len(points) else 0.0
            due = frame.index - key.index >= MOST_FRAMES_APART or moved >= FAR_ENOUGH_PX
            if len(points) >= LEAST_INLIERS and due:
                yield measure_pair(key, frame, start, points, camera)
            if len(points) < LEAST_INLIERS or due:
                key = None
        if key is None or not len(points):
            key, gray_key = frame, gray
            start = points = _corners(gray_key, frame.depth)
        last, gray_last = frame, gray
    if key is not None and last is not None and last.index - key.index > 1 and len(points) >= LEAST_INLIERS:
        yield measure_pair(key, last, start, points, camera)


def measure_pair(first: Frame, second: Frame, start: Pixels, end: Pixels, camera: Camera) -> RgbdPair:
    """The pair of two frames whose corners `start` ``[N, 2]`` were found again at `end` ``[N, 2]``, raw pixels."""
    depth_first, depth_second = _at(first.depth, start), _at(second.depth, end)
    a, b = camera.undistort_points(start), camera.undistort_points(end)
    displacement = float(np.median(np.linalg.norm(b - a, axis=1)))
    inliers, pose = relative_pose(a, depth_first, b, camera)
    share = float(np.mean(first.depth[::4, ::4] > 0))
    return RgbdPair(first.index, second.index, a, depth_first, b, depth_second, inliers, pose, displacement, share)


def relative_pose(
    pixels_first: Array, depth_first: Array, pixels_second: Array, camera: Camera
) -> tuple[NDArray[np.bool_], Array | None]:
    """The inliers ``[N]``, and the second camera's pose in the first one's frame; None if too few corners agree."""
    nothing = np.zeros(len(pixels_first), bool)
    points = camera.unproject(pixels_first, depth_first)
    cv2.setRNGSeed(0)
    found, rotation, translation, index = cv2.solvePnPRansac(
        points, pixels_second, camera.matrix, None, iterationsCount=200, reprojectionError=INLIER_PX, confidence=0.999
    )
    if not found or index is None or len(index) < max(LEAST_INLIERS, LEAST_INLIER_SHARE * len(points)):
        return nothing, None
    inliers = nothing.copy()
    inliers[np.asarray(index).reshape(-1)] = True
    rotation, translation = cv2.solvePnPRefineLM(
        points[inliers], pixels_second[inliers], camera.matrix, None, rotation, translation
    )
    R, t = cv2.Rodrigues(rotation)[0], np.asarray(translation).reshape(3)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = R.T, -R.T @ t
    return inliers, pose if np.isfinite(pose).all() else None


def _corners(gray: NDArray[np.uint8], depth: NDArray[np.float32]) -> Pixels:
    """Corners ``[N, 2]`` that lie on a surface, not at its edge."""
    window = np.ones((5, 5), np.uint8)
    near, far = cv2.erode(depth, window), cv2.dilate(depth, window)
    mask = ((near > 0) & (far - near < _DEPTH_EDGE * near)).astype(np.uint8)
    found = cv2.goodFeaturesToTrack(gray, CORNERS, 0.01, max(6, gray.shape[1] // 60), mask=mask)
    return np.zeros((0, 2), np.float32) if found is None else np.asarray(found, np.float32).reshape(-1, 2)


def _track(before: NDArray[np.uint8], after: NDArray[np.uint8], points: Pixels) -> tuple[Pixels, NDArray[np.bool_]]:
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, after, points, np.empty_like(points), maxLevel=4)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(after, before, there, np.empty_like(points), maxLevel=4)
    good = (found.reshape(-1) == 1) & (found_back.reshape(-1) == 1)
    good &= np.linalg.norm(back - points, axis=1) < _BACK_AND_FORTH_PX
    height, width = after.shape
    good &= (there >= 0).all(axis=1) & (there[:, 0] <= width - 1) & (there[:, 1] <= height - 1)
    return np.asarray(there, np.float32), np.asarray(good, np.bool_)


def _at(depth: NDArray[np.float32], pixels: Pixels) -> Array:
    x, y = np.round(pixels).astype(int).T
    return np.asarray(depth[y, x], dtype=np.float64)
