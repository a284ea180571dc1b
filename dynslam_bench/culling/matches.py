"""The fundamental matrix of chosen matches, what it says of others, and when it means nothing (paper, Eq. 24-25)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dynslam_bench.contracts.filter import FilterState, FrameBundle
from dynslam_bench.contracts.flow import FlowResult
from dynslam_bench.culling.settings import Unmatched
from dynslam_bench.geometry.camera import Camera

Points = NDArray[np.float64]
Flags = NDArray[np.bool_]

MIN_MATCHES = 16  # twice the eight-point algorithm's minimum
METHODS = {"ransac": cv2.FM_RANSAC, "lmeds": cv2.FM_LMEDS, "magsac": cv2.USAC_MAGSAC}


@dataclass(frozen=True)
class Estimator:
    """How F is estimated.

    Attributes:
        method: ``ransac``, ``lmeds`` or ``magsac``.
        inlier_px: Distance in pixels up to which a match agrees with F.
        confidence: Of the robust estimator.
        max_draws: Most samples that it draws.
        min_matches: Fewer matches give no F.
        refits: How often F is fitted anew to all matches that agree: the minimal sample's F is noisy at the image's
            fringe.
    """

    method: str = "ransac"
    inlier_px: float = 1.0
    confidence: float = 0.99
    max_draws: int = 2000
    min_matches: int = MIN_MATCHES
    refits: int = 2


@dataclass(frozen=True, eq=False)
class Matches:
    """Undistorted pixels of points in the previous and in the current image.

    Attributes:
        before: float64 ``[N, 2]``, x1.
        now: float64 ``[N, 2]``, x2.
    """

    before: Points
    now: Points

    @classmethod
    def by_flow(cls, frame: FrameBundle, state: FilterState) -> Matches | None:
        """All keypoints and where their flow ends; None where there is no flow or no previous image to test against."""
        if state.flow is None or state.previous is None:
            return None
        return cls(state.camera.undistort_points(state.flow.xy), frame.xy)

    def distances(self, fit: Flags, judged: Flags, estimator: Estimator) -> Points | None:
        """How far points are from the epipolar line that an F of some of them gives.

        Args:
            fit: bool ``[N]``, the matches that F is fitted to.
            judged: bool ``[N]``, the matches that are measured.
            estimator: How F is estimated.

        Returns:
            Distances ``[N]`` in pixels, 0 where a match is not judged; None where F cannot be estimated.
        """
        matrix = fundamental_matrix(self.before[fit], self.now[fit], estimator)
        if matrix is None:
            return None
        distance = np.zeros(len(judged))
        distance[judged] = epipolar_distance(matrix, self.before[judged], self.now[judged])
        return distance


def f_stats(*, asked: bool, judged: bool = False) -> dict[str, float]:
    """A filter's account of its fundamental matrix, see `FilterResult`: was there anything to test, and did F judge?"""
    return {"f_asked": float(asked), "f_judged": float(judged)}


def fundamental_matrix(first: Points, second: Points, estimator: Estimator) -> NDArray[np.float64] | None:
    """The matrix F with ``x2^T F x1 = 0`` (Eq. 24) for matched pixels, robustly.

    Args:
        first: Undistorted pixels x1, float64 ``[N, 2]``.
        second: Undistorted pixels x2, float64 ``[N, 2]``.
        estimator: Method and thresholds.

    Returns:
        F ``[3, 3]``, or None where it cannot be estimated (too few points, degenerate, the estimator gave up).
    """
    if len(first) < estimator.min_matches:
        return None
    method, draws = METHODS[estimator.method], estimator.max_draws
    try:
        matrix, _ = cv2.findFundamentalMat(first, second, method, estimator.inlier_px, estimator.confidence, draws)
    except cv2.error:  # OpenCV 5.0's MAGSAC raises "!model.empty()" where no model was found
        return None
    for _ in range(estimator.refits):
        if not _usable(matrix):
            return None
        agree = epipolar_distance(np.asarray(matrix, np.float64), first, second) < estimator.inlier_px
        if np.count_nonzero(agree) < estimator.min_matches:
            return None
        matrix, _ = cv2.findFundamentalMat(first[agree], second[agree], cv2.FM_8POINT)
    return np.asarray(matrix, dtype=np.float64) if _usable(matrix) else None


def _usable(matrix: Any) -> bool:
    return matrix is not None and matrix.shape == (3, 3) and bool(np.isfinite(matrix).all())


def epipolar_distance(matrix: NDArray[np.float64], first: Points, second: Points) -> Points:
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
    rays = [_rays(first, camera), _rays(second, camera)]
    weight = np.ones(len(first))
    residual = np.zeros(len(first))
    for _ in range(3):  # iteratively reweighted, so that moving things do not turn the rotation
        u, _, vt = np.linalg.svd((rays[1] * weight[:, None]).T @ rays[0])
        rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        residual = np.linalg.norm(camera.project(rays[0] @ rotation.T) - second, axis=1)
        weight = 1.0 / np.maximum(residual, 0.5)
    return float(np.median(residual))


def _rays(xy: Points, camera: Camera) -> Points:
    """Unit vectors ``[N, 3]`` towards undistorted pixels ``[N, 2]``."""
    rays = np.column_stack([(xy - (camera.cx, camera.cy)) / (camera.fx, camera.fy), np.ones(len(xy))])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def homography_share(first: Points, second: Points) -> float:
    """Share of the matches ``[N, 2]`` that one homography explains within 1 px: 1 for a plane or a pure rotation."""
    matrix, mask = cv2.findHomography(first, second, cv2.RANSAC, 1.0, maxIters=300, confidence=0.99)
    return 0.0 if matrix is None else float(np.mean(mask))


# Which feature of the previous frame is this one, and which are judged by their flow at all?


def link_to_previous(frame: FrameBundle, state: FilterState, radius_px: float = 2.5) -> NDArray[np.intp]:
    """Index of the previous frame's keypoint that each keypoint continues, ``[N]``; -1 for none.

    Args:
        frame: The current frame.
        state: With the flow to the previous image.
        radius_px: How near the flow's end must be to an earlier keypoint.
    """
    link = np.full(len(frame), -1, dtype=np.intp)
    if state.flow is None or state.previous is None or not len(state.previous):
        return link
    rows = np.flatnonzero(state.flow.valid & np.isfinite(state.flow.xy).all(axis=1))
    if not len(rows):
        return link
    distance, nearest = cKDTree(state.previous.keypoints.xy).query(state.flow.xy[rows], distance_upper_bound=radius_px)
    near = np.isfinite(distance)
    link[rows[near]] = np.asarray(nearest)[near]
    return link


def judged_by_flow(flow: FlowResult, asked: NDArray[np.bool_], unmatched: Unmatched) -> NDArray[np.bool_]:
    """Which features a test on flow judges, bool ``[N]``.

    Args:
        flow: Flow of the features; where it failed, ``xy`` is the place where the tracker gave up.
        asked: bool ``[N]``, features whose flow was asked for: those that earlier filters kept.
        unmatched: ``judge`` takes those along whose flow failed.
    """
    if unmatched != "judge":
        return np.asarray(asked & flow.valid)
    return np.asarray(asked & np.isfinite(flow.xy).all(axis=1))


def inherit(values: NDArray[np.float64], link: NDArray[np.intp], default: float) -> NDArray[np.float64]:
    """Values ``[M, ...]`` of the previous keypoints, carried to the current ones ``[N, ...]`` along their links."""
    carried = np.full((len(link), *values.shape[1:]), default, dtype=np.float64)
    carried[link >= 0] = values[link[link >= 0]]
    return carried
