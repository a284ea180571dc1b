"""B3, the epipolar test on optical flow (paper, Eq. 23-25): this project's, with boxes, by class (B15), by vote (B11).

F is the fundamental matrix of the matches between the previous and the current image.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import FilterResult, FilterState, FrameBundle, Need
from dynslam_bench.culling import BaseFilter, Number, ObjectFilter
from dynslam_bench.culling.ego_motion import PATCH_3X3, rigid_flow
from dynslam_bench.culling.moving_regions import in_moving_region
from dynslam_bench.culling.semantic import dynamic_boxes, in_boxes
from dynslam_bench.culling.settings import (
    BoxEpipolarSettings,
    ClassRuleSettings,
    EpipolarSettings,
    MovingVoteSettings,
    Unmatched,
)
from dynslam_bench.geometry import Camera, at_width, inside
from dynslam_bench.segmentation.postprocess import dynamic_mask, select

Points = NDArray[np.float64]
Flags = NDArray[np.bool_]

MIN_MATCHES = 16
"""Twice the minimum of the eight-point algorithm."""
CONFIDENCE = 0.99
"""Probability at which RANSAC has drawn a sample without outliers."""
RIGID_PX = 2.0
"""A point within this distance of its prediction by the camera's motion counts as static in `contradiction_share`."""
VOTE_SHARE = 0.3
"""Share of an object's tested points that must fail for the object to count as moving (not stated in the paper)."""
MIN_OUTSIDE = 20
"""SG-SLAM takes all matches where fewer than this lie outside the boxes."""


def fundamental_matrix(
    x1: Points,
    x2: Points,
    *,
    inlier_px: float = 1.0,
    max_draws: int = 2000,
    min_matches: int = MIN_MATCHES,
    refits: int = 2,
) -> NDArray[np.float64] | None:
    """The matrix F with ``x2^T F x1 = 0`` (Eq. 24) for matched pixels, by RANSAC.

    Args:
        x1: Undistorted pixels of the previous image, float64 ``[N, 2]``.
        x2: Undistorted pixels of the current image, float64 ``[N, 2]``; row i is matched with row i
            of `x1`.
        inlier_px: Distance in pixels up to which a match agrees with F.
        max_draws: Most samples that RANSAC draws.
        min_matches: Fewer matches give no F.
        refits: How often F is fitted again to all matches that agree: the F of the minimal sample
            is noisy at the image's border.

    Returns:
        F ``[3, 3]``, or None where it cannot be estimated (too few points, degenerate).
    """
    # all matches at first, then those that agree with the F before
    agree = np.ones(len(x1), dtype=bool)
    for refit in range(refits + 1):
        if np.count_nonzero(agree) < min_matches:
            return None
        # RANSAC at first, then the eight-point algorithm on all that agree
        if refit == 0:
            matrix, _ = cv2.findFundamentalMat(
                x1, x2, cv2.FM_RANSAC, inlier_px, CONFIDENCE, max_draws
            )
        else:
            matrix, _ = cv2.findFundamentalMat(x1[agree], x2[agree], cv2.FM_8POINT)
        if matrix is None or matrix.shape != (3, 3) or not np.isfinite(matrix).all():
            return None
        agree = epipolar_distance(np.asarray(matrix, dtype=np.float64), x1, x2) < inlier_px
    return np.asarray(matrix, dtype=np.float64)


def epipolar_distance(matrix: NDArray[np.float64], x1: Points, x2: Points) -> Points:
    """Distances ``[N]`` in pixels of x2 to the epipolar line of x1 (Eq. 25, with the root that the text lost)."""
    # the line F x1 of each match: a x + b y + c = 0
    lines = np.column_stack([x1, np.ones(len(x1))]) @ matrix.T
    signed = (lines[:, :2] * x2).sum(axis=1) + lines[:, 2]
    return np.asarray(np.abs(signed) / np.maximum(np.hypot(lines[:, 0], lines[:, 1]), 1e-12))


class FlowMatches(NamedTuple):
    """Keypoints and where their flow ends, undistorted pixels.

    Attributes:
        x1: float64 ``[N, 2]``, in the previous image.
        x2: float64 ``[N, 2]``, in the current one.
        valid: bool ``[N]``, keypoints whose flow succeeded.
        tested: bool ``[N]``, keypoints that are tested.
    """

    x1: Points
    x2: Points
    valid: Flags
    tested: Flags

    def distances(self, fitted: Flags, inlier_px: float = 1.0) -> Points | None:
        """Epipolar distances ``[N]`` in pixels of the tested matches, 0 for others; None where F cannot be estimated.

        Args:
            fitted: bool ``[N]``, matches that F is fitted to.
            inlier_px: Distance in pixels up to which one of them agrees with F.
        """
        matrix = fundamental_matrix(self.x1[fitted], self.x2[fitted], inlier_px=inlier_px)
        if matrix is None:
            return None
        distance = np.zeros(len(fitted))
        distance[self.tested] = epipolar_distance(
            matrix, self.x1[self.tested], self.x2[self.tested]
        )
        return distance


def matches_by_flow(
    frame: FrameBundle, state: FilterState, unmatched: Unmatched | None = None
) -> FlowMatches | None:
    """The keypoints' matches; None without flow or without a previous frame.

    Args:
        frame: The current frame.
        state: With the flow.
        unmatched: None tests every valid match. Else only keypoints that earlier filters kept are
            tested; ``judge`` includes those whose flow failed, at the place where it lost them.
    """
    flow = state.flow
    if flow is None or state.previous is None:
        return None
    # the keypoints that are tested
    if unmatched is None:
        tested = flow.valid
    elif unmatched == "judge":
        tested = state.keep & np.isfinite(flow.xy).all(axis=1)
    else:
        tested = state.keep & flow.valid
    return FlowMatches(state.flow_xy, frame.xy, flow.valid, tested)


class EpipolarFilter(BaseFilter[EpipolarSettings]):
    """Drops points, or objects, whose flow leaves the epipolar line.

    F is fitted to the flow of the points that earlier filters kept; all points with a valid flow
    are tested. Stats: ``dropped``, ``matches``, ``inliers`` (of F), ``parallax_px``,
    ``homography_share`` (0 where the parallax is too small), ``contradiction`` (see
    `contradiction_share`), ``degenerate`` (1 where the test was skipped), ``moving_objects``, ``f_asked``
    and ``f_judged`` (see `filter.FilterResult`).
    """

    name = "epipolar"
    needs: frozenset[Need] = frozenset({"flow", "previous"})
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

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Test the flow of this frame's keypoints to the previous image."""
        keep = np.ones(len(frame.xy), dtype=bool)
        matches = matches_by_flow(frame, state)
        if matches is None:
            return self.verdict(keep)

        # views that determine no F are not judged
        fitted = matches.valid & state.keep
        stats: dict[str, Number] = {
            "matches": np.count_nonzero(fitted),
            "degenerate": 1,
            "f_asked": 1,
        }
        if self._is_degenerate(matches.x1[fitted], matches.x2[fitted], state.camera, stats):
            return self.verdict(keep, **stats)

        # F of the kept points (Eq. 24); points too far from their epipolar line fail (Eq. 25)
        distance = matches.distances(fitted)
        if distance is None:
            return self.verdict(keep, **stats)
        failing = distance > self.settings.threshold_px
        stats["inliers"] = np.count_nonzero(fitted & ~failing)

        # an F that rejects what follows the camera's motion is not that of the static scene
        if self.settings.max_contradiction < 1:
            share = stats["contradiction"] = contradiction_share(frame, state, failing, matches)
            if share > self.settings.max_contradiction:
                return self.verdict(keep, **stats)
        stats |= {"degenerate": 0, "f_judged": 1}

        # drop whole objects, or regions in which enough points fail
        if self.settings.mode == "object":
            keep, stats["moving_objects"] = vote_on_objects(frame, failing, matches.valid)
            return self.verdict(keep, **stats)
        moving = in_moving_region(
            failing,
            matches.valid,
            frame.keypoints.xy,
            self.settings.min_share,
            frame.gray.shape,
        )
        return self.verdict(~moving, **stats)

    def _is_degenerate(
        self, x1: Points, x2: Points, camera: Camera, stats: dict[str, Number]
    ) -> bool:
        """Whether matches or parallax are too small or one homography explains the view; fills in both stats."""
        if len(x1) < MIN_MATCHES:
            return True
        # no parallax: a pure rotation
        parallax_px = stats["parallax_px"] = rotation_residual(x1, x2, camera)
        flow_px = float(np.median(np.linalg.norm(x1 - x2, axis=1)))
        if parallax_px < max(self.settings.min_parallax_px, self.settings.parallax_share * flow_px):
            return True
        # one plane: a homography explains the matches as well, and F is not determined
        share = stats["homography_share"] = homography_share(x1, x2)
        return share > self.settings.homography_share


def rotation_residual(x1: Points, x2: Points, camera: Camera) -> float:
    """Median distance in pixels between matches ``[N, 2]`` and the best pure rotation: the parallax."""
    rays = camera.unproject(np.stack([x1, x2]), np.ones((2, len(x1))))
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    weight = np.ones(len(x1))
    residual = np.zeros(len(x1))
    # iteratively reweighted, so that moving objects do not influence the rotation
    for _ in range(3):
        # the rotation that aligns the rays best (Kabsch), by singular value decomposition
        u, _, vt = np.linalg.svd((rays[1] * weight[:, None]).T @ rays[0])
        rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        residual = np.linalg.norm(camera.project(rays[0] @ rotation.T) - x2, axis=1)
        weight = 1.0 / np.maximum(residual, 0.5)
    return float(np.median(residual))


def homography_share(x1: Points, x2: Points) -> float:
    """Share of the matches ``[N, 2]`` within 1 px of one homography: 1 for a plane or a pure rotation.

    Of a homography with the share 0.8 that matters, one of 50 draws of four matches is free of
    outliers but for once in 10^11.
    """
    matrix, mask = cv2.findHomography(x1, x2, cv2.RANSAC, 1.0, maxIters=50, confidence=0.99)
    return 0.0 if matrix is None else float(np.mean(mask))


def contradiction_share(
    frame: FrameBundle, state: FilterState, failing: Flags, matches: FlowMatches
) -> float:
    """Share of the points that fit the camera's motion in depth and fail the epipolar test.

    Where a person fills the image, the largest consistent set of matches may lie on the person. The
    camera's motion is known from `ego_motion`: an F that rejects many of the points that follow it
    is not the F of the static scene.

    Args:
        frame: The current frame.
        state: With previous and predicted pose.
        failing: bool ``[N]``, points that fail the epipolar test.
        matches: Matches of the points.

    Returns:
        The share, 0 to 1; 0 where too few points have depth or no pose is known.
    """
    if state.T_world_prev is None or state.T_world_pred is None:
        return 0.0
    # where points with depth were in the previous image, if only the camera moved
    rows = matches.valid & state.keep & (frame.z > 0)
    _, expected = rigid_flow(frame, state, rows)

    # of those that were there: how many the epipolar test rejects
    rows[rows] = np.linalg.norm(expected - matches.x1[rows], axis=1) < RIGID_PX
    if np.count_nonzero(rows) < MIN_MATCHES:
        return 0.0
    return float(failing[rows].mean())


def vote_on_objects(frame: FrameBundle, failing: Flags, tested: Flags) -> tuple[Flags, float]:
    """B11: an object moves if enough of its tested points fail; then all of its points are dropped.

    Args:
        frame: The frame with its instances; without any, nothing is dropped.
        failing: bool ``[N]``, points that failed a test.
        tested: bool ``[N]``, points that were tested.

    Returns:
        bool ``[N]`` keep, and the number of moving objects.
    """
    # object by object: the tested points on it vote
    keep = np.ones(len(frame.xy), dtype=bool)
    moving = 0
    if frame.instances is None:
        return keep, moving
    for mask in frame.instances.masks:
        on_object = inside(mask, frame.keypoints.xy)
        voters = on_object & tested
        if voters.any() and failing[voters].mean() >= VOTE_SHARE:
            keep &= ~on_object
            moving += 1
    return keep, moving


class BoxEpipolarFilter(ObjectFilter[BoxEpipolarSettings]):
    """B3 with boxes: drops points off their epipolar line, with one limit inside dynamic boxes and another outside.

    Unlike `EpipolarFilter` it has no degeneracy guard: the published systems have none, and fail
    where F is degenerate. The setting ``unmatched`` decides about features whose flow failed.
    Stats: ``dropped``, ``matches``, ``boxes``, ``lost`` (features whose flow failed), ``failed`` (1
    where F could not be estimated).
    """

    name = "box_epipolar"
    needs: frozenset[Need] = frozenset({"flow", "boxes", "previous"})
    stats_names = ("dropped", "matches", "lost", "failed", "boxes", "f_asked", "f_judged")

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Test the flow of this frame's keypoints to the previous image."""
        # matches by flow, and the features whose flow failed
        settings = self.settings
        keep = np.ones(len(frame.xy), dtype=bool)
        matches = matches_by_flow(frame, state, settings.unmatched)
        boxes = dynamic_boxes(frame, self.segmentation)
        if matches is None or state.flow is None or state.previous is None:
            return self.verdict(keep, boxes=len(boxes))
        lost = state.keep & ~matches.valid
        tested = matches.tested
        if settings.unmatched == "drop":
            keep &= ~lost

        # matches that F is fitted to: outside this frame's boxes, outside the previous one's, or all
        in_box = in_boxes(frame.keypoints.xy, boxes).any(axis=0)
        if settings.fit == "kept":
            fitted = tested
        elif settings.fit == "outside previous":
            previous_boxes = dynamic_boxes(state.previous, self.segmentation)
            # a place that no box contains, where there is no flow
            flow_ends = np.nan_to_num(state.flow.xy, nan=-1e6)
            fitted = tested & ~in_boxes(flow_ends, previous_boxes).any(axis=0)
        else:
            fitted = tested & ~in_box
        if np.count_nonzero(fitted) < MIN_OUTSIDE:
            fitted = tested
        stats: dict[str, Number] = {
            "matches": np.count_nonzero(fitted),
            "lost": np.count_nonzero(lost),
            "boxes": len(boxes),
            "f_asked": 1,
        }
        # distances of all tested matches from their epipolar lines
        distance = matches.distances(fitted, settings.inlier_px)
        if distance is None:
            return self.verdict(keep, failed=1, **stats)

        # one limit inside boxes, another outside
        outside_px = settings.outside_px if settings.test_outside else np.inf
        limit = np.where(in_box, settings.inside_px, outside_px)
        keep[tested] = (distance <= limit)[tested]
        return self.verdict(keep, f_judged=1, **stats)


class ClassRuleFilter(ObjectFilter[ClassRuleSettings]):
    """B15, class, depth and epipolar line (SEG-SLAM): drops people, and points on movable objects that fail a test.

    The setting ``unmatched`` decides about a feature on a movable object whose flow failed.
    Stats: ``dropped``, ``on_people``, ``on_movable``, ``moving_objects``, ``lost`` (features whose
    flow failed).
    """

    name = "class_rule"
    needs: frozenset[Need] = frozenset({"masks", "flow", "previous", "depth"})
    stats_names = (
        "dropped",
        "on_people",
        "on_movable",
        "moving_objects",
        "lost",
        "f_asked",
        "f_judged",
    )

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Drop by class first, then test movable objects by geometry."""
        # matches by flow; without any object everything is kept
        settings = self.settings
        xy = frame.keypoints.xy
        keep = np.ones(len(xy), dtype=bool)
        none = np.zeros(len(xy), dtype=bool)
        matches = matches_by_flow(frame, state, settings.unmatched)
        stats: dict[str, Number] = {
            "f_asked": matches is not None,
            "on_movable": 0,
            "moving_objects": 0,
        }
        if frame.instances is None or not len(frame.instances):
            return self.verdict(keep, **stats)

        # by class: people
        people = dynamic_mask(frame.instances, self.segmentation, frame.depth)
        keep &= ~inside(people, xy)
        stats["on_people"] = np.count_nonzero(~keep)

        # by epipolar line: F of what lies neither on people nor on movable objects
        movable_classes = self.segmentation.model_copy(update={"classes": settings.movable})
        movable = select(frame.instances, movable_classes)
        off_line = none
        tested = none
        lost = none
        if matches is not None:
            lost = state.keep & ~matches.valid
            distance = matches.distances(matches.tested & keep & ~inside(movable.union(), xy))
            if distance is not None:
                off_line = distance > settings.threshold_px
                tested = matches.tested
        stats |= {"lost": np.count_nonzero(lost), "f_judged": tested.any()}

        # movable objects: failing points, and all points at the depth of an object that moves
        for mask in movable.masks:
            on_object = inside(mask, xy) & keep
            stats["on_movable"] += np.count_nonzero(on_object)
            voters = on_object & tested
            failed = off_line | lost if settings.unmatched == "drop" else off_line
            drop = on_object & failed
            if voters.any() and off_line[voters].mean() >= settings.vote_share:
                stats["moving_objects"] += 1
                # its points at its own depth: the mask covers some background, too
                depth = frame.depth[mask]
                depth = depth[np.isfinite(depth) & (depth > 0)]
                if len(depth):
                    drop |= on_object & (np.abs(frame.z - np.median(depth)) < settings.depth_m)
            keep &= ~drop
        return self.verdict(keep, people, **stats)


# B3 and B11 as in DS-SLAM's code: one moving corner near a person drops the features of all people.

VOTE_BORDER_PX = 5
"""Corners nearer to the image's border are left out."""
HARRIS_K = 0.04
"""Parameter of the corner measure that the authors' code chooses (Harris, blocks of 3 px)."""
VOTE_LEVELS = 5
"""Coarsest pyramid level of Lucas-Kanade."""
VOTE_MATCHES = 8
"""Eight matches suffice and RANSAC's own F is taken, as in the authors' code."""
VOTE_WINDOW = (22, 22)
"""Window of Lucas-Kanade, pixels."""


class MovingVoteFilter(ObjectFilter[MovingVoteSettings]):
    """DS-SLAM's moving consistency check: corners of its own, pyramidal Lucas-Kanade, F by RANSAC, one global vote.

    It has no degeneracy guard; the published system fails on `walking_rpy` without one.
    Stats: ``dropped``, ``corners`` (tracked), ``moving`` (off their line), ``votes`` (of those,
    near a person).
    """

    name = "moving_vote"
    needs: frozenset[Need] = frozenset({"masks", "previous"})
    stats_names = ("dropped", "corners", "moving", "votes", "f_asked", "f_judged")

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Vote, and drop the points on people if enough moving corners lie near them."""
        keep = np.ones(len(frame.xy), dtype=bool)
        asked = state.previous is not None
        if state.previous is None or frame.instances is None:
            return self.verdict(keep, f_asked=asked)

        # moving corners vote if they lie near a person, in a square window as in the authors' code
        people = select(frame.instances, self.segmentation).union()
        moving, corners, judged = self._moving_corners(
            state.previous.gray, frame.gray, state.camera
        )
        side = 2 * round(at_width(self.settings.radius_px, people.shape[1])) + 1
        dilated = cv2.dilate(people.view(np.uint8), np.ones((side, side), np.uint8))
        votes = np.count_nonzero(inside(dilated.astype(bool), moving))

        # enough votes drop the points on all people
        mask = people if votes >= self.settings.min_votes else None
        if mask is not None:
            keep = ~inside(people, frame.keypoints.xy)
        return self.verdict(
            keep,
            mask,
            corners=corners,
            moving=len(moving),
            votes=votes,
            f_asked=asked,
            f_judged=judged,
        )

    def _moving_corners(
        self, previous: NDArray[np.uint8], current: NDArray[np.uint8], camera: Camera
    ) -> tuple[NDArray[np.float32], int, bool]:
        """Pixels ``[M, 2]`` of the corners off their line, the number of tracked corners, whether F was estimated."""
        # corners of the previous image, to a fraction of a pixel
        no_corners = np.zeros((0, 2), np.float32)
        corners = cv2.goodFeaturesToTrack(
            previous,
            self.settings.corners,
            0.01,
            8,
            blockSize=3,
            useHarrisDetector=True,
            k=HARRIS_K,
        )
        if corners is None or len(corners) < VOTE_MATCHES:
            return no_corners, 0, False
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.03)
        corners = cv2.cornerSubPix(previous, corners, (10, 10), (-1, -1), criteria)

        # their flow to the current image
        tracked, status, _ = cv2.calcOpticalFlowPyrLK(
            previous,
            current,
            corners,
            corners.copy(),
            winSize=VOTE_WINDOW,
            maxLevel=VOTE_LEVELS,
            criteria=(criteria[0], 20, 0.01),
        )
        before = corners.reshape(-1, 2)
        after = tracked.reshape(-1, 2)

        # without corners at the border, and those whose patches differ
        low = VOTE_BORDER_PX
        high = np.array(current.shape[::-1]) - VOTE_BORDER_PX - 1
        good = status.ravel().astype(bool)
        for xy in (before, after):
            good &= (xy >= low).all(axis=1) & (xy <= high).all(axis=1)
        difference = _patch_difference(previous, current, before[good], after[good])
        good[good] = difference <= self.settings.sad_limit
        before = before[good]
        after = after[good]

        # F by RANSAC, and the corners off their epipolar line
        x1 = camera.undistort_points(before)
        x2 = camera.undistort_points(after)
        inlier_px = self.settings.inlier_px
        matrix = fundamental_matrix(
            x1, x2, inlier_px=inlier_px, max_draws=1000, min_matches=VOTE_MATCHES, refits=0
        )
        if matrix is None:
            return no_corners, len(before), False
        off_line = epipolar_distance(matrix, x1, x2) > self.settings.threshold_px
        return after[off_line], len(before), True


def _patch_difference(
    first: NDArray[np.uint8],
    second: NDArray[np.uint8],
    xy1: NDArray[np.float32],
    xy2: NDArray[np.float32],
) -> NDArray[np.int64]:
    """Sum of absolute differences of the 3x3 patches around truncated pixels inside both images, ``[N]``.

    Args:
        first: uint8 ``[H, W]``, grey levels.
        second: uint8 ``[H, W]``, grey levels of the other image.
        xy1: Pixels ``[N, 2]`` of the first image.
        xy2: Pixels ``[N, 2]`` of the second image.
    """
    difference = _patches(first, xy1) - _patches(second, xy2)
    return np.asarray(np.abs(difference).sum(axis=0))


def _patches(image: NDArray[np.uint8], xy: NDArray[np.float32]) -> NDArray[np.int64]:
    """Grey levels ``[9, N]`` of the 3x3 pixels around truncated pixels ``[N, 2]``."""
    columns, rows = (xy[:, None].astype(np.intp) + PATCH_3X3).T
    return np.asarray(image[rows, columns], np.int64)
