"""Which poses, points and observations a bundle adjustment takes from the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..bundle.schur import BundleProblem
from ..settings import BundleAdjustmentSettings
from .map import Map
from .map_kernels import distinct

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
    points = distinct(world.kf_point[variable], world.alive.size)
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
    rows = world.observations(points)
    of_point, pose = np.repeat(np.arange(len(points)), world.n_obs[points]), rank[world.obs_kf[rows]]
    support = np.bincount(of_point[pose >= 0], minlength=len(points))
    worth = np.flatnonzero(support >= 2)
    order = worth[np.lexsort((world.id[points[worth]], -support[worth]))]  # long tracks first
    order = order[np.cumsum(support[order]) <= observations]
    order.sort()
    if not len(order):
        return None
    number = np.full(len(points), -1, np.int64)
    number[order] = np.arange(len(order))
    used = (pose >= 0) & (number[of_point] >= 0)
    obs_point, obs_pose, points = number[of_point[used]], pose[used], points[order]
    features = world.obs_ft[rows[used]].astype(np.int64)
    at = poses[obs_pose]
    problem = BundleProblem(
        world.kf_pose[poses], len(variable), world.position[points], obs_pose, obs_point,
        world.kf_xy[at, features], world.kf_right[at, features], world.kf_info[at, features],
        world.kf_info_right[at, features], world.camera,
    )  # fmt: skip
    return Bundle(problem, poses, points, features)
