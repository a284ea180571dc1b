"""B3 and B11 as in DS-SLAM's code: one moving corner near a person drops the features of all people."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.filter import FilterResult, FilterState, FrameBundle, Need, Provenance
from dynslam_bench.culling import ObjectRule
from dynslam_bench.culling.epipolar import epipolar_distance, fundamental_matrix
from dynslam_bench.culling.settings import MovingVoteSettings
from dynslam_bench.geometry.camera import Camera, inside
from dynslam_bench.segmentation.postprocess import select

BORDER_PX = 5
HARRIS_K = 0.04
"""Of the corner measure that the authors' code chooses (Harris, blocks of 3 px)."""
LEVELS = 5
MIN_MATCHES = 8
"""Eight matches suffice and RANSAC's own F is taken, as in the authors' code."""
WINDOW = (22, 22)


class MovingVoteFilter(ObjectRule[MovingVoteSettings]):
    """DS-SLAM's moving consistency check: corners of its own, pyramidal Lucas-Kanade, F by RANSAC, one global vote.

    It has no degeneracy guard; the published system fails on `walking_rpy` without one.
    Stats: ``dropped``, ``corners`` (tracked), ``moving`` (off their line), ``votes`` (of those, near a person).
    """

    name = "moving_vote"
    needs: frozenset[Need] = frozenset({"masks", "previous"})
    provenance: Provenance = "faithful-code"
    stats_names = ("dropped", "corners", "moving", "votes", "f_asked", "f_judged")

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Vote, and drop the points on people if enough moving corners lie near them."""
        keep, asked = np.ones(len(frame.xy), dtype=bool), state.previous is not None
        if state.previous is None or frame.instances is None:
            return self.verdict(keep, f_asked=asked)
        people = select(frame.instances, self.segmentation).union()
        moving, corners, judged = self._moving_corners(state.previous.gray, frame.gray, state.camera)
        side = 2 * self.settings.radius_px + 1  # a square window, as in the authors' code
        near_people = cv2.dilate(people.view(np.uint8), np.ones((side, side), np.uint8)).astype(bool)
        votes = np.count_nonzero(inside(near_people, moving))
        mask = people if votes >= self.settings.min_votes else None
        if mask is not None:
            keep = ~inside(people, frame.keypoints.xy)
        return self.verdict(
            keep, mask, corners=corners, moving=len(moving), votes=votes, f_asked=asked, f_judged=judged
        )

    def _moving_corners(
        self, previous: NDArray[np.uint8], current: NDArray[np.uint8], camera: Camera
    ) -> tuple[NDArray[np.float32], int, bool]:
        """Pixels ``[M, 2]`` of the corners off their line, the number of tracked corners, whether F was estimated."""
        no_corners = np.zeros((0, 2), np.float32)
        corners = cv2.goodFeaturesToTrack(
            previous, self.settings.corners, 0.01, 8, blockSize=3, useHarrisDetector=True, k=HARRIS_K
        )
        if corners is None or len(corners) < MIN_MATCHES:
            return no_corners, 0, False
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.03)
        corners = cv2.cornerSubPix(previous, corners, (10, 10), (-1, -1), criteria)
        tracked, status, _ = cv2.calcOpticalFlowPyrLK(
            previous,
            current,
            corners,
            corners.copy(),
            winSize=WINDOW,
            maxLevel=LEVELS,
            criteria=(criteria[0], 20, 0.01),
        )
        before, after = corners.reshape(-1, 2), tracked.reshape(-1, 2)
        low, high = BORDER_PX, np.array(current.shape[::-1]) - BORDER_PX - 1
        good = status.ravel().astype(bool)
        for xy in (before, after):
            good &= (xy >= low).all(axis=1) & (xy <= high).all(axis=1)
        good[good] = _patch_difference(previous, current, before[good], after[good]) <= self.settings.sad_limit
        before, after = before[good], after[good]
        first, second = camera.undistort_points(before), camera.undistort_points(after)
        inlier_px = self.settings.inlier_px
        matrix = fundamental_matrix(
            first, second, inlier_px=inlier_px, max_draws=1000, min_matches=MIN_MATCHES, refits=0
        )
        if matrix is None:
            return no_corners, len(before), False
        return after[epipolar_distance(matrix, first, second) > self.settings.threshold_px], len(before), True


def _patch_difference(
    first: NDArray[np.uint8], second: NDArray[np.uint8], xy1: NDArray[np.float32], xy2: NDArray[np.float32]
) -> NDArray[np.int64]:
    """Sum of absolute differences of the 3x3 patches around truncated pixels inside both images, ``[N]``."""
    offsets = np.array([(dx, dy) for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
    a, b = (
        image[tuple((xy[:, None].astype(np.intp) + offsets).T[::-1])].astype(np.int64)
        for image, xy in ((first, xy1), (second, xy2))
    )
    return np.asarray(np.abs(a - b).sum(axis=0))
