"""Finding the pose without a prediction: descriptor matching against keyframes, then PnP with RANSAC."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dynslam_bench.features.matching import match_brute_force
from dynslam_bench.geometry.camera import Camera

from ..mapping.map import Map
from ..settings import RelocalisationSettings
from .observation import Observations
from .pose import PoseEstimate, optimise_pose
from .tracking import Matches

Array = NDArray[np.float64]

BATCH = 25
"""Samples that are drawn and judged together."""


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


def located(
    world: Map,
    keyframes: list[int],
    seen: Observations,
    settings: RelocalisationSettings,
    rng: np.random.Generator,
    min_inliers: int,
) -> Iterator[Relocalised]:
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
    others: list[Relocalised] = []
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
        pose_there = Relocalised(keyframe, kept, estimate)
        if estimate.count >= 2 * min_inliers:
            yield pose_there
        else:
            others.append(pose_there)
    yield from sorted(others, key=lambda each: -each.estimate.count)
