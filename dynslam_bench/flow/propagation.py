"""Label propagation between neighbouring points: nearest neighbours, transported labels, common motions, consensus."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from dynslam_bench.core.compiled import Scalar, inlined, kernel
from dynslam_bench.flow.label_search import advance, scrambled
from dynslam_bench.flow.simd import Flags, Floats, Longs

NO_MOTION = np.empty((0, 4), dtype=np.float32)
NEIGHBOUR_WINDOW = 40
"""Points compared on each side, in the order of x, to find the nearest neighbours."""
MOST_NEIGHBOURS = 8
VOTERS = 256
"""Approximate number of points that vote on a hypothesis."""


@kernel
def transported_labels(
    start: int, stop: int, points: Floats, labels: Floats, turns: Floats, neighbours: Longs, motions: Floats,
    lower: Floats, upper: Floats, out: Floats,
) -> None:  # fmt: skip
    """Labels of neighbours and of common motions, as seen from each point.

    A neighbour's label is a similarity around the neighbour; at point p it means the displacement that this similarity
    gives p. Scale and rotation are clipped to the point's bounds; the displacement is not: a label of a neighbour
    is a tested match, and the bounds limit only where the search draws.

    Args:
        start: First point.
        stop: One past the last.
        points: float32 ``[N, 2]``.
        labels: float32 ``[N, 4]``, best labels of the previous phase.
        turns: float32 ``[N, 2]`` of `label_turns`.
        neighbours: int64 ``[N, K]``, indices; negative means none.
        motions: float32 ``[M, 4]``, similarities ``(a, b, tx, ty)``: ``p' = [[a, -b], [b, a]] p + t``; NaN means none.
        lower: float32 ``[N, 4]``.
        upper: float32 ``[N, 4]``.
        out: float32 ``[N, K + M, 4]``, NaN where there is none.
    """
    count = neighbours.shape[1]
    sizes, angles = np.empty(len(motions), dtype=np.float32), np.empty(len(motions), dtype=np.float32)
    for m in range(len(motions)):
        a, b = motions[m, 0], motions[m, 1]
        sizes[m] = np.float32(0.5) * np.float32(np.log2(max(a * a + b * b, np.float32(1e-12))))
        angles[m] = np.float32(np.arctan2(b, a))
    for i in range(start, stop):
        x, y = points[i, 0], points[i, 1]
        for k in range(count):
            j = neighbours[i, k]
            if j < 0:
                out[i, k, 0] = np.nan
                continue
            c, n = turns[j, 0], turns[j, 1]
            dx, dy = x - points[j, 0], y - points[j, 1]
            u = points[j, 0] + labels[j, 0] + c * dx - n * dy - x
            v = points[j, 1] + labels[j, 1] + n * dx + c * dy - y
            admit(out, i, k, u, v, labels[j, 2], labels[j, 3], lower, upper)
        for m in range(len(motions)):
            a, b = motions[m, 0], motions[m, 1]
            u, v = a * x - b * y + motions[m, 2] - x, b * x + a * y + motions[m, 3] - y
            admit(out, i, count + m, u, v, sizes[m], angles[m], lower, upper)


@inlined
def admit(
    out: Floats, i: int, k: int, u: Scalar, v: Scalar, s: Scalar, theta: Scalar, lower: Floats, upper: Floats
) -> None:
    """Store a candidate."""
    out[i, k, 0], out[i, k, 1] = u, v
    out[i, k, 2] = min(max(s, lower[i, 2]), upper[i, 2])
    out[i, k, 3] = min(max(theta, lower[i, 3]), upper[i, 3])


@kernel
def label_turns(labels: Floats) -> Floats:
    """What labels ``[N, 4]`` do to directions: ``2**s (cos theta, sin theta)``, float32 ``[N, 2]``."""
    turns = np.empty((len(labels), 2), dtype=np.float32)
    for i in range(len(labels)):
        scale = np.float32(np.exp2(labels[i, 2]))
        turns[i, 0] = np.float32(np.cos(labels[i, 3])) * scale
        turns[i, 1] = np.float32(np.sin(labels[i, 3])) * scale
    return turns


def labels_as_seen(points: Floats, labels: Floats, neighbours: Longs, motions: Floats = NO_MOTION) -> Floats:
    """`transported_labels` without bounds that matter, float32 ``[N, K + M, 4]``."""
    count = len(points)
    extent = np.full((count, 4), 8.0, dtype=np.float32)
    out = np.empty((count, neighbours.shape[1] + len(motions), 4), dtype=np.float32)
    transported_labels(0, count, points, labels, label_turns(labels), neighbours, motions, -extent, extent, out)
    return out


def common_motions(
    points: Floats, labels: Floats, costs: Longs, hypotheses: int, tolerance: Scalar, seed: Scalar, out: Floats
) -> None:
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
    if len(points) >= 4:  # partitioned in numpy: in a kernel it would add a tenth to the compile time of all kernels
        half = max(len(costs) // 2, 4)
        keys = costs * len(costs) + np.arange(len(costs))  # of equal costs the first
        better = np.sort(np.argpartition(keys, half - 1)[:half])
        motions_of(points, labels, better, hypotheses, tolerance, seed, out)


@kernel
def motions_of(
    points: Floats, labels: Floats, good: Longs, hypotheses: int, tolerance: Scalar, seed: Scalar, out: Floats
) -> None:
    """`common_motions` of the points with indices `good`; `out` holds NaN."""
    half = len(good)
    # where the good points lie and where their labels take them, one coordinate after the other for vector code
    x, y = np.empty(half, dtype=np.float32), np.empty(half, dtype=np.float32)
    to_x, to_y = np.empty(half, dtype=np.float32), np.empty(half, dtype=np.float32)
    count = 0
    for i in good:
        x[count], y[count] = points[i, 0], points[i, 1]
        to_x[count], to_y[count] = points[i, 0] + labels[i, 0], points[i, 1] + labels[i, 1]
        count += 1
    voters = np.empty((4, half), dtype=np.float32)
    state = np.uint64(seed) ^ np.uint64(0x5DEECE66D)
    limit = np.float32(tolerance * tolerance)
    for m in range(2):
        if count < 6:
            return
        voting = choose_voters(x, y, to_x, to_y, count, voters)
        best = 0
        for _ in range(hypotheses):
            state = advance(state)
            bits = scrambled(state)
            i = np.int64(((bits & np.uint64(0xFFFFFFFF)) * np.uint64(count)) >> np.uint64(32))
            j = np.int64(((bits >> np.uint64(32)) * np.uint64(count)) >> np.uint64(32))
            dx, dy = x[j] - x[i], y[j] - y[i]
            length = dx * dx + dy * dy
            if length < 400:
                continue
            ex, ey = to_x[j] - to_x[i], to_y[j] - to_y[i]
            a, b = (ex * dx + ey * dy) / length, (ey * dx - ex * dy) / length
            grown = a * a + b * b
            if grown < 0.15 or grown > 6.5:
                continue
            tx, ty = to_x[i] - a * x[i] + b * y[i], to_y[i] - b * x[i] - a * y[i]
            votes = count_votes(voters, voting, a, b, tx, ty, limit)
            if votes > best and votes >= 6:
                best = int(votes)
                out[m, 0], out[m, 1], out[m, 2], out[m, 3] = a, b, tx, ty
        if best == 0:
            return
        a, b, tx, ty = out[m, 0], out[m, 1], out[m, 2], out[m, 3]
        # the second motion is fitted to the points that do not follow the first
        count = drop_followers(x, y, to_x, to_y, count, a, b, tx, ty, 4 * limit)


@inlined
def choose_voters(x: Floats, y: Floats, to_x: Floats, to_y: Floats, count: int, voters: Floats) -> int:
    """Copy about `VOTERS` of `count` points, evenly spread, into ``voters`` ``[4, ...]``; returns how many."""
    voting, every = 0, -(-count // VOTERS)
    for k in range(0, count, every):
        voters[0, voting], voters[1, voting] = x[k], y[k]
        voters[2, voting], voters[3, voting] = to_x[k], to_y[k]
        voting += 1
    return voting


@inlined
def count_votes(voters: Floats, voting: int, a: Scalar, b: Scalar, tx: Scalar, ty: Scalar, limit: Scalar) -> Scalar:
    """How many voters a motion takes to where they were found, by squared distance."""
    from_x, from_y, goal_x, goal_y = voters[0, :voting], voters[1, :voting], voters[2, :voting], voters[3, :voting]
    votes = np.int32(0)
    for k in range(voting):
        rx, ry = a * from_x[k] - b * from_y[k] + tx - goal_x[k], b * from_x[k] + a * from_y[k] + ty - goal_y[k]
        votes = np.int32(votes + np.int32(rx * rx + ry * ry < limit))
    return votes


@inlined
def drop_followers(
    x: Floats, y: Floats, to_x: Floats, to_y: Floats, count: int, a: Scalar, b: Scalar, tx: Scalar, ty: Scalar,
    limit: Scalar,
) -> int:  # fmt: skip
    """Move those of `count` points that a motion misses by more than the root of `limit` forward; returns how many."""
    left = 0
    for k in range(count):
        rx, ry = a * x[k] - b * y[k] + tx - to_x[k], b * x[k] + a * y[k] + ty - to_y[k]
        if rx * rx + ry * ry >= limit:
            x[left], y[left], to_x[left], to_y[left] = x[k], y[k], to_x[k], to_y[k]
            left += 1
    return left


def nearest(points: Floats, run: Callable[..., Any]) -> Longs:
    """Indices ``[N, K]`` of each point's nearest others; `run` divides the work among threads."""
    n = len(points)
    neighbours = np.empty((n, min(MOST_NEIGHBOURS, n - 1)), dtype=np.int64)
    if n > 1:
        order = np.argsort(points[:, 0], kind="stable")
        run(nearest_neighbours, 0, n, points[order], order, NEIGHBOUR_WINDOW, neighbours)
    return neighbours


@kernel
def nearest_neighbours(start: int, stop: int, ordered: Floats, order: Longs, width: int, out: Longs) -> None:
    """The nearest other points of each point, in an approximate but deterministic search over rows of equal bands.

    Args:
        start: First position in the order.
        stop: One past the last.
        ordered: float32 ``[N, 2]``, the points sorted by x.
        order: int64 ``[N]``, their indices.
        width: Number of points compared on each side in that order.
        out: int64 ``[N, K]``, nearest first; -1 where there are fewer. Rows are points, not positions in the order.
    """
    n, count = out.shape
    best, index = np.empty(count, dtype=np.float32), np.empty(count, dtype=np.int64)
    distances = np.empty(2 * width + 1, dtype=np.float32)
    for place in range(start, stop):
        x, y = ordered[place, 0], ordered[place, 1]
        first, last = max(0, place - width), min(n, place + width + 1)
        for k in range(last - first):
            dx, dy = ordered[first + k, 0] - x, ordered[first + k, 1] - y
            distances[k] = dx * dx + dy * dy
        distances[place - first] = np.inf
        best[:], index[:] = np.inf, -1
        worst = np.float32(np.inf)
        for k in range(last - first):
            distance = distances[k]
            if distance < worst:
                slot = count - 1
                while slot > 0 and best[slot - 1] > distance:
                    best[slot], index[slot] = best[slot - 1], index[slot - 1]
                    slot -= 1
                best[slot], index[slot] = distance, order[first + k]
                worst = best[count - 1]
        i = order[place]
        for slot in range(count):
            out[i, slot] = index[slot]


def dissenting_labels(predictions: Floats, labels: Floats, tolerance: Scalar) -> tuple[Floats, Flags]:
    """Find points whose neighbours agree with each other but not with the point, e.g. one period off on a texture.

    Args:
        predictions: float32 ``[N, K, 4]``, the neighbours' labels as seen from each point; NaN means none.
        labels: float32 ``[N, 4]``, the points' own labels.
        tolerance: Displacements this close agree, pixels.

    Returns:
        float32 ``[N, 4]``, the prediction on which most neighbours agree, and bool ``[N]``, whether it has more support
        than the point's own label.
    """
    limit, (u, v) = tolerance * tolerance, np.moveaxis(predictions[:, :, :2], 2, 0)
    du, dv = u[:, :, None] - u[:, None], v[:, :, None] - v[:, None]
    support = np.count_nonzero(du * du + dv * dv < limit, axis=2)
    du, dv = u - labels[:, :1], v - labels[:, 1:2]
    away = du * du + dv * dv
    choice = np.arange(len(labels)), support.argmax(axis=1)
    most, own = support[choice], np.count_nonzero(away < limit, axis=1)
    return predictions[choice], (most > 1) & (most > own) & (away[choice] >= limit)
