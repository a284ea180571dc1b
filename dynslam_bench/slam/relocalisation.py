"""Relocalisation: which keyframes show the place of a frame, its pose there, and whether the place is verified.

1. *Rank*: keyframes are scored by the 16-bit substrings of binary descriptors that they share with the frame. Two
   descriptors of one point differ in few bits, so that some substrings are equal; those of
   different points seldom share one (multi-index hashing: Norouzi, Punjani and Fleet, 2012).
   Nothing is trained or downloaded.
2. *Pose*: descriptors are matched with a candidate's map points; a pose follows by RANSAC over three-point poses.
3. *Verify*: all points around the candidate are matched. What was mapped there and should be in view has to be seen,
   unless a mask hides it; a few dozen matches alone fit between places that share a shelf or a
   poster.
4. *Uncertainty*: the matches have to determine the pose well; those on one distant poster do not.
5. *Perceptual aliasing*: the features must not fit a second place, as in buildings with repeated corridors.
6. *Relocalisation gate*: the pose has to be within what the camera can have moved. Buildings repeat themselves: the
   next door looks like the last one, and the local map there agrees. A camera covers a limited
   distance in the time, and the images since the last tracked frame tell how far it has rotated.

The map is read and never changed (but for the index, which is brought up to date).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dynslam_bench.core.compiled import kernel
from dynslam_bench.core.seeding import stream
from dynslam_bench.features.matching import Words, match_brute_force
from dynslam_bench.geometry import Camera, feature_scale, pixel_index, se3
from dynslam_bench.slam.atlas import Atlas
from dynslam_bench.slam.map import Array, Map, Slots
from dynslam_bench.slam.motion_model import pose_covariance
from dynslam_bench.slam.observations import Observations
from dynslam_bench.slam.pose_optimisation import CHI2_MONO, NEAR_M
from dynslam_bench.slam.settings import BackendSettings, TrackingSettings
from dynslam_bench.slam.tracking import (
    MIN_MATCHES,
    InitialPose,
    Matches,
    TrackedFrame,
    match_map,
    solve,
)

VALUES = 1 << 16
"""Values that a substring of 16 bits can have."""
STRIDE = 4
"""Every fourth substring is used: the others change the ranking little and cost as much again."""
CHANGED = 0.25
"""A keyframe is indexed again when it has gained or lost this share of its points."""

MAX_DISTANCE = 60
"""Largest Hamming distance of a match by descriptor alone."""
RATIO = 0.85
"""Largest ratio of that distance to the second nearest one's."""
RANSAC_ITERATIONS = 150
"""RANSAC samples at most."""
RANSAC_BATCH = 25
"""RANSAC samples that are evaluated together."""
RANSAC_CHI2 = 2.0 * CHI2_MONO
"""Largest chi-square of a RANSAC inlier, twice that of an optimised pose."""
RANSAC_FAILURE = 0.001
"""Probability that all samples contain an outlier at which RANSAC stops."""
PNP_CANDIDATES = 5
"""Keyframes with the most descriptor matches that RANSAC is tried on."""
MIN_PNP_INLIERS = 8
"""Inliers of RANSAC without which a keyframe gives no pose, and matches that it needs before."""

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
MIN_SPREAD_MATCHES = 12
"""Matches at least: a half of fewer determines no pose."""
SPLITS = 12
"""Random halves of the matches that the pose is fitted to."""
MAX_SPLIT_SPREAD = 0.01
"""Largest spread of the positions by these halves, median depths."""

ALIASING_CANDIDATES = 12
"""Best-ranked keyframes of each submap that are tested for aliasing."""
ALIASING_SHARE = 0.33
"""Share of the first place's matches from which a second place looks like it, too. Without repetition it is 0.15 at
most, with repeated walls 0.4 to 1 (rendered buildings)."""
SAME_PLACE_DEPTHS = 0.3
"""Poses farther apart, in median depths of what is seen, are two places."""
SAME_PLACE_ANGLE = np.radians(15.0)
"""Poses that are rotated by more, radians, are two places."""
MIN_ALIASING_MATCHES = 30
"""Matches that make a second place."""

CANDIDATES = 10
"""Best-ranked keyframes that are matched feature by feature; bounds the time of a frame."""
MANY_POINTS = 60
"""Matches at a place that are many."""
MANY_POINTS_SHARE = 0.75
"""Factor on the share that must be seen, where there are many matches."""

SLACK_M = 0.5
"""Distance that the camera may have moved in no time, metres."""
KIDNAP_POINTS = 60
"""A frame that shows so many map points, as many as a map begins with, followed by one that shows none of them and is
not connected with it: the camera was kidnapped."""
CONNECTED = 20
"""Matches that must fit one homography to connect two images."""
CONNECTED_SHARE = 0.4
"""Least share of these matches among all."""
HOMOGRAPHY_PX = 4.0
"""Largest error of these matches, pixels of octave 0."""
ROTATION_SLACK = np.radians(20.0)
"""Largest error of the rotation is this angle, radians, plus `ROTATION_SLACK_SHARE`."""
ROTATION_SLACK_SHARE = 0.75
"""Share of all rotations between images that is added: a camera that moves sideways seems to rotate. On four rendered
laps none of 4,000 sections of 3 to 30 steps exceeded the share and half the angle."""


# ---------------------------------------------------------------------- rank


def top_candidates(
    slam_map: Map, keyframes: Slots, observations: Observations, count: int
) -> list[int]:
    """The keyframes with the highest place-recognition scores.

    Args:
        slam_map: The map.
        keyframes: Slots to choose from, ``[S]``.
        observations: The frame's features.
        count: How many to choose at most.

    Returns:
        Slots, best first; of equal scores the newer keyframe. All, in the order given, if there are
        at most `count`.
    """
    if len(keyframes) <= count or not len(observations):
        return list(map(int, keyframes[:count]))
    scores = recognition_scores(slam_map, keyframes, observations)
    order = np.lexsort((-slam_map.kf_id[keyframes], -scores))
    return list(map(int, keyframes[order[:count]]))


def recognition_scores(slam_map: Map, keyframes: Slots, observations: Observations) -> Array:
    """Place-recognition scores ``[S]`` of keyframes; comparable within one call alone.

    The sum of the weights of the substrings that a keyframe shares with the frame, over the root of
    its number of points: many points share more by chance. The weight is the logarithm of how much
    rarer a substring is than all of the frame's together.
    """
    _index_substrings(slam_map)

    # table of the frame's substrings by position and value: 0 if the frame has it, else -1
    query = _substrings(observations.descriptors)
    counts = np.full((len(query), VALUES), -1, np.int64)
    np.put_along_axis(counts, query.astype(np.int64), 0, axis=1)

    # how often all keyframes together have each of them
    indexed = [slam_map.substrings[slot][1] for slot in keyframes.tolist()]
    for substrings in indexed:
        _count_shared(substrings, counts)

    # rare ones weigh more
    total = np.maximum(counts, 0).sum()
    weight = np.where(counts > 0, np.log(max(total, 1) / np.maximum(counts, 1)), 0.0)
    scores = np.array([_sum_weights(substrings, weight) for substrings in indexed])
    points = [max(substrings.shape[1], 1) for substrings in indexed]
    return np.asarray(scores / np.sqrt(points))


def _substrings(descriptors: Words) -> NDArray[np.uint16]:
    """Every `STRIDE`-th substring of descriptors ``[N, W]``, by position ``[P, N]``."""
    return np.ascontiguousarray(descriptors).view(np.uint16)[:, ::STRIDE].T


def _index_substrings(slam_map: Map) -> None:
    """Sort the substrings of new keyframes, and of those that have gained or lost many points."""
    # features of each keyframe that observe a point: their descriptors are indexed
    observed = np.count_nonzero(slam_map.kf_point >= 0, axis=1)
    for slot in np.flatnonzero(slam_map.kf_alive).tolist():
        keyframe, substrings = slam_map.substrings.get(slot, (-1, np.zeros((0, 0), np.uint16)))
        # a slot may hold another keyframe than it did, or one that was observed more since
        new = keyframe != slam_map.kf_id[slot]
        count = substrings.shape[1]
        if new or abs(observed[slot] - count) > CHANGED * count:
            descriptors = slam_map.kf_descriptor[slot, slam_map.kf_point[slot] >= 0]
            columns = np.ascontiguousarray(_substrings(descriptors))
            slam_map.substrings[slot] = int(slam_map.kf_id[slot]), np.sort(columns)


@kernel
def _count_shared(substrings: NDArray[np.uint16], counts: NDArray[np.int64]) -> None:
    """Count the substrings ``[P, F]`` of a keyframe that are in the frame; those that are not have -1."""
    for position in range(substrings.shape[0]):
        for value in substrings[position]:
            if counts[position, value] >= 0:
                counts[position, value] += 1


@kernel
def _sum_weights(substrings: NDArray[np.uint16], weight: NDArray[np.float64]) -> float:
    """Sum of the weights ``[P, VALUES]`` of a keyframe's substrings ``[P, F]``."""
    score = 0.0
    for position in range(substrings.shape[0]):
        for value in substrings[position]:
            score += weight[position, value]
    return score


# ---------------------------------------------------------------------- pose


def match_keyframe(slam_map: Map, keyframe: int, observations: Observations) -> Matches:
    """Match a frame's features to those of a keyframe that observe map points, by descriptor alone."""
    # rows of the keyframe's features that observe a point
    point = slam_map.kf_point[keyframe, : slam_map.kf_count[keyframe]]
    rows = np.flatnonzero(point >= 0)
    # mutual nearest descriptors, clearly nearer than the second ones
    feature, row = match_brute_force(
        observations.descriptors,
        slam_map.kf_descriptor[keyframe, rows],
        max_distance=MAX_DISTANCE,
        ratio=RATIO,
    )
    slots = point[rows[row]].astype(np.int64)
    return Matches(feature, slots, slam_map.position[slots])


def ransac_pose(
    position: Array, xy: Array, info: Array, camera: Camera, rng: np.random.Generator
) -> tuple[Array, NDArray[np.bool_]] | None:
    """A pose by RANSAC over three-point poses.

    Args:
        position: World points ``[N, 3]``, three or more.
        xy: Undistorted pixels ``[N, 2]``.
        info: Inverse variances of the pixels ``[N]``.
        camera: Intrinsics.
        rng: Draws the samples.

    Returns:
        The world-to-camera pose with the most inliers and its inliers; None if no sample gave one
        with four.
    """
    # a sample of three fits itself: an inlier more is the least that counts
    n = len(position)
    best: tuple[Array, NDArray[np.bool_]] | None = None
    best_count = 3
    needed = RANSAC_ITERATIONS
    drawn = 0
    while drawn < min(needed, RANSAC_ITERATIONS):
        # all poses that fit any of a batch of samples
        samples = _triples(n, min(RANSAC_BATCH, RANSAC_ITERATIONS - drawn), rng)
        drawn += len(samples)
        poses = _three_point_poses(position[samples], xy[samples], camera)
        if not len(poses):
            continue

        # inliers ``[H, N]`` of each, by the reprojection error
        local = np.swapaxes(poses[:, :3, :3] @ position.T + poses[:, :3, 3:], 1, 2)
        chi2 = info * np.square(camera.project(local) - xy).sum(axis=-1)
        inliers = (local[..., 2] > NEAR_M) & (chi2 < RANSAC_CHI2)
        count = np.count_nonzero(inliers, axis=1)
        most = int(count.argmax())
        if count[most] > best_count:
            best = (poses[most], inliers[most])
            best_count = int(count[most])
            # samples until one of three inliers was drawn almost surely
            all_inliers = min(best_count / n, 0.999) ** 3
            needed = int(np.ceil(np.log(RANSAC_FAILURE) / np.log1p(-all_inliers))) + 1
    return best


def _triples(n: int, count: int, rng: np.random.Generator) -> Slots:
    """So many samples ``[count, 3]`` of three different indices below `n`, all equally likely."""
    a = rng.integers(n, size=count)
    b = rng.integers(n - 1, size=count)
    c = rng.integers(n - 2, size=count)
    # skip the indices that are taken, so that the three differ
    b += b >= a
    for other in (np.minimum(a, b), np.maximum(a, b)):
        c += c >= other
    return np.stack([a, b, c], axis=1)


def _three_point_poses(position: Array, xy: Array, camera: Camera) -> Array:
    """All poses ``[H, 4, 4]``, world to camera, that fit any of the samples ``[S, 3, 3]`` and ``[S, 3, 2]``."""
    solutions = [np.zeros((0, 6))]
    # up to four poses a sample, as rotation vector and translation (AP3P)
    for points, pixels in zip(position, xy, strict=True):
        try:
            _, rotations, translations = cv2.solveP3P(
                points, pixels, camera.matrix, None, flags=cv2.SOLVEPNP_AP3P
            )
        except cv2.error:
            # a degenerate sample, e.g. collinear points
            continue
        vectors = np.reshape(rotations, (-1, 3))
        solutions.append(np.hstack([vectors, np.reshape(translations, (-1, 3))]))

    # as matrices, without solutions that are no numbers
    flat = np.concatenate(solutions)
    flat = flat[np.isfinite(flat).all(axis=1)]
    poses = np.tile(np.eye(4), (len(flat), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(flat[:, :3]).as_matrix()
    poses[:, :3, 3] = flat[:, 3:]
    return poses


def _ransac_place(
    slam_map: Map,
    keyframe: int,
    observations: Observations,
    matches: Matches,
    rng: np.random.Generator,
    min_inliers: int,
) -> InitialPose | None:
    """The RANSAC pose of matches with a keyframe; None where fewer than `min_inliers` fit it.

    Args:
        slam_map: The map.
        keyframe: Slot of the keyframe.
        observations: The frame's features.
        matches: Its matches with the keyframe's map points.
        rng: Draws the samples.
        min_inliers: Inliers that are needed.
    """
    feature = matches.feature
    # reprojection errors by the features' own information
    ransac = ransac_pose(
        matches.position, observations.xy[feature], observations.info[feature], slam_map.camera, rng
    )
    if ransac is None:
        return None
    T_cam_world, inliers = ransac
    if np.count_nonzero(inliers) < min_inliers:
        return None
    return InitialPose(T_cam_world, matches.select(inliers), keyframe)


def pnp_poses(
    slam_map: Map,
    keyframes: list[int],
    observations: Observations,
    rng: np.random.Generator,
    min_inliers: int,
) -> Iterator[InitialPose]:
    """Poses by descriptor matches: a good one at once, the others after all candidates, the best first.

    Args:
        slam_map: The map.
        keyframes: Slots to match against; the ones with the most matches are tried first.
        observations: The frame's features.
        rng: Draws RANSAC's samples.
        min_inliers: Inliers that the optimised pose needs.
    """
    if len(observations) < min_inliers:
        return

    # keyframes with the most descriptor matches first, of equal ones the newer
    matched = [
        (match_keyframe(slam_map, keyframe, observations), keyframe) for keyframe in keyframes
    ]
    matched.sort(key=lambda pair: (-len(pair[0]), -int(slam_map.kf_id[pair[1]])))
    others: list[InitialPose] = []
    for matches, keyframe in matched[:PNP_CANDIDATES]:
        if len(matches) < max(MIN_PNP_INLIERS, min_inliers // 3):
            break

        # a pose by RANSAC, fitted to its inliers
        place = _ransac_place(slam_map, keyframe, observations, matches, rng, MIN_PNP_INLIERS)
        if place is None:
            continue
        estimate = solve(slam_map.camera, observations, place.matches, place.T_cam_world)
        inliers = place.matches.select(estimate.inliers)
        candidate = InitialPose(estimate.T_cam_world, inliers, keyframe)
        if estimate.count >= 2 * min_inliers:
            yield candidate
        else:
            others.append(candidate)
    yield from sorted(others, key=lambda candidate: -len(candidate.matches))


# ---------------------------------------------------------------------- verify


def verify_place(
    slam_map: Map, candidate: InitialPose, observations: Observations, settings: TrackingSettings
) -> InitialPose:
    """Match all points around a keyframe, and fit the pose to them, again while that gives more matches.

    Args:
        slam_map: The map.
        candidate: A pose, the matches that agree on it, and the keyframe.
        observations: The frame's features.
        settings: Radius and descriptor distances.
    """
    # start from the matches that agree on the candidate
    keyframe = candidate.keyframe
    matches = candidate.matches

    # match the points around and fit the pose, while that gives more inliers
    points = slam_map.points_of(keyframe_neighbourhood(slam_map, keyframe))
    estimate = solve(slam_map.camera, observations, matches, candidate.T_cam_world)
    for _ in range(ROUNDS):
        count = len(matches)
        more, _ = match_map(
            slam_map, observations, estimate.T_cam_world, matches, points, settings, WIDEN
        )
        joined = matches.joined(more)
        estimate = solve(slam_map.camera, observations, joined, estimate.T_cam_world)
        matches = joined.select(estimate.inliers)
        if len(matches) <= count:
            break
    T_cam_world = estimate.T_cam_world

    # share of the keyframe's own points in view, and behind no mask, that is matched
    own = slam_map.kf_point[keyframe]
    in_view, uv, *_ = slam_map.project(T_cam_world, own[own >= 0].astype(np.int64))
    if observations.mask is not None:
        # the distortion is less than what masks are dilated by
        pixels, _ = pixel_index(uv, observations.mask.shape)
        in_view = in_view[~observations.mask[pixels]]
    seen_share = float(np.isin(in_view, matches.point).mean()) if len(in_view) else 0.0

    # depth of the place, which distances there are compared with
    depth = np.nan
    if len(matches):
        depth = float(np.median(se3.transform(T_cam_world, matches.position)[:, 2]))
    return InitialPose(T_cam_world, matches, keyframe, seen_share, depth)


def recognise_place(
    slam_map: Map,
    keyframe: int,
    observations: Observations,
    settings: TrackingSettings,
    rng: np.random.Generator,
    min_matches: int,
    min_inliers: int,
) -> InitialPose | None:
    """The verified pose at a keyframe's place; None with too few matches by descriptor or inliers of RANSAC.

    Args:
        slam_map: The map.
        keyframe: Slot of the keyframe.
        observations: The frame's features.
        settings: Radius and descriptor distances.
        rng: Draws RANSAC's samples.
        min_matches: Matches by descriptor that are needed.
        min_inliers: Inliers of RANSAC that are needed.
    """
    matches = match_keyframe(slam_map, keyframe, observations)
    if len(matches) < min_matches:
        return None
    candidate = _ransac_place(slam_map, keyframe, observations, matches, rng, min_inliers)
    return None if candidate is None else verify_place(slam_map, candidate, observations, settings)


def pose_uncertainty(
    slam_map: Map, observations: Observations, place: InitialPose, rng: np.random.Generator
) -> float:
    """Uncertainty of the pose by the matches, e.g. those on one distant poster; up to 1 is precise enough.

    The number of matches says nothing of that: errors of the map are common to all of them. So they
    have to be well spread, and any half has to give the pose, so that a few far off the others do
    not settle it.

    Args:
        slam_map: The map.
        observations: The frame's features.
        place: The place, with matches and pose.
        rng: Draws the halves.
    """
    matches = place.matches
    T_cam_world = place.T_cam_world
    xy = observations.xy[matches.feature]
    count = len(matches)
    if count < MIN_SPREAD_MATCHES:
        return np.inf

    # dilution of precision: position's uncertainty by the inner matches, with the information of one
    off_centre = np.abs(xy - np.median(xy, axis=0)).max(axis=1)
    inner_matches = matches.select(off_centre <= np.quantile(off_centre, INNER_SHARE))
    inner = solve(slam_map.camera, observations, inner_matches, T_cam_world)
    if inner.count < MIN_SPREAD_MATCHES // 2:
        return np.inf
    covariance = pose_covariance(inner.T_cam_world, inner.information, inner.count)
    dilution = np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])

    # spread of the positions by random halves of the matches
    halves = [matches.select(rng.permutation(count) < count // 2) for _ in range(SPLITS)]
    poses = np.array(
        [solve(slam_map.camera, observations, half, T_cam_world).T_cam_world for half in halves]
    )
    centres = se3.inverse(poses)[:, :3, 3]
    spread = np.sqrt(np.square(centres - np.median(centres, axis=0)).sum(axis=1).mean())

    # the worse of the two, in median depths of the place
    worst = float(max(dilution / MAX_DILUTION, spread / MAX_SPLIT_SPREAD) / place.depth)
    return worst if np.isfinite(worst) else np.inf


def keyframe_neighbourhood(slam_map: Map, keyframe: int) -> Slots:
    """Slots of a keyframe, first, and of those that share most points with it."""
    near, _ = slam_map.covisible(keyframe)
    return np.concatenate([[keyframe], near[:AROUND]]).astype(np.int64)


# ---------------------------------------------------------------------- perceptual aliasing


def are_different_places(one: InitialPose, other: InitialPose) -> bool:
    """Whether a frame cannot have been taken at both places."""
    # transform from the one camera to the other
    between = one.T_cam_world @ se3.inverse(other.T_cam_world)
    far = np.linalg.norm(between[:3, 3]) > SAME_PLACE_DEPTHS * max(one.depth, other.depth)
    return bool(far or se3.rotation_angle(between) > SAME_PLACE_ANGLE)


def is_aliased(
    slam_map: Map,
    observations: Observations,
    hypotheses: Mapping[int, InitialPose],
    keyframes: Slots,
    settings: TrackingSettings,
    seed: int,
    possible: Callable[[int, Array], bool] = lambda _, __: True,
) -> bool:
    """Whether a frame's features fit two places of one submap.

    Args:
        slam_map: The map.
        observations: The features.
        hypotheses: Known poses of the frame: submap number to pose.
        keyframes: Slots of the keyframes that are searched for a second place.
        settings: Settings of tracking.
        seed: Seed of RANSAC's draws.
        possible: Called with a submap's number and ``T_cam_world``; False where the camera cannot be
            (`MotionBound.admits`).
    """
    # a second place must show nearly as much of what it should as the first
    min_share = ALIASING_SHARE * max(place.seen_share for place in hypotheses.values())
    for submap in np.unique(slam_map.kf_map[keyframes]).tolist():
        places = [hypotheses[submap]] if submap in hypotheses else []
        slots = keyframes[slam_map.kf_map[keyframes] == submap]
        for slot in top_candidates(slam_map, slots, observations, ALIASING_CANDIDATES):
            # another place counts if it shows as much, and the camera can be there
            other = recognise_place(
                slam_map,
                slot,
                observations,
                settings,
                stream(seed, "lookalikes", int(slam_map.kf_id[slot])),
                min_matches=MIN_ALIASING_MATCHES // 2,
                min_inliers=MIN_ALIASING_MATCHES // 3,
            )
            if (
                other is None
                or len(other.matches) < MIN_ALIASING_MATCHES
                or other.seen_share < min_share
                or not possible(submap, other.T_cam_world)
            ):
                continue

            # the same place seen from another keyframe does not contradict
            if any(are_different_places(place, other) for place in places):
                return True
            places.append(other)
    return False


# ---------------------------------------------------------------------- the relocalisation gate


@dataclass(frozen=True, eq=False)
class RotationEstimate:
    """The rotation since the last tracked frame, by images alone.

    Attributes:
        observations: Features of the newest image.
        R_now_last: Rotation ``[3, 3]`` from the camera's axes in the last tracked frame to those
            now.
        apparent: Sum of the rotations between consecutive images, radians.
    """

    observations: Observations
    R_now_last: Array
    apparent: float = 0.0

    def advanced(self, observations: Observations, camera: Camera) -> RotationEstimate | None:
        """The rotation up to the next image; None where that is not connected with the one before.

        Args:
            observations: Its features.
            camera: Intrinsics without distortion.
        """
        # match the two images, and keep what fits one homography
        row_before, row_now = match_brute_force(
            self.observations.descriptors,
            observations.descriptors,
            max_distance=MAX_DISTANCE,
            ratio=RATIO,
        )
        if len(row_before) < CONNECTED:
            return None
        xy_before = self.observations.xy[row_before]
        xy_now = observations.xy[row_now]
        tolerance_px = HOMOGRAPHY_PX * feature_scale(camera.width)
        homography, mask = cv2.findHomography(xy_before, xy_now, cv2.RANSAC, tolerance_px)
        fits = np.zeros(len(row_before), bool) if homography is None else mask.ravel() > 0
        if np.count_nonzero(fits) < max(CONNECTED, CONNECTED_SHARE * len(row_before)):
            return None

        # the rotation that aligns their bearings best
        bearings_now = _bearings(xy_now[fits], camera)
        bearings_before = _bearings(xy_before[fits], camera)
        step, _ = Rotation.align_vectors(bearings_now, bearings_before)
        return RotationEstimate(
            observations,
            step.as_matrix() @ self.R_now_last,
            self.apparent + float(step.magnitude()),
        )

    @property
    def slack(self) -> float:
        """Largest error of the rotation, radians."""
        return float(ROTATION_SLACK + ROTATION_SLACK_SHARE * self.apparent)

    def applied(self, T_last_world: Array) -> Array:
        """The world-to-camera pose ``[4, 4]`` of the last tracked frame, rotated about its centre."""
        # the centre stays where the whole upper part [R t] is rotated from the left
        pose = T_last_world.copy()
        pose[:3] = self.R_now_last @ T_last_world[:3]
        return pose

    def allows(self, T_last_world: Array, T_now_world: Array, more: float = 0.0) -> bool:
        """Whether the rotation between two poses agrees with the images.

        Args:
            T_last_world: World-to-camera pose ``[4, 4]`` in the last tracked frame.
            T_now_world: World-to-camera pose ``[4, 4]`` now.
            more: How far the two worlds may be rotated against each other, radians.
        """
        # rotation left between the pose and the one that the images predict
        difference = T_now_world @ se3.inverse(self.applied(T_last_world))
        return bool(se3.rotation_angle(difference) <= self.slack + more)


def _bearings(xy: Array, camera: Camera) -> Array:
    """Unit vectors ``[N, 3]`` in the camera frame towards pixels ``[N, 2]``."""
    rays = camera.unproject(xy, np.ones(len(xy)))
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


@dataclass(frozen=True, eq=False)
class MotionBound:
    """Bound on where the camera can be since it was tracked last.

    Attributes:
        atlas: Where the submaps may lie; the camera was tracked last in the active one.
        T_last_world: World-to-camera pose ``[4, 4]`` in the last tracked frame.
        distance_m: How far it may have moved since.
        rotation: How it has rotated since; None if that is unknown.
    """

    atlas: Atlas
    T_last_world: Array
    distance_m: float
    rotation: RotationEstimate | None

    def admits(self, submap: int, T_cam_world: Array) -> bool:
        """Whether the camera can be at a world-to-camera pose in a submap."""
        # the rotation agrees with the images, up to what the submaps may be rotated by
        slack = self.atlas.slack(self.atlas.active, submap)
        if self.rotation is not None and not self.rotation.allows(
            self.T_last_world, T_cam_world, slack
        ):
            return False

        # the distance can have been covered
        last_centre = se3.inverse(self.T_last_world)[:3, 3]
        centre = se3.inverse(T_cam_world)[:3, 3]
        return self.atlas.reachable(self.atlas.active, submap, last_centre, centre, self.distance_m)


class RelocalisationGate:
    """Bounds distance and rotation since the last tracked frame.

    Args:
        atlas: Where the submaps may lie.
        max_speed: Largest speed of the camera, metres a second.
        anywhere: Whether the camera may be anywhere at first, as in a loaded map.

    Attributes:
        rotation: The rotation since then; None where the images are not connected.
    """

    def __init__(self, atlas: Atlas, max_speed: float, *, anywhere: bool = False) -> None:
        self._atlas = atlas
        self._max_speed = max_speed
        self._kidnapped = anywhere
        self.rotation: RotationEstimate | None = None

    def lose(self, last: TrackedFrame, observations: Observations, *, textured: bool) -> None:
        """Begin to follow the rotation of a camera that was lost: in the first frame that is not tracked any more.

        Args:
            last: The last tracked frame.
            observations: The new one's features.
            textured: Whether it shows more than a blank wall or a covered lens.
        """
        self.start(last)
        self._advance(observations)
        # a well-tracked camera that sees something else at once was kidnapped
        points = int((last.point >= 0).sum())
        self._kidnapped = self.rotation is None and textured and points >= KIDNAP_POINTS

    def start(self, last: TrackedFrame) -> None:
        """Begin to follow the rotation of a camera that counts as lost from the next frame on.

        Args:
            last: The last tracked frame.
        """
        self.rotation = RotationEstimate(last.observations, np.eye(3))
        self._kidnapped = False

    def while_lost(
        self, last: TrackedFrame, observations: Observations, timestamp: float
    ) -> MotionBound:
        """The bound for the next frame of a lost camera; has to be called for every one of them."""
        self._advance(observations)
        return MotionBound(
            self._atlas, last.T_cam_world, self.distance_m(last, timestamp), self.rotation
        )

    def while_tracked(
        self, last: TrackedFrame, observations: Observations, timestamp: float, prediction: Array
    ) -> MotionBound:
        """The bound for the frame after a tracked one.

        A camera that moves fast, as on a car, may go on as the motion model has it: world-to-camera
        `prediction`.
        """
        # rotation by the two images
        unrotated = RotationEstimate(last.observations, np.eye(3))
        rotation = unrotated.advanced(observations, self._atlas.map.camera)

        # distance: the predicted step, and what the largest speed adds to it
        centres = se3.inverse(np.stack([last.T_cam_world, prediction]))[:, :3, 3]
        step = float(np.linalg.norm(centres[1] - centres[0]))
        return MotionBound(
            self._atlas, last.T_cam_world, step + self._distance(last, timestamp), rotation
        )

    def _advance(self, observations: Observations) -> None:
        """Follow the rotation to the next image, until two images are not connected."""
        if self.rotation is not None:
            self.rotation = self.rotation.advanced(observations, self._atlas.map.camera)

    @property
    def slack(self) -> float:
        """Largest error of the rotation, radians."""
        return np.pi if self.rotation is None else self.rotation.slack

    def rotated(self, last: TrackedFrame) -> Array:
        """World-to-camera pose ``[4, 4]`` of a camera that has rotated but has not moved."""
        if self.rotation is None:
            return last.T_cam_world
        return self.rotation.applied(last.T_cam_world)

    def distance_m(self, last: TrackedFrame, timestamp: float) -> float:
        """Largest distance until a time, metres; infinite for a kidnapped camera."""
        return np.inf if self._kidnapped else self._distance(last, timestamp)

    def _distance(self, last: TrackedFrame, timestamp: float) -> float:
        """Largest distance until a time of a camera that was not kidnapped, metres."""
        return SLACK_M + self._max_speed * max(timestamp - last.timestamp, 0.0)


# ---------------------------------------------------------------------- the initial pose


@dataclass(frozen=True, eq=False)
class PoseSearch:
    """The search of keyframes for the initial pose of one frame; it reads the map and never changes it.

    Attributes:
        observations: The frame's features.
        reference: Slot of the keyframe that shares most points with the last tracked frame.
        keyframes: Slots of the candidate keyframes.
        lost: Whether the camera was lost since then; else it was tracked in the frame before.
        bound: Where the camera can be.
        settings: Settings of the back end.
        seed: Seed of the sequence's random draws.
        frame: Index of the frame.
    """

    observations: Observations
    reference: int
    keyframes: Slots
    lost: bool
    bound: MotionBound
    settings: BackendSettings
    seed: int
    frame: int

    def relocalised(self, weak: InitialPose | None) -> InitialPose | None:
        """The pose from keyframes.

        A pose from the last frame that few matches agree on, as by chance after a gap or a sudden
        rotation, competes with those of keyframes, and has to be within the motion bound. After a
        loss it counts only if the place is verified.

        Args:
            weak: The pose from the last frame, if there is one.
        """
        if weak is None:
            return self._relocalise(MIN_MATCHES)
        if self.lost:
            return self._verified(weak) or self._relocalise(MIN_MATCHES)
        # a pose from keyframes has to be better
        pose = self._relocalise(len(weak.matches) + 1)
        if pose is None and self._within_bound(weak):
            return weak
        return pose

    def pose_in_root_map(self) -> InitialPose | None:
        """The pose in the root map of a camera that is tracked in a submap, as strict as for a lost one."""
        root_map = self.bound.atlas.map.submap(0)
        pose = replace(self, keyframes=root_map, lost=True)._relocalise(MIN_MATCHES)
        if pose is None or len(pose.matches) < self.settings.relocalisation.min_inliers:
            return None
        return pose

    def _relocalise(self, min_inliers: int) -> InitialPose | None:
        """A pose by descriptors: from the reference keyframe, else from the best-ranked candidates."""
        rng = stream(self.seed, "relocalisation", self.frame)
        slam_map = self.bound.atlas.map
        least = self.settings.tracking.min_inliers

        # the camera was tracked in the frame before: it is near the reference keyframe
        if not self.lost:
            for candidate in pnp_poses(slam_map, [self.reference], self.observations, rng, least):
                if len(candidate.matches) >= min_inliers and self._within_bound(candidate):
                    return candidate

        # the first of the best-ranked keyframes whose place is verified
        keyframes = top_candidates(slam_map, self.keyframes, self.observations, CANDIDATES)
        for candidate in pnp_poses(slam_map, keyframes, self.observations, rng, least):
            if len(candidate.matches) >= min_inliers:
                pose = self._verified(candidate)
                if pose is not None:
                    return pose
        return None

    def _verified(self, candidate: InitialPose) -> InitialPose | None:
        """The pose at a candidate's place, if it is within the motion bound and the place is verified."""
        slam_map = self.bound.atlas.map
        observations = self.observations
        settings = self.settings

        # within the motion bound
        submap = int(slam_map.kf_map[candidate.keyframe])
        if not self.bound.admits(submap, candidate.T_cam_world):
            return None

        # most of what should be in view is seen
        place = verify_place(slam_map, candidate, observations, settings.tracking)
        factor = MANY_POINTS_SHARE if len(place.matches) >= MANY_POINTS else 1.0
        if place.seen_share < factor * settings.relocalisation.min_share:
            return None
        if not self.lost:
            return replace(place, uncertainty=0.0)

        # the matches determine the pose well
        # a lost camera's place has to pass two more tests
        rng = stream(self.seed, "halves", self.frame)
        uncertainty = pose_uncertainty(slam_map, observations, place, rng)
        if uncertainty > 1:
            return None

        # the features fit no second place
        aliased = is_aliased(
            slam_map,
            observations,
            {submap: place},
            self.keyframes,
            settings.tracking,
            self.seed,
            self.bound.admits,
        )
        return None if aliased else replace(place, uncertainty=uncertainty)

    def _within_bound(self, candidate: InitialPose) -> bool:
        """Whether the camera can be at a pose in the map where it was tracked last."""
        return self.bound.admits(self.bound.atlas.active, candidate.T_cam_world)
