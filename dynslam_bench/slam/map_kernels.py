"""Compiled loops over the map's tables; `map.py` holds the tables and documents them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import kernel
from dynslam_bench.features.matching import distance

Array = NDArray[np.float64]
Ints = NDArray[np.int32]
Slots = NDArray[np.int64]
Table = NDArray[np.int32]
Flags = NDArray[np.bool_]

MIN_COSINE = 0.5
"""Smallest cosine between a point's mean viewing direction and the ray to the camera (ORB-SLAM2's number)."""
WIDEN_RANGE = 1.25
"""Factor by which the scale range of a point is widened."""


@kernel
def move(obs_kf: Ints, obs_ft: Ints, obs_at: Slots, n_obs: Ints, points: Slots, to: Slots) -> None:
    """Move the observations of the points to where there is more room."""
    for i in range(points.shape[0]):
        p = points[i]
        for k in range(n_obs[p]):
            obs_kf[to[i] + k] = obs_kf[obs_at[p] + k]
            obs_ft[to[i] + k] = obs_ft[obs_at[p] + k]
        obs_at[p] = to[i]


@kernel
def link(
    obs_kf: Ints, obs_ft: Ints, obs_at: Slots, n_obs: Ints, kf_point: Table, keyframe: int, features: Slots,
    points: Slots,
) -> None:  # fmt: skip
    """Add observations of the points by the keyframe's features; a second one by the same keyframe is skipped."""
    for i in range(points.shape[0]):
        p, f = points[i], features[i]
        if kf_point[keyframe, f] >= 0:
            continue
        observed = False
        begin, end = obs_at[p], obs_at[p] + n_obs[p]
        for o in range(begin, end):
            if obs_kf[o] == keyframe:
                observed = True
        if observed:
            continue
        obs_kf[end] = keyframe
        obs_ft[end] = f
        n_obs[p] += 1
        kf_point[keyframe, f] = p


@kernel
def unlink(
    obs_kf: Ints, obs_ft: Ints, obs_at: Slots, n_obs: Ints, kf_point: Table, keyframe: int, feature: int
) -> None:
    """Remove one observation; the order of the others is kept."""
    p = kf_point[keyframe, feature]
    if p < 0:
        return
    kf_point[keyframe, feature] = -1
    begin, out = obs_at[p], obs_at[p]
    for o in range(begin, begin + n_obs[p]):
        if obs_kf[o] == keyframe and obs_ft[o] == feature:
            continue
        obs_kf[out] = obs_kf[o]
        obs_ft[out] = obs_ft[o]
        out += 1
    n_obs[p] = out - begin


@kernel
def unlink_many(
    obs_kf: Ints, obs_ft: Ints, obs_at: Slots, n_obs: Ints, kf_point: Table, keyframes: Slots, features: Slots
) -> None:
    """Remove several observations."""
    for i in range(keyframes.shape[0]):
        unlink(obs_kf, obs_ft, obs_at, n_obs, kf_point, keyframes[i], features[i])


@kernel
def drop_points(obs_kf: Ints, obs_ft: Ints, obs_at: Slots, n_obs: Ints, kf_point: Table, points: Slots) -> None:
    """Remove all observations of the points."""
    for i in range(points.shape[0]):
        p = points[i]
        for o in range(obs_at[p], obs_at[p] + n_obs[p]):
            kf_point[obs_kf[o], obs_ft[o]] = -1
        n_obs[p] = 0


@kernel
def merge(obs_kf: Ints, obs_ft: Ints, obs_at: Slots, n_obs: Ints, kf_point: Table, old: int, new: int) -> None:
    """Move the observations of `old` to `new`; where one keyframe observes both, that of `new` stays."""
    for o in range(obs_at[old], obs_at[old] + n_obs[old]):
        kf, ft = obs_kf[o], obs_ft[o]
        kf_point[kf, ft] = -1
        observed = False
        begin, end = obs_at[new], obs_at[new] + n_obs[new]
        for other in range(begin, end):
            if obs_kf[other] == kf:
                observed = True
        if not observed:
            obs_kf[end] = kf
            obs_ft[end] = ft
            n_obs[new] += 1
            kf_point[kf, ft] = new
    n_obs[old] = 0


@kernel
def covisibility(obs_kf: Ints, obs_at: Slots, n_obs: Ints, points: Ints, slots: int) -> Slots:
    """How many of the points each keyframe slot observes."""
    counts = np.zeros(slots, np.int64)
    for i in range(points.shape[0]):
        p = points[i]
        if p >= 0:
            for o in range(obs_at[p], obs_at[p] + n_obs[p]):
                counts[obs_kf[o]] += 1
    return counts


@kernel
def distinct(table: Table, most: int) -> Slots:
    """Points below `most` that a table ``[K, F]`` of observations names, each once, ascending; -1 is none."""
    named, count, least, last = np.zeros(most, np.bool_), 0, most, -1
    for k in range(table.shape[0]):
        for f in range(table.shape[1]):
            p = table[k, f]
            if p >= 0 and not named[p]:
                named[p] = True
                count += 1
                least, last = min(least, p), max(last, p)
    points = np.empty(count, np.int64)
    at = 0
    for p in range(least, last + 1):
        if named[p]:
            points[at] = p
            at += 1
    return points


@kernel
def refresh(
    points: Slots, position: Array, normal: Array, far: Array, words: Any, obs_kf: Ints, obs_ft: Ints, obs_at: Slots,
    n_obs: Ints, kf_words: Any, kf_octave: Any, kf_centre: Array, scales: Array,
) -> None:  # fmt: skip
    """Renew descriptor (the medoid of the observed ones), viewing direction and scale range of the points."""
    for i in range(points.shape[0]):
        p = points[i]
        n = n_obs[p]
        if n == 0:
            continue
        begin, end = obs_at[p], obs_at[p] + n
        m = min(n, 12)  # only the newest observations count
        best = end - 1
        if m > 2:
            best_score = 1 << 40
            for a in range(end - m, end):
                score = 0
                for b in range(end - m, end):
                    score += distance(kf_words[obs_kf[a], obs_ft[a]], kf_words[obs_kf[b], obs_ft[b]])
                if score < best_score:
                    best, best_score = a, score
        for w in range(words.shape[1]):  # whole rows would compile a message for shapes that differ, seconds of it
            words[p, w] = kf_words[obs_kf[best], obs_ft[best], w]
        sx, sy, sz = 0.0, 0.0, 0.0
        reference_distance = 0.0
        for o in range(begin, end):
            c = kf_centre[obs_kf[o]]
            x, y, z = position[p, 0] - c[0], position[p, 1] - c[1], position[p, 2] - c[2]
            d = np.sqrt(x * x + y * y + z * z) + 1e-12
            sx += x / d
            sy += y / d
            sz += z / d
            if o == begin:
                reference_distance = d * scales[kf_octave[obs_kf[o], obs_ft[o]]]
        length = np.sqrt(sx * sx + sy * sy + sz * sz) + 1e-12
        normal[p, 0], normal[p, 1], normal[p, 2] = sx / length, sy / length, sz / length
        far[p] = reference_distance


@kernel
def project(
    pose: Array, candidates: NDArray[np.int64], position: Array, normal: Array, far: Array,
    fx: float, fy: float, cx: float, cy: float, bf: float, width: float, height: float, scale_factor: float,
    levels: int,
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
        if d > WIDEN_RANGE * far[p] or d * WIDEN_RANGE < far[p] / nearest:
            continue
        c = (dx * normal[p, 0] + dy * normal[p, 1] + dz * normal[p, 2]) / d
        if c < MIN_COSINE:
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
    keyframe: int, close: Flags, kf_point: Table, kf_octave: Any,
    obs_kf: Ints, obs_ft: Ints, obs_at: Slots, n_obs: Ints, others: int,
) -> tuple[int, int]:  # fmt: skip
    """Close points that the keyframe observes, and those that `others` see, at most one octave coarser."""
    total, redundant = 0, 0
    for f in range(close.shape[0]):
        p = kf_point[keyframe, f]
        if p < 0 or not close[f]:
            continue
        total += 1
        if n_obs[p] <= others:
            continue
        fine = 0
        for o in range(obs_at[p], obs_at[p] + n_obs[p]):
            if obs_kf[o] != keyframe and kf_octave[obs_kf[o], obs_ft[o]] <= kf_octave[keyframe, f] + 1:
                fine += 1
        redundant += fine >= others
    return total, redundant
