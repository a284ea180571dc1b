"""The first map without depth: how the camera moved between two views, and the points that both show.

As in ORB-SLAM (Mur-Artal, Montiel and Tardos 2015, Section IV) a homography and an essential matrix are fitted to the
same matches, so that flat and deep scenes both give a motion, and a motion counts if nearly all matches lie before both
cameras, no other explains them as well, and the rays meet at a wide enough angle. Which one explains them best is not
read off the two models' scores as there, but off what is left after bundle adjustment of each motion: on a scene with
one large wall the essential matrix of most matches is a wrong one, while a homography's motion is right, and the points
beside the wall tell which of them. Two views a hand's breadth apart do not tell a step from a turn; all the views
between them do, so that those are adjusted together. All functions are pure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.filter import FrameBundle
from dynslam_bench.features.matching import rotation_consistent, search_in_radius
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.slam.bundle_adjustment import BundleProblem, adjust_bundle, reprojection_chi2
from dynslam_bench.slam.map import Map
from dynslam_bench.slam.observation import Observations
from dynslam_bench.slam.pose_optimisation import NEAR_M, optimise_pose
from dynslam_bench.slam.settings import TwoViewSettings

Array = NDArray[np.float64]
Slots = NDArray[np.int64]

MAX_DISTANCE = 50
RATIO = 0.9
"""Largest Hamming distance of a match, and over that of the second nearest (ORB-SLAM's numbers)."""
CHI2_LINE, CHI2_POINT = 3.841, 5.991
"""95 % quantiles of chi-square: distance from a line, and from a point."""
SURE_SHARE = 0.8
"""Share of the matches that fit either model which must lie before both cameras and project back."""
RIVAL_SHARE = 0.75
"""A motion that explains a smaller share of what the best one does is no rival."""
RIVAL_COST, RIVAL_FACTOR = 30.0, 1.1
"""So much more chi-square, and so many times as much, as to the best motion must be left to every rival."""
VIEWS = 7
"""So many views beside the first, at most, are adjusted together: the newest, and others spread evenly before it."""
SAME_DEG = 1.0, 5.0
"""Motions whose rotations and whose directions differ by less are one."""
WIDE_POINTS = 50
"""So many points must be seen under the smallest parallax or more."""
RANSAC_ITERATIONS, CONFIDENCE = 2000, 0.999
BUNDLE_ITERATIONS = 20
"""Of the bundle adjustment of a motion (ORB-SLAM2's number)."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Matches between two views.

    Attributes:
        first: int64 ``[M]``, features of the first view.
        second: int64 ``[M]``, features of the second.
    """

    first: Slots
    second: Slots

    def __len__(self) -> int:
        return len(self.first)

    def select(self, index: Slots | NDArray[np.bool_]) -> Pair:
        """Some of the matches, by row or by mask."""
        return Pair(self.first[index], self.second[index])


@dataclass(frozen=True, eq=False)
class LaterView:
    """A view after the first, and its matches with that one."""

    seen: Observations
    pair: Pair


@dataclass(frozen=True, eq=False)
class TwoViewMotion:
    """A motion and the points that it makes of matches, refined together; the unit of length is arbitrary.

    Attributes:
        T_second_first: Pose ``[4, 4]`` from the first camera's frame to the second's.
        pair: The matches that became points.
        points: ``[M, 3]`` in the first camera's frame.
        cost: Chi-square that is left to an observation, in all views and in the mean.
        count: How many observations that are.
    """

    T_second_first: Array
    pair: Pair
    points: Array
    cost: float
    count: int

    @property
    def parallax_deg(self) -> float:
        """Angle under which `WIDE_POINTS` of the points are seen, or more."""
        to_second = self.points - se3.inverse(self.T_second_first)[:3, 3]
        lengths = np.linalg.norm(self.points, axis=1) * np.linalg.norm(to_second, axis=1)
        cosine = np.sort((self.points * to_second).sum(axis=1) / np.maximum(lengths, 1e-12))
        return float(np.degrees(np.arccos(np.clip(cosine[min(WIDE_POINTS, len(cosine)) - 1], -1.0, 1.0))))

    def gone_on(self, newer: Observations, pair: Pair, camera: Camera) -> Array:
        """Pose ``[4, 4]`` from the first camera's frame to that of a newer view, in which `pair` shows some points."""
        _, ours, theirs = np.intersect1d(self.pair.first, pair.first, return_indices=True)
        rows = pair.second[theirs]
        measured = newer.xy[rows], newer.right[rows], newer.info[rows], newer.info_right[rows]
        return optimise_pose(self.T_second_first, self.points[ours], *measured, camera).T_cam_world

    def is_as(self, other: TwoViewMotion) -> bool:
        """Whether it is the same motion as another."""
        turned = se3.rotation_angle(self.T_second_first @ se3.inverse(other.T_second_first))
        ways = self.T_second_first[:3, 3], other.T_second_first[:3, 3]
        one, two = (way / max(float(np.linalg.norm(way)), 1e-12) for way in ways)
        apart = np.arccos(np.clip(one @ two, -1.0, 1.0))
        return bool(np.degrees(turned) < SAME_DEG[0] and np.degrees(apart) < SAME_DEG[1])

    def beats(self, other: TwoViewMotion) -> bool:
        """Whether it explains what all views show so much better than another motion that this one is out."""
        more = (other.cost - self.cost) * self.count
        return self.is_as(other) or bool(more > RIVAL_COST and other.cost > RIVAL_FACTOR * self.cost)


def match_views(first: Observations, second: Observations, expected: Array, radius_px: float) -> Pair:
    """Features of two views that look alike, each sought around where it was seen last.

    Args:
        first: The first view.
        second: The second.
        expected: Pixels ``[N, 2]`` of the first view's features in the image before the second.
        radius_px: Half side of the window.
    """
    count = len(first)
    windows = expected, np.full(count, np.nan), np.full(count, radius_px)
    octaves = first.octave - 1, first.octave + 1
    free = np.ones(len(second), bool)
    found, _ = search_in_radius(
        second.grid, second.arrays, free, windows, octaves, first.words, max_distance=MAX_DISTANCE, ratio=RATIO
    )
    rows = np.flatnonzero(found >= 0)
    steady = rotation_consistent(first.angle[rows], second.angle[found[rows]])
    return Pair(rows[steady], found[rows[steady]])


def possible_motions(
    first: Observations,
    later: Sequence[LaterView],
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
        before: What this gave for the view before: the right one may be missing among what the newest view tells.

    Returns:
        Each refined with its points, the one that explains the views best first; none where they are too unsure.
    """
    second, pair = later[-1].seen, later[-1].pair
    one, other = first.xy[pair.first], second.xy[pair.second]
    info = np.minimum(first.info[pair.first], second.info[pair.second])
    flat, on_plane = _homography(one, other, info, camera)
    deep, on_lines = _essential(one, other, info, camera)
    further = [motion.gone_on(second, pair, camera) for motion in before]
    rows = np.flatnonzero(on_plane | on_lines)
    if not len(rows):
        return []
    motions = [motion for motion in (*flat, *deep, *further) if np.isfinite(motion).all()]
    tried = [(motion, *_triangulated(motion, one[rows], other[rows], info[rows], camera)) for motion in motions]
    most = max((np.count_nonzero(good) for _, _, good in tried), default=0)
    if most < max(settings.min_points, SURE_SHARE * len(rows)):
        return []
    by_two = [
        _adjusted(first, later[-1:], motion[None], pair.select(rows[good]), points[good], camera)
        for motion, points, good in tried
        if np.count_nonzero(good) >= RIVAL_SHARE * most
    ]
    enough = [each for each in by_two if len(each.pair) >= settings.min_points]
    rivals = distinct(sorted(enough, key=lambda each: each.cost))
    refined = [_by_all_between(first, later, each, camera) for each in rivals]
    return sorted((each for each in refined if len(each.pair) >= settings.min_points), key=lambda each: each.cost)


def believed(motions: Sequence[TwoViewMotion], settings: TwoViewSettings) -> TwoViewMotion | None:
    """The first of the motions, if it leaves no doubt about any other, and shows enough parallax.

    Each one's cost is that of the matches which it was adjusted with. A wrong motion may fit those better for what it
    left out, such as all that stands before a wall: each observation that another has and it has not counts against it,
    and the same motion has to be the best either way.
    """
    if not motions or not all(motions[0].beats(other) for other in motions[1:]):
        return None
    most = max(each.count for each in motions)
    left = [each.cost * each.count + CHI2_POINT * (most - each.count) for each in motions]
    if not motions[int(np.argmin(left))].is_as(motions[0]):
        return None
    return motions[0] if motions[0].parallax_deg >= settings.min_parallax_deg else None


def distinct(motions: Sequence[TwoViewMotion]) -> list[TwoViewMotion]:
    """The motions without those that are as an earlier one."""
    kept: list[TwoViewMotion] = []
    for motion in motions:
        if not any(motion.is_as(other) for other in kept):
            kept.append(motion)
    return kept


def _homography(one: Array, other: Array, info: Array, camera: Camera) -> tuple[list[Array], NDArray[np.bool_]]:
    """The motions of the homography of most matches, and which matches fit it in both images."""
    nothing: tuple[list[Array], NDArray[np.bool_]] = [], np.zeros(len(one), bool)
    if len(one) < 8:
        return nothing
    model, _ = cv2.findHomography(one, other, cv2.RANSAC, np.sqrt(CHI2_POINT), None, RANSAC_ITERATIONS, CONFIDENCE)
    if model is None or abs(np.linalg.det(model)) < 1e-12:
        return nothing
    errors = [
        info * np.square(cv2.perspectiveTransform(a[None], h)[0] - b).sum(axis=1)
        for h, a, b in ((model, one, other), (np.linalg.inv(model), other, one))
    ]
    return _motions_of_homography(np.asarray(model, np.float64), camera), np.asarray(np.maximum(*errors) <= CHI2_POINT)


def _essential(one: Array, other: Array, info: Array, camera: Camera) -> tuple[list[Array], NDArray[np.bool_]]:
    """The motions of the essential matrix of most matches, and which matches fit it in both images."""
    nothing: tuple[list[Array], NDArray[np.bool_]] = [], np.zeros(len(one), bool)
    if len(one) < 8:
        return nothing
    limit = np.sqrt(CHI2_LINE)
    found, _ = cv2.findEssentialMat(one, other, camera.matrix, cv2.RANSAC, CONFIDENCE, limit, RANSAC_ITERATIONS)
    if found is None or found.shape != (3, 3):
        return nothing
    inverse = np.linalg.inv(camera.matrix)
    f = inverse.T @ found @ inverse
    a, b = (np.column_stack([xy, np.ones(len(xy))]) for xy in (one, other))
    lines_in_other, lines_in_one = a @ f.T, b @ f
    offset = np.square((b * lines_in_other).sum(axis=1))
    errors = [info * offset / np.square(lines[:, :2]).sum(axis=1) for lines in (lines_in_other, lines_in_one)]
    return _motions_of_essential(np.asarray(found, np.float64)), np.asarray(np.maximum(*errors) <= CHI2_LINE)


def _motions_of_homography(model: Array, camera: Camera) -> list[Array]:
    _, rotations, translations, _ = cv2.decomposeHomographyMat(model, camera.matrix)
    return [
        _pose(np.asarray(r), np.asarray(t))
        for r, t in zip(rotations, translations, strict=True)
        if np.linalg.norm(t) > 1e-9
    ]


def _motions_of_essential(model: Array) -> list[Array]:
    one, other, t = cv2.decomposeEssentialMat(model)
    return [_pose(np.asarray(r), sign * np.asarray(t)) for r in (one, other) for sign in (1.0, -1.0)]


def _pose(rotation: NDArray[Any], translation: NDArray[Any]) -> Array:
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = np.ravel(translation) / np.linalg.norm(translation)
    return pose


def _triangulated(
    T_second_first: Array, one: Array, other: Array, info: Array, camera: Camera
) -> tuple[Array, NDArray[np.bool_]]:
    """Points ``[M, 3]`` in the first camera's frame, and which of them lie before both cameras and project back."""
    projections = camera.matrix @ np.eye(3, 4), camera.matrix @ T_second_first[:3]
    homogeneous = cv2.triangulatePoints(*projections, one.T, other.T).T
    with np.errstate(divide="ignore", invalid="ignore"):
        points = np.nan_to_num(homogeneous[:, :3] / homogeneous[:, 3:], nan=0.0, posinf=0.0, neginf=0.0)
    moved = se3.transform(T_second_first, points)
    good = (points[:, 2] > NEAR_M) & (moved[:, 2] > NEAR_M)
    for local, seen in ((points, one), (moved, other)):
        uv = camera.project(np.where(good[:, None], local, [0.0, 0.0, 1.0]))
        good = good & (info * np.square(uv - seen).sum(axis=1) < CHI2_POINT)
    return points, np.asarray(good)


def _by_all_between(
    first: Observations, later: Sequence[LaterView], found: TwoViewMotion, camera: Camera
) -> TwoViewMotion:
    """Motion and points adjusted by the views between the two, too."""
    if len(later) == 1:
        return found
    chosen = np.unique(np.linspace(0, len(later) - 1, VIEWS).round().astype(int))
    on_the_way = se3.exp((chosen[:, None] + 1) / len(later) * se3.log(found.T_second_first))
    return _adjusted(first, [later[at] for at in chosen], on_the_way, found.pair, found.points, camera)


def _adjusted(
    first: Observations, later: Sequence[LaterView], poses: Array, pair: Pair, points: Array, camera: Camera
) -> TwoViewMotion:
    """The later views' poses ``[V, 4, 4]`` and the points of the last one's `pair`, by all that the views show."""
    row = np.full(len(first), -1, np.int64)
    row[pair.first] = np.arange(len(pair))
    views = [first, *(each.seen for each in later)]
    point = [row[pair.first], *(row[each.pair.first] for each in later)]
    feature = [pair.first, *(each.pair.second for each in later)]
    known = [each >= 0 for each in point]
    view = np.concatenate([np.full(np.count_nonzero(each), at) for at, each in enumerate(known)])
    xy, info = (
        np.concatenate([getattr(seen, name)[f[k]] for seen, f, k in zip(views, feature, known, strict=True)])
        for name in ("xy", "info")
    )
    point_of = np.concatenate([p[k] for p, k in zip(point, known, strict=True)])
    order = np.lexsort((view, point_of))
    view, point_of, xy, info = view[order], point_of[order], xy[order], info[order]
    none = np.full(len(xy), np.nan), np.zeros(len(xy))
    count = len(later)
    problem = BundleProblem(
        np.concatenate([poses, np.eye(4)[None]]), count, points, (view - 1) % (count + 1), point_of,
        xy, none[0], info, none[1], camera,
    )  # fmt: skip
    result = adjust_bundle(problem, BUNDLE_ITERATIONS)
    _, chi2 = reprojection_chi2(problem, result.poses, result.points)
    kept = np.asarray(np.isfinite(result.points).all(axis=1))
    kept[point_of[~result.inliers & ((view == 0) | (view == count))]] = False
    cost = float(np.minimum(chi2, CHI2_POINT).mean()) if len(chi2) else np.inf
    return TwoViewMotion(result.poses[count - 1], pair.select(kept), result.points[kept], cost, len(chi2))


# The first map of a camera without depth: two keyframes and what both show, the median depth being one.


FEWEST = 3
"""So many views beside the first are needed at least: two alone take a turn for a step."""
CARRIED = 2
"""So many of the motions that one frame tells are asked about the next one, too."""


@dataclass(frozen=True, eq=False)
class View:
    """A frame, and its features as the back end uses them."""

    frame: FrameBundle
    seen: Observations


@dataclass(frozen=True, eq=False)
class InitialMap:
    """Two views and what they give together; lengths in units of the first view's median depth.

    Attributes:
        first: The first view.
        second: The second.
        T_cam_first: Pose ``[4, 4]`` from the first camera's frame to the second's.
        pair: Which features show a point.
        points: ``[M, 3]`` in the first camera's frame.
    """

    first: View
    second: View
    T_cam_first: Array
    pair: Pair
    points: Array


class TwoViewInitialiser:
    """Keeps a first view and what came after, until all of it together tells how the camera moved.

    Attributes:
        later: Views since the first one, oldest first; thinned out where a camera that hardly moves waits for long.
    """

    def __init__(self) -> None:
        self._first: View | None = None
        self._expected: Array = np.zeros((0, 2))
        self.later: list[LaterView] = []
        self._motions: list[TwoViewMotion] = []

    def take(self, view: View, camera: Camera, settings: TwoViewSettings) -> InitialMap | None:
        """Try the next frame with the first view; it takes that one's place where they have too little in common.

        Args:
            view: The next frame.
            camera: Intrinsics, without distortion.
            settings: What is asked of the two views.
        """
        first = self._first
        if first is None:
            self._begin(view, settings)
            return None
        pair = match_views(first.seen, view.seen, self._expected, settings.radius_px)
        if len(pair) < settings.min_matches:
            self._begin(view, settings)
            return None
        self._expected[pair.first] = view.seen.xy[pair.second]
        if len(self.later) >= 2 * VIEWS:
            del self.later[::2]
        self.later.append(LaterView(view.seen, pair))
        if len(self.later) < FEWEST:
            return None
        motions = possible_motions(first.seen, self.later, camera, settings, self._motions)
        self._motions = distinct(motions)[:CARRIED]
        found = believed(motions, settings)
        return None if found is None else _scaled(first, view, found)

    def _begin(self, view: View, settings: TwoViewSettings) -> None:
        self._first = view if len(view.seen) >= settings.min_matches else None
        self._expected = view.seen.xy.copy()
        self.later, self._motions = [], []


def _scaled(first: View, second: View, found: TwoViewMotion) -> InitialMap:
    depth = float(np.median(found.points[:, 2]))
    pose = found.T_second_first.copy()
    pose[:3, 3] /= depth
    return InitialMap(first, second, pose, found.pair, found.points / depth)


def put(world: Map, start: InitialMap, T_first_world: Array, submap: int) -> tuple[int, int]:
    """Put a first map into the map as an submap that has nothing yet; the slots of its two keyframes.

    Args:
        world: The map.
        start: What the two views give.
        T_first_world: Pose ``[4, 4]`` of the first view in the submap's world, world to camera.
        submap: The submap's number (`Map.kf_map`).
    """
    poses = T_first_world, start.T_cam_first @ T_first_world
    slots = [
        world.add_keyframe(view.seen, pose, view.frame.index, view.frame.timestamp, submap)
        for view, pose in zip((start.first, start.second), poses, strict=True)
    ]
    position = se3.transform(se3.inverse(T_first_world), start.points)
    points = world.add_points(position, start.first.seen.rgb[start.pair.first], slots[0], start.pair.first)
    world.observe(slots[1], start.pair.second, points)
    world.refresh(points)
    return slots[0], slots[1]
