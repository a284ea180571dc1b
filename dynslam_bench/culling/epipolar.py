"""B3: the epipolar test on optical flow (paper, Eq. 23-25), with a degeneracy guard."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.filter import DynamicFilter, FilterResult, FilterState, FrameBundle, Need, Provenance
from dynslam_bench.culling.ego_motion import coherent, rigid_flow
from dynslam_bench.culling.matches import (
    MIN_MATCHES,
    Estimator,
    Matches,
    Points,
    f_stats,
    homography_share,
    rotation_residual,
)
from dynslam_bench.culling.settings import EpipolarSettings
from dynslam_bench.geometry.camera import Camera, inside

RIGID_PX = 2.0
"""Nearer than this to where the camera's motion puts it, a point moves with the static world."""
STATS = (
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
    stats_names = ("dropped", *STATS)

    def __init__(self, settings: EpipolarSettings) -> None:
        self.settings = settings

    def reset(self, camera: Camera) -> None:
        """Nothing to forget."""

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Test the flow of this frame's keypoints to the previous image."""
        stats = dict.fromkeys(STATS, 0.0)
        keep = np.ones(len(frame), dtype=bool)
        matches = Matches.by_flow(frame, state)
        if matches is None or state.flow is None:
            return FilterResult.of(keep, stats)
        valid = state.flow.valid
        fit = valid & state.keep
        stats |= f_stats(asked=True) | {"matches": float(np.count_nonzero(fit)), "degenerate": 1.0}
        if stats["matches"] < MIN_MATCHES or self._means_nothing(matches, fit, state.camera, stats):
            return FilterResult.of(keep, stats)
        options = self.settings
        distance = matches.distances(fit, valid, Estimator(options.estimator, options.inlier_px, options.confidence))
        if distance is None:
            return FilterResult.of(keep, stats)
        failing = distance > options.threshold_px
        stats["inliers"] = float(np.count_nonzero(fit & ~failing))
        if options.max_contradiction < 1:
            stats["contradiction"] = contradiction(frame, state, failing, matches.before)
            if stats["contradiction"] > options.max_contradiction:
                return FilterResult.of(keep, stats)
        stats |= f_stats(asked=True, judged=True) | {"degenerate": 0.0}
        if options.mode == "point":
            moving = coherent(failing, valid, frame.keypoints.xy, options.min_share, frame.gray.shape)
            return FilterResult.of(~moving, stats)
        keep, stats["moving_objects"] = vote_on_objects(frame, failing, valid, options.vote_share)
        return FilterResult.of(keep, stats)

    def _means_nothing(self, matches: Matches, fit: NDArray[np.bool_], camera: Camera, stats: dict[str, float]) -> bool:
        """Whether the view is degenerate: too little parallax, or one homography says it all; fills in both stats."""
        before, now = matches.before[fit], matches.now[fit]
        stats["parallax_px"] = rotation_residual(before, now, camera)
        flow_px = float(np.median(np.linalg.norm(before - now, axis=1)))
        if stats["parallax_px"] < max(self.settings.min_parallax_px, self.settings.parallax_share * flow_px):
            return True
        stats["homography_share"] = homography_share(before, now)
        return stats["homography_share"] > self.settings.homography_share


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
