"""Compiled loops over the map's tables; `map.py` holds the tables and documents them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import kernel
from dynslam_bench.features.matching import distance

Array = NDArray[np.float64]
Ints = NDArray[np.int32]
Table = NDArray[np.int32]


@kernel
def fullest(n_obs: Ints, points: NDArray[np.int64]) -> int:
    """Largest number of observations among the points."""
    most = 0
    for i in range(points.shape[0]):
        most = max(most, n_obs[points[i]])
    return most


@kernel
def link(
    obs_kf: Table, obs_ft: Table, n_obs: Ints, kf_point: Table, keyframe: int, features: NDArray[np.int64],
    points: NDArray[np.int64],
) -> None:  # fmt: skip
    """Note that the keyframe's features observe the points; a pair that would be a second observation is skipped."""
    for i in range(points.shape[0]):
        p, f = points[i], features[i]
        if kf_point[keyframe, f] >= 0:
            continue
        seen = False
        for k in range(n_obs[p]):
            if obs_kf[p, k] == keyframe:
                seen = True
        if seen:
            continue
        obs_kf[p, n_obs[p]] = keyframe
        obs_ft[p, n_obs[p]] = f
        n_obs[p] += 1
        kf_point[keyframe, f] = p


@kernel
def unlink(obs_kf: Table, obs_ft: Table, n_obs: Ints, kf_point: Table, keyframe: int, feature: int) -> None:
    """Forget one observation; the order of the others is kept."""
    p = kf_point[keyframe, feature]
    if p < 0:
        return
    kf_point[keyframe, feature] = -1
    out = 0
    for k in range(n_obs[p]):
        if obs_kf[p, k] == keyframe and obs_ft[p, k] == feature:
            continue
        obs_kf[p, out] = obs_kf[p, k]
        obs_ft[p, out] = obs_ft[p, k]
        out += 1
    n_obs[p] = out


@kernel
def unlink_many(
    obs_kf: Table,
    obs_ft: Table,
    n_obs: Ints,
    kf_point: Table,
    keyframes: NDArray[np.int64],
    features: NDArray[np.int64],
) -> None:
    """Forget several observations."""
    for i in range(keyframes.shape[0]):
        unlink(obs_kf, obs_ft, n_obs, kf_point, keyframes[i], features[i])


@kernel
def drop_points(obs_kf: Table, obs_ft: Table, n_obs: Ints, kf_point: Table, points: NDArray[np.int64]) -> None:
    """Remove all observations of the points."""
    for i in range(points.shape[0]):
        p = points[i]
        for k in range(n_obs[p]):
            kf_point[obs_kf[p, k], obs_ft[p, k]] = -1
        n_obs[p] = 0


@kernel
def merge(obs_kf: Table, obs_ft: Table, n_obs: Ints, kf_point: Table, old: int, new: int) -> None:
    """Hand the observations of `old` to `new`; where both are seen in one keyframe, `new`'s stays."""
    for k in range(n_obs[old]):
        kf, ft = obs_kf[old, k], obs_ft[old, k]
        kf_point[kf, ft] = -1
        seen = False
        for m in range(n_obs[new]):
            if obs_kf[new, m] == kf:
                seen = True
        if not seen:
            obs_kf[new, n_obs[new]] = kf
            obs_ft[new, n_obs[new]] = ft
            n_obs[new] += 1
            kf_point[kf, ft] = new
    n_obs[old] = 0


@kernel
def covisibility(obs_kf: Table, n_obs: Ints, points: Ints, slots: int) -> NDArray[np.int64]:
    """How many of the points each keyframe slot observes."""
    counts = np.zeros(slots, np.int64)
    for i in range(points.shape[0]):
        p = points[i]
        if p >= 0:
            for k in range(n_obs[p]):
                counts[obs_kf[p, k]] += 1
    return counts


@kernel
def refresh(
    points: NDArray[np.int64], position: Array, normal: Array, far: Array, words: Any,
    obs_kf: Table, obs_ft: Table, n_obs: Ints, kf_words: Any, kf_octave: Any, kf_centre: Array, scales: Array,
) -> None:  # fmt: skip
    """Renew descriptor (the medoid of the observed ones), viewing direction and scale range of the points."""
    for i in range(points.shape[0]):
        p = points[i]
        n = n_obs[p]
        if n == 0:
            continue
        m = min(n, 12)  # the newest observations stand for all
        best = n - 1
        if m > 2:
            best_score = 1 << 40
            for a in range(n - m, n):
                score = 0
                for b in range(n - m, n):
                    score += distance(kf_words[obs_kf[p, a], obs_ft[p, a]], kf_words[obs_kf[p, b], obs_ft[p, b]])
                if score < best_score:
                    best, best_score = a, score
        for w in range(words.shape[1]):  # whole rows would compile a message for shapes that differ, seconds of it
            words[p, w] = kf_words[obs_kf[p, best], obs_ft[p, best], w]
        sx, sy, sz = 0.0, 0.0, 0.0
        reach = 0.0
        for k in range(n):
            c = kf_centre[obs_kf[p, k]]
            x, y, z = position[p, 0] - c[0], position[p, 1] - c[1], position[p, 2] - c[2]
            d = np.sqrt(x * x + y * y + z * z) + 1e-12
            sx += x / d
            sy += y / d
            sz += z / d
            if k == 0:
                reach = d * scales[kf_octave[obs_kf[p, k], obs_ft[p, k]]]
        length = np.sqrt(sx * sx + sy * sy + sz * sz) + 1e-12
        normal[p, 0], normal[p, 1], normal[p, 2] = sx / length, sy / length, sz / length
        far[p] = reach


@kernel
def project(
    pose: Array, candidates: NDArray[np.int64], position: Array, normal: Array, far: Array,
    fx: float, fy: float, cx: float, cy: float, bf: float, width: float, height: float, scale_factor: float,
    levels: int, min_cosine: float, wide: float,
) -> tuple[NDArray[np.int64], Array, Array, NDArray[np.int64], Array]:  # fmt: skip
    """The candidate points that the camera should see: in the image, at a fit distance, from a fit side.

    Returns:
        Points, pixels, right coordinates, predicted octaves and cosines of the viewing angle.
    """
    n = candidates.shape[0]
    index = np.empty(n, np.int64)
    uv = np.empty((n, 2))
    right = np.empty(n)
    octave = np.empty(n, np.int64)
    cosine = np.empty(n)
    r, t = pose[:3, :3], pose[:3, 3]
    ox = -(r[0, 0] * t[0] + r[1, 0] * t[1] + r[2, 0] * t[2])
    oy = -(r[0, 1] * t[0] + r[1, 1] * t[1] + r[2, 1] * t[2])
    oz = -(r[0, 2] * t[0] + r[1, 2] * t[1] + r[2, 2] * t[2])
    nearest = scale_factor ** (levels - 1)
    inverse_log = 1.0 / np.log(scale_factor)
    count = 0
    for i in range(n):
        p = candidates[i]
        x, y, z = position[p, 0], position[p, 1], position[p, 2]
        zc = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        if zc < 0.05:
            continue
        u = fx * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]) / zc + cx
        v = fy * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]) / zc + cy
        if u < 0.0 or u >= width or v < 0.0 or v >= height:
            continue
        dx, dy, dz = x - ox, y - oy, z - oz
        d = np.sqrt(dx * dx + dy * dy + dz * dz)
        if d > wide * far[p] or d * wide < far[p] / nearest:
            continue
        c = (dx * normal[p, 0] + dy * normal[p, 1] + dz * normal[p, 2]) / d
        if c < min_cosine:
            continue
        level = int(np.ceil(np.log(far[p] / d) * inverse_log - 1e-9))
        index[count] = p
        uv[count, 0], uv[count, 1] = u, v
        right[count] = u - bf / zc
        octave[count] = min(max(level, 0), levels - 1)
        cosine[count] = c
        count += 1
    return index[:count].copy(), uv[:count].copy(), right[:count].copy(), octave[:count].copy(), cosine[:count].copy()


@kernel
def redundancy(
    keyframe: int, count: int, kf_point: Table, kf_octave: Any, kf_z: Any, close: float,
    obs_kf: Table, obs_ft: Table, n_obs: Ints, others: int,
) -> tuple[int, int]:  # fmt: skip
    """How many close points the keyframe observes, and how many of them `others` keyframes see as well or finer."""
    total, redundant = 0, 0
    for f in range(count):
        p = kf_point[keyframe, f]
        if p < 0 or kf_z[keyframe, f] <= 0.0 or kf_z[keyframe, f] > close:
            continue
        total += 1
        if n_obs[p] <= others:
            continue
        fine = 0
        for k in range(n_obs[p]):
            if obs_kf[p, k] != keyframe and kf_octave[obs_kf[p, k], obs_ft[p, k]] <= kf_octave[keyframe, f] + 1:
                fine += 1
        redundant += fine >= others
    return total, redundant
