"""B3: the epipolar test on optical flow (paper, Eq. 23-25), with a degeneracy guard."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.filter import FilterResult, FilterState, FrameBundle, Need, Provenance
from dynslam_bench.culling import Rule
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
"""A point within this distance of its prediction by the camera's motion counts as static in `contradiction`."""
VOTE_SHARE = 0.3
"""Share of an object's tested points that must fail for the object to count as moving (not stated in the paper)."""
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


class EpipolarFilter(Rule[EpipolarSettings]):
    """Drops points, or objects, whose flow leaves the epipolar line.

    F is fitted to the flow of the points that earlier filters kept; all points with a valid flow are tested.
    Stats: ``dropped``, ``matches``, ``inliers`` (of F), ``parallax_px``, ``homography_share`` (0 where the parallax
    is too small), ``contradiction`` (see `contradiction`), ``degenerate`` (1 where the test was skipped),
    ``moving_objects``, ``f_asked`` and ``f_judged`` (see `filter.FilterResult`).
    """

    name = "epipolar"
    needs: frozenset[Need] = frozenset({"flow", "previous"})
    provenance: Provenance = "faithful-paper"
    stats_names = ("dropped", *STATS)

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
        if stats["matches"] < MIN_MATCHES or self._is_degenerate(matches, fit, state.camera, stats):
            return FilterResult.of(keep, stats)
        distance = matches.distances(fit, valid, Estimator())
        if distance is None:
            return FilterResult.of(keep, stats)
        failing = distance > self.settings.threshold_px
        stats["inliers"] = float(np.count_nonzero(fit & ~failing))
        if self.settings.max_contradiction < 1:
            stats["contradiction"] = contradiction(frame, state, failing, matches.before)
            if stats["contradiction"] > self.settings.max_contradiction:
                return FilterResult.of(keep, stats)
        stats |= f_stats(asked=True, judged=True) | {"degenerate": 0.0}
        if self.settings.mode == "point":
            moving = coherent(failing, valid, frame.keypoints.xy, self.settings.min_share, frame.gray.shape)
            return FilterResult.of(~moving, stats)
        keep, stats["moving_objects"] = vote_on_objects(frame, failing, valid)
        return FilterResult.of(keep, stats)

    def _is_degenerate(self, matches: Matches, fit: NDArray[np.bool_], camera: Camera, stats: dict[str, float]) -> bool:
        """Whether the parallax is too small or one homography explains the view; fills in both stats."""
        before, now = matches.before[fit], matches.now[fit]
        stats["parallax_px"] = rotation_residual(before, now, camera)
        flow_px = float(np.median(np.linalg.norm(before - now, axis=1)))
        if stats["parallax_px"] < max(self.settings.min_parallax_px, self.settings.parallax_share * flow_px):
            return True
        stats["homography_share"] = homography_share(before, now)
        return stats["homography_share"] > self.settings.homography_share


def contradiction(frame: FrameBundle, state: FilterState, failing: NDArray[np.bool_], before: Points) -> float:
    """Share of the points that fit the camera's motion in depth and fail the epipolar test.

    Where a person fills the image, the largest consistent set of matches may lie on the person. The camera's motion is
    known from `ego_motion`: an F that rejects many of the points that follow it is not the F of the static scene.

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


def vote_on_objects(
    frame: FrameBundle, failing: NDArray[np.bool_], tested: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], float]:
    """B11: an object moves if enough of its tested points fail; then all of its points are dropped.

    Args:
        frame: The frame with its instances; without any, nothing is dropped.
        failing: bool ``[N]``, points that failed a test.
        tested: bool ``[N]``, points that were tested.

    Returns:
        bool ``[N]`` keep, and the number of moving objects.
    """
    keep = np.ones(len(frame), dtype=bool)
    moving = 0
    for mask in () if frame.instances is None else frame.instances.masks:
        on_object = inside(mask, frame.keypoints.xy)
        voters = on_object & tested
        if voters.any() and failing[voters].mean() >= VOTE_SHARE:
            keep &= ~on_object
            moving += 1
    return keep, float(moving)
