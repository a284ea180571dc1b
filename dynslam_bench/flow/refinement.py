"""Photometric refinement of labels: Lucas-Kanade with four degrees of freedom.

Inverse compositional (Baker and Matthews 2004): template gradients and Hessian are computed once a
point, the label's warp is updated until it converges. Patch means are removed, so that a change of
brightness has no influence.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dynslam_bench.core.compiled import Scalar, inlined, kernel
from dynslam_bench.core.simd import (
    Bytes,
    Floats,
    Ints,
    load,
    load_bytes,
    sample,
    spread,
    square,
    store,
    store_offsets,
    total,
)
from dynslam_bench.geometry.gauss_newton import cholesky_solve

BORDER = 48
"""Pixels repeated around the images that are refined on."""
FLAT_VARIANCE = 1.0
"""Below this variance, in squared grey levels, a window is flat."""
FLAT_GRADIENT = 4.0 * 0.05
"""Smallest mean squared gradient along the worse direction: 0.05 squared levels a pixel, differences over two."""
SIMILARITY_DAMPING = 0.1
"""Prior on the change of scale and rotation, relative to the translation's information at the window's edge."""


class Window(NamedTuple):
    """The square window that is aligned, and when to stop.

    Attributes:
        step: Full-image pixels a pixel of the images.
        radius: In pixels of the images.
        margin: Largest translation within one warp, in their pixels, at least 1.
        warps: Times the target is warped, at most: once, or twice with a change of scale and
            rotation between.
        iterations: Translations a warp, at most.
        tolerance: Stop below this change, in their pixels.
    """

    step: int
    radius: int
    margin: int
    warps: int
    iterations: int = 3
    tolerance: np.float32 = np.float32(0.03)


@inlined
def read_frame(image: Bytes, x: Scalar, y: Scalar, rows: int, pitch: int, out: Floats) -> None:
    """Bilinear samples, one pixel apart, of `rows` rows of `pitch` columns from position (x, y) on."""
    flat = image.reshape(-1)
    stride = np.int64(image.shape[1])
    column = np.int64(x)
    row = np.int64(y)
    right = spread(x - np.float32(column))
    lower = spread(y - np.float32(row))
    for block in range((pitch + 15) // 16):
        first = min(16 * block, max(pitch - 16, 0))
        at = row * stride + column + first
        before = load_bytes(flat, at)
        before = before + right * (load_bytes(flat, at + 1) - before)
        for r in range(rows):
            at += stride
            after = load_bytes(flat, at)
            after = after + right * (load_bytes(flat, at + 1) - after)
            store(out, r * pitch + first, before + lower * (after - before))
            before = after


@inlined
def warp_patch(
    image: Bytes, x: Scalar, y: Scalar, a: Scalar, b: Scalar, reach: int, columns: Ints, rows: Ints, scratch: Ints,
    out: Floats,
) -> None:  # fmt: skip
    """Samples of a square patch of radius `reach` under the similarity ``[[a, -b], [b, a]]`` around (x, y)."""
    one = np.float32(65536)
    far = np.float32(reach)
    column = np.int32((x - a * far + b * far) * one)
    row = np.int32((y - b * far - a * far) * one)
    step_x = np.int32(a * one)
    step_y = np.int32(b * one)
    flat = image.reshape(-1)
    stride = np.int64(image.shape[1])
    for k in range(0, len(columns), 16):
        store_offsets(scratch, columns, rows, k, column, row, step_x, step_y, np.int32(stride))
    for k in range(len(columns)):
        scratch[k] = square(flat, np.int64(scratch[k]), stride)
    for k in range(0, len(columns), 16):
        store(out, k, sample(scratch, columns, rows, k, column, row, step_x, step_y))


@kernel
def similarity_lucas_kanade(
    start: int, stop: int, points: Floats, labels: Floats, template_image: Bytes, target_image: Bytes, window: Window,
    correlation: Floats,
) -> None:  # fmt: skip
    """Refine labels by photometric alignment of a square window.

    The target is warped by the label into the template's frame. Within that patch only the
    translation changes (cheap); between two warps scale and rotation are corrected as well. A label
    changes only if the windows' correlation grows.

    All windows are flat arrays at the patch's pitch, so that a shift by whole pixels is an offset.
    Elements outside the window have zero gradients and mask.

    Args:
        start: First point.
        stop: One past the last.
        points: float32 ``[N, 2]``, full-image pixels of the template image.
        labels: float32 ``[N, 4]``, changed in place.
        template_image: uint8 ``[h + 2 BORDER, w + 2 BORDER]``, at 1 / `step` of the full
            resolution, edges repeated.
        target_image: Likewise.
        window: `Window`, and when to stop.
        correlation: float32 ``[N]``, filled with the windows' zero-mean normalised correlation, -1
            if flat or outside.
    """
    step, radius, margin, warps, iterations, tolerance = window
    border = BORDER
    side = 2 * radius + 1
    reach = radius + margin
    pitch = 2 * reach + 1
    length = 16 * ((side * pitch + 15) // 16)
    slack = 2 * pitch + 32
    patch = np.zeros(16 * ((pitch * pitch + 15) // 16) + slack, dtype=np.float32)
    grid_columns = np.zeros(len(patch) - slack, dtype=np.int32)
    grid_rows = np.zeros(len(patch) - slack, dtype=np.int32)
    scratch = np.empty(len(patch) - slack, dtype=np.int32)
    for k in range(pitch * pitch):
        grid_columns[k] = k % pitch
        grid_rows[k] = k // pitch
    frame = np.zeros((side + 2) * pitch + slack, dtype=np.float32)
    template = np.zeros(length, dtype=np.float32)
    mask = np.zeros(length, dtype=np.float32)
    gradient_x = np.zeros(length, dtype=np.float32)
    gradient_y = np.zeros(length, dtype=np.float32)
    right = np.zeros(length, dtype=np.float32)
    down = np.zeros(length, dtype=np.float32)
    for y in range(side):
        for x in range(side):
            k = y * pitch + x
            mask[k], right[k], down[k] = (
                np.float32(1),
                np.float32(x - radius),
                np.float32(y - radius),
            )
    h = np.empty((4, 4), dtype=np.float64)
    g = np.empty(4, dtype=np.float64)
    rows, columns = target_image.shape
    n = np.float64(side * side)
    half = np.float32(0.5)
    zero = spread(np.float32(0))
    scale_down = np.float32(1) / np.float32(step)
    limit = np.float32(margin) - np.float32(0.01)
    room = np.float32(radius + 2)
    for i in range(start, stop):
        correlation[i] = np.float32(-1)
        px = (points[i, 0] + half) * scale_down - half + border
        py = (points[i, 1] + half) * scale_down - half + border
        if not (px >= room and py >= room and px < columns - room - 17 and py < rows - room - 2):
            continue
        read_frame(
            template_image,
            px - np.float32(radius + 1),
            py - np.float32(radius + 1),
            side + 2,
            pitch,
            frame,
        )
        sum_t = zero
        sum_x = zero
        sum_y = zero
        xx = zero
        xy = zero
        yy = zero
        for k in range(0, length, 16):
            inside = load(mask, k)
            gx = inside * (load(frame, k + pitch + 2) - load(frame, k + pitch))
            gy = inside * (load(frame, k + 2 * pitch + 1) - load(frame, k + 1))
            sum_t = sum_t + inside * load(frame, k + pitch + 1)
            sum_x = sum_x + gx
            sum_y = sum_y + gy
            xx = xx + gx * gx
            xy = xy + gx * gy
            yy = yy + gy * gy
            store(gradient_x, k, gx)
            store(gradient_y, k, gy)
        j0 = np.float64(total(sum_x))
        j1 = np.float64(total(sum_y))
        # differences over two pixels
        h00 = total(xx) - j0 * j0 / n
        h01 = total(xy) - j0 * j1 / n
        h11 = total(yy) - j1 * j1 / n
        trace = h00 + h11
        determinant = h00 * h11 - h01 * h01
        smaller = 0.5 * (trace - np.sqrt(max(trace * trace - 4 * determinant, 0.0)))
        if not smaller >= n * FLAT_GRADIENT:
            continue
        mean_t = spread(np.float32(total(sum_t) / n))
        tt = zero
        xt = zero
        yt = zero
        for k in range(0, length, 16):
            t = load(mask, k) * (load(frame, k + pitch + 1) - mean_t)
            tt = tt + t * t
            xt = xt + t * load(gradient_x, k)
            yt = yt + t * load(gradient_y, k)
            store(template, k, t)
        energy = np.float64(total(tt))
        rest0 = np.float64(total(xt))
        rest1 = np.float64(total(yt))
        if energy < n * FLAT_VARIANCE:
            continue
        scale = np.float32(np.exp2(labels[i, 2]))
        a = scale * np.float32(np.cos(labels[i, 3]))
        b = scale * np.float32(np.sin(labels[i, 3]))
        tx = (points[i, 0] + labels[i, 0] + half) * scale_down - half + border
        ty = (points[i, 1] + labels[i, 1] + half) * scale_down - half + border
        first = np.float32(-1)
        best = np.float32(-1)
        best_a = a
        best_b = b
        best_x = tx
        best_y = ty
        for warp in range(warps):
            span = (abs(a) + abs(b)) * np.float32(reach) + np.float32(2)
            least = max(span, np.float32(border))
            most_x = columns - border - 1
            most_y = rows - border - 1
            if not (
                least <= tx <= most_x
                and least <= ty <= most_y
                and tx < columns - span
                and ty < rows - span
            ):
                break
            warp_patch(target_image, tx, ty, a, b, reach, grid_columns, grid_rows, scratch, patch)
            ox = oy = np.float32(0)
            mean = 0.0
            at = np.int64(0)
            w00 = zero
            w01 = zero
            w10 = zero
            w11 = zero
            for iteration in range(iterations + 1):
                left = ox + np.float32(margin)
                top = oy + np.float32(margin)
                column = np.int64(left)
                row = np.int64(top)
                fx = left - np.float32(column)
                fy = top - np.float32(row)
                at = row * pitch + column
                w11 = spread(fx * fy)
                w01 = spread(fx - fx * fy)
                w10 = spread(fy - fx * fy)
                w00 = spread(np.float32(1) - fx - fy + fx * fy)
                sum_w = zero
                ww = zero
                wt = zero
                wx = zero
                wy = zero
                for k in range(0, length, 16):
                    j = at + k
                    w = (
                        w00 * load(patch, j)
                        + w01 * load(patch, j + 1)
                        + w10 * load(patch, j + pitch)
                    )
                    w = load(mask, k) * (w + w11 * load(patch, j + pitch + 1) - mean_t)
                    sum_w = sum_w + w
                    ww = ww + w * w
                    wt = wt + w * load(template, k)
                    wx = wx + w * load(gradient_x, k)
                    wy = wy + w * load(gradient_y, k)
                sum_of_w = np.float64(total(sum_w))
                mean = sum_of_w / n
                variance = total(ww) - mean * sum_of_w
                score = np.float32(-1)  # a flat target looks like anything
                if variance >= n * FLAT_VARIANCE:
                    score = np.float32(total(wt) / np.sqrt(variance * energy))
                if warp == 0 and iteration == 0:
                    first = score
                if score > best:
                    best = score
                    best_a = a
                    best_b = b
                    best_x = tx + a * ox - b * oy
                    best_y = ty + b * ox + a * oy
                g[0], g[1] = total(wx) - mean * j0 - rest0, total(wy) - mean * j1 - rest1
                if iteration == iterations:
                    break
                d0 = np.float32(2 * (h11 * g[0] - h01 * g[1]) / determinant)
                d1 = np.float32(2 * (h00 * g[1] - h01 * g[0]) / determinant)
                ox = ox - d0
                oy = oy - d1
                if not (abs(ox) < limit and abs(oy) < limit):
                    ox = min(max(ox, -limit), limit)
                    oy = min(max(oy, -limit), limit)
                    break
                if d0 * d0 + d1 * d1 < tolerance * tolerance:
                    break
            mx = a * ox - b * oy
            my = b * ox + a * oy
            tx = tx + mx
            ty = ty + my
            if warp == warps - 1:
                break
            # the change of scale and rotation
            sum_s = zero
            sum_r = zero
            sx = zero
            sy = zero
            rx = zero
            ry = zero
            ss = zero
            rr = zero
            rs = zero
            st = zero
            rt = zero
            ws = zero
            wr = zero
            for k in range(0, length, 16):
                j = at + k
                w = w00 * load(patch, j) + w01 * load(patch, j + 1) + w10 * load(patch, j + pitch)
                w = w + w11 * load(patch, j + pitch + 1) - mean_t
                gx = load(gradient_x, k)
                gy = load(gradient_y, k)
                dx = load(right, k)
                dy = load(down, k)
                swell = gx * dx + gy * dy
                turn = gy * dx - gx * dy
                t = load(template, k)
                sum_s = sum_s + swell
                sum_r = sum_r + turn
                sx = sx + swell * gx
                sy = sy + swell * gy
                rx = rx + turn * gx
                ry = ry + turn * gy
                ss = ss + swell * swell
                rr = rr + turn * turn
                rs = rs + turn * swell
                st = st + swell * t
                rt = rt + turn * t
                ws = ws + w * swell
                wr = wr + w * turn
            j2 = np.float64(total(sum_s))
            j3 = np.float64(total(sum_r))
            g[2], g[3] = (
                total(ws) - mean * j2 - np.float64(total(st)),
                total(wr) - mean * j3 - np.float64(total(rt)),
            )
            h[0, 0] = h00
            h[1, 0] = h01
            h[1, 1] = h11
            h[2, 0], h[2, 1] = total(sx) - j2 * j0 / n, total(sy) - j2 * j1 / n
            h[3, 0], h[3, 1] = total(rx) - j3 * j0 / n, total(ry) - j3 * j1 / n
            damping = SIMILARITY_DAMPING * trace * (radius * radius)
            h[2, 2], h[3, 3] = total(ss) - j2 * j2 / n + damping, total(rr) - j3 * j3 / n + damping
            h[3, 2] = total(rs) - j3 * j2 / n
            if not cholesky_solve(h, g):
                break
            da = np.float32(1) + 2 * np.float32(g[2])
            db = 2 * np.float32(g[3])
            size = da * da + db * db
            if not 0.25 < size < 4:
                break
            # compose with the inverse of the increment: A (I + dA)^-1
            a, b = (a * da + b * db) / size, (b * da - a * db) / size
        correlation[i] = best
        if best > first:
            labels[i, 0] = (best_x - border + half) * np.float32(step) - half - points[i, 0]
            labels[i, 1] = (best_y - border + half) * np.float32(step) - half - points[i, 1]
            labels[i, 2] = half * np.float32(np.log2(best_a * best_a + best_b * best_b))
            labels[i, 3] = np.float32(np.arctan2(best_b, best_a))
