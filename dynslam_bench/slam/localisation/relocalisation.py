"""Finding the pose without a prediction: descriptor matching against keyframes, then PnP with RANSAC."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.features.matching import match_brute_force
from dynslam_bench.geometry.camera import Camera

from ..mapping.map import Map
from ..settings import RelocalisationSettings
from .observation import Observations
from .pose import PoseEstimate, optimise_pose
from .tracking import Matches

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Relocalised:
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
        The world-to-camera pose with the most inliers and its inliers; None if no sample gave a pose.
    """
    n = len(position)
    if n < 4:
        return None
    best: tuple[Array, NDArray[np.bool_]] | None = None
    best_count = 3
    needed = iterations
    drawn = 0
    while drawn < min(needed, iterations):
        drawn += 1
        sample = rng.choice(n, 3, replace=False)
        try:
            _, rotations, translations = cv2.solveP3P(
                position[sample], xy[sample], camera.matrix, None, flags=cv2.SOLVEPNP_AP3P
            )
        except cv2.error:  # a degenerate sample, e.g. collinear points
            continue
        for rotation, translation in zip(rotations, translations, strict=True):
            pose = np.eye(4)
            pose[:3, :3] = cv2.Rodrigues(rotation)[0]
            pose[:3, 3] = np.asarray(translation).ravel()
            if not np.isfinite(pose).all():
                continue
            inliers = _inliers(pose, position, xy, info, camera)
            count = int(np.count_nonzero(inliers))
            if count > best_count:
                best, best_count = (pose, inliers), count
                share = min(count / n, 0.999)
                needed = int(np.ceil(np.log(0.001) / np.log1p(-(share**3)))) + 1
    return best


def _inliers(pose: Array, position: Array, xy: Array, info: Array, camera: Camera) -> NDArray[np.bool_]:
    local = position @ pose[:3, :3].T + pose[:3, 3]
    ahead = local[:, 2] > 0.05
    error = camera.project(np.where(ahead[:, None], local, [0.0, 0.0, 1.0])) - xy
    return np.asarray(ahead & (info * (error**2).sum(axis=1) < 2.0 * 5.991))


def locate(
    world: Map,
    keyframes: list[int],
    seen: Observations,
    settings: RelocalisationSettings,
    rng: np.random.Generator,
    min_inliers: int,
) -> Relocalised | None:
    """The best pose that any of the keyframes supports.

    Args:
        world: The map.
        keyframes: Slots to match against; the ones with the most matches are tried first.
        seen: The frame's features.
        settings: Number of candidates and samples.
        rng: Draws RANSAC's samples.
        min_inliers: Inliers that the optimised pose needs.
    """
    if len(seen) < min_inliers:
        return None
    matched = [(match_keyframe(world, keyframe, seen, settings.max_distance), keyframe) for keyframe in keyframes]
    matched = sorted(matched, key=lambda pair: (-len(pair[0]), -int(world.kf_id[pair[1]])))
    best: Relocalised | None = None
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
        if best is None or estimate.count > best.estimate.count:
            best = Relocalised(keyframe, kept, estimate)
        if best.estimate.count >= 2 * min_inliers:
            break
    return best
