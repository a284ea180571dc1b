"""Matches with the previous frame by optical flow, and the fundamental matrix of matches (paper, Eq. 24-25)."""

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

MIN_MATCHES = 16
"""Twice the minimum of the eight-point algorithm."""


@dataclass(frozen=True)
class Estimator:
    """Options of RANSAC for F.

    Attributes:
        inlier_px: Distance in pixels up to which a match agrees with F.
        confidence: Of RANSAC.
        max_draws: Most samples that it draws.
        min_matches: Fewer matches give no F.
        refits: How often F is fitted again to all matches that agree: the F of the minimal sample is noisy at the
            image's border.
    """

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
        """All keypoints and where their flow ends; None without flow or without a previous frame."""
        if state.flow is None or state.previous is None:
            return None
        return cls(state.camera.undistort_points(state.flow.xy), frame.xy)

    def distances(self, fit: Flags, tested: Flags, estimator: Estimator) -> Points | None:
        """Distances from the epipolar lines of an F that is fitted to some of the matches.

        Args:
            fit: bool ``[N]``, the matches that F is fitted to.
            tested: bool ``[N]``, the matches that are measured.
            estimator: Options of RANSAC.

        Returns:
            Distances ``[N]`` in pixels, 0 where a match is not tested; None where F cannot be estimated.
        """
        matrix = fundamental_matrix(self.before[fit], self.now[fit], estimator)
        if matrix is None:
            return None
        distance = np.zeros(len(tested))
        distance[tested] = epipolar_distance(matrix, self.before[tested], self.now[tested])
        return distance


def f_stats(*, asked: bool, judged: bool = False) -> dict[str, float]:
    """Stats of a filter that uses F, see `FilterResult`: whether there were matches, and whether F was used."""
    return {"f_asked": float(asked), "f_judged": float(judged)}


def fundamental_matrix(first: Points, second: Points, estimator: Estimator) -> NDArray[np.float64] | None:
    """The matrix F with ``x2^T F x1 = 0`` (Eq. 24) for matched pixels, by RANSAC.

    Args:
        first: Undistorted pixels x1, float64 ``[N, 2]``.
        second: Undistorted pixels x2, float64 ``[N, 2]``.
        estimator: Thresholds and limits.

    Returns:
        F ``[3, 3]``, or None where it cannot be estimated (too few points, degenerate).
    """
    if len(first) < estimator.min_matches:
        return None
    matrix, _ = cv2.findFundamentalMat(
        first, second, cv2.FM_RANSAC, estimator.inlier_px, estimator.confidence, estimator.max_draws
    )
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
    """Median distance in pixels between matches ``[N, 2]`` and the best pure rotation: the parallax."""
    rays = [_rays(first, camera), _rays(second, camera)]
    weight = np.ones(len(first))
    residual = np.zeros(len(first))
    for _ in range(3):  # iteratively reweighted, so that moving objects do not influence the rotation
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
    """Share of the matches ``[N, 2]`` within 1 px of one homography: 1 for a plane or a pure rotation."""
    matrix, mask = cv2.findHomography(first, second, cv2.RANSAC, 1.0, maxIters=300, confidence=0.99)
    return 0.0 if matrix is None else float(np.mean(mask))


def link_to_previous(frame: FrameBundle, state: FilterState, radius_px: float = 2.5) -> NDArray[np.intp]:
    """Index of the previous frame's keypoint that each keypoint continues, ``[N]``; -1 for none.

    Args:
        frame: The current frame.
        state: With the flow to the previous image.
        radius_px: Largest distance between the end of the flow and an earlier keypoint.
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


def tested_by_flow(flow: FlowResult, kept: NDArray[np.bool_], unmatched: Unmatched) -> NDArray[np.bool_]:
    """Features that a test on flow applies to, bool ``[N]``.

    Args:
        flow: Flow of the features; where it failed, ``xy`` is the place where the tracker lost the feature.
        kept: bool ``[N]``, features that earlier filters kept and whose flow was computed.
        unmatched: ``judge`` includes features whose flow failed.
    """
    if unmatched != "judge":
        return np.asarray(kept & flow.valid)
    return np.asarray(kept & np.isfinite(flow.xy).all(axis=1))
