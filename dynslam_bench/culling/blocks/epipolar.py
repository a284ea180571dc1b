"""B3: the epipolar test on optical flow (paper, Eq. 23-25), with a degeneracy guard."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.filter import DynamicFilter, FilterResult, FilterState, FrameBundle, Need, Provenance
from dynslam_bench.geometry.camera import Camera

from ..settings import EpipolarSettings
from ..tools.coherence import coherent
from ..tools.ego_motion import rigid_flow
from .semantic import inside

MIN_MATCHES = 16  # twice the eight-point algorithm's minimum
RIGID_PX = 2.0
"""Nearer than this to where the camera's motion puts it, a point moves with the static world."""
Points = NDArray[np.float64]

_METHODS = {"ransac": cv2.FM_RANSAC, "lmeds": cv2.FM_LMEDS, "magsac": cv2.USAC_MAGSAC}


def fundamental_matrix(first: Points, second: Points, settings: EpipolarSettings) -> NDArray[np.float64] | None:
    """The matrix F with ``x2^T F x1 = 0`` (Eq. 24) for matched pixels, robustly.

    Args:
        first: Undistorted pixels x1, float64 ``[N, 2]``.
        second: Undistorted pixels x2, float64 ``[N, 2]``.
        settings: Estimator and thresholds.

    Returns:
        F ``[3, 3]``, or None where it cannot be estimated (too few points, degenerate, the estimator gave up).
    """
    if len(first) < MIN_MATCHES:
        return None
    try:
        matrix, _ = cv2.findFundamentalMat(
            first, second, _METHODS[settings.estimator], settings.inlier_px, settings.confidence, 2000
        )
    except cv2.error:  # OpenCV 5.0's MAGSAC raises "!model.empty()" where no model was found
        return None
    for _ in range(2):  # the minimal sample's F is noisy at the image's fringe: refit it to all that agree
        if matrix is None or matrix.shape != (3, 3) or not np.isfinite(matrix).all():
            return None
        agree = epipolar_distance(np.asarray(matrix, np.float64), first, second) < settings.inlier_px
        if np.count_nonzero(agree) < MIN_MATCHES:
            return None
        matrix, _ = cv2.findFundamentalMat(first[agree], second[agree], cv2.FM_8POINT)
    return None if matrix is None or matrix.shape != (3, 3) else np.asarray(matrix, dtype=np.float64)


def epipolar_distance(matrix: NDArray[np.float64], first: Points, second: Points) -> NDArray[np.float64]:
    """Distances ``[N]`` in pixels of x2 to the epipolar line of x1 (Eq. 25, with the root that the text lost)."""
    lines = np.column_stack([first, np.ones(len(first))]) @ matrix.T
    signed = (lines[:, :2] * second).sum(axis=1) + lines[:, 2]
    return np.asarray(np.abs(signed) / np.maximum(np.hypot(lines[:, 0], lines[:, 1]), 1e-12))


def rotation_residual(first: Points, second: Points, camera: Camera) -> float:
    """How much of the flow a pure rotation of the camera leaves unexplained: median residual in pixels.

    Args:
        first: Undistorted pixels ``[N, 2]``.
        second: Undistorted pixels ``[N, 2]``.
        camera: Intrinsics.
    """
    rays = [np.column_stack([(xy - (camera.cx, camera.cy)) / (camera.fx, camera.fy), np.ones(len(xy))])
            for xy in (first, second)]  # fmt: skip
    rays = [ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays]
    weight = np.ones(len(first))
    residual = np.zeros(len(first))
    for _ in range(3):  # iteratively reweighted, so that moving things do not turn the rotation
        u, _, vt = np.linalg.svd((rays[1] * weight[:, None]).T @ rays[0])
        rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        residual = np.linalg.norm(camera.project(rays[0] @ rotation.T) - second, axis=1)
        weight = 1.0 / np.maximum(residual, 0.5)
    return float(np.median(residual))


def homography_share(first: Points, second: Points) -> float:
    """Share of the matches ``[N, 2]`` that one homography explains within 1 px: 1 for a plane or a pure rotation."""
    matrix, mask = cv2.findHomography(first, second, cv2.RANSAC, 1.0, maxIters=300, confidence=0.99)
    return 0.0 if matrix is None else float(np.mean(mask))


def contradiction(frame: FrameBundle, state: FilterState, failing: NDArray[np.bool_], before: Points) -> float:
    """Share of the points which move as depth and the camera's motion say that the epipolar test rejects.

    Where a person fills the image, the largest set of matches that agree on an F may be the person's. Depth tells: the
    camera's motion is known from elsewhere (`ego_motion`), and points that follow it are static. An F that rejects many
    of them is not the camera's.

    Args:
        frame: The current frame.
        state: With flow, previous and predicted pose.
        failing: bool ``[N]``, points that fail the epipolar test.
        before: Undistorted pixels ``[N, 2]`` in the previous image.

    Returns:
        The share, 0 to 1; 0 where too few points have depth or no pose is known.
    """
    if state.flow is None or state.T_world_prev is None or state.T_world_pred is None:
        return 0.0
    rows = state.flow.valid & state.keep & (frame.z > 0)
    rows[rows] = np.linalg.norm(rigid_flow(frame, state, rows)[1] - before[rows], axis=1) < RIGID_PX
    return float(failing[rows].mean()) if np.count_nonzero(rows) >= MIN_MATCHES else 0.0


class EpipolarFilter(DynamicFilter):
    """Drops points, or objects, whose flow leaves the epipolar line.

    F comes from the flow of the points that earlier filters kept; the test covers all points with a valid flow.
    Stats: ``dropped``, ``matches``, ``inliers`` (of F), ``parallax_px``, ``homography_share`` (0 where
    the parallax had decided already), ``contradiction`` (see `contradiction`), ``degenerate`` (1 where the guard
    skipped the test), ``moving_objects``, ``f_asked`` and ``f_judged`` (see `filter.FilterResult`).
    """

    name = "epipolar"
    needs: frozenset[Need] = frozenset({"flow", "previous"})
    provenance: Provenance = "faithful-paper"
    stats_names = (
        "dropped",
        "matches",
        "inliers",
        "parallax_px",
        "homography_share",
        "contradiction",
        "degenerate",
        "moving_objects",
        "f_asked",
        "f_judged",
    )

    def __init__(self, settings: EpipolarSettings) -> None:
        self.settings = settings

    def reset(self, camera: Camera) -> None:
        """Nothing to forget."""

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Test the flow of this frame's keypoints to the previous image."""
        stats = dict.fromkeys(
            (
                "matches", "inliers", "parallax_px", "homography_share", "contradiction", "degenerate",
                "moving_objects", "f_asked", "f_judged",
            ),
            0.0,
        )  # fmt: skip
        keep = np.ones(len(frame), dtype=bool)
        flow = state.flow
        if flow is None or state.previous is None:
            return FilterResult.of(keep, stats)
        stats["f_asked"] = 1.0
        before = state.camera.undistort_points(flow.xy)
        fit = flow.valid & state.keep
        stats["matches"] = float(np.count_nonzero(fit))
        if stats["matches"] < MIN_MATCHES:
            return FilterResult.of(keep, {**stats, "degenerate": 1.0})
        stats["parallax_px"] = rotation_residual(before[fit], frame.xy[fit], state.camera)
        flow_px = float(np.median(np.linalg.norm(before[fit] - frame.xy[fit], axis=1)))
        needed = max(self.settings.min_parallax_px, self.settings.parallax_share * flow_px)
        degenerate = stats["parallax_px"] < needed
        if not degenerate:
            stats["homography_share"] = homography_share(before[fit], frame.xy[fit])
            degenerate = stats["homography_share"] > self.settings.homography_share
        matrix = None if degenerate else fundamental_matrix(before[fit], frame.xy[fit], self.settings)
        if matrix is None:
            return FilterResult.of(keep, {**stats, "degenerate": 1.0})
        failing = np.zeros(len(frame), dtype=bool)
        distance = epipolar_distance(matrix, before[flow.valid], frame.xy[flow.valid])
        failing[flow.valid] = distance > self.settings.threshold_px
        stats["inliers"] = float(np.count_nonzero(fit & ~failing))
        if self.settings.max_contradiction < 1:
            stats["contradiction"] = contradiction(frame, state, failing, before)
            if stats["contradiction"] > self.settings.max_contradiction:
                return FilterResult.of(keep, {**stats, "degenerate": 1.0})
        stats["f_judged"] = 1.0
        if self.settings.mode == "point":
            moving = coherent(failing, flow.valid, frame.keypoints.xy, self.settings.min_share, frame.gray.shape)
            return FilterResult.of(~moving, stats)
        keep, stats["moving_objects"] = vote_on_objects(frame, failing, flow.valid, self.settings.vote_share)
        return FilterResult.of(keep, stats)


def vote_on_objects(
    frame: FrameBundle, failing: NDArray[np.bool_], tested: NDArray[np.bool_], share: float
) -> tuple[NDArray[np.bool_], float]:
    """B11: an object moves if enough of its tested points fail; then all of its points are dropped.

    Args:
        frame: The frame with its instances; without any, nothing is dropped.
        failing: bool ``[N]``, points that failed a test.
        tested: bool ``[N]``, points that were tested.
        share: Share of the tested points that must fail.

    Returns:
        bool ``[N]`` keep, and the number of moving objects.
    """
    keep = np.ones(len(frame), dtype=bool)
    moving = 0
    for mask in () if frame.instances is None else frame.instances.masks:
        on_object = inside(mask, frame.keypoints.xy)
        voters = on_object & tested
        if voters.any() and failing[voters].mean() >= share:
            keep &= ~on_object
            moving += 1
    return keep, float(moving)
