"""Place recognition: which keyframes show the place of a frame, its pose there, and whether the place is verified.

1. *Rank*: keyframes are scored by the 16-bit substrings of binary descriptors that they share with the frame. Two
   descriptors of one point differ in few bits, so that some substrings are equal; those of different points seldom
   share one (multi-index hashing: Norouzi, Punjani and Fleet, 2012). Nothing is trained or downloaded.
2. *Pose*: descriptors are matched with a candidate's map points; a pose follows by RANSAC over three-point poses.
3. *Verify*: all points around the candidate are matched. What was mapped there and should be in view has to be seen,
   unless a mask hides it; a few dozen matches alone fit between places that share a shelf or a poster.
4. *Uncertainty*: the matches have to determine the pose well; those on one distant poster do not.
5. *Perceptual aliasing*: the features must not fit a second place, as in buildings with repeated corridors.

All functions are pure: they read the map and never change it (but for the index, which is brought up to date).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dynslam_bench.core.compiled import kernel
from dynslam_bench.core.seeding import stream
from dynslam_bench.features.matching import match_brute_force
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.slam.map import Array, Map, Slots
from dynslam_bench.slam.motion_model import pose_covariance
from dynslam_bench.slam.settings import TrackingSettings
from dynslam_bench.slam.tracking import Matches, Observations, PoseCandidate, match_map, solve

VALUES = 1 << 16
"""Values of a substring."""
STRIDE = 4
"""Every fourth substring is used: the others change the ranking little and cost as much again."""
CHANGED = 0.25
"""A keyframe is indexed again when it has gained or lost this share of its points."""

MAX_DISTANCE = 60
RATIO = 0.85
"""Largest Hamming distance of a match by descriptor alone, and over that of the second nearest."""
RANSAC_ITERATIONS = 150
"""RANSAC samples at most."""
RANSAC_BATCH = 25
"""Samples that are evaluated together."""
PNP_CANDIDATES = 5
"""Keyframes with the most descriptor matches that RANSAC is tried on."""
MIN_PNP_INLIERS = 8

AROUND = 10
"""Keyframes around a place whose points are matched."""
WIDEN = 2.0
"""Factor on the search windows: the RANSAC pose rests on few matches."""
ROUNDS = 6
"""Matching and fitting are repeated up to so often: a small patch predicts only its own neighbourhood well."""

INNER_SHARE = 0.85
"""Share of the matches, those nearest their median in the image, that have to determine the pose by themselves."""
MAX_DILUTION = 0.1
"""Largest dilution of precision: uncertainty of the position in median depths, with the information of one match."""
MIN_MATCHES = 12
"""Matches at least: a half of fewer determines no pose."""
SPLITS, MAX_SPLIT_SPREAD = 12, 0.01
"""Random halves of the matches that the pose is fitted to, and the largest spread of these positions, median depths."""

ALIASING_CANDIDATES = 12
"""Best-ranked keyframes of each submap that are tested for aliasing."""
ALIASING_SHARE = 0.33
"""What a second place has to show, as a share of what the first one does. Without repetition it is 0.15 at most, with
repeated walls 0.4 to 1 (rendered buildings)."""
SAME_PLACE_DEPTHS, SAME_PLACE_ANGLE = 0.3, np.radians(15.0)
"""Poses farther apart, in median depths of what is seen, or rotated by more, are two places."""
MIN_ALIASING_MATCHES = 30
"""Matches that make a second place."""


# ---------------------------------------------------------------------- rank


def top_candidates(world: Map, keyframes: Slots, observations: Observations, count: int) -> list[int]:
    """The keyframes with the highest place-recognition scores.

    Args:
        world: The map.
        keyframes: Slots to choose from, ``[S]``.
        observations: The frame's features.
        count: How many to choose at most.

    Returns:
        Slots, best first; of equal scores the newer keyframe. All, in the order given, if there are at most `count`.
    """
    if len(keyframes) <= count or not len(observations):
        return [int(slot) for slot in keyframes[:count]]
    order = np.lexsort((-world.kf_id[keyframes], -recognition_scores(world, keyframes, observations)))
    return [int(slot) for slot in keyframes[order[:count]]]


def recognition_scores(world: Map, keyframes: Slots, observations: Observations) -> Array:
    """Place-recognition scores ``[S]`` of keyframes; comparable within one call alone.

    The sum of the weights of the substrings that a keyframe shares with the frame, over the root of its number of
    points: many points share more by chance. The weight is the logarithm of how much rarer a substring is than all of
    the frame's together.
    """
    _index_substrings(world)
    query = np.ascontiguousarray(observations.words).view(np.uint16)[:, ::STRIDE].T
    counts = np.full((len(query), VALUES), -1, np.int64)
    for position, values in enumerate(query):
        counts[position, values] = 0
    indexed = [world.substrings[slot][1] for slot in keyframes.tolist()]
    for substrings in indexed:
        _count_shared(substrings, counts)
    total = np.maximum(counts, 0).sum()
    weight = np.where(counts > 0, np.log(max(total, 1) / np.maximum(counts, 1)), 0.0)
    scores = np.array([_sum_weights(substrings, counts, weight) for substrings in indexed])
    return np.asarray(scores / np.sqrt([max(substrings.shape[1], 1) for substrings in indexed]))


def _index_substrings(world: Map) -> None:
    """Sort the substrings of new keyframes, and of those that have gained or lost many points."""
    observed = np.count_nonzero(world.kf_point >= 0, axis=1)
    for slot in np.flatnonzero(world.kf_alive).tolist():
        keyframe, substrings = world.substrings.get(slot, (-1, np.zeros((0, 0), np.uint16)))
        new, count = keyframe != world.kf_id[slot], substrings.shape[1]
        if new or abs(observed[slot] - count) > CHANGED * count:
            columns = world.kf_words[slot, world.kf_point[slot] >= 0].view(np.uint16)[:, ::STRIDE].T
            world.substrings[slot] = int(world.kf_id[slot]), np.sort(np.ascontiguousarray(columns))


@kernel
def _count_shared(substrings: NDArray[np.uint16], counts: NDArray[np.int64]) -> None:
    """Count the substrings ``[P, F]`` of a keyframe that are in the frame; those that are not have -1."""
    for position in range(substrings.shape[0]):
        for value in substrings[position]:
            if counts[position, value] >= 0:
                counts[position, value] += 1


@kernel
def _sum_weights(substrings: NDArray[np.uint16], counts: NDArray[np.int64], weight: NDArray[np.float64]) -> float:
    score = 0.0
    for position in range(substrings.shape[0]):
        for value in substrings[position]:
            if counts[position, value] > 0:
                score += weight[position, value]
    return score


# ---------------------------------------------------------------------- pose


def match_keyframe(world: Map, keyframe: int, observations: Observations) -> Matches:
    """Match a frame's features to those of a keyframe that observe map points, by descriptor alone."""
    point = world.kf_point[keyframe, : world.kf_count[keyframe]]
    rows = np.flatnonzero(point >= 0)
    feature, row = match_brute_force(
        observations.words, world.kf_words[keyframe, rows], max_distance=MAX_DISTANCE, ratio=RATIO
    )
    slots = point[rows[row]].astype(np.int64)
    return Matches(feature, slots, world.position[slots])


def ransac_pose(
    position: Array, xy: Array, info: Array, camera: Camera, rng: np.random.Generator
) -> tuple[Array, NDArray[np.bool_]] | None:
    """A pose by RANSAC over three-point poses.

    Args:
        position: World points ``[N, 3]``.
        xy: Undistorted pixels ``[N, 2]``.
        info: Inverse variances of the pixels ``[N]``.
        camera: Intrinsics.
        rng: Draws the samples.

    Returns:
        The world-to-camera pose with the most inliers and its inliers; None if no sample gave one with four.
    """
    n = len(position)
    if n < 4:
        return None
    best: tuple[Array, NDArray[np.bool_]] | None = None
    best_count, needed, drawn = 3, RANSAC_ITERATIONS, 0
    while drawn < min(needed, RANSAC_ITERATIONS):
        samples = _triples(n, min(RANSAC_BATCH, RANSAC_ITERATIONS - drawn), rng)
        drawn += len(samples)
        poses = _three_point_poses(position[samples], xy[samples], camera)
        if not len(poses):
            continue
        local = np.swapaxes(poses[:, :3, :3] @ position.T + poses[:, :3, 3:], 1, 2)
        chi2 = info * np.square(camera.project(local) - xy).sum(axis=-1)
        inliers = (local[..., 2] > 0.05) & (chi2 < 2.0 * 5.991)
        count = np.count_nonzero(inliers, axis=1)
        most = int(count.argmax())
        if count[most] > best_count:
            best, best_count = (poses[most], inliers[most]), int(count[most])
            needed = int(np.ceil(np.log(0.001) / np.log1p(-(min(best_count / n, 0.999) ** 3)))) + 1
    return best


def _triples(n: int, count: int, rng: np.random.Generator) -> Slots:
    """So many samples ``[count, 3]`` of three different indices below `n`, all equally likely."""
    a, b, c = (rng.integers(n - k, size=count) for k in range(3))
    b += b >= a
    for other in (np.minimum(a, b), np.maximum(a, b)):
        c += c >= other
    return np.stack([a, b, c], axis=1)


def _three_point_poses(position: Array, xy: Array, camera: Camera) -> Array:
    """All poses ``[H, 4, 4]``, world to camera, that fit any of the samples ``[S, 3, 3]`` and ``[S, 3, 2]``."""
    solutions = [np.zeros((0, 6))]
    for points, pixels in zip(position, xy, strict=True):
        try:
            _, rotations, translations = cv2.solveP3P(points, pixels, camera.matrix, None, flags=cv2.SOLVEPNP_AP3P)
        except cv2.error:  # a degenerate sample, e.g. collinear points
            continue
        solutions.append(np.hstack([np.reshape(rotations, (-1, 3)), np.reshape(translations, (-1, 3))]))
    flat = np.concatenate(solutions)
    flat = flat[np.isfinite(flat).all(axis=1)]
    poses = np.tile(np.eye(4), (len(flat), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(flat[:, :3]).as_matrix()
    poses[:, :3, 3] = flat[:, 3:]
    return poses


def ransac_matches(
    matches: Matches, observations: Observations, camera: Camera, rng: np.random.Generator, min_inliers: float
) -> tuple[Array, Matches] | None:
    """The RANSAC pose of matches and the matches that fit it; None where these are fewer than `min_inliers`."""
    f = matches.feature
    ransac = ransac_pose(matches.position, observations.xy[f], observations.info[f], camera, rng)
    if ransac is None or np.count_nonzero(ransac[1]) < min_inliers:
        return None
    return ransac[0], matches.select(ransac[1])


def pnp_poses(
    world: Map, keyframes: list[int], observations: Observations, rng: np.random.Generator, min_inliers: int
) -> Iterator[PoseCandidate]:
    """Poses by descriptor matches: a good one at once, the others after all candidates, the best first.

    Args:
        world: The map.
        keyframes: Slots to match against; the ones with the most matches are tried first.
        observations: The frame's features.
        rng: Draws RANSAC's samples.
        min_inliers: Inliers that the optimised pose needs.
    """
    if len(observations) < min_inliers:
        return
    matched = [(match_keyframe(world, keyframe, observations), keyframe) for keyframe in keyframes]
    matched.sort(key=lambda pair: (-len(pair[0]), -int(world.kf_id[pair[1]])))
    others: list[PoseCandidate] = []
    for matches, keyframe in matched[:PNP_CANDIDATES]:
        if len(matches) < max(MIN_PNP_INLIERS, min_inliers // 3):
            break
        ransac = ransac_matches(matches, observations, world.camera, rng, MIN_PNP_INLIERS)
        if ransac is None:
            continue
        pose, inliers = ransac
        candidate = PoseCandidate(keyframe, inliers, solve(world.camera, observations, inliers, pose))
        if candidate.estimate.count >= 2 * min_inliers:
            yield candidate
        else:
            others.append(candidate)
    yield from sorted(others, key=lambda candidate: -candidate.estimate.count)


# ---------------------------------------------------------------------- verify


@dataclass(frozen=True, eq=False)
class PlaceHypothesis:
    """A frame's pose by a place.

    Attributes:
        T_cam_world: World to camera, ``[4, 4]``.
        share: Which share of the points that should be in view is seen.
        depth: Median depth of what is seen.
    """

    T_cam_world: Array
    share: float
    depth: float

    def contradicts(self, other: PlaceHypothesis) -> bool:
        """Whether the frame cannot have been taken at both places."""
        between = self.T_cam_world @ se3.inverse(other.T_cam_world)
        far = np.linalg.norm(between[:3, 3]) > SAME_PLACE_DEPTHS * max(self.depth, other.depth)
        return bool(far or se3.rotation_angle(between) > SAME_PLACE_ANGLE)


@dataclass(frozen=True, eq=False)
class PlaceMatch:
    """A frame at the place of a keyframe.

    Attributes:
        T_cam_world: World-to-camera pose by the points around the keyframe.
        matches: The matches with points that fit it.
        share: Which share of the keyframe's own points, in view and behind no mask, is among them.
    """

    T_cam_world: Array
    matches: Matches
    share: float

    @property
    def hypothesis(self) -> PlaceHypothesis:
        """The pose, with the median depth of what is seen."""
        depth = float(np.median(se3.transform(self.T_cam_world, self.matches.position)[:, 2]))
        return PlaceHypothesis(self.T_cam_world, self.share, depth)


def verify_place(
    world: Map,
    keyframe: int,
    observations: Observations,
    matches: Matches,
    T_cam_world: Array,
    settings: TrackingSettings,
) -> PlaceMatch:
    """Match all points around a keyframe, and fit the pose to them, again while that gives more matches.

    Args:
        world: The map.
        keyframe: Slot of the keyframe.
        observations: The frame's features.
        matches: Matches that agree on an initial pose.
        T_cam_world: That pose.
        settings: Radius and descriptor distances.
    """
    estimate, points = solve(world.camera, observations, matches, T_cam_world), world.points_of(around(world, keyframe))
    for _ in range(ROUNDS):
        before = len(matches)
        more, _ = match_map(world, observations, estimate.T_cam_world, matches, points, settings, WIDEN)
        joined = matches.joined(more)
        estimate = solve(world.camera, observations, joined, estimate.T_cam_world)
        matches = joined.select(estimate.inliers)
        if len(matches) <= before:
            break
    own = world.kf_point[keyframe]
    in_view, uv, *_ = world.project(estimate.T_cam_world, own[own >= 0].astype(np.int64))
    if observations.mask is not None:  # the distortion is less than what masks are dilated by
        height, width = observations.mask.shape
        column, row = np.rint(uv).astype(np.int64).T
        in_view = in_view[~observations.mask[row.clip(0, height - 1), column.clip(0, width - 1)]]
    share = float(np.isin(in_view, matches.point).mean()) if len(in_view) else 0.0
    share = share if np.isfinite(estimate.T_cam_world).all() else 0.0
    return PlaceMatch(estimate.T_cam_world, matches, share)


def pose_uncertainty(world: Map, observations: Observations, place: PlaceMatch, rng: np.random.Generator) -> float:
    """How badly the matches determine the pose, e.g. those on one distant poster; up to 1 is precise enough.

    The number of matches says nothing of that: errors of the map are common to all of them. So they have to be well
    spread, and any half has to give the pose, so that a few far off the others do not settle it.

    Args:
        world: The map.
        observations: The frame's features.
        place: The place, with matches and pose.
        rng: Draws the halves.
    """
    matches, T_cam_world = place.matches, place.T_cam_world
    xy, count = observations.xy[matches.feature], len(matches)
    if count < MIN_MATCHES or not np.isfinite(T_cam_world).all():
        return np.inf
    off = np.abs(xy - np.median(xy, axis=0)).max(axis=1)
    inner = solve(world.camera, observations, matches.select(off <= np.quantile(off, INNER_SHARE)), T_cam_world)
    if inner.count < MIN_MATCHES // 2 or not np.isfinite(inner.T_cam_world).all():
        return np.inf
    covariance = pose_covariance(inner.T_cam_world, inner.information, inner.count)
    dilution = np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])
    halves = [matches.select(rng.permutation(count) < count // 2) for _ in range(SPLITS)]
    poses = np.array([solve(world.camera, observations, half, T_cam_world).T_cam_world for half in halves])
    centres = se3.inverse(poses)[:, :3, 3]
    spread = np.sqrt(np.square(centres - np.median(centres, axis=0)).sum(axis=1).mean())
    worst = float(max(dilution / MAX_DILUTION, spread / MAX_SPLIT_SPREAD) / place.hypothesis.depth)
    return worst if np.isfinite(worst) else np.inf


def around(world: Map, keyframe: int) -> Slots:
    """Slots of a keyframe, first, and of those that share most points with it."""
    near, _ = world.covisible(keyframe)
    return np.concatenate([[keyframe], near[:AROUND]]).astype(np.int64)


# ---------------------------------------------------------------------- perceptual aliasing


def is_aliased(
    world: Map,
    observations: Observations,
    hypotheses: dict[int, PlaceHypothesis],
    keyframes: Slots,
    settings: TrackingSettings,
    seed: int,
    possible: Callable[[int, Array], bool] = lambda _, __: True,
) -> bool:
    """Whether a frame's features fit two places of one submap.

    Args:
        world: The map.
        observations: The features.
        hypotheses: The frame's pose by submap, as far as it is known.
        keyframes: Slots of the keyframes whose places may be others.
        settings: Of tracking.
        seed: Founds RANSAC's draws.
        possible: Whether the frame can have been taken in a submap at a world-to-camera pose.
    """
    min_share = ALIASING_SHARE * max(place.share for place in hypotheses.values())
    for submap in np.unique(world.kf_map[keyframes]).tolist():
        places = [hypotheses[submap]] if submap in hypotheses else []
        slots = keyframes[world.kf_map[keyframes] == submap]
        for slot in top_candidates(world, slots, observations, ALIASING_CANDIDATES):
            other = _place_of(world, slot, observations, settings, seed)
            if other is None or other.share < min_share or not possible(submap, other.T_cam_world):
                continue
            if any(place.contradicts(other) for place in places):
                return True
            places.append(other)
    return False


def _place_of(
    world: Map, slot: int, observations: Observations, settings: TrackingSettings, seed: int
) -> PlaceHypothesis | None:
    """The pose at a keyframe's place, if enough of it is seen."""
    matches = match_keyframe(world, slot, observations)
    if len(matches) < MIN_ALIASING_MATCHES // 2:
        return None
    rng = stream(seed, "lookalikes", int(world.kf_id[slot]))
    ransac = ransac_matches(matches, observations, world.camera, rng, MIN_ALIASING_MATCHES // 3)
    if ransac is None:
        return None
    pose, inliers = ransac
    place = verify_place(world, slot, observations, inliers, pose, settings)
    return place.hypothesis if len(place.matches) >= MIN_ALIASING_MATCHES else None
