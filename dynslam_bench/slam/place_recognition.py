"""Which keyframes look like this frame? A cheap ranking, so that only a few are matched feature by feature.

Each binary descriptor is read as a row of 16-bit pieces (multi-index hashing: Norouzi, Punjani and Fleet, 2012). Two
descriptors of one point differ in few bits, so that some of their pieces are equal; those of different points seldom
share one. A keyframe scores for every piece that its map points share with the frame, the more the rarer the piece is
among the keyframes. Nothing is trained, stored or downloaded: the pieces are the descriptors themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dynslam_bench.core.seeding import stream
from dynslam_bench.features.matching import match_brute_force
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.slam.descriptor_index import EVERY
from dynslam_bench.slam.map import Map
from dynslam_bench.slam.map_kernels import distinct
from dynslam_bench.slam.motion_model import pose_covariance
from dynslam_bench.slam.observation import Observations
from dynslam_bench.slam.pose_optimisation import PoseEstimate, optimise_pose
from dynslam_bench.slam.settings import BackendSettings, RelocalisationSettings, TrackingSettings
from dynslam_bench.slam.tracking import Matches, match_map, solve


def top_candidates(world: Map, keyframes: NDArray[np.int64], seen: Observations, count: int) -> list[int]:
    """The keyframes that look most like a frame.

    Args:
        world: The map.
        keyframes: Slots to choose from, ``[S]``.
        seen: The frame's features.
        count: How many to choose at most.

    Returns:
        Slots, most alike first; equal scores go to the newer keyframe. All of them, in the order given, where there
        are no more than `count`.
    """
    if len(keyframes) <= count or not len(seen):
        return [int(slot) for slot in keyframes[:count]]
    order = np.lexsort((-world.kf_id[keyframes], -recognition_scores(world, keyframes, seen)))
    return [int(slot) for slot in keyframes[order[:count]]]


def recognition_scores(world: Map, keyframes: NDArray[np.int64], seen: Observations) -> NDArray[np.float64]:
    """How much each of the keyframes ``[S]`` looks like a frame; comparable within one call alone.

    The weights of what it shares with the frame, over the root of its points: a crowd has more in common by chance.
    """
    world.pieces.renew(world.kf_alive, world.kf_id, world.kf_point, world.kf_words.view(np.uint16)[:, :, ::EVERY])
    own = np.ascontiguousarray(seen.words).view(np.uint16)[:, ::EVERY]
    score, points = world.pieces.score(keyframes, own)
    world.space.rest("kf_words", "kf_point")
    return np.asarray(score / np.sqrt(np.maximum(points, 1)))


# Finding the pose without a prediction: descriptor matching against keyframes, then PnP with RANSAC.

Array = NDArray[np.float64]

BATCH = 25
"""Samples that are drawn and judged together."""


@dataclass(frozen=True, eq=False)
class PnpPose:
    """A pose found without prediction, the matches it rests on and its inliers among them."""

    keyframe: int
    matches: Matches
    estimate: PoseEstimate


def match_keyframe(world: Map, keyframe: int, seen: Observations, max_distance: int) -> Matches:
    """Match a frame's features to those of a keyframe that observe map points, by descriptor alone."""
    n = int(world.kf_count[keyframe])
    point = world.kf_point[keyframe, :n]
    rows = np.flatnonzero(point >= 0)
    ours, theirs, _ = match_brute_force(
        seen.words, world.kf_words[keyframe, rows], max_distance=max_distance, ratio=0.85
    )
    slots = point[rows[theirs]].astype(np.int64)
    return Matches(ours, slots, world.position[slots])


def ransac_pose(
    position: Array, xy: Array, info: Array, camera: Camera, iterations: int, rng: np.random.Generator
) -> tuple[Array, NDArray[np.bool_]] | None:
    """A pose by RANSAC over three-point poses.

    Args:
        position: World points ``[N, 3]``.
        xy: Undistorted pixels ``[N, 2]``.
        info: Inverse variances of the pixels ``[N]``.
        camera: Intrinsics.
        iterations: Samples drawn at most.
        rng: Draws the samples.

    Returns:
        The world-to-camera pose with the most inliers and its inliers; None if no sample gave one with four.
    """
    n = len(position)
    if n < 4:
        return None
    best: tuple[Array, NDArray[np.bool_]] | None = None
    best_count, needed, drawn = 3, iterations, 0
    while drawn < min(needed, iterations):
        samples = _triples(n, min(BATCH, iterations - drawn), rng)
        drawn += len(samples)
        poses = _three_point_poses(position[samples], xy[samples], camera)
        if not len(poses):
            continue
        inliers = _inliers(poses, position, xy, info, camera)
        count = np.count_nonzero(inliers, axis=1)
        most = int(count.argmax())
        if count[most] > best_count:
            best, best_count = (poses[most], inliers[most]), int(count[most])
            share = min(best_count / n, 0.999)
            needed = int(np.ceil(np.log(0.001) / np.log1p(-(share**3)))) + 1
    return best


def _triples(n: int, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """So many samples ``[count, 3]`` of three different indices below `n`, all equally likely."""
    a, b, c = (rng.integers(n - k, size=count) for k in range(3))
    b += b >= a
    for other in (np.minimum(a, b), np.maximum(a, b)):
        c += c >= other
    return np.stack([a, b, c], axis=1)


def _three_point_poses(position: Array, xy: Array, camera: Camera) -> Array:
    """All poses ``[H, 4, 4]``, world to camera, that fit any of the samples ``[S, 3, 3]`` and ``[S, 3, 2]``."""
    found = [np.zeros((0, 6))]
    for points, pixels in zip(position, xy, strict=True):
        try:
            _, rotations, translations = cv2.solveP3P(points, pixels, camera.matrix, None, flags=cv2.SOLVEPNP_AP3P)
        except cv2.error:  # a degenerate sample, e.g. collinear points
            continue
        found.append(np.hstack([np.reshape(rotations, (-1, 3)), np.reshape(translations, (-1, 3))]))
    flat = np.concatenate(found)
    flat = flat[np.isfinite(flat).all(axis=1)]
    poses = np.tile(np.eye(4), (len(flat), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(flat[:, :3]).as_matrix()
    poses[:, :3, 3] = flat[:, 3:]
    return poses


def _inliers(poses: Array, position: Array, xy: Array, info: Array, camera: Camera) -> NDArray[np.bool_]:
    """Which points ``[H, N]`` each of the poses ``[H, 4, 4]`` explains."""
    local = np.swapaxes(poses[:, :3, :3] @ position.T + poses[:, :3, 3:], 1, 2)
    error = camera.project(local) - xy
    return np.asarray((local[..., 2] > 0.05) & (info * np.square(error).sum(axis=-1) < 2.0 * 5.991))


def pnp_poses(
    world: Map,
    keyframes: list[int],
    seen: Observations,
    settings: RelocalisationSettings,
    rng: np.random.Generator,
    min_inliers: int,
) -> Iterator[PnpPose]:
    """Poses that the keyframes support: a good one at once, the others after all were looked at, the best first.

    Args:
        world: The map.
        keyframes: Slots to match against; the ones with the most matches are tried first.
        seen: The frame's features.
        settings: Number of candidates and samples.
        rng: Draws RANSAC's samples.
        min_inliers: Inliers that the optimised pose needs.
    """
    if len(seen) < min_inliers:
        return
    matched = [(match_keyframe(world, keyframe, seen, settings.max_distance), keyframe) for keyframe in keyframes]
    matched = sorted(matched, key=lambda pair: (-len(pair[0]), -int(world.kf_id[pair[1]])))
    others: list[PnpPose] = []
    for matches, keyframe in matched[: settings.candidates]:
        if len(matches) < max(8, min_inliers // 3):
            break
        f = matches.feature
        found = ransac_pose(matches.position, seen.xy[f], seen.info[f], world.camera, settings.iterations, rng)
        if found is None or np.count_nonzero(found[1]) < 8:
            continue
        pose, inliers = found
        kept = matches.select(inliers)
        f = kept.feature
        estimate = optimise_pose(
            pose, kept.position, seen.xy[f], seen.right[f], seen.info[f], seen.info_right[f], world.camera
        )
        pose_there = PnpPose(keyframe, kept, estimate)
        if estimate.count >= 2 * min_inliers:
            yield pose_there
        else:
            others.append(pose_there)
    yield from sorted(others, key=lambda each: -each.estimate.count)


# Whether a frame really shows the place of a keyframe: everything around has to agree, not a few features.

Slots = NDArray[np.int64]

AROUND = 10
"""Keyframes around a place whose points are looked for."""
WIDEN = 2.0
"""Factor on the search windows: the first pose rests on few matches."""
ROUNDS = 6
"""So often, at most, the pose is fitted anew to what it let find: a small patch tells its surroundings alone well."""

INNER = 0.85
"""Share of the matches, those nearest their middle in the image, that have to tell the pose by themselves."""
DILUTED = 0.1
"""Dilution of precision at most: how uncertain the camera's place is, in median depths, by one match's worth of what
these tell."""
MIN_MATCHES = 12
"""Matches at least: a half of fewer tells no pose."""
SPLITS, MAX_SPLIT_SPREAD = 12, 0.01
"""Halves of the matches that are asked, and how far apart, in median depths, they may place the camera."""


@dataclass(frozen=True, eq=False)
class PlaceMatch:
    """A frame at the place of a keyframe.

    Attributes:
        T_cam_world: World-to-camera pose by the points around the keyframe.
        matches: The matches with points that fit it.
        share: How many of the keyframe's own points that should be in view, and behind nobody, are among them, of one.
    """

    T_cam_world: Array
    matches: Matches
    share: float

    @property
    def depth(self) -> float:
        """Median depth of what is seen."""
        return float(np.median(se3.transform(self.T_cam_world, self.matches.position)[:, 2]))


def verify_place(
    world: Map, keyframe: int, seen: Observations, first: Matches, T_cam_world: Array, settings: TrackingSettings
) -> PlaceMatch:
    """Look for all points around a keyframe, and fit the pose to them, again while that finds more.

    Args:
        world: The map.
        keyframe: Slot of the keyframe.
        seen: The frame's features.
        first: Matches that agree on the first pose.
        T_cam_world: That pose.
        settings: Radius and descriptor distances.
    """
    estimate, fitting, points = solve(world, seen, first, T_cam_world), first, points_around(world, keyframe)
    for _ in range(ROUNDS):
        known = len(fitting)
        more, _ = match_map(world, seen, estimate.T_cam_world, fitting, points, settings, WIDEN)
        joined = fitting.joined(more)
        estimate = solve(world, seen, joined, estimate.T_cam_world)
        fitting = joined.select(estimate.inliers)
        if len(fitting) <= known:
            break
    own = world.kf_point[keyframe]
    in_view, uv, *_ = world.project(estimate.T_cam_world, own[own >= 0].astype(np.int64))
    if seen.mask is not None:
        in_view = in_view[~_behind(seen.mask, uv)]
    share = float(np.isin(in_view, fitting.point).mean()) if len(in_view) else 0.0
    share = share if np.isfinite(estimate.T_cam_world).all() else 0.0
    return PlaceMatch(estimate.T_cam_world, fitting, share)


def pose_uncertainty(world: Map, seen: Observations, place: PlaceMatch, rng: np.random.Generator) -> float:
    """How badly what was recognised tells from where it is seen; one poster far away does not. Up to 1 is precise.

    How many matches there are says nothing of that: what was mapped a little bent is so for all of them. So they have
    to lie well; and a few far off the others, right or wrong, must not settle the pose, so that any half tells it.

    Args:
        world: The map.
        seen: The frame's features.
        place: Where they were recognised.
        rng: Draws the halves.
    """
    matches, T_cam_world = place.matches, place.T_cam_world
    xy, count = seen.xy[matches.feature], len(matches)
    if count < MIN_MATCHES or not np.isfinite(T_cam_world).all():
        return np.inf
    off = np.abs(xy - np.median(xy, axis=0)).max(axis=1)
    inner = solve(world, seen, matches.select(off <= np.quantile(off, INNER)), T_cam_world)
    if inner.count < MIN_MATCHES // 2 or not np.isfinite(inner.T_cam_world).all():
        return np.inf
    covariance = pose_covariance(inner.T_cam_world, inner.information, inner.count)
    diluted = np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])
    halves = [matches.select(rng.permutation(count) < count // 2) for _ in range(SPLITS)]
    centres = se3.inverse(np.array([solve(world, seen, half, T_cam_world).T_cam_world for half in halves]))[:, :3, 3]
    apart = np.sqrt(np.square(centres - np.median(centres, axis=0)).sum(axis=1).mean())
    worst = float(max(diluted / DILUTED, apart / MAX_SPLIT_SPREAD) / place.depth)
    return worst if np.isfinite(worst) else np.inf


def _behind(mask: NDArray[np.bool_], uv: Array) -> NDArray[np.bool_]:
    """Which undistorted pixels ``[N, 2]`` lie on a mask; the distortion is less than what masks are dilated by."""
    height, width = mask.shape
    column, row = np.rint(uv).astype(np.int64).T
    return np.asarray(mask[row.clip(0, height - 1), column.clip(0, width - 1)])


def around(world: Map, keyframe: int) -> Slots:
    """Slots of a keyframe, first, and of those that share most points with it."""
    near, _ = world.covisible(keyframe)
    return np.concatenate([[keyframe], near[:AROUND]]).astype(np.int64)


def points_around(world: Map, keyframe: int) -> Slots:
    """Slots of the points that these observe, ascending."""
    return distinct(world.kf_point[around(world, keyframe)], world.alive.size)


# Whether what a frame shows is found in more than one place: then it does not tell where it was taken.


LOOKED_AT = 12
"""Keyframes of each submap, those most alike, that are looked at."""
RIVAL = 0.33
"""What another place has to show, as a share of what the first one does. Where nothing repeats itself it is 0.15 at
most, where walls do 0.4 to 1 (rendered rooms, `docs/backend.md`)."""
APART_DEPTHS = 0.3
APART = np.radians(15.0)
"""Poses that far apart, in median depths of what is seen, or turned, are two places."""
MIN_POINTS = 30
"""Points that a place shows at least."""


@dataclass(frozen=True, eq=False)
class PlaceHypothesis:
    """A frame's pose by a place.

    Attributes:
        T_cam_world: World to camera, ``[4, 4]``.
        share: How much of what should be in view is, of one.
        depth: Median depth of what is seen.
    """

    T_cam_world: Array
    share: float
    depth: float

    def contradicts(self, other: PlaceHypothesis) -> bool:
        """Whether the frame cannot have been taken in both places."""
        between = self.T_cam_world @ se3.inverse(other.T_cam_world)
        far = np.linalg.norm(between[:3, 3]) > APART_DEPTHS * max(self.depth, other.depth)
        return bool(far or se3.rotation_angle(between) > APART)


def sight(place: PlaceMatch) -> PlaceHypothesis:
    """What a place that was recognised gives."""
    return PlaceHypothesis(place.T_cam_world, place.share, place.depth)


def ambiguous(
    world: Map,
    seen: Observations,
    known: dict[int, PlaceHypothesis],
    among: Slots,
    settings: BackendSettings,
    seed: int,
    possible: Callable[[int, Array], bool] = lambda _, __: True,
) -> bool:
    """Whether a frame's features are found in two places of one submap.

    Args:
        world: The map.
        seen: The features.
        known: What is known of the frame's pose, by submap.
        among: Slots of the keyframes whose places may be others.
        settings: Of tracking and relocalisation.
        seed: Founds RANSAC's draws.
        possible: Whether the frame can have been taken on an submap of this number with this world-to-camera pose.
    """
    enough = RIVAL * max(each.share for each in known.values())
    for submap in np.unique(world.kf_map[among]).tolist():
        sights = [known[submap]] if submap in known else []
        slots = among[world.kf_map[among] == submap]
        for slot in top_candidates(world, slots, seen, LOOKED_AT):
            other = _seen_from(world, slot, seen, settings, seed)
            if other is None or other.share < enough or not possible(submap, other.T_cam_world):
                continue
            if any(each.contradicts(other) for each in sights):
                return True
            sights.append(other)
    return False


def _seen_from(
    world: Map, slot: int, seen: Observations, settings: BackendSettings, seed: int
) -> PlaceHypothesis | None:
    """The pose by a keyframe's surroundings, if it shows enough of them."""
    matches = match_keyframe(world, slot, seen, settings.relocalisation.max_distance)
    if len(matches) < MIN_POINTS // 2:
        return None
    f, rng = matches.feature, stream(seed, "lookalikes", int(world.kf_id[slot]))
    found = ransac_pose(
        matches.position, seen.xy[f], seen.info[f], world.camera, settings.relocalisation.iterations, rng
    )
    if found is None or np.count_nonzero(found[1]) < MIN_POINTS // 3:
        return None
    place = verify_place(world, slot, seen, matches.select(found[1]), found[0], settings.tracking)
    return sight(place) if len(place.matches) >= MIN_POINTS else None
