"""Map initialisation without depth: the motion between two views, and the points that both show.

As in ORB-SLAM (Mur-Artal, Montiel and Tardos 2015, Section IV) a homography and an essential matrix
are fitted to the same matches, so that flat and deep scenes both give a motion. A motion is
accepted if nearly all matches lie before both cameras, no other motion explains them as well, and
the parallax is large enough. The best motion is not decided by the scores of the two models as
there, but by its cost after bundle adjustment. On a scene with one large wall the essential matrix
of most matches is wrong and a homography's motion right; the points beside the wall show which. Two
views a few centimetres apart do not tell a translation from a rotation; all views between them do,
so that those are adjusted together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.filter import FrameBundle
from dynslam_bench.features.matching import rotation_consistent, search_in_radius
from dynslam_bench.geometry import Camera, se3
from dynslam_bench.slam.bundle_adjustment import BundleProblem, adjust_bundle
from dynslam_bench.slam.map import Array, Map, Slots
from dynslam_bench.slam.observations import Observations
from dynslam_bench.slam.pose_optimisation import NEAR_M, optimise_pose
from dynslam_bench.slam.settings import TwoViewSettings

MAX_DISTANCE = 50
RATIO = 0.9
"""Largest Hamming distance of a match, and over that of the second nearest (ORB-SLAM's numbers)."""
CHI2_LINE = 3.841
CHI2_POINT = 5.991
"""95 % quantiles of chi-square: distance from a line, and from a point."""
MIN_GOOD_SHARE = 0.8
"""Share of the matches that fit either model which must lie before both cameras and project back."""
RIVAL_SHARE = 0.75
"""A motion that explains a smaller share of what the best one does is no rival."""
RIVAL_COST = 30.0
RIVAL_FACTOR = 1.1
"""A motion is accepted if every rival has so much more chi-square, and so many times as much."""
VIEWS = 7
"""Views beside the first that are adjusted together at most: the newest, and others spread evenly before it."""
MIN_VIEWS = 3
"""Views beside the first that are needed at least: two alone mistake a rotation for a translation."""
CARRIED = 2
"""Best motions of one frame that are tried at the next one, too."""
SAME_DEG = 1.0, 5.0
"""Motions whose rotations and whose directions differ by less are the same."""
WIDE_POINTS = 50
"""Points that must be seen under the smallest parallax or more."""
RANSAC_ITERATIONS = 2000
CONFIDENCE = 0.999
BUNDLE_ITERATIONS = 20
"""Of the bundle adjustment of a motion (ORB-SLAM2's number)."""


@dataclass(frozen=True, eq=False)
class View:
    """A frame, its features as the back end uses them, and their matches with the first view.

    Attributes:
        frame: The frame.
        observations: Its features.
        matches: int64 ``[M, 2]``, a feature of the first view and one of this view; none for the
            first view itself.
    """

    frame: FrameBundle
    observations: Observations
    matches: Slots


@dataclass(frozen=True, eq=False)
class TwoViewMotion:
    """A motion and the triangulated points of the matches, refined together; the unit of length is arbitrary.

    Attributes:
        T_second_first: Pose ``[4, 4]`` from the first camera's frame to the second's.
        matches: int64 ``[M, 2]``, the matches of the newest view that became points.
        points: ``[M, 3]`` in the first camera's frame.
        cost: Mean chi-square of an observation, over all views.
        count: Number of observations.
    """

    T_second_first: Array
    matches: Slots
    points: Array
    cost: float
    count: int

    @property
    def parallax_deg(self) -> float:
        """Angle under which `WIDE_POINTS` of the points are seen, or more."""
        to_second = self.points - se3.inverse(self.T_second_first)[:3, 3]
        lengths = np.linalg.norm(self.points, axis=1) * np.linalg.norm(to_second, axis=1)
        cosine = np.sort((self.points * to_second).sum(axis=1) / np.maximum(lengths, 1e-12))
        return float(
            np.degrees(np.arccos(np.clip(cosine[min(WIDE_POINTS, len(cosine)) - 1], -1.0, 1.0)))
        )

    def continued(self, newest: View, camera: Camera) -> Array:
        """Pose ``[4, 4]`` from the first camera's frame to that of a newer view, which shows some of the points."""
        _, ours, theirs = np.intersect1d(
            self.matches[:, 0], newest.matches[:, 0], return_indices=True
        )
        rows = newest.matches[theirs, 1]
        newer = newest.observations
        measured = newer.xy[rows], newer.right[rows], newer.info[rows], newer.info_right[rows]
        return optimise_pose(self.T_second_first, self.points[ours], *measured, camera).T_cam_world

    def same_as(self, other: TwoViewMotion) -> bool:
        """Whether it is the same motion as another."""
        rotation = se3.rotation_angle(self.T_second_first @ se3.inverse(other.T_second_first))
        translations = self.T_second_first[:3, 3], other.T_second_first[:3, 3]
        one, two = (t / max(float(np.linalg.norm(t)), 1e-12) for t in translations)
        direction = np.arccos(np.clip(one @ two, -1.0, 1.0))
        return bool(np.degrees(rotation) < SAME_DEG[0] and np.degrees(direction) < SAME_DEG[1])

    def rules_out(self, other: TwoViewMotion) -> bool:
        """Whether it explains all views so much better than another motion that the other is ruled out."""
        more = (other.cost - self.cost) * self.count
        return self.same_as(other) or bool(
            more > RIVAL_COST and other.cost > RIVAL_FACTOR * self.cost
        )


def match_views(
    first: Observations, second: Observations, expected: Array, radius_px: float
) -> Slots:
    """Features of two views that match by descriptor, each within a window around its last position.

    Args:
        first: The first view.
        second: The second.
        expected: Pixels ``[N, 2]`` of the first view's features in the image before the second.
        radius_px: Half side of the window.

    Returns:
        int64 ``[M, 2]``, features of the first view and of the second.
    """
    windows = expected, np.full(len(first), np.nan), np.full(len(first), radius_px)
    free = np.ones(len(second), bool)
    feature = search_in_radius(
        second, free, windows, first.octave, first.words, max_distance=MAX_DISTANCE, ratio=RATIO
    )
    rows = np.flatnonzero(feature >= 0)
    rows = rows[rotation_consistent(first.angle[rows], second.angle[feature[rows]])]
    return np.stack([rows, feature[rows]], axis=1)


def possible_motions(
    first: Observations,
    later: Sequence[View],
    camera: Camera,
    settings: TwoViewSettings,
    before: Sequence[TwoViewMotion] = (),
) -> list[TwoViewMotion]:
    """Motions of the camera from the first view to the newest that explain nearly as much as any other.

    Args:
        first: The first view.
        later: Views since then, oldest first; the newest is the second of the two views.
        camera: Intrinsics, without distortion.
        settings: Number of points that a motion needs.
        before: The result for the view before: the newest view alone may not give the right motion.

    Returns:
        Each refined with its points, lowest cost first; none where too few matches agree with any.
    """
    second = later[-1].observations
    matches = later[-1].matches
    xy_first = first.xy[matches[:, 0]]
    xy_second = second.xy[matches[:, 1]]
    info = np.minimum(first.info[matches[:, 0]], second.info[matches[:, 1]])
    of_homography, on_plane = _homography(xy_first, xy_second, info, camera)
    of_essential, on_lines = _essential(xy_first, xy_second, info, camera)
    continued = [motion.continued(later[-1], camera) for motion in before]
    rows = np.flatnonzero(on_plane | on_lines)
    if not len(rows):
        return []
    tried = [
        (motion, *_triangulated(motion, xy_first[rows], xy_second[rows], info[rows], camera))
        for motion in (*of_homography, *of_essential, *continued)
        if np.isfinite(motion).all()
    ]
    most = max((np.count_nonzero(good) for _, _, good in tried), default=0)
    if most < max(settings.min_points, MIN_GOOD_SHARE * len(rows)):
        return []
    by_two = [
        _adjusted(first, later[-1:], motion[None], matches[rows[good]], points[good], camera)
        for motion, points, good in tried
        if np.count_nonzero(good) >= RIVAL_SHARE * most
    ]
    rivals = distinct_motions(_by_cost(by_two, settings))
    return _by_cost([_adjusted_by_all(first, later, motion, camera) for motion in rivals], settings)


def _by_cost(motions: Sequence[TwoViewMotion], settings: TwoViewSettings) -> list[TwoViewMotion]:
    """The motions with enough points, lowest cost first."""
    enough = [motion for motion in motions if len(motion.matches) >= settings.min_points]
    return sorted(enough, key=lambda motion: motion.cost)


def accepted_motion(
    motions: Sequence[TwoViewMotion], settings: TwoViewSettings
) -> TwoViewMotion | None:
    """The first of the motions, if it rules out all others and shows enough parallax.

    The cost of a motion is that of the matches it was adjusted with. A wrong motion may fit those
    better because of what it left out, such as everything before a wall: an observation that
    another motion has and this one has not counts against it, and the same motion has to be the
    best either way.
    """
    if not motions or not all(motions[0].rules_out(other) for other in motions[1:]):
        return None
    most = max(motion.count for motion in motions)
    total = [motion.cost * motion.count + CHI2_POINT * (most - motion.count) for motion in motions]
    if not motions[int(np.argmin(total))].same_as(motions[0]):
        return None
    return motions[0] if motions[0].parallax_deg >= settings.min_parallax_deg else None


def distinct_motions(motions: Sequence[TwoViewMotion]) -> list[TwoViewMotion]:
    """The motions without those that are the same as an earlier one."""
    kept: list[TwoViewMotion] = []
    for motion in motions:
        if not any(motion.same_as(other) for other in kept):
            kept.append(motion)
    return kept


def _homography(
    xy_first: Array, xy_second: Array, info: Array, camera: Camera
) -> tuple[list[Array], NDArray[np.bool_]]:
    """The motions of the homography of most matches, and which matches fit it in both images."""
    limit = np.sqrt(CHI2_POINT)
    model, _ = cv2.findHomography(
        xy_first, xy_second, cv2.RANSAC, limit, None, RANSAC_ITERATIONS, CONFIDENCE
    )
    if model is None or abs(np.linalg.det(model)) < 1e-12:
        return [], np.zeros(len(xy_first), bool)
    errors = [
        info * np.square(cv2.perspectiveTransform(a[None], h)[0] - b).sum(axis=1)
        for h, a, b in ((model, xy_first, xy_second), (np.linalg.inv(model), xy_second, xy_first))
    ]
    _, rotations, translations, _ = cv2.decomposeHomographyMat(
        np.asarray(model, np.float64), camera.matrix
    )
    motions = [
        _pose(r, t)
        for r, t in zip(rotations, translations, strict=True)
        if np.linalg.norm(t) > 1e-9
    ]
    return motions, np.asarray(np.maximum(*errors) <= CHI2_POINT)


def _essential(
    xy_first: Array, xy_second: Array, info: Array, camera: Camera
) -> tuple[list[Array], NDArray[np.bool_]]:
    """The motions of the essential matrix of most matches, and which matches fit it in both images."""
    limit = np.sqrt(CHI2_LINE)
    model, _ = cv2.findEssentialMat(
        xy_first, xy_second, camera.matrix, cv2.RANSAC, CONFIDENCE, limit, RANSAC_ITERATIONS
    )
    if model is None or model.shape != (3, 3):
        return [], np.zeros(len(xy_first), bool)
    inverse = np.linalg.inv(camera.matrix)
    f = inverse.T @ model @ inverse
    a, b = (np.column_stack([xy, np.ones(len(xy))]) for xy in (xy_first, xy_second))
    lines_in_second = a @ f.T
    lines_in_first = b @ f
    offset = np.square((b * lines_in_second).sum(axis=1))
    errors = [
        info * offset / np.square(lines[:, :2]).sum(axis=1)
        for lines in (lines_in_second, lines_in_first)
    ]
    one, other, t = cv2.decomposeEssentialMat(np.asarray(model, np.float64))
    motions = [_pose(r, sign * np.asarray(t)) for r in (one, other) for sign in (1.0, -1.0)]
    return motions, np.asarray(np.maximum(*errors) <= CHI2_LINE)


def _pose(rotation: Any, translation: Any) -> Array:
    return se3.from_matrix(np.ravel(translation) / np.linalg.norm(translation), rotation)


def _triangulated(
    T_second_first: Array, xy_first: Array, xy_second: Array, info: Array, camera: Camera
) -> tuple[Array, NDArray[np.bool_]]:
    """Points ``[M, 3]`` in the first camera's frame, and which of them lie before both cameras and project back."""
    projections = camera.matrix @ np.eye(3, 4), camera.matrix @ T_second_first[:3]
    homogeneous = cv2.triangulatePoints(*projections, xy_first.T, xy_second.T).T
    with np.errstate(divide="ignore", invalid="ignore"):
        points = np.nan_to_num(
            homogeneous[:, :3] / homogeneous[:, 3:], nan=0.0, posinf=0.0, neginf=0.0
        )
    moved = se3.transform(T_second_first, points)
    good = (points[:, 2] > NEAR_M) & (moved[:, 2] > NEAR_M)
    for local, xy in ((points, xy_first), (moved, xy_second)):
        uv = camera.project(np.where(good[:, None], local, [0.0, 0.0, 1.0]))
        good = good & (info * np.square(uv - xy).sum(axis=1) < CHI2_POINT)
    return points, np.asarray(good)


def _adjusted_by_all(
    first: Observations, later: Sequence[View], motion: TwoViewMotion, camera: Camera
) -> TwoViewMotion:
    """Motion and points adjusted by the views between the two, too."""
    if len(later) == 1:
        return motion
    chosen = np.unique(np.linspace(0, len(later) - 1, VIEWS).round().astype(int))
    poses = se3.exp((chosen[:, None] + 1) / len(later) * se3.log(motion.T_second_first))
    return _adjusted(
        first, [later[at] for at in chosen], poses, motion.matches, motion.points, camera
    )


def _adjusted(
    first: Observations,
    later: Sequence[View],
    poses: Array,
    matches: Slots,
    points: Array,
    camera: Camera,
) -> TwoViewMotion:
    """Bundle adjustment of the later views' poses ``[V, 4, 4]`` and the points of the last one's `matches`."""
    count = len(later)
    point_of_feature = np.full(len(first), -1, np.int64)
    point_of_feature[matches[:, 0]] = np.arange(len(matches))
    columns = []
    views = [(first, matches[:, [0, 0]]), *((view.observations, view.matches) for view in later)]
    for number, (observations, rows) in enumerate(views):
        point = point_of_feature[rows[:, 0]]
        rows = rows[point >= 0, 1]
        columns.append(
            (
                np.full(len(rows), number),
                point[point >= 0],
                observations.xy[rows],
                observations.info[rows],
            )
        )
    view, point, xy, info = (np.concatenate(column) for column in zip(*columns, strict=True))
    order = np.lexsort((view, point))
    view = view[order]
    point = point[order]
    xy = xy[order]
    info = info[order]
    problem = BundleProblem(
        np.concatenate([poses, np.eye(4)[None]]),
        count,
        points,
        (view - 1) % (count + 1),
        point,
        xy,
        np.full(len(xy), np.nan),
        info,
        np.zeros(len(xy)),
        camera,
    )
    result = adjust_bundle(problem, BUNDLE_ITERATIONS)
    kept = np.asarray(np.isfinite(result.points).all(axis=1))
    kept[point[~result.inliers & ((view == 0) | (view == count))]] = False
    cost = float(np.minimum(result.chi2, CHI2_POINT).mean()) if len(result.chi2) else np.inf
    return TwoViewMotion(
        result.poses[count - 1], matches[kept], result.points[kept], cost, len(result.chi2)
    )


# ---------------------------------------------------------------------- the initial map


@dataclass(frozen=True, eq=False)
class InitialMap:
    """Two views and the motion between them; lengths in units of the first view's median depth."""

    first: View
    second: View
    motion: TwoViewMotion

    def insert_into(self, world: Map, T_first_world: Array, submap: int) -> list[int]:
        """Add the two views as keyframes of an empty submap, with their points; returns the keyframes' slots.

        Args:
            world: The map.
            T_first_world: Pose ``[4, 4]`` of the first view in the submap's world, world to camera.
            submap: The submap's number (`Map.kf_map`).
        """
        first, second = self.motion.matches.T
        slots = [
            world.add_keyframe(
                view.observations, pose, view.frame.index, view.frame.timestamp, submap
            )
            for view, pose in (
                (self.first, T_first_world),
                (self.second, self.motion.T_second_first @ T_first_world),
            )
        ]
        position = se3.transform(se3.inverse(T_first_world), self.motion.points)
        points = world.add_points(position, self.first.observations.rgb[first], slots[0], first)
        world.observe(slots[1], second, points)
        world.refresh(points)
        return slots


class TwoViewInitialiser:
    """Keeps a first view and the later ones until they determine the motion together.

    Attributes:
        later: Views since the first one, oldest first; every second one is dropped where the wait
            is long.
    """

    def __init__(self) -> None:
        self._first: View | None = None
        self._expected: Array = np.zeros((0, 2))
        self.later: list[View] = []
        self._motions: list[TwoViewMotion] = []

    def add(
        self,
        frame: FrameBundle,
        observations: Observations,
        camera: Camera,
        settings: TwoViewSettings,
    ) -> InitialMap | None:
        """Try the next frame with the first view; it becomes the first view where they have too few matches.

        Args:
            frame: The next frame.
            observations: Its features.
            camera: Intrinsics, without distortion.
            settings: Thresholds of the two views.
        """
        first = self._first
        matches = np.zeros((0, 2), np.int64)
        if first is not None:
            matches = match_views(
                first.observations, observations, self._expected, settings.radius_px
            )
        view = View(frame, observations, matches)
        if first is None or len(matches) < settings.min_matches:
            self._first = view if len(observations) >= settings.min_matches else None
            self._expected = observations.xy.copy()
            self.later = []
            self._motions = []
            return None
        self._expected[matches[:, 0]] = observations.xy[matches[:, 1]]
        if len(self.later) >= 2 * VIEWS:
            del self.later[::2]
        self.later.append(view)
        if len(self.later) < MIN_VIEWS:
            return None
        motions = possible_motions(first.observations, self.later, camera, settings, self._motions)
        motion, self._motions = (
            accepted_motion(motions, settings),
            distinct_motions(motions)[:CARRIED],
        )
        if motion is None:
            return None
        depth = float(np.median(motion.points[:, 2]))
        pose = motion.T_second_first
        pose = se3.from_matrix(pose[:3, 3] / depth, pose[:3, :3])
        return InitialMap(
            first, view, replace(motion, T_second_first=pose, points=motion.points / depth)
        )
