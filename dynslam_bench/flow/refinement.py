"""Photometric refinement of labels: Lucas-Kanade with four degrees of freedom.

Inverse compositional (Baker and Matthews 2004): template gradients and Hessian are computed once a point, the label's
warp is updated until it stands. Patch means are removed, so that a change of brightness does not pull.
"""

from __future__ import annotations

import numpy as np

from ._jit import inlined, kernel

BORDER = 48
"""Pixels repeated around the images that are refined on."""
FLAT_VARIANCE = 256.0
"""Below a variance of one squared grey level a window is flat (in squared sixteenths)."""
FLAT_GRADIENT = 1024.0 * 0.05
"""Smallest mean squared gradient along the worse direction (0.05 squared levels a pixel)."""
SIMILARITY_DAMPING = 0.1
"""Prior on the change of scale and rotation, relative to the translation's information at the window's edge."""


@kernel
def pad_image(image, margin, out):  # type: ignore[no-untyped-def]
    """Copy a uint8 image into the middle of `out` and repeat its edges over `margin` pixels."""
    height, width = image.shape
    for y in range(height + 2 * margin):
        row = image[min(max(y - margin, 0), height - 1)]
        line = out[y]
        for x in range(margin):
            line[x] = row[0]
            line[margin + width + x] = row[width - 1]
        line[margin : margin + width] = row


@inlined
def read_window(image, x, y, side, out):  # type: ignore[no-untyped-def]
    """Bilinear samples, one pixel apart, from position (x, y) on: ``side * side`` values in sixteenths of a level."""
    column, row = np.int64(x), np.int64(y)
    fx, fy = np.int32((x - np.float32(column)) * np.float32(64)), np.int32((y - np.float32(row)) * np.float32(64))
    w11 = fx * fy
    w01, w10 = fx * np.int32(64) - w11, fy * np.int32(64) - w11
    w00 = np.int32(4096) - w01 - w10 - w11
    for r in range(side):
        upper = image[row + r, column : column + side + 1]
        lower = image[row + r + 1, column : column + side + 1]
        line = out[r * side : (r + 1) * side]
        for c in range(side):
            line[c] = np.int32(
                w00 * np.int32(upper[c]) + w01 * np.int32(upper[c + 1]) + w10 * np.int32(lower[c])
                + w11 * np.int32(lower[c + 1]) + np.int32(128)
            ) >> np.int32(8)  # fmt: skip


@inlined
def warp_window(image, x, y, a, b, reach, out):  # type: ignore[no-untyped-def]
    """Samples of a window of radius `reach` under the similarity ``[[a, -b], [b, a]]`` around (x, y)."""
    flat, stride = image.reshape(-1), np.uint64(image.shape[1])
    one = np.float32(65536)
    step_x, step_y = np.int64(a * one), np.int64(b * one)
    far = np.float32(reach)
    column0, row0 = np.int64((x - a * far + b * far) * one), np.int64((y - b * far - a * far) * one)
    bottom, eight, sixteen, low = np.uint64(1), np.uint64(8), np.uint64(16), np.uint64(255)
    k = 0
    for r in range(2 * reach + 1):
        column, row = column0 - r * step_y, row0 + r * step_x
        for _ in range(2 * reach + 1):
            ux, uy = np.uint64(column), np.uint64(row)
            at = (uy >> sixteen) * stride + (ux >> sixteen)
            fx, fy = np.int32((ux >> eight) & low), np.int32((uy >> eight) & low)
            p, q = np.int32(flat[at]), np.int32(flat[at + bottom])
            s, t = np.int32(flat[at + stride]), np.int32(flat[at + stride + bottom])
            upper, lower = p * 256 + fx * (q - p), s * 256 + fx * (t - s)
            out[k] = np.int32((upper * 256 + fy * (lower - upper) + 2048) >> 12)
            k += 1
            column += step_x
            row += step_y


@inlined
def shift_window(patch, width, x, y, side, out):  # type: ignore[no-untyped-def]
    """Bilinear samples of a patch of `width` columns from (x, y) on."""
    column, row = np.int64(x), np.int64(y)
    fx, fy = np.int32((x - np.float32(column)) * np.float32(128)), np.int32((y - np.float32(row)) * np.float32(128))
    w11 = fx * fy
    w01, w10 = fx * np.int32(128) - w11, fy * np.int32(128) - w11
    w00 = np.int32(16384) - w01 - w10 - w11
    for r in range(side):
        first = (row + r) * width + column
        upper = patch[first : first + side + 1]
        lower = patch[first + width : first + width + side + 1]
        line = out[r * side : (r + 1) * side]
        for c in range(side):
            line[c] = np.int32(
                w00 * upper[c] + w01 * upper[c + 1] + w10 * lower[c] + w11 * lower[c + 1] + np.int32(8192)
            ) >> np.int32(14)


@inlined
def dot(first, second):  # type: ignore[no-untyped-def]
    """Exact inner product of two int32 vectors."""
    total = np.int64(0)
    for k in range(len(first)):
        total += np.int64(first[k]) * np.int64(second[k])
    return total


@kernel
def similarity_lucas_kanade(  # type: ignore[no-untyped-def]
    start, stop, points, labels, template_image, target_image, border, step, radius, margin, warps, iterations,
    tolerance, correlation,
):  # fmt: skip
    """Refine labels by photometric alignment of a square window.

    The target is warped by the label into the template's frame; within that patch only the translation moves (cheap),
    between two warps scale and rotation are corrected as well. Sums are of whole numbers, hence exact in any order. A
    label changes only if the windows' correlation grows.

    Args:
        start: First point.
        stop: One past the last.
        points: float32 ``[N, 2]``, full-image pixels of the template image.
        labels: float32 ``[N, 4]``, changed in place.
        template_image: uint8 ``[h + 2 border, w + 2 border]``, at 1 / `step` of the full resolution, edges repeated.
        target_image: Likewise.
        border: Pixels repeated around the images.
        step: Full-image pixels a pixel of these images.
        radius: Window radius in their pixels.
        margin: Largest translation within one warp, in their pixels.
        warps: Times the target is warped.
        iterations: Translations a warp, at most.
        tolerance: Stop below this change, in their pixels.
        correlation: float32 ``[N]``, filled with the windows' zero-mean normalised correlation, -1 if flat or not seen.
    """
    side, reach = 2 * radius + 1, radius + margin
    area, width = side * side, 2 * (radius + margin) + 1
    frame = np.empty((side + 2) * (side + 2), dtype=np.int32)
    template = np.empty(area, dtype=np.int32)
    gradient_x, gradient_y = np.empty(area, dtype=np.int32), np.empty(area, dtype=np.int32)
    swell, turn = np.empty(area, dtype=np.int32), np.empty(area, dtype=np.int32)
    patch = np.empty(width * width, dtype=np.int32)
    window = np.empty(area, dtype=np.int32)
    h = np.empty((4, 4), dtype=np.float64)
    rows, columns = target_image.shape
    n = np.float64(area)
    half = np.float32(0.5)
    scale_down = np.float32(1) / np.float32(step)
    for i in range(start, stop):
        correlation[i] = np.float32(-1)
        px = (points[i, 0] + half) * scale_down - half + border
        py = (points[i, 1] + half) * scale_down - half + border
        room = np.float32(radius + 2)
        if not (px >= room and py >= room and px < columns - room - 1 and py < rows - room - 1):
            continue
        read_window(template_image, px - np.float32(radius + 1), py - np.float32(radius + 1), side + 2, frame)
        for y in range(side):
            base, line = (y + 1) * (side + 2) + 1, y * side
            dy = np.int32(y - radius)
            for x in range(side):
                template[line + x] = frame[base + x]
                gx = np.int32(frame[base + x + 1] - frame[base + x - 1])
                gy = np.int32(frame[base + x + side + 2] - frame[base + x - side - 2])
                gradient_x[line + x], gradient_y[line + x] = gx, gy
                dx = np.int32(x - radius)
                swell[line + x] = gx * dx + gy * dy
                turn[line + x] = gy * dx - gx * dy
        ones = np.int64(0)
        j0 = j1 = j2 = j3 = np.int64(0)
        for k in range(area):
            ones += template[k]
            j0 += gradient_x[k]
            j1 += gradient_y[k]
            j2 += swell[k]
            j3 += turn[k]
        # gradients are in sixteenths of a level over two pixels
        energy = dot(template, template) - np.float64(ones) * ones / n
        h00 = dot(gradient_x, gradient_x) - np.float64(j0) * j0 / n
        h01 = dot(gradient_x, gradient_y) - np.float64(j0) * j1 / n
        h11 = dot(gradient_y, gradient_y) - np.float64(j1) * j1 / n
        trace, determinant = h00 + h11, h00 * h11 - h01 * h01
        smaller = 0.5 * (trace - np.sqrt(max(trace * trace - 4 * determinant, 0.0)))
        if energy < n * FLAT_VARIANCE or smaller < n * FLAT_GRADIENT:
            continue
        rest0 = dot(gradient_x, template) - np.float64(j0) * ones / n
        rest1 = dot(gradient_y, template) - np.float64(j1) * ones / n
        rest2 = rest3 = 0.0
        factored = False
        scale = np.float32(np.exp2(labels[i, 2]))
        a, b = scale * np.float32(np.cos(labels[i, 3])), scale * np.float32(np.sin(labels[i, 3]))
        tx = (points[i, 0] + labels[i, 0] + half) * scale_down - half + border
        ty = (points[i, 1] + labels[i, 1] + half) * scale_down - half + border
        first, best = np.float32(-1), np.float32(-1)
        best_a, best_b, best_x, best_y = a, b, tx, ty
        for warp in range(warps):
            span = (abs(a) + abs(b)) * np.float32(reach) + np.float32(2)
            if not (tx >= span and ty >= span and tx < columns - span and ty < rows - span):
                break
            if not (tx >= border and ty >= border and tx <= columns - border - 1 and ty <= rows - border - 1):
                break
            warp_window(target_image, tx, ty, a, b, reach, patch)
            ox = oy = np.float32(0)
            g0 = g1 = 0.0
            mean = np.float64(0)
            for iteration in range(iterations + 1):
                shift_window(patch, width, ox + np.float32(margin), oy + np.float32(margin), side, window)
                total, power, product = np.int64(0), np.int64(0), np.int64(0)
                s0, s1 = np.int64(0), np.int64(0)
                for k in range(area):
                    value = np.int64(window[k])
                    total += value
                    power += value * value
                    product += value * np.int64(template[k])
                    s0 += value * np.int64(gradient_x[k])
                    s1 += value * np.int64(gradient_y[k])
                mean = np.float64(total) / n
                variance = power - mean * total
                score = np.float32((product - mean * ones) / np.sqrt(max(variance * energy, 1.0)))
                if warp == 0 and iteration == 0:
                    first = score
                if score > best:
                    best, best_a, best_b = score, a, b
                    best_x, best_y = tx + a * ox - b * oy, ty + b * ox + a * oy
                g0, g1 = s0 - mean * j0 - rest0, s1 - mean * j1 - rest1
                if iteration == iterations:
                    break
                # the gradients' unit: 2 pixels' difference
                d0 = np.float32(2 * (h11 * g0 - h01 * g1) / determinant)
                d1 = np.float32(2 * (h00 * g1 - h01 * g0) / determinant)
                ox, oy = ox - d0, oy - d1
                limit = np.float32(margin) - np.float32(0.01)
                if not (abs(ox) < limit and abs(oy) < limit):
                    ox, oy = min(max(ox, -limit), limit), min(max(oy, -limit), limit)
                    break
                if d0 * d0 + d1 * d1 < tolerance * tolerance:
                    break
            mx, my = a * ox - b * oy, b * ox + a * oy
            tx, ty = tx + mx, ty + my
            if warp == warps - 1:
                break
            if not factored:
                h[0, 0], h[1, 0], h[1, 1] = h00, h01, h11
                h[2, 0], h[2, 1] = dot(swell, gradient_x) - j2 * (j0 / n), dot(swell, gradient_y) - j2 * (j1 / n)
                h[3, 0], h[3, 1] = dot(turn, gradient_x) - j3 * (j0 / n), dot(turn, gradient_y) - j3 * (j1 / n)
                h[2, 2], h[3, 3] = dot(swell, swell) - j2 * (j2 / n), dot(turn, turn) - j3 * (j3 / n)
                h[3, 2] = dot(turn, swell) - j3 * (j2 / n)
                damping = SIMILARITY_DAMPING * trace * (radius * radius)
                h[2, 2], h[3, 3] = h[2, 2] + damping, h[3, 3] + damping
                if not cholesky4(h):
                    break
                rest2 = dot(swell, template) - j2 * (ones / n)
                rest3 = dot(turn, template) - j3 * (ones / n)
                factored = True
            g2, g3 = dot(swell, window) - mean * j2 - rest2, dot(turn, window) - mean * j3 - rest3
            d0, d1, d2, d3 = solve4(h, g0, g1, g2, g3)
            da, db = np.float32(1) + 2 * d2, 2 * d3
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


@inlined
def cholesky4(h):  # type: ignore[no-untyped-def]
    """Lower Cholesky factor of a 4 x 4 matrix, in place; False if it is not positive definite."""
    for j in range(4):
        for k in range(j):
            h[j, j] -= h[j, k] * h[j, k]
        if not h[j, j] > 1e-9:
            return False
        h[j, j] = np.sqrt(h[j, j])
        for r in range(j + 1, 4):
            for k in range(j):
                h[r, j] -= h[r, k] * h[j, k]
            h[r, j] /= h[j, j]
    return True


@inlined
def solve4(h, g0, g1, g2, g3):  # type: ignore[no-untyped-def]
    """Solve with the factor of `cholesky4`."""
    y0 = g0 / h[0, 0]
    y1 = (g1 - h[1, 0] * y0) / h[1, 1]
    y2 = (g2 - h[2, 0] * y0 - h[2, 1] * y1) / h[2, 2]
    y3 = (g3 - h[3, 0] * y0 - h[3, 1] * y1 - h[3, 2] * y2) / h[3, 3]
    x3 = y3 / h[3, 3]
    x2 = (y2 - h[3, 2] * x3) / h[2, 2]
    x1 = (y1 - h[2, 1] * x2 - h[3, 1] * x3) / h[1, 1]
    x0 = (y0 - h[1, 0] * x1 - h[2, 0] * x2 - h[3, 0] * x3) / h[0, 0]
    return np.float32(x0), np.float32(x1), np.float32(x2), np.float32(x3)
