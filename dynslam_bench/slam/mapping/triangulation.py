"""New points from two keyframes, for features whose depth the sensor does not give."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import kernel
from dynslam_bench.features.matching import FAR, Words, distance
from dynslam_bench.geometry.camera import Camera

from ..settings import MappingSettings
from .map import Map

Array = NDArray[np.float64]
Slots = NDArray[np.int64]

MAX_DISTANCE = 50
"""Largest Hamming distance of a match along an epipolar line (ORB-SLAM2's lower threshold)."""


@kernel
def _triangulate(
    pose_a: Array, pose_b: Array, rows_a: Slots, rows_b: Slots, xy_a: Array, xy_b: Array, z_b: Array,
    octave_a: Slots, octave_b: Slots, words_a: Words, words_b: Words, scales: Array,
    fx: float, fy: float, cx: float, cy: float, min_parallax: float, sigmas: float, max_distance: int,
) -> tuple[Slots, Slots, Array]:  # fmt: skip
    """Pairs of rows that fit one point, and its depth along the ray of camera `a`."""
    # x_b = r x_a + t
    r = np.zeros((3, 3))
    t = np.zeros(3)
    for i in range(3):
        for j in range(3):
            for k in range(3):
                r[i, j] += pose_b[i, k] * pose_a[j, k]
    for i in range(3):
        t[i] = pose_b[i, 3]
        for k in range(3):
            t[i] -= r[i, k] * pose_a[k, 3]
    n, m = rows_a.shape[0], rows_b.shape[0]
    partner = np.full(n, -1, np.int64)
    found_depth = np.zeros(n)
    owner = np.full(m, -1, np.int64)
    best_distance = np.full(n, FAR, np.int64)
    bx, by = np.empty(m), np.empty(m)
    for j in range(m):
        bx[j] = (xy_b[rows_b[j], 0] - cx) / fx
        by[j] = (xy_b[rows_b[j], 1] - cy) / fy
    cosine_limit = np.cos(min_parallax)
    focal = 0.5 * (fx + fy)
    for i in range(n):
        a = rows_a[i]
        x, y = (xy_a[a, 0] - cx) / fx, (xy_a[a, 1] - cy) / fy
        d0 = r[0, 0] * x + r[0, 1] * y + r[0, 2]
        d1 = r[1, 0] * x + r[1, 1] * y + r[1, 2]
        d2 = r[2, 0] * x + r[2, 1] * y + r[2, 2]
        # epipolar line of a's ray in b: t x d
        l0, l1, l2 = t[1] * d2 - t[2] * d1, t[2] * d0 - t[0] * d2, t[0] * d1 - t[1] * d0
        norm = np.sqrt(l0 * l0 + l1 * l1)
        if norm < 1e-9:
            continue
        length = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        for j in range(m):
            b = rows_b[j]
            sigma = scales[octave_b[b]] / focal
            off = (l0 * bx[j] + l1 * by[j] + l2) / norm
            if off * off > 3.84 * sigma * sigma:
                continue
            d = distance(words_a[a], words_b[b])
            if d > max_distance or d >= best_distance[i]:
                continue
            p0, p1 = d0 - bx[j] * d2, d1 - by[j] * d2
            q0, q1 = bx[j] * t[2] - t[0], by[j] * t[2] - t[1]
            cosine = (d0 * bx[j] + d1 * by[j] + d2) / (length * np.sqrt(bx[j] * bx[j] + by[j] * by[j] + 1.0))
            least = sigmas * max(scales[octave_a[a]], scales[octave_b[b]]) / focal
            if cosine < cosine_limit and cosine < 1.0 - 0.5 * least * least:
                s = (p0 * q0 + p1 * q1) / (p0 * p0 + p1 * p1)
            elif z_b[b] > 0.0 and abs(d2) > 1e-6:
                s = (z_b[b] - t[2]) / d2  # too little parallax, but the other keyframe has depth
            else:
                continue
            w = d2 * s + t[2]
            if s < 0.1 or w < 0.1 or s > 40.0:
                continue
            if z_b[b] > 0.0 and abs(w - z_b[b]) > 0.05 * z_b[b]:
                continue
            e0 = (d0 * s + t[0]) / w - bx[j]
            e1 = (d1 * s + t[1]) / w - by[j]
            if e0 * e0 + e1 * e1 > 5.991 * sigma * sigma:
                continue
            ratio = (s * np.sqrt(x * x + y * y + 1.0)) / (w * np.sqrt(bx[j] * bx[j] + by[j] * by[j] + 1.0))
            expected = scales[octave_b[b]] / scales[octave_a[a]]
            # the nearer view shows the patch larger, hence at a coarser octave
            if ratio > 1.8 * expected or ratio * 1.8 < expected:
                continue
            best_distance[i] = d
            partner[i] = j
            found_depth[i] = s
    for i in range(n):  # one feature of b for one of a: the smaller distance wins, then the lower index
        j = partner[i]
        if j >= 0 and (owner[j] < 0 or best_distance[i] < best_distance[owner[j]]):
            owner[j] = i
    count = 0
    out_a, out_b, out_z = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n)
    for i in range(n):
        if partner[i] >= 0 and owner[partner[i]] == i:
            out_a[count], out_b[count], out_z[count] = rows_a[i], rows_b[partner[i]], found_depth[i]
            count += 1
    return out_a[:count].copy(), out_b[:count].copy(), out_z[:count].copy()


def triangulate(world: Map, slot: int, other: int, settings: MappingSettings) -> tuple[Slots, Slots, Array]:
    """Features of two keyframes that observe no point yet and show one point along an epipolar line.

    Where the parallax is too small for a depth of its own, the other keyframe's measured depth is taken; where it is
    large enough, a measured depth must agree.

    Args:
        world: The map.
        slot: The new keyframe.
        other: One that sees the same part of the world.
        settings: Smallest angle between the rays of a triangulated point, and how far above their noise it must be.

    Returns:
        Features of `slot`, features of `other`, world points ``[M, 3]``.
    """
    n, m = int(world.kf_count[slot]), int(world.kf_count[other])
    camera: Camera = world.camera
    ours, theirs, depth = _triangulate(
        world.kf_pose[slot], world.kf_pose[other],
        np.flatnonzero(world.kf_point[slot, :n] < 0), np.flatnonzero(world.kf_point[other, :m] < 0),
        world.kf_xy[slot], world.kf_xy[other], world.kf_z[other].astype(np.float64),
        world.kf_octave[slot].astype(np.int64), world.kf_octave[other].astype(np.int64),
        world.kf_words[slot], world.kf_words[other], world.scales,
        camera.fx, camera.fy, camera.cx, camera.cy, float(np.deg2rad(settings.min_parallax_deg)),
        float(settings.min_parallax_sigmas), MAX_DISTANCE,
    )  # fmt: skip
    pose = world.T_world_cam(slot)
    local = camera.unproject(world.kf_xy[slot, ours], depth)
    return ours, theirs, local @ pose[:3, :3].T + pose[:3, 3]
