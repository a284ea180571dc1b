"""Sub-pixel refinement of labels: a parabola through matching costs, then Lucas-Kanade with four degrees of freedom.

The second step is inverse compositional (Baker and Matthews 2004): template gradients and Hessian are computed once a
point, the similarity warp of the label is updated until it stands. Patch means are removed, so that a change of
brightness does not pull.
"""

from __future__ import annotations

import numpy as np

from ._jit import inlined, kernel
from .matching import label_cost


@kernel
def parabola(start, stop, labels, step, reference, target, tables, used):  # type: ignore[no-untyped-def]
    """Move each label to the vertex of the parabolas through its cost and those `step` pixels beside it.

    Args:
        start: First point.
        stop: One past the last.
        labels: float32 ``[N, 4]``, changed in place; moves by at most `step`.
        step: Pixels.
        reference: `matching.Reference`.
        target: `matching.Side`.
        tables: `matching.CostTables`.
        used: int64 ``[N]``, cost evaluations, counted on.
    """
    far = np.int64(1 << 40)
    for i in range(start, stop):
        u, v, s, theta = labels[i, 0], labels[i, 1], labels[i, 2], labels[i, 3]
        middle = label_cost(i, u, v, s, theta, reference, target, tables, far)
        left = label_cost(i, u - step, v, s, theta, reference, target, tables, far)
        right = label_cost(i, u + step, v, s, theta, reference, target, tables, far)
        up = label_cost(i, u, v - step, s, theta, reference, target, tables, far)
        down = label_cost(i, u, v + step, s, theta, reference, target, tables, far)
        used[i] += 5
        labels[i, 0] = u + step * vertex(left, middle, right)
        labels[i, 1] = v + step * vertex(up, middle, down)


@inlined
def vertex(before, middle, after):  # type: ignore[no-untyped-def]
    """Position of the minimum of a parabola through values at -1, 0, 1, within these; 0 if it is not convex."""
    curvature = before + after - 2 * middle
    if curvature <= 0:
        return np.float32(0)
    return min(max(np.float32(before - after) / np.float32(2 * curvature), np.float32(-1)), np.float32(1))


@inlined
def bilinear(image, x, y):  # type: ignore[no-untyped-def]
    """Grey level at a position inside ``[0, W - 1] x [0, H - 1]``; the nearest inside position otherwise."""
    height, width = image.shape
    x = min(max(x, np.float32(0)), np.float32(width) - np.float32(1.001))
    y = min(max(y, np.float32(0)), np.float32(height) - np.float32(1.001))
    column, row = np.uint64(x), np.uint64(y)
    fx, fy = x - np.float32(np.int32(column)), y - np.float32(np.int32(row))
    one = np.uint64(1)
    a, b = np.float32(image[row, column]), np.float32(image[row, column + one])
    c, d = np.float32(image[row + one, column]), np.float32(image[row + one, column + one])
    upper, lower = a + fx * (b - a), c + fx * (d - c)
    return upper + fy * (lower - upper)


@kernel
def similarity_lucas_kanade(  # type: ignore[no-untyped-def]
    start, stop, points, labels, template_image, target_image, step, radius, iterations, tolerance, reach, correlation
):
    """Refine labels by photometric alignment of a square window.

    Args:
        start: First point.
        stop: One past the last.
        points: float32 ``[N, 2]``, full-image pixels of the template image.
        labels: float32 ``[N, 4]``, changed in place where the alignment improved.
        template_image: uint8 ``[h, w]``, at 1 / `step` of the full resolution.
        target_image: uint8 ``[h, w]``.
        step: Full-image pixels a pixel of these images.
        radius: Window radius in their pixels.
        iterations: At most.
        tolerance: Stop below this change, in their pixels.
        reach: Largest accepted change, in their pixels.
        correlation: float32 ``[N]``, filled with the windows' zero-mean normalised correlation, -1 if flat or not seen.
    """
    side = 2 * radius + 1
    area = side * side
    patch = np.empty((side + 2, side + 2), dtype=np.float32)
    jacobian = np.empty((area, 4), dtype=np.float32)
    template = np.empty(area, dtype=np.float32)
    warped = np.empty(area, dtype=np.float32)
    height, width = target_image.shape
    one, half = np.float32(1), np.float32(0.5)
    inverse_step, unit = one / np.float32(step), one / np.float32(radius)
    for i in range(start, stop):
        correlation[i] = -one
        px = (points[i, 0] + half) * inverse_step - half
        py = (points[i, 1] + half) * inverse_step - half
        for y in range(side + 2):
            for x in range(side + 2):
                patch[y, x] = bilinear(template_image, px + np.float32(x - radius - 1), py + np.float32(y - radius - 1))
        mean, j0, j1, j2, j3 = np.float32(0), np.float32(0), np.float32(0), np.float32(0), np.float32(0)
        k = 0
        for y in range(side):
            dy = np.float32(y - radius) * unit
            for x in range(side):
                dx = np.float32(x - radius) * unit
                gx = (patch[y + 1, x + 2] - patch[y + 1, x]) * half
                gy = (patch[y + 2, x + 1] - patch[y, x + 1]) * half
                template[k] = patch[y + 1, x + 1]
                turn, swell = gy * dx - gx * dy, gx * dx + gy * dy
                jacobian[k, 0], jacobian[k, 1], jacobian[k, 2], jacobian[k, 3] = gx, gy, swell, turn
                mean, j0, j1, j2, j3 = mean + template[k], j0 + gx, j1 + gy, j2 + swell, j3 + turn
                k += 1
        share = one / np.float32(area)
        mean, j0, j1, j2, j3 = mean * share, j0 * share, j1 * share, j2 * share, j3 * share
        h = np.zeros((4, 4), dtype=np.float64)
        energy = np.float32(0)
        h00 = h01 = h02 = h03 = h11 = h12 = h13 = h22 = h23 = h33 = np.float32(0)
        for k in range(area):
            template[k] -= mean
            energy += template[k] * template[k]
            a, b, c, d = jacobian[k, 0] - j0, jacobian[k, 1] - j1, jacobian[k, 2] - j2, jacobian[k, 3] - j3
            jacobian[k, 0], jacobian[k, 1], jacobian[k, 2], jacobian[k, 3] = a, b, c, d
            h00, h01, h02, h03 = h00 + a * a, h01 + a * b, h02 + a * c, h03 + a * d
            h11, h12, h13 = h11 + b * b, h12 + b * c, h13 + b * d
            h22, h23, h33 = h22 + c * c, h23 + c * d, h33 + d * d
        # translation must be observable: smaller eigenvalue of the 2 x 2 block against sensor noise
        trace, determinant = h00 + h11, h00 * h11 - h01 * h01
        smaller = half * (trace - np.sqrt(max(trace * trace - 4 * determinant, np.float32(0))))
        if energy < np.float32(area) * 1 or smaller < np.float32(area) * np.float32(0.05):
            continue
        damping = np.float64(0.01) * trace
        h[0, 0], h[0, 1], h[0, 2], h[0, 3] = h00, h01, h02, h03
        h[1, 0], h[1, 1], h[1, 2], h[1, 3] = h01, h11, h12, h13
        h[2, 0], h[2, 1], h[2, 2], h[2, 3] = h02, h12, h22 + damping, h23
        h[3, 0], h[3, 1], h[3, 2], h[3, 3] = h03, h13, h23, h33 + damping
        if not cholesky4(h):
            continue
        scale = np.float32(np.exp2(labels[i, 2]))
        a, b = scale * np.float32(np.cos(labels[i, 3])), scale * np.float32(np.sin(labels[i, 3]))
        tx = (points[i, 0] + labels[i, 0] + half) * inverse_step - half
        ty = (points[i, 1] + labels[i, 1] + half) * inverse_step - half
        first = last = np.float32(-1)
        best_a, best_b, best_x, best_y, best_r = a, b, tx, ty, np.float32(-1)
        x0, y0 = tx, ty
        for iteration in range(iterations + 1):
            if not (tx >= 0 and ty >= 0 and tx <= width - 1 and ty <= height - 1):
                break
            total = np.float32(0)
            k = 0
            for y in range(-radius, radius + 1):
                ox, oy = tx - b * np.float32(y), ty + a * np.float32(y)
                for x in range(-radius, radius + 1):
                    value = bilinear(target_image, ox + a * np.float32(x), oy + b * np.float32(x))
                    warped[k] = value
                    total += value
                    k += 1
            total *= share
            g0 = g1 = g2 = g3 = power = product = np.float32(0)
            for k in range(area):
                value = warped[k] - total
                power += value * value
                product += value * template[k]
                error = value - template[k]
                g0, g1 = g0 + jacobian[k, 0] * error, g1 + jacobian[k, 1] * error
                g2, g3 = g2 + jacobian[k, 2] * error, g3 + jacobian[k, 3] * error
            last = product / np.sqrt(max(power * energy, np.float32(1e-6)))
            if iteration == 0:
                first = last
            if last > best_r:
                best_a, best_b, best_x, best_y, best_r = a, b, tx, ty, last
            if iteration == iterations:
                break
            d0, d1, d2, d3 = solve4(h, g0, g1, g2, g3)
            da, db = one + d2 * unit, d3 * unit
            size = da * da + db * db
            if size < np.float32(0.25):
                break
            # compose with the inverse of the increment: A (I + dA)^-1 and p' - A (I + dA)^-1 dt
            na, nb = (a * da + b * db) / size, (b * da - a * db) / size
            mx, my = na * d0 - nb * d1, nb * d0 + na * d1
            a, b, tx, ty = na, nb, tx - mx, ty - my
            moved = (tx - x0) * (tx - x0) + (ty - y0) * (ty - y0)
            if not moved <= reach * reach:
                break
            if mx * mx + my * my < tolerance * tolerance and iteration > 0:
                break
        correlation[i] = best_r
        if best_r > first:
            labels[i, 0] = (best_x + half) * np.float32(step) - half - points[i, 0]
            labels[i, 1] = (best_y + half) * np.float32(step) - half - points[i, 1]
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
