"""A parabola through matching costs: the first sub-pixel step of a label."""

from __future__ import annotations

import numpy as np

from dynslam_bench.core.compiled import Scalar, inlined, kernel

from ..kernels.arrays import Floats, Longs
from .cost import CostTables, Reference, Side, label_cost


@kernel
def parabola(
    start: int, stop: int, labels: Floats, step: float, reference: Reference, target: Side, tables: CostTables,
    used: Longs,
) -> None:  # fmt: skip
    """Move each label to the vertex of the parabolas through its cost and those `step` pixels beside it.

    Args:
        start: First point.
        stop: One past the last.
        labels: float32 ``[N, 4]``, changed in place; moves by at most `step`.
        step: Pixels.
        reference: `cost.Reference`.
        target: `cost.Side`.
        tables: `cost.CostTables`.
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
def vertex(before: Scalar, middle: Scalar, after: Scalar) -> Scalar:
    """Position of the minimum of a parabola through values at -1, 0, 1, within these; 0 if it is not convex."""
    curvature = before + after - 2 * middle
    if curvature <= 0:
        return np.float32(0)
    return min(max(np.float32(before - after) / np.float32(2 * curvature), np.float32(-1)), np.float32(1))
