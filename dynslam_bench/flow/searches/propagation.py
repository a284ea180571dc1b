"""What neighbouring points tell each other between the phases of a search: their labels, and the motions they share."""

from __future__ import annotations

import numpy as np

from .._jit import inlined, kernel


@kernel
def transported_labels(start, stop, points, labels, neighbours, motions, lower, upper, out):  # type: ignore[no-untyped-def]
    """Labels of neighbours and of common motions, as seen from each point.

    A neighbour's label is a similarity around the neighbour; at point p it means the displacement that this similarity
    gives p. Scale and rotation are clipped to the point's box; the displacement is not: what neighbours have found
    is no random guess (the box is where the search starts, not what the scene obeys).

    Args:
        start: First point.
        stop: One past the last.
        points: float32 ``[N, 2]``.
        labels: float32 ``[N, 4]``, best labels of the previous phase.
        neighbours: int64 ``[N, K]``, indices; negative means none.
        motions: float32 ``[M, 4]``, similarities ``(a, b, tx, ty)``: ``p' = [[a, -b], [b, a]] p + t``; NaN means none.
        lower: float32 ``[N, 4]``.
        upper: float32 ``[N, 4]``.
        out: float32 ``[N, K + M, 4]``, NaN where there is none.
    """
    count = neighbours.shape[1]
    for i in range(start, stop):
        x, y = points[i, 0], points[i, 1]
        for k in range(count):
            j = neighbours[i, k]
            if j < 0:
                out[i, k, 0] = np.nan
                continue
            s, theta = labels[j, 2], labels[j, 3]
            scale = np.float32(np.exp2(s))
            c, n = np.float32(np.cos(theta)) * scale, np.float32(np.sin(theta)) * scale
            dx, dy = x - points[j, 0], y - points[j, 1]
            u = points[j, 0] + labels[j, 0] + c * dx - n * dy - x
            v = points[j, 1] + labels[j, 1] + n * dx + c * dy - y
            admit(out[i, k], u, v, s, theta, lower[i], upper[i])
        for m in range(len(motions)):
            a, b = motions[m, 0], motions[m, 1]
            u, v = a * x - b * y + motions[m, 2] - x, b * x + a * y + motions[m, 3] - y
            s = np.float32(0.5) * np.float32(np.log2(max(a * a + b * b, np.float32(1e-12))))
            admit(out[i, count + m], u, v, s, np.float32(np.arctan2(b, a)), lower[i], upper[i])


@inlined
def admit(out, u, v, s, theta, lower, upper):  # type: ignore[no-untyped-def]
    """Store a candidate."""
    out[0], out[1] = u, v
    out[2] = min(max(s, lower[2]), upper[2])
    out[3] = min(max(theta, lower[3]), upper[3])


@kernel
def common_motions(points, labels, costs, hypotheses, tolerance, seed, out):  # type: ignore[no-untyped-def]
    """Up to two similarity motions with which most points agree (RANSAC over pairs of well-matched points).

    Args:
        points: float32 ``[N, 2]``.
        labels: float32 ``[N, 4]``.
        costs: int64 ``[N]``; pairs are drawn from the better half.
        hypotheses: Number of pairs tried for each motion.
        tolerance: Distance in pixels at which a point agrees.
        seed: Of the frame.
        out: float32 ``[2, 4]``, ``(a, b, tx, ty)``; NaN where fewer than 6 points agree.
    """
    out[:] = np.nan
    n = len(points)
    if n < 4:
        return
    order = np.argsort(costs)
    half = max(n // 2, 4)
    free = np.ones(n, dtype=np.bool_)
    stride = max(1, half // 256)
    state = np.uint64(seed) ^ np.uint64(0x5DEECE66D)
    limit = tolerance * tolerance
    for m in range(2):
        best = 0
        for _ in range(hypotheses):
            state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
            i = order[np.int64((state >> np.uint64(33)) % np.uint64(half))]
            state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
            j = order[np.int64((state >> np.uint64(33)) % np.uint64(half))]
            if i == j or not free[i] or not free[j]:
                continue
            dx, dy = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1]
            length = dx * dx + dy * dy
            if length < 400:
                continue
            ex, ey = dx + labels[j, 0] - labels[i, 0], dy + labels[j, 1] - labels[i, 1]
            a, b = (ex * dx + ey * dy) / length, (ey * dx - ex * dy) / length
            grown = a * a + b * b
            if grown < 0.15 or grown > 6.5:
                continue
            tx = points[i, 0] + labels[i, 0] - a * points[i, 0] + b * points[i, 1]
            ty = points[i, 1] + labels[i, 1] - b * points[i, 0] - a * points[i, 1]
            votes = 0
            for r in range(0, half, stride):
                k = order[r]
                if free[k]:
                    x, y = points[k, 0], points[k, 1]
                    rx, ry = a * x - b * y + tx - x - labels[k, 0], b * x + a * y + ty - y - labels[k, 1]
                    if rx * rx + ry * ry < limit:
                        votes += 1
            if votes > best and votes >= 6:
                best = votes
                out[m, 0], out[m, 1], out[m, 2], out[m, 3] = a, b, tx, ty
        if best == 0:
            return
        a, b, tx, ty = out[m, 0], out[m, 1], out[m, 2], out[m, 3]
        for k in range(n):
            x, y = points[k, 0], points[k, 1]
            rx, ry = a * x - b * y + tx - x - labels[k, 0], b * x + a * y + ty - y - labels[k, 1]
            if rx * rx + ry * ry < 4 * limit:
                free[k] = False
