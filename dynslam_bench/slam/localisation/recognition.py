"""Whether a frame really shows the place of a keyframe: everything around has to agree, not a few features.

A few dozen matches that fit a pose are found between places that only have something in common, such as the same
shelf or poster. What was mapped around the keyframe and should be in view then is not there. What somebody stands in
front of is not expected to be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..mapping.map import Map
from ..settings import TrackingSettings
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
    return Recognised(estimate.T_cam_world, fitting, share if np.isfinite(estimate.T_cam_world).all() else 0.0)


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
    table = world.kf_point[around(world, keyframe)]
    return np.unique(table[table >= 0]).astype(np.int64)
