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
    Doubles,
    Floats,
    Ints,
    load,
    load_bytes,
    spread,
    store,
    total,
)
from dynslam_bench.flow.sampling import sample, square, store_offsets
from dynslam_bench.geometry.gauss_newton import cholesky_solve

BORDER = 48
"""Pixels repeated around the images that are refined on."""
FLAT_VARIANCE = 1.0
"""Below this variance, in squared grey levels, a window is flat."""
FLAT_GRADIENT = 4.0 * 0.05
"""Smallest mean squared gradient along the worse direction, below which a window determines no translation.

0.05 squared levels a pixel; the factor is 2 squared, because gradients are differences over two pixels.
"""
SIMILARITY_DAMPING = 0.1
"""Prior on the change of scale and rotation, relative to the translation's information at the window's edge."""


class Window(NamedTuple):
    """The square window that is aligned, and when to stop.

    Attributes:
        step: Full-image pixels a pixel of the images.
        radius: The window is ``2 radius + 1`` pixels of the images wide.
        margin: Largest translation within one warp, pixels of the images, at least 1.
        warps: Times the target is warped, at most: once, or twice with a change of scale and
            rotation between.
        iterations: Translations a warp, at most.
        tolerance: Stop below this change, pixels of the images.
    """

    step: int
    radius: int
    margin: int
    warps: int
    iterations: int = 3
    tolerance: np.float32 = np.float32(0.03)


class Workspace(NamedTuple):
    """Arrays of one thread, made once a call; `points` are refined one after the other in them.

    All are flat, with rows of `pitch` numbers: pixel (x, y) lies at ``y * pitch + x``, so that a
    shift by whole pixels is an offset. The patch is the warped target, ``pitch = 2 (radius +
    margin) + 1`` pixels wide and high. The window is its top left part of ``2 radius + 1`` rows
    and columns; elements to the right of it have a mask of zero. Lengths are rounded up to whole
    SIMD vectors of sixteen numbers.

    Attributes:
        pitch: Numbers a row.
        length: Numbers of a window's rows, a multiple of 16.
        mask: float32 ``[length]``, 1 inside the window.
        right: float32 ``[length]``, column from the window's centre.
        down: float32 ``[length]``, row from the window's centre.
        grid_columns: int32 ``[pitch * pitch ...]``, column of each pixel of the patch.
        grid_rows: int32 ``[pitch * pitch ...]``, its row.
        squares: int32 ``[pitch * pitch ...]``, scratch of `warp_patch`.
        patch: float32 ``[pitch * pitch ...]``, the warped target.
        frame: float32, the template's samples: the window with a frame of one pixel.
        template: float32 ``[length]``, the window's grey levels without their mean.
        gradient_x: float32 ``[length]``, differences over two pixels along x.
        gradient_y: float32 ``[length]``, differences over two pixels along y.
        hessian: float64 ``[4, 4]``, normal equations of translation, scale and rotation.
        steepest: float64 ``[4]``, their right side, then their solution.
    """

    pitch: int
    length: int
    mask: Floats
    right: Floats
    down: Floats
    grid_columns: Ints
    grid_rows: Ints
    squares: Ints
    patch: Floats
    frame: Floats
    template: Floats
    gradient_x: Floats
    gradient_y: Floats
    hessian: Doubles
    steepest: Doubles


class Gradients(NamedTuple):
    """Sums of the template's gradients over the window.

    Attributes:
        levels: Sum of the grey levels.
        x: Sum of the gradients along x.
        y: Sum of the gradients along y.
        xx: Sum of gx^2 over the window, mean removed; with xy and yy the Hessian of the
            translation.
        xy: Sum of gx gy over the window, mean removed: the Hessian's off-diagonal element.
        yy: Sum of gy^2 over the window, mean removed.
        trace: Trace of that Hessian.
        determinant: Determinant of that Hessian.
    """

    levels: Scalar
    x: Scalar
    y: Scalar
    xx: Scalar
    xy: Scalar
    yy: Scalar
    trace: Scalar
    determinant: Scalar


class Template(NamedTuple):
    """Sums over the template without its mean.

    Attributes:
        mean: Mean grey level of the window.
        energy: Sum of squares.
        x: Sum of the products with the gradients along x.
        y: Sum of the products with the gradients along y.
    """

    mean: Scalar
    energy: Scalar
    x: Scalar
    y: Scalar


class Warp(NamedTuple):
    """The window in the target: offset d from its centre lies at ``[[a, -b], [b, a]] d + (x, y)``.

    Attributes:
        a: Scale times cosine of the rotation.
        b: Scale times sine of the rotation.
        x: Column in the target image with its border.
        y: Row in the target image with its border.
    """

    a: Scalar
    b: Scalar
    x: Scalar
    y: Scalar


class Alignment(NamedTuple):
    """Result of the translations within one warp, in pixels of the patch.

    Attributes:
        x: Offset along x after the last step.
        y: Offset along y after the last step.
        sampled_x: Offset along x at which the patch was last compared with the template.
        sampled_y: Offset along y at which the patch was last compared with the template.
        mean: Mean grey level of the patch there, less the template's.
        residual_x: Sum of the residuals there times the gradients along x.
        residual_y: Sum of the residuals there times the gradients along y.
        initial: Correlation before the first step.
    """

    x: Scalar
    y: Scalar
    sampled_x: Scalar
    sampled_y: Scalar
    mean: Scalar
    residual_x: Scalar
    residual_y: Scalar
    initial: Scalar


@kernel
def make_workspace(radius: int, margin: int) -> Workspace:
    """The arrays for windows of a radius and translations up to a margin, pixels."""
    side = 2 * radius + 1
    # sizes: rows of the patch, rounded up to whole vectors of sixteen
    pitch = 2 * (radius + margin) + 1
    length = 16 * ((side * pitch + 15) // 16)
    patch_length = 16 * ((pitch * pitch + 15) // 16)
    # vectors that begin inside the window read up to two rows and two vectors beyond it
    slack = 2 * pitch + 32

    # where each sample of the patch lies on its grid
    grid_columns = np.zeros(patch_length, dtype=np.int32)
    grid_rows = np.zeros(patch_length, dtype=np.int32)
    for k in range(pitch * pitch):
        grid_columns[k] = k % pitch
        grid_rows[k] = k // pitch

    # which samples belong to the window, and how far right of and below its centre they lie
    mask = np.zeros(length, dtype=np.float32)
    right = np.zeros(length, dtype=np.float32)
    down = np.zeros(length, dtype=np.float32)
    for y in range(side):
        for x in range(side):
            k = y * pitch + x
            mask[k] = np.float32(1)
            right[k] = np.float32(x - radius)
            down[k] = np.float32(y - radius)
    # the rest is filled for every point: rows of pixels, patch, gradients, template and equations
    return Workspace(
        pitch,
        length,
        mask,
        right,
        down,
        grid_columns,
        grid_rows,
        np.empty(patch_length, dtype=np.int32),
        np.zeros(patch_length + slack, dtype=np.float32),
        np.zeros((side + 2) * pitch + slack, dtype=np.float32),
        np.zeros(length, dtype=np.float32),
        np.zeros(length, dtype=np.float32),
        np.zeros(length, dtype=np.float32),
        np.empty((4, 4), dtype=np.float64),
        np.empty(4, dtype=np.float64),
    )


@kernel
def similarity_lucas_kanade(
    start: int,
    stop: int,
    points: Floats,
    labels: Floats,
    template_image: Bytes,
    target_image: Bytes,
    window: Window,
    correlation: Floats,
) -> None:
    """Refine labels by photometric alignment of a square window.

    The target is warped by the label into the template's frame. Within that patch only the
    translation changes (cheap); between two warps scale and rotation are corrected as well. A label
    changes only if the windows' correlation grows.

    Args:
        start: First point.
        stop: One past the last.
        points: float32 ``[N, 2]``, full-image pixels of the template image.
        labels: float32 ``[N, 4]``, changed in place.
        template_image: uint8 ``[h + 2 BORDER, w + 2 BORDER]``, at 1 / `step` of the full
            resolution, edges repeated.
        target_image: uint8 ``[h + 2 BORDER, w + 2 BORDER]``, likewise.
        window: `Window`, and when to stop.
        correlation: float32 ``[N]``, filled with the windows' zero-mean normalised correlation, -1
            if flat or outside.
    """
    # pixels of the window, and scratch arrays for it
    side = 2 * window.radius + 1
    n = np.float64(side * side)
    scale_down = np.float32(1) / np.float32(window.step)
    space = make_workspace(window.radius, window.margin)
    for i in range(start, stop):
        correlation[i] = np.float32(-1)

        # the template: samples, gradients and the Hessian of the translation, once a point
        px = framed(points[i, 0], scale_down)
        py = framed(points[i, 1], scale_down)
        if not template_fits(px, py, window, target_image):
            continue
        corner = np.float32(window.radius + 1)
        read_frame(template_image, px - corner, py - corner, side + 2, space.pitch, space.frame)
        gradients = template_gradients(space, n)
        if not smaller_eigenvalue(gradients) >= n * FLAT_GRADIENT:
            continue
        template = centre_template(space, gradients, n)
        if template.energy < n * FLAT_VARIANCE:
            continue

        # warps, beginning with that of the label
        warp = warp_of_label(labels[i], points[i], scale_down)
        initial = np.float32(-1)
        best = np.float32(-1)
        best_warp = warp
        for number in range(window.warps):
            if not target_fits(warp, window, target_image):
                break
            warp_patch(target_image, warp, window.radius + window.margin, space)

            # inverse compositional steps of the translation within the patch
            alignment, best, best_warp = align_translation(
                space, gradients, template, warp, window, n, best, best_warp
            )
            # the correlation of the label that was given
            if number == 0:
                initial = alignment.initial
            warp = Warp(
                warp.a,
                warp.b,
                warp.x + (warp.a * alignment.x - warp.b * alignment.y),
                warp.y + (warp.b * alignment.x + warp.a * alignment.y),
            )
            if number == window.warps - 1:
                break

            # one step of translation, scale and rotation together, before the next warp
            similarity_equations(space, gradients, template, alignment, window, n)
            if not cholesky_solve(space.hessian, space.steepest):
                break
            # the increment as a similarity; 2, because gradients are differences over two pixels
            da = np.float32(1) + 2 * np.float32(space.steepest[2])
            db = 2 * np.float32(space.steepest[3])
            size = da * da + db * db
            if not 0.25 < size < 4:
                break
            # compose with the inverse of the increment: A (I + dA)^-1
            warp = Warp(
                (warp.a * da + warp.b * db) / size,
                (warp.b * da - warp.a * db) / size,
                warp.x,
                warp.y,
            )

        # the best warp as a label, where it is better than the label that was given
        correlation[i] = best
        if best > initial:
            store_label(labels[i], points[i], best_warp, window.step)


@inlined
def warp_of_label(label: Floats, point: Floats, scale_down: Scalar) -> Warp:
    """The warp of a label; its translation is in pixels of the target with its border.

    Args:
        label: float32 ``[4]``: u, v (full-image pixels), log2 of the scale, rotation (radians).
        point: float32 ``[2]``, full-image pixels.
        scale_down: Pixels of the target in a full-image pixel.
    """
    scale = np.float32(np.exp2(label[2]))
    return Warp(
        np.float64(scale * np.float32(np.cos(label[3]))),
        np.float64(scale * np.float32(np.sin(label[3]))),
        framed(point[0] + label[0], scale_down),
        framed(point[1] + label[1], scale_down),
    )


@inlined
def store_label(label: Floats, point: Floats, warp: Warp, step: int) -> None:
    """Write a warp as a label, the inverse of `warp_of_label`; `step`: full-image pixels in a target pixel."""
    half = np.float32(0.5)
    a = warp.a
    b = warp.b
    label[0] = (warp.x - BORDER + half) * np.float32(step) - half - point[0]
    label[1] = (warp.y - BORDER + half) * np.float32(step) - half - point[1]
    label[2] = half * np.float32(np.log2(a * a + b * b))
    label[3] = np.float32(np.arctan2(b, a))


@inlined
def framed(position: Scalar, scale_down: Scalar) -> Scalar:
    """A full-image coordinate (pixel centres at whole numbers) in the smaller image with its border."""
    half = np.float32(0.5)
    return (position + half) * scale_down - half + BORDER


@inlined
def template_fits(px: Scalar, py: Scalar, window: Window, image: Bytes) -> Scalar:
    """Whether the window around (px, py), and what vectors read beyond it, lies in the image with its border."""
    rows, columns = image.shape
    room = np.float32(window.radius + 2)
    return px >= room and py >= room and px < columns - room - 17 and py < rows - room - 2


@inlined
def target_fits(warp: Warp, window: Window, image: Bytes) -> Scalar:
    """Whether the warp's centre lies in the image, and its whole patch in the image with its border.

    Args:
        warp: Where the patch lies now, in pixels of the bordered image.
        window: Size of the patch.
        image: uint8 ``[H + 2 BORDER, W + 2 BORDER]``.
    """
    # half the width of the patch in the image, under the warp
    rows, columns = image.shape
    reach = window.radius + window.margin
    span = (abs(warp.a) + abs(warp.b)) * np.float32(reach) + np.float32(2)
    least = max(span, np.float32(BORDER))
    most_x = columns - BORDER - 1
    most_y = rows - BORDER - 1
    return (
        least <= warp.x <= most_x
        and least <= warp.y <= most_y
        and warp.x < columns - span
        and warp.y < rows - span
    )


@inlined
def read_frame(image: Bytes, x: Scalar, y: Scalar, rows: int, pitch: int, out: Floats) -> None:
    """Bilinear samples, one pixel apart, of `rows` rows of `pitch` columns from position (x, y) on.

    Args:
        image: uint8 ``[H, W]``.
        x: Column of the first sample, pixels.
        y: Row of the first sample, pixels.
        rows: Rows of samples.
        pitch: Samples a row.
        out: float32, flat, filled.
    """
    # the pixel that contains (x, y), and the parts of a pixel beyond it
    flat = image.reshape(-1)
    stride = np.int64(image.shape[1])
    column = np.int64(x)
    row = np.int64(y)
    right = spread(x - np.float32(column))
    lower = spread(y - np.float32(row))
    # sixteen columns at a time, all rows of these; the last vector overlaps the one before
    for block in range((pitch + 15) // 16):
        first = min(16 * block, max(pitch - 16, 0))
        at = row * stride + column + first
        # a row of samples between columns, then between two such rows
        above = load_bytes(flat, at)
        above = above + right * (load_bytes(flat, at + 1) - above)
        for r in range(rows):
            at += stride
            below = load_bytes(flat, at)
            below = below + right * (load_bytes(flat, at + 1) - below)
            store(out, r * pitch + first, above + lower * (below - above))
            above = below


@inlined
def warp_patch(image: Bytes, warp: Warp, reach: int, space: Workspace) -> None:
    """Fill the patch: bilinear samples of a square of radius `reach` pixels under the warp.

    Args:
        image: uint8 ``[H, W]``, the target with its border.
        warp: Where the window's centre lies in it, with scale and rotation.
        reach: Half side of the square.
        space: Its `patch` is filled.
    """
    # positions are whole numbers of 65536ths of a pixel
    one = np.float32(65536)
    far = np.float32(reach)
    column = np.int32((warp.x - warp.a * far + warp.b * far) * one)
    row = np.int32((warp.y - warp.b * far - warp.a * far) * one)
    step_x = np.int32(warp.a * one)
    step_y = np.int32(warp.b * one)
    flat = image.reshape(-1)
    stride = np.int64(image.shape[1])
    columns = space.grid_columns
    rows = space.grid_rows
    squares = space.squares
    # where the four pixels around each sample lie, these pixels, and the samples between them
    for k in range(0, len(columns), 16):
        store_offsets(squares, columns, rows, k, column, row, step_x, step_y, np.int32(stride))
    for k in range(len(columns)):
        squares[k] = square(flat, np.int64(squares[k]), stride)
    for k in range(0, len(columns), 16):
        store(space.patch, k, sample(squares, columns, rows, k, column, row, step_x, step_y))


@inlined
def template_gradients(space: Workspace, n: float) -> Gradients:
    """Fill the template's gradients from its samples, central differences; returns their sums over `n` pixels."""
    # sums over the window, sixteen pixels at a time
    pitch = space.pitch
    frame = space.frame
    zero = spread(np.float32(0))
    sum_t = zero
    sum_x = zero
    sum_y = zero
    xx = zero
    xy = zero
    yy = zero
    for k in range(0, space.length, 16):
        # the window's pixel k is the frame's at k + pitch + 1
        inside = load(space.mask, k)
        gx = inside * (load(frame, k + pitch + 2) - load(frame, k + pitch))
        gy = inside * (load(frame, k + 2 * pitch + 1) - load(frame, k + 1))
        sum_t = sum_t + inside * load(frame, k + pitch + 1)
        sum_x = sum_x + gx
        sum_y = sum_y + gy
        xx = xx + gx * gx
        xy = xy + gx * gy
        yy = yy + gy * gy
        store(space.gradient_x, k, gx)
        store(space.gradient_y, k, gy)
    # the sixteen sums of a vector, added up
    x = np.float64(total(sum_x))
    y = np.float64(total(sum_y))
    # removing a patch's mean removes the gradients' means from the Hessian
    h_xx = total(xx) - x * x / n
    h_xy = total(xy) - x * y / n
    h_yy = total(yy) - y * y / n
    trace = h_xx + h_yy
    determinant = h_xx * h_yy - h_xy * h_xy
    return Gradients(total(sum_t), x, y, h_xx, h_xy, h_yy, trace, determinant)


@inlined
def smaller_eigenvalue(gradients: Gradients) -> Scalar:
    """The smaller eigenvalue of the translation's Hessian: texture along the worse direction."""
    trace = gradients.trace
    return 0.5 * (trace - np.sqrt(max(trace * trace - 4 * gradients.determinant, 0.0)))


@inlined
def centre_template(space: Workspace, gradients: Gradients, n: float) -> Template:
    """Fill the template, the samples less their mean over `n` pixels; returns its sums."""
    # grey levels less their mean, and their sums with themselves and the gradients
    mean = np.float32(gradients.levels / n)
    mean_t = spread(mean)
    zero = spread(np.float32(0))
    tt = zero
    xt = zero
    yt = zero
    for k in range(0, space.length, 16):
        t = load(space.mask, k) * (load(space.frame, k + space.pitch + 1) - mean_t)
        tt = tt + t * t
        xt = xt + t * load(space.gradient_x, k)
        yt = yt + t * load(space.gradient_y, k)
        store(space.template, k, t)
    return Template(mean, np.float64(total(tt)), np.float64(total(xt)), np.float64(total(yt)))


@inlined
def bilinear_weights(x: Scalar, y: Scalar) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """Weights, a vector each, of a pixel, the ones right of it, below it, and below right, for a shift by parts."""
    w11 = spread(x * y)
    w01 = spread(x - x * y)
    w10 = spread(y - x * y)
    w00 = spread(np.float32(1) - x - y + x * y)
    return w00, w01, w10, w11


@inlined
def shifted(
    patch: Floats, k: int, pitch: int, weights: tuple[Scalar, Scalar, Scalar, Scalar]
) -> Scalar:
    """Sixteen pixels of the patch from index k on, shifted by a part of a pixel (`bilinear_weights`).

    Args:
        patch: float32, flat, grey levels.
        k: Index of the first pixel.
        pitch: Pixels a row.
        weights: Bilinear weights of the four pixels around each.
    """
    w00, w01, w10, w11 = weights
    upper = w00 * load(patch, k) + w01 * load(patch, k + 1)
    return upper + w10 * load(patch, k + pitch) + w11 * load(patch, k + pitch + 1)


@inlined
def patch_shift(
    x: Scalar, y: Scalar, margin: int, pitch: int
) -> tuple[Scalar, tuple[Scalar, Scalar, Scalar, Scalar]]:
    """An offset of the window in the patch: index of the window's first pixel, weights of the part of a pixel."""
    # whole pixels go into the index, the rest into the weights
    left = x + np.float32(margin)
    top = y + np.float32(margin)
    column = np.int64(left)
    row = np.int64(top)
    return row * pitch + column, bilinear_weights(left - np.float32(column), top - np.float32(row))


@inlined
def compare_with_template(
    space: Workspace, mean: Scalar, at: int, weights: tuple[Scalar, Scalar, Scalar, Scalar]
) -> tuple[Scalar, Scalar, Scalar, Scalar, Scalar]:
    """Sums over the window of the patch w, less the template's mean: of w, w^2, and w times template and gradients.

    Args:
        space: Patch, template and its gradients.
        mean: Mean grey level of the template.
        at: Index of the window's first pixel in the patch.
        weights: Bilinear weights of the part of a pixel by which the window is shifted.
    """
    # sums over the window, sixteen pixels at a time
    mean_t = spread(mean)
    zero = spread(np.float32(0))
    sum_w = zero
    ww = zero
    wt = zero
    wx = zero
    wy = zero
    for k in range(0, space.length, 16):
        w = load(space.mask, k) * (shifted(space.patch, at + k, space.pitch, weights) - mean_t)
        sum_w = sum_w + w
        ww = ww + w * w
        wt = wt + w * load(space.template, k)
        wx = wx + w * load(space.gradient_x, k)
        wy = wy + w * load(space.gradient_y, k)
    return total(sum_w), total(ww), total(wt), total(wx), total(wy)


@inlined
def align_translation(
    space: Workspace,
    gradients: Gradients,
    template: Template,
    warp: Warp,
    window: Window,
    n: float,
    best: Scalar,
    best_warp: Warp,
) -> tuple[Alignment, Scalar, Warp]:
    """Translate the window within the warped patch until it fits the template.

    Args:
        space: `Workspace` with patch, template and gradients.
        gradients: Gradients of the template (`template_gradients`).
        template: Its sums.
        warp: Warp of the patch: where the window lies in the target.
        window: Largest translation, number of steps, tolerance.
        n: Pixels of the window.
        best: Highest correlation so far.
        best_warp: Its warp.

    Returns:
        Where the translation ended, and the highest correlation with its warp.
    """
    # a window that reaches the patch's edge goes no further
    limit = np.float32(window.margin) - np.float32(0.01)
    x = np.float32(0)
    y = np.float32(0)
    sampled_x = x
    sampled_y = y
    mean = 0.0
    residual_x = 0.0
    residual_y = 0.0
    initial = np.float32(-1)
    for iteration in range(window.iterations + 1):
        sampled_x = x
        sampled_y = y
        # sums over the patch at the offset so far
        at, weights = patch_shift(x, y, window.margin, space.pitch)
        sum_w, ww, wt, wx, wy = compare_with_template(space, template.mean, at, weights)

        # zero-mean normalised correlation
        sum_of_w = np.float64(sum_w)
        mean = sum_of_w / n
        variance = ww - mean * sum_of_w
        # a flat target looks like anything
        score = np.float32(-1)
        if variance >= n * FLAT_VARIANCE:
            score = np.float32(wt / np.sqrt(variance * template.energy))
        if iteration == 0:
            initial = score
        if score > best:
            best = score
            best_warp = Warp(
                warp.a,
                warp.b,
                warp.x + warp.a * x - warp.b * y,
                warp.y + warp.b * x + warp.a * y,
            )

        # residuals, patch less template without their means, times the gradients
        residual_x = wx - mean * gradients.x - template.x
        residual_y = wy - mean * gradients.y - template.y
        if iteration == window.iterations:
            break

        # solve the 2 x 2 equations; 2, because gradients are differences over two pixels
        dx = np.float32(
            2 * (gradients.yy * residual_x - gradients.xy * residual_y) / gradients.determinant
        )
        dy = np.float32(
            2 * (gradients.xx * residual_y - gradients.xy * residual_x) / gradients.determinant
        )
        # inverse compositional: the increment of the template is taken back
        x = x - dx
        y = y - dy
        if not (abs(x) < limit and abs(y) < limit):
            x = min(max(x, -limit), limit)
            y = min(max(y, -limit), limit)
            break
        # a step below the tolerance
        if dx * dx + dy * dy < window.tolerance * window.tolerance:
            break
    alignment = Alignment(x, y, sampled_x, sampled_y, mean, residual_x, residual_y, initial)
    return alignment, best, best_warp


@inlined
def similarity_equations(
    space: Workspace,
    gradients: Gradients,
    template: Template,
    alignment: Alignment,
    window: Window,
    n: float,
) -> None:
    """Fill the normal equations of translation, scale (s) and rotation (r) where the patch was last sampled.

    Derivatives at offset (dx, dy) from the window's centre: ``s = gx dx + gy dy``, ``r = gy dx - gx
    dy``. As in `align_translation` the means of all derivatives are removed.
    """
    # the patch where it was sampled last
    at, weights = patch_shift(alignment.sampled_x, alignment.sampled_y, window.margin, space.pitch)
    mean_t = spread(template.mean)
    zero = spread(np.float32(0))
    # sums over the window, sixteen samples at a time: of each derivative, and of products of two of
    # {s, r, gx = x, gy = y, template t, patch w}
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
    for k in range(0, space.length, 16):
        # patch, gradients and offsets of these samples, and from them the two derivatives
        w = shifted(space.patch, at + k, space.pitch, weights) - mean_t
        gx = load(space.gradient_x, k)
        gy = load(space.gradient_y, k)
        dx = load(space.right, k)
        dy = load(space.down, k)
        s = gx * dx + gy * dy
        r = gy * dx - gx * dy
        t = load(space.template, k)
        sum_s = sum_s + s
        sum_r = sum_r + r
        sx = sx + s * gx
        sy = sy + s * gy
        rx = rx + r * gx
        ry = ry + r * gy
        ss = ss + s * s
        rr = rr + r * r
        rs = rs + r * s
        st = st + s * t
        rt = rt + r * t
        ws = ws + w * s
        wr = wr + w * r
    # the means of the derivatives are removed with these sums
    s_total = np.float64(total(sum_s))
    r_total = np.float64(total(sum_r))
    mean = alignment.mean

    # the right side: residuals times derivatives
    g = space.steepest
    g[0] = alignment.residual_x
    g[1] = alignment.residual_y
    g[2] = total(ws) - mean * s_total - np.float64(total(st))
    g[3] = total(wr) - mean * r_total - np.float64(total(rt))

    # the lower triangle of the Hessian; a prior holds scale and rotation back
    h = space.hessian
    damping = SIMILARITY_DAMPING * gradients.trace * (window.radius * window.radius)
    h[0, 0] = gradients.xx
    h[1, 0] = gradients.xy
    h[1, 1] = gradients.yy
    h[2, 0] = total(sx) - s_total * gradients.x / n
    h[2, 1] = total(sy) - s_total * gradients.y / n
    h[2, 2] = total(ss) - s_total * s_total / n + damping
    h[3, 0] = total(rx) - r_total * gradients.x / n
    h[3, 1] = total(ry) - r_total * gradients.y / n
    h[3, 2] = total(rs) - r_total * s_total / n
    h[3, 3] = total(rr) - r_total * r_total / n + damping
