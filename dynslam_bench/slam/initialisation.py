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
from dynslam_bench.geometry import Camera, feature_scale, se3
from dynslam_bench.slam.bundle_adjustment import BundleProblem, adjust_bundle
from dynslam_bench.slam.map import Array, Map, Slots
from dynslam_bench.slam.observations import Observations
from dynslam_bench.slam.pose_optimisation import NEAR_M, optimise_pose
from dynslam_bench.slam.settings import TwoViewSettings

MAX_DISTANCE = 50
"""Largest Hamming distance of a match (ORB-SLAM's number)."""
RATIO = 0.9
"""Largest ratio of that distance to the second nearest one's (ORB-SLAM's number)."""
CHI2_LINE = 3.841
"""95 % quantile of chi-square with one degree of freedom: distance from an epipolar line."""
CHI2_POINT = 5.991
"""95 % quantile of chi-square with two degrees of freedom: distance from a point."""
MIN_GOOD_SHARE = 0.8
"""Share of the matches that fit either model which must lie before both cameras and project back."""
RIVAL_SHARE = 0.75
"""A motion that explains a smaller share of what the best one does is no rival."""
RIVAL_COST = 30.0
"""A motion is accepted if every rival has so much more chi-square."""
RIVAL_FACTOR = 1.1
"""A motion is accepted if every rival has so many times its chi-square as well."""
VIEWS = 7
"""Views beside the first that are adjusted together at most: the newest, and others spread evenly before it."""
MIN_VIEWS = 3
"""Views beside the first that are needed at least: two alone mistake a rotation for a translation."""
CARRIED = 2
"""Best motions of one frame that are tried at the next one, too."""
SAME_ROTATION_DEG = 1.0
"""Motions are the same if their rotations differ by less, and their directions too."""
SAME_DIRECTION_DEG = 5.0
"""Motions are the same if the directions of their translations differ by less, and their rotations too."""
WIDE_POINTS = 50
"""Points that must be seen under the smallest parallax or more."""
RANSAC_ITERATIONS = 2000
"""RANSAC samples of either model at most."""
CONFIDENCE = 0.999
"""Probability at which RANSAC has drawn a sample without outliers."""
BUNDLE_ITERATIONS = 20
"""Iterations of the bundle adjustment of a motion (ORB-SLAM2's number)."""


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
        # of the widest angles, smallest cosines first
        cosine = np.sort((self.points * to_second).sum(axis=1) / np.maximum(lengths, 1e-12))
        widest = cosine[min(WIDE_POINTS, len(cosine)) - 1]
        return float(np.degrees(np.arccos(np.clip(widest, -1.0, 1.0))))

    def continued(self, newest: View, camera: Camera) -> Array:
        """Pose ``[4, 4]`` from the first camera's frame to that of a newer view, which shows some of the points."""
        # features of the first view that both match
        _, in_motion, in_newest = np.intersect1d(
            self.matches[:, 0], newest.matches[:, 0], return_indices=True
        )
        points = self.points[in_motion]

        # fit the newest pose to them, starting from the pose of the view before
        measured = newest.observations.measurements(newest.matches[in_newest, 1])
        return optimise_pose(self.T_second_first, points, measured, camera).T_cam_world

    def same_as(self, other: TwoViewMotion) -> bool:
        """Whether it is the same motion as another."""
        # the angle between the rotations, and that between the directions of the translations
        rotation = se3.rotation_angle(self.T_second_first @ se3.inverse(other.T_second_first))
        cosine = _direction(self.T_second_first) @ _direction(other.T_second_first)
        between = np.arccos(np.clip(cosine, -1.0, 1.0))
        return bool(
            np.degrees(rotation) < SAME_ROTATION_DEG and np.degrees(between) < SAME_DIRECTION_DEG
        )

    def rules_out(self, other: TwoViewMotion) -> bool:
        """Whether it explains all views so much better than another motion that the other is ruled out."""
        if self.same_as(other):
            return True
        # more in all, and by a factor: many observations make any small difference large
        more_chi2 = (other.cost - self.cost) * self.count
        return bool(more_chi2 > RIVAL_COST and other.cost > RIVAL_FACTOR * self.cost)


def _direction(pose: Array) -> Array:
    """Unit vector ``[3]`` of a pose's translation; 0 without any."""
    translation = pose[:3, 3]
    return np.asarray(translation / max(float(np.linalg.norm(translation)), 1e-12))


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
    # nearest descriptors in the windows; the right coordinate is unknown
    windows = expected, np.full(len(first), np.nan), np.full(len(first), radius_px)
    free = np.ones(len(second), bool)
    feature = search_in_radius(
        second,
        free,
        windows,
        first.octave,
        first.descriptors,
        max_distance=MAX_DISTANCE,
        ratio=RATIO,
    )

    # matches that rotate in the image as most others
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
    # motions by a homography, by an essential matrix, and those of the view before
    second = later[-1].observations
    matches = later[-1].matches
    xy_first = first.xy[matches[:, 0]]
    xy_second = second.xy[matches[:, 1]]
    info = np.minimum(first.info[matches[:, 0]], second.info[matches[:, 1]])
    of_homography, on_plane = _homography(xy_first, xy_second, info, camera)
    of_essential, on_lines = _essential(xy_first, xy_second, info, camera)
    continued = [motion.continued(later[-1], camera) for motion in before]

    # triangulate by each motion what fits either model
    rows = np.flatnonzero(on_plane | on_lines)
    if not len(rows):
        return []
    triangulated: list[tuple[Array, Array, NDArray[np.bool_]]] = []
    for T_second_first in (*of_homography, *of_essential, *continued):
        if np.isfinite(T_second_first).all():
            points, good = _triangulated(
                T_second_first, xy_first[rows], xy_second[rows], info[rows], camera
            )
            triangulated.append((T_second_first, points, good))

    # one motion must explain nearly all of it
    most = max((np.count_nonzero(good) for _, _, good in triangulated), default=0)
    if most < max(settings.min_points, MIN_GOOD_SHARE * len(rows)):
        return []

    # adjust all that explain nearly as much: by the two views, then distinct ones by all views
    by_two_views: list[TwoViewMotion] = []
    for T_second_first, points, good in triangulated:
        if np.count_nonzero(good) >= RIVAL_SHARE * most:
            by_two_views.append(
                _adjusted(
                    first,
                    later[-1:],
                    T_second_first[None],
                    matches[rows[good]],
                    points[good],
                    camera,
                )
            )
    rivals = distinct_motions(_by_cost(by_two_views, settings))
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
    if not motions:
        return None

    # every other motion explains the matches clearly worse
    best = motions[0]
    if not all(best.rules_out(other) for other in motions[1:]):
        return None

    # it is the best as well where missing observations count as outliers
    most = max(motion.count for motion in motions)
    total = [motion.cost * motion.count + CHI2_POINT * (most - motion.count) for motion in motions]
    if not motions[int(np.argmin(total))].same_as(best):
        return None
    return best if best.parallax_deg >= settings.min_parallax_deg else None


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
    """The motions of the homography of most matches, and which matches fit it in both images.

    Args:
        xy_first: Pixels ``[N, 2]`` of the first view.
        xy_second: Pixels ``[N, 2]`` of the second view.
        info: Inverse variances of the pixels ``[N]``.
        camera: Intrinsics without distortion.
    """
    # RANSAC; the limit is for a standard deviation of one pixel
    limit = np.sqrt(CHI2_POINT)
    model, _ = cv2.findHomography(
        xy_first, xy_second, cv2.RANSAC, limit, None, RANSAC_ITERATIONS, CONFIDENCE
    )
    if model is None or abs(np.linalg.det(model)) < 1e-12:
        return [], np.zeros(len(xy_first), bool)

    # symmetric transfer error, as chi-square
    in_second = cv2.perspectiveTransform(xy_first[None], model)[0]
    in_first = cv2.perspectiveTransform(xy_second[None], np.linalg.inv(model))[0]
    error_second = info * np.square(in_second - xy_second).sum(axis=1)
    error_first = info * np.square(in_first - xy_first).sum(axis=1)

    # its motions; one without a translation gives no points
    _, rotations, translations, _ = cv2.decomposeHomographyMat(
        np.asarray(model, np.float64), camera.matrix
    )
    motions: list[Array] = []
    for rotation, translation in zip(rotations, translations, strict=True):
        if np.linalg.norm(translation) > 1e-9:
            motions.append(_pose(rotation, translation))
    return motions, np.asarray(np.maximum(error_second, error_first) <= CHI2_POINT)


def _essential(
    xy_first: Array, xy_second: Array, info: Array, camera: Camera
) -> tuple[list[Array], NDArray[np.bool_]]:
    """The motions of the essential matrix of most matches, and which matches fit it in both images.

    Motions are ``[4, 4]``, from the first camera to the second, with a translation of length 1.

    Args:
        xy_first: Pixels ``[N, 2]`` of the first view.
        xy_second: Pixels ``[N, 2]`` of the second view.
        info: Inverse variances of the pixels ``[N]``.
        camera: Intrinsics without distortion.
    """
    # RANSAC; the limit is for a standard deviation of one pixel
    limit = np.sqrt(CHI2_LINE)
    model, _ = cv2.findEssentialMat(
        xy_first, xy_second, camera.matrix, cv2.RANSAC, CONFIDENCE, limit, RANSAC_ITERATIONS
    )
    if model is None or model.shape != (3, 3):
        return [], np.zeros(len(xy_first), bool)

    # fundamental matrix F = K^-T E K^-1, and the distances from the epipolar lines as chi-square
    inverse = np.linalg.inv(camera.matrix)
    f = inverse.T @ model @ inverse
    first = np.column_stack([xy_first, np.ones(len(xy_first))])
    second = np.column_stack([xy_second, np.ones(len(xy_second))])
    lines_in_second = first @ f.T
    lines_in_first = second @ f
    algebraic = np.square((second * lines_in_second).sum(axis=1))
    error_second = info * algebraic / np.square(lines_in_second[:, :2]).sum(axis=1)
    error_first = info * algebraic / np.square(lines_in_first[:, :2]).sum(axis=1)

    # its four motions: two rotations, and the translation with either sign
    one, other, t = cv2.decomposeEssentialMat(np.asarray(model, np.float64))
    motions = [
        _pose(one, np.asarray(t)),
        _pose(one, -1.0 * np.asarray(t)),
        _pose(other, np.asarray(t)),
        _pose(other, -1.0 * np.asarray(t)),
    ]
    return motions, np.asarray(np.maximum(error_second, error_first) <= CHI2_LINE)


def _pose(rotation: Any, translation: Any) -> Array:
    """The pose ``[4, 4]`` of a rotation and a translation that is made as long as 1."""
    return se3.from_matrix(np.ravel(translation) / np.linalg.norm(translation), rotation)


def _triangulated(
    T_second_first: Array, xy_first: Array, xy_second: Array, info: Array, camera: Camera
) -> tuple[Array, NDArray[np.bool_]]:
    """Points ``[M, 3]`` in the first camera's frame, and which of them lie before both cameras and project back.

    Args:
        T_second_first: Motion ``[4, 4]`` between the views.
        xy_first: Pixels ``[M, 2]`` of the first view.
        xy_second: Pixels ``[M, 2]`` of the second view.
        info: Inverse variances of the pixels ``[M]``.
        camera: Intrinsics without distortion.
    """
    # linear triangulation; points at infinity become 0, which is not good below
    projections = camera.matrix @ np.eye(3, 4), camera.matrix @ T_second_first[:3]
    homogeneous = cv2.triangulatePoints(*projections, xy_first.T, xy_second.T).T
    with np.errstate(divide="ignore", invalid="ignore"):
        points = np.nan_to_num(
            homogeneous[:, :3] / homogeneous[:, 3:], nan=0.0, posinf=0.0, neginf=0.0
        )

    # before both cameras, and near the pixels of both features
    in_second = se3.transform(T_second_first, points)
    good = (points[:, 2] > NEAR_M) & (in_second[:, 2] > NEAR_M)
    for local, xy in ((points, xy_first), (in_second, xy_second)):
        # points behind a camera are not good, whatever their projection
        uv = camera.project(np.where(good[:, None], local, [0.0, 0.0, 1.0]))
        good = good & (info * np.square(uv - xy).sum(axis=1) < CHI2_POINT)
    return points, np.asarray(good)


def _adjusted_by_all(
    first: Observations, later: Sequence[View], motion: TwoViewMotion, camera: Camera
) -> TwoViewMotion:
    """Motion and points adjusted by the views between the two, too."""
    if len(later) == 1:
        return motion
    # a few views, spread evenly; the motion is taken as constant for their initial poses
    chosen = np.unique(np.linspace(0, len(later) - 1, VIEWS).round().astype(int))
    poses = se3.exp((chosen[:, None] + 1) / len(later) * se3.log(motion.T_second_first))
    views = [later[number] for number in chosen]
    return _adjusted(first, views, poses, motion.matches, motion.points, camera)


def _adjusted(
    first: Observations,
    later: Sequence[View],
    poses: Array,
    matches: Slots,
    points: Array,
    camera: Camera,
) -> TwoViewMotion:
    """Bundle adjustment of the later views' poses ``[V, 4, 4]`` and the points of the last one's `matches`.

    Args:
        first: The first view, whose pose is the identity.
        later: Further views, the newest last.
        poses: Their poses ``[V, 4, 4]``, first view to camera, to start from.
        matches: Features of the first view and of the newest one, ``[M, 2]``.
        points: Their points ``[M, 3]`` in the first camera's frame.
        camera: Intrinsics without distortion.
    """
    # observations of the points in the first view (number 0) and in the later ones
    count = len(later)
    point_of_feature = np.full(len(first), -1, np.int64)
    point_of_feature[matches[:, 0]] = np.arange(len(matches))
    views = [(first, matches[:, [0, 0]])]
    views += [(view.observations, view.matches) for view in later]
    numbers = []
    points_seen = []
    pixels = []
    infos = []
    for number, (observations, pairs) in enumerate(views):
        point = point_of_feature[pairs[:, 0]]
        features = pairs[point >= 0, 1]
        numbers.append(np.full(len(features), number))
        points_seen.append(point[point >= 0])
        pixels.append(observations.xy[features])
        infos.append(observations.info[features])

    # sorted by point, then by view
    view = np.concatenate(numbers)
    point = np.concatenate(points_seen)
    order = np.lexsort((view, point))
    view = view[order]
    point = point[order]
    xy = np.concatenate(pixels)[order]
    info = np.concatenate(infos)[order]

    # bundle adjustment; the first view stays and is the last pose
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

    # points that do not fit in the first or the last view are left out
    kept = np.asarray(np.isfinite(result.points).all(axis=1))
    kept[point[~result.inliers & ((view == 0) | (view == count))]] = False
    cost = float(np.minimum(result.chi2, CHI2_POINT).mean()) if len(result.chi2) else np.inf
    return TwoViewMotion(
        result.poses[count - 1], matches[kept], result.points[kept], cost, len(result.chi2)
    )


# ---------------------------------------------------------------------- the initial map


@dataclass(frozen=True, eq=False)
class InitialMap:
    """Two views and the motion between them; lengths in units of the first view's median depth.

    Attributes:
        first: The first view.
        second: The newest view.
        motion: The accepted motion.
    """

    first: View
    second: View
    motion: TwoViewMotion

    def insert_into(self, slam_map: Map, T_first_world: Array, submap: int) -> list[int]:
        """Add the two views as keyframes of an empty submap, with their points; returns the keyframes' slots.

        Args:
            slam_map: The map.
            T_first_world: Pose ``[4, 4]`` of the first view in the submap's world, world to camera.
            submap: The submap's number (`Map.kf_map`).
        """
        # both views become keyframes; the second one's pose follows from the measured motion
        T_second_world = self.motion.T_second_first @ T_first_world
        slots: list[int] = []
        for view, pose in ((self.first, T_first_world), (self.second, T_second_world)):
            frame = view.frame
            slots.append(
                slam_map.add_keyframe(view.observations, pose, frame.index, frame.timestamp, submap)
            )

        # points that both observe
        first_features, second_features = self.motion.matches.T
        position = se3.transform(se3.inverse(T_first_world), self.motion.points)
        rgb = self.first.observations.rgb[first_features]
        points = slam_map.add_points(position, rgb, slots[0], first_features)
        slam_map.observe(slots[1], second_features, points)
        slam_map.refresh(points)
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
        # matches with the first view
        first = self._first
        matches = np.zeros((0, 2), np.int64)
        if first is not None:
            matches = match_views(
                first.observations,
                observations,
                self._expected,
                settings.radius_px * feature_scale(camera.width),
            )
        view = View(frame, observations, matches)

        # too few: begin again with this frame
        if first is None or len(matches) < settings.min_matches:
            self._first = view if len(observations) >= settings.min_matches else None
            self._expected = observations.xy.copy()
            self.later = []
            self._motions = []
            return None

        # features are expected next where they were seen last
        self._expected[matches[:, 0]] = observations.xy[matches[:, 1]]
        if len(self.later) >= 2 * VIEWS:
            del self.later[::2]
        self.later.append(view)
        if len(self.later) < MIN_VIEWS:
            return None

        # the motion that rules out all others, if there is one
        motions = possible_motions(first.observations, self.later, camera, settings, self._motions)
        motion = accepted_motion(motions, settings)
        self._motions = distinct_motions(motions)[:CARRIED]
        if motion is None:
            return None

        # the median depth becomes the unit of length
        depth = float(np.median(motion.points[:, 2]))
        T_second_first = se3.from_matrix(
            motion.T_second_first[:3, 3] / depth, motion.T_second_first[:3, :3]
        )
        scaled = replace(motion, T_second_first=T_second_first, points=motion.points / depth)
        return InitialMap(first, view, scaled)
