"""Whether a frame really shows the place of a keyframe: everything around has to agree, not a few features.

A few dozen matches that fit a pose are found between places that only have something in common, such as the same
shelf or poster. What was mapped around the keyframe and should be in view then is not there. What somebody stands in
front of is not expected to be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.geometry import se3

from ..mapping.map import Map
from ..mapping.map_kernels import distinct
from ..settings import TrackingSettings
from .motion_model import pose_covariance
from .observation import Observations
from .tracking import Matches, match_map, solve

Array = NDArray[np.float64]
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
FEWEST = 12
"""Matches at least: a half of fewer tells no pose."""
HALVES, APART = 12, 0.01
"""Halves of the matches that are asked, and how far apart, in median depths, they may place the camera."""


@dataclass(frozen=True, eq=False)
class Recognised:
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


def recognise(
    world: Map, keyframe: int, seen: Observations, first: Matches, T_cam_world: Array, settings: TrackingSettings
) -> Recognised:
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
    return Recognised(estimate.T_cam_world, fitting, share)


def imprecision(world: Map, seen: Observations, place: Recognised, rng: np.random.Generator) -> float:
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
    if count < FEWEST or not np.isfinite(T_cam_world).all():
        return np.inf
    off = np.abs(xy - np.median(xy, axis=0)).max(axis=1)
    inner = solve(world, seen, matches.select(off <= np.quantile(off, INNER)), T_cam_world)
    if inner.count < FEWEST // 2 or not np.isfinite(inner.T_cam_world).all():
        return np.inf
    covariance = pose_covariance(inner.T_cam_world, inner.information, inner.count)
    diluted = np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])
    halves = [matches.select(rng.permutation(count) < count // 2) for _ in range(HALVES)]
    centres = se3.inverse(np.array([solve(world, seen, half, T_cam_world).T_cam_world for half in halves]))[:, :3, 3]
    apart = np.sqrt(np.square(centres - np.median(centres, axis=0)).sum(axis=1).mean())
    worst = float(max(diluted / DILUTED, apart / APART) / place.depth)
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
