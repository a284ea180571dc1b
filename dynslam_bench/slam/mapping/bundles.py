"""Which poses, points and observations a bundle adjustment takes from the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..bundle.schur import BundleProblem
from ..settings import BundleAdjustmentSettings
from .map import Map

Slots = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Bundle:
    """A bundle adjustment, and where its parts lie in the map.

    Attributes:
        problem: What is to be solved.
        poses: Slots of its keyframes ``[P]``.
        points: Slots of its points ``[Q]``.
        features: Feature number of each observation ``[N]``.
    """

    problem: BundleProblem
    poses: Slots
    points: Slots
    features: Slots


def around(world: Map, slot: int, settings: BundleAdjustmentSettings) -> Bundle | None:
    """The local window around a keyframe, cut to the observation budget; None if there is nothing to refine.

    Variable are the keyframe and its most covisible ones; fixed are further keyframes that see the same points, and
    always at least one. The oldest keyframe of all is never variable.
    """
    near, _ = world.covisible(slot)
    variable = np.concatenate([[slot], near[: settings.window - 1]]).astype(np.int64)
    variable = variable[world.kf_id[variable] > 0]
    if not len(variable):
        return None
    table = world.kf_point[variable]
    counts = np.bincount(table[table >= 0].astype(np.int64), minlength=world.alive.size)
    points = np.flatnonzero(counts)
    further, _ = world.covisible_of(points)
    further = further[~np.isin(further, variable)][: settings.fixed]
    if not len(further):
        if len(variable) < 2:
            return None
        further, variable = variable[-1:], variable[:-1]
    return _bundle(world, variable, further, points, settings.observations)


def whole(world: Map) -> Bundle | None:
    """All keyframes and points; the oldest keyframe stays. None if there are no two keyframes."""
    keyframes = world.keyframes
    if len(keyframes) < 2:
        return None
    return _bundle(world, keyframes[1:], keyframes[:1], world.points, int(world.n_obs[world.points].sum()))


def _bundle(world: Map, variable: Slots, fixed: Slots, points: Slots, observations: int) -> Bundle | None:
    poses = np.concatenate([variable, fixed])
    rank = np.full(world.kf_alive.size, -1, np.int64)
    rank[poses] = np.arange(len(poses))
    n_obs = world.n_obs[points]
    width = int(n_obs.max(initial=0))
    valid = np.arange(width)[None] < n_obs[:, None]
    keyframe = world.obs_kf[points, :width]
    pose = np.where(valid, rank[keyframe], -1)
    used = pose >= 0
    support = used.sum(axis=1)
    worth = support >= 2
    points, pose, used, support = points[worth], pose[worth], used[worth], support[worth]
    order = np.lexsort((world.id[points], -support))  # long tracks first
    order = order[np.cumsum(support[order]) <= observations]
    order.sort()
    points, pose, used = points[order], pose[order], used[order]
    if not len(points):
        return None
    obs_point, column = np.nonzero(used)
    obs_pose = pose[obs_point, column]
    features = world.obs_ft[points[obs_point], column].astype(np.int64)
    at = poses[obs_pose]
    problem = BundleProblem(
        world.kf_pose[poses], len(variable), world.position[points], obs_pose.astype(np.int64),
        obs_point.astype(np.int64), world.kf_xy[at, features], world.kf_right[at, features],
        world.kf_info[at, features], world.kf_info_right[at, features], world.camera,
    )  # fmt: skip
    return Bundle(problem, poses, points, features)
