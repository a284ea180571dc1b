"""The first map without depth: how the camera moved between two views, and the points that both show.

As ORB-SLAM does it (Mur-Artal, Montiel and Tardos 2015, Section IV): a homography and an essential matrix are fitted to
the same matches; what explains more of them decides which of the two is taken apart into motions; a motion counts if
nearly all matches lie before both cameras, no other motion does as well, and the rays meet at a wide enough angle.
Whether a scene is flat is thus decided by the scene. All functions are pure.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.features.matching import rotation_consistent, search_in_radius
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera

from ..monocular_settings import TwoViewSettings
from .observation import Observations

Array = NDArray[np.float64]
Slots = NDArray[np.int64]

MAX_DISTANCE = 50
RATIO = 0.9
"""Largest Hamming distance of a match, and over that of the second nearest (ORB-SLAM's numbers)."""
CHI2_LINE, CHI2_POINT = 3.841, 5.991
"""95 % quantiles of chi-square: distance from a line, and from a point."""
FLAT_SHARE = 0.5
"""The homography is taken where its score is a larger share of both scores (ORB-SLAM 0.40, 0.45 and 0.50)."""
SURE_SHARE = 0.9
"""Share of the matches that fit the model which must lie before both cameras and project back."""
RIVAL_SHARE = 0.75
"""The second best motion may explain at most this share of what the best one does."""
WIDE_POINTS = 50
"""So many points must be seen under the smallest parallax or more."""
ITERATIONS = 2000
CONFIDENCE = 0.999


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


@dataclass(frozen=True, eq=False)
class TwoViews:
    """A motion and the points that it makes of matches; the unit of length is the way between the views.

    Attributes:
        T_second_first: Pose ``[4, 4]`` from the first camera's frame to the second's.
        pair: The matches that became points.
        points: ``[M, 3]`` in the first camera's frame.
        parallax_deg: Angle under which `WIDE_POINTS` of them are seen, or more.
        flat: Whether it comes from a homography.
    """

    T_second_first: Array
    pair: Pair
    points: Array
    parallax_deg: float
    flat: bool


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


def reconstruct(
    first: Observations, second: Observations, pair: Pair, camera: Camera, settings: TwoViewSettings
) -> TwoViews | None:
    """The camera's motion between two views; None where they do not tell it.

    Args:
        first: The first view.
        second: The second.
        pair: Their matches.
        camera: Intrinsics, without distortion.
        settings: Parallax and number of points that it needs.
    """
    one, other = first.xy[pair.first], second.xy[pair.second]
    info = np.minimum(first.info[pair.first], second.info[pair.second])
    homography, flat_score, on_plane = _homography(one, other, info)
    essential, deep_score, on_lines = _essential(one, other, info, camera)
    if flat_score + deep_score <= 0:
        return None
    flat = flat_score > FLAT_SHARE * (flat_score + deep_score)
    model, fitting = (homography, on_plane) if flat else (essential, on_lines)
    if model is None or np.count_nonzero(fitting) < settings.min_points:
        return None
    motions = _motions_of_homography(model, camera) if flat else _motions_of_essential(model)
    rows = np.flatnonzero(fitting)
    tried = [_triangulated(motion, one[rows], other[rows], info[rows], camera) for motion in motions]
    order = np.argsort([-np.count_nonzero(good) for _, good, _ in tried], kind="stable")
    points, good, angle = tried[order[0]]
    count = int(np.count_nonzero(good))
    rival = int(np.count_nonzero(tried[order[1]][1])) if len(order) > 1 else 0
    if count < max(settings.min_points, SURE_SHARE * len(rows)) or rival > RIVAL_SHARE * count:
        return None
    widest = np.sort(angle[good])[::-1]
    parallax = float(widest[min(WIDE_POINTS, count - 1)])
    if parallax < settings.min_parallax_deg:
        return None
    kept = rows[good]
    return TwoViews(motions[order[0]], Pair(pair.first[kept], pair.second[kept]), points[good], parallax, flat)


def _homography(one: Array, other: Array, info: Array) -> tuple[Array | None, float, NDArray[np.bool_]]:
    """The homography of most matches, its score and what fits it."""
    nothing = None, 0.0, np.zeros(len(one), bool)
    if len(one) < 8:
        return nothing
    model, _ = cv2.findHomography(one, other, cv2.RANSAC, np.sqrt(CHI2_POINT), None, ITERATIONS, CONFIDENCE)
    if model is None or abs(np.linalg.det(model)) < 1e-12:
        return nothing
    errors = [
        info * np.square(cv2.perspectiveTransform(a[None], h)[0] - b).sum(axis=1)
        for h, a, b in ((model, one, other), (np.linalg.inv(model), other, one))
    ]
    return np.asarray(model, np.float64), *_score(np.array(errors), CHI2_POINT)


def _essential(
    one: Array, other: Array, info: Array, camera: Camera
) -> tuple[Array | None, float, NDArray[np.bool_]]:
    """The essential matrix of most matches, its score and what fits it."""
    nothing = None, 0.0, np.zeros(len(one), bool)
    if len(one) < 8:
        return nothing
    found, _ = cv2.findEssentialMat(
        one, other, camera.matrix, cv2.RANSAC, CONFIDENCE, np.sqrt(CHI2_LINE), ITERATIONS
    )
    if found is None or found.shape != (3, 3):
        return nothing
    inverse = np.linalg.inv(camera.matrix)
    f = inverse.T @ found @ inverse
    a, b = (np.column_stack([xy, np.ones(len(xy))]) for xy in (one, other))
    lines_in_other, lines_in_one = a @ f.T, b @ f
    offset = np.square((b * lines_in_other).sum(axis=1))
    errors = [info * offset / np.square(lines[:, :2]).sum(axis=1) for lines in (lines_in_other, lines_in_one)]
    return np.asarray(found, np.float64), *_score(np.array(errors), CHI2_LINE)


def _score(errors: Array, limit: float) -> tuple[float, NDArray[np.bool_]]:
    """ORB-SLAM's score (its Eq. 2): what is left of the same bound, summed over both images' errors ``[2, M]``."""
    errors = np.nan_to_num(errors, nan=np.inf)
    fitting = errors <= limit
    return float((CHI2_POINT - errors[fitting]).sum()), fitting.all(axis=0)


def _motions_of_homography(model: Array, camera: Camera) -> list[Array]:
    _, rotations, translations, _ = cv2.decomposeHomographyMat(model, camera.matrix)
    return [_pose(r, t) for r, t in zip(rotations, translations, strict=True) if np.linalg.norm(t) > 1e-9]


def _motions_of_essential(model: Array) -> list[Array]:
    one, other, t = cv2.decomposeEssentialMat(model)
    return [_pose(r, sign * t) for r in (one, other) for sign in (1.0, -1.0)]


def _pose(rotation: Array, translation: Array) -> Array:
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = np.ravel(translation) / np.linalg.norm(translation)
    return pose


def _triangulated(
    T_second_first: Array, one: Array, other: Array, info: Array, camera: Camera
) -> tuple[Array, NDArray[np.bool_], Array]:
    """Points ``[M, 3]`` in the first camera's frame, which of them both cameras see, and their parallax in degrees."""
    projections = camera.matrix @ np.eye(3, 4), camera.matrix @ T_second_first[:3]
    homogeneous = cv2.triangulatePoints(*projections, one.T, other.T).T
    with np.errstate(divide="ignore", invalid="ignore"):
        points = np.nan_to_num(homogeneous[:, :3] / homogeneous[:, 3:], nan=0.0, posinf=0.0, neginf=0.0)
    moved = se3.transform(T_second_first, points)
    good = (points[:, 2] > 0) & (moved[:, 2] > 0)
    for local, seen in ((points, one), (moved, other)):
        uv = camera.project(np.where(good[:, None], local, [0.0, 0.0, 1.0]))
        good = good & (info * np.square(uv - seen).sum(axis=1) < CHI2_POINT)
    to_second = points - se3.inverse(T_second_first)[:3, 3]
    lengths = np.linalg.norm(points, axis=1) * np.linalg.norm(to_second, axis=1)
    cosine = (points * to_second).sum(axis=1) / np.maximum(lengths, 1e-12)
    return points, good, np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
